"""A real car: its devices, its drive, and what keeps the drive safe."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
