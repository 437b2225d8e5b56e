"""Friction estimation and missing physics for legged robots, on Drake.

    import fbse_drake as fd

    log = fd.simulate(fd.load_scenario("paper_walk")).log
    fd.study(fd.load_scenario("paper_walk"), log).save("out/study")

Everything a user needs is here: `__init__.pyi` says where each name comes from, and a name is
imported when it is asked for (Drake takes seconds, and `fbse --help` does without). Modules below
this one may change between versions.
"""

import lazy_loader

_imported, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)


def __getattr__(name: str) -> object:
    if name != "__version__":
        return _imported(name)
    from importlib.metadata import version

    return version(__name__)
