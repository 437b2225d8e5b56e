"""Friction estimation and missing physics for legged robots, on Drake.

    import fbse_drake as fd

    log = fd.simulate(fd.load_scenario("paper_walk")).log
    fd.study(fd.load_scenario("paper_walk"), log).save("out/study")

Everything a user needs is here: `__init__.pyi` says where each name comes from, and a name is
imported when it is asked for (Drake takes seconds, and `fbse --help` does without). Modules below
this one may change between versions.
"""

from importlib.metadata import version

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
__version__ = version(__name__)
