"""Closed-loop error and its intervals; fields against scenes."""

import lazy_loader

from mi_nerfattack.extras import require

require("an evaluation", "pandas")
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
