"""Files of all kinds, checked and atomic: the only place that opens user files."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
