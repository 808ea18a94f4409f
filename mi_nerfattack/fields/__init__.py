"""Radiance fields: data, point evaluation, occupancy, files."""

from typing import TYPE_CHECKING

from mi_nerfattack._lazy import lazy

if TYPE_CHECKING:
    from .base import AbstractField as AbstractField
    from .grid import GridField as GridField
    from .grid import GridLayout as GridLayout
    from .io import load_field as load_field
    from .io import load_grid as load_grid
    from .io import save_field as save_field
    from .ngp import NGPField as NGPField
    from .ngp import NGPLayout as NGPLayout
    from .occupancy import Occupancy as Occupancy
    from .splats import read_splats as read_splats

__getattr__, __dir__ = lazy(__name__)
