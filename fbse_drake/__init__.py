"""Friction estimation and missing physics for legged robots, on Drake.

    import fbse_drake as fd

    log = fd.simulate(fd.load_scenario("paper_walk")).log
    fd.study(fd.load_scenario("paper_walk"), log).save("out/study")

Everything a user needs is here: `__init__.pyi` says where each name comes from, and type checkers
and editors read it. Modules below this one may change between versions.
"""

import ast
import sys
from importlib.resources import files
from types import ModuleType


def _exports() -> dict[str, str]:
    """The module of every public name, as the stub of this package says."""
    stub = ast.parse(files(__name__).joinpath("__init__.pyi").read_text(encoding="utf-8"))
    return {
        alias.asname: f"{statement.module}:{alias.name}"
        for statement in stub.body
        if isinstance(statement, ast.ImportFrom)
        for alias in statement.names
        if alias.asname
    }


class _Package(ModuleType):
    """Imports a public name when it is asked for: Drake takes seconds, and `fbse --help` does
    without."""


def _offered(place: str) -> property:
    module, _, name = place.partition(":")

    def load(package: ModuleType) -> object:  # noqa: ARG001
        # As `from module import name`: the name may be that of a module, too.
        return getattr(__import__(module, fromlist=[name]), name)

    def keep(package: ModuleType, module: object) -> None:
        """`simulate` is the function, also when the module of that name has been imported."""

    return property(load, keep)


class _Version:
    """The version of the installed package."""

    def __get__(self, package: ModuleType, kind: type) -> str:
        from importlib.metadata import version

        return version(package.__name__)


_PLACES = _exports()
__all__ = sorted(_PLACES)
for _name, _place in _PLACES.items():
    setattr(_Package, _name, _offered(_place))
_Package.__version__ = _Version()
sys.modules[__name__].__class__ = _Package
