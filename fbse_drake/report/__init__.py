"""Figures, numbers and pages of logs and of results."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach(__name__, submodules=["figures", "metrics"])
