"""Closed-loop drives: what decides them, a store, the runner, and their tables."""

import lazy_loader

from mi_nerfattack.extras import require

require("a table of drives", "pandas")
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
