"""Radiance fields: data, point evaluation, occupancy, files."""

from mi_nerfattack.fields.base import AbstractField
from mi_nerfattack.fields.grid import GridField, GridLayout
from mi_nerfattack.fields.io import load_field, load_grid, save_field
from mi_nerfattack.fields.ngp import NGPField, NGPLayout
from mi_nerfattack.fields.occupancy import Occupancy

__all__ = [
    "AbstractField",
    "GridField",
    "GridLayout",
    "NGPField",
    "NGPLayout",
    "Occupancy",
    "load_field",
    "load_grid",
    "save_field",
]
