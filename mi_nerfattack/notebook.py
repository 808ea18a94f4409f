"""The small picture by which a notebook shows an object.

``report.small`` draws it with matplotlib, a second of loading. That part imports
the parts whose objects it draws, so these can find it only by its name, and do so when
a notebook asks for a picture.
"""

from __future__ import annotations

from importlib import import_module
from typing import Any


def picture(thing: Any) -> bytes:
    """Draw an object that `report.small.draw` knows; return a PNG file."""
    return import_module("mi_nerfattack.report.small").draw(thing)
