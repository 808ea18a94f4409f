"""What a run leaves behind: metrics, tables, EXR frames, plots and a page."""

import lazy_loader

from mi_nerfattack.extras import require

require("a report", "matplotlib", "pandas")
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
