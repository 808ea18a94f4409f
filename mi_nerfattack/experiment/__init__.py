"""One attack as a job: stages, run folder, results."""

import lazy_loader

from mi_nerfattack.extras import require

require("an experiment", "matplotlib", "pandas")
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
