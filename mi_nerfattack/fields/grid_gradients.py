"""Derivatives between a grid field's parameters and what kernels read of them.

Kernels read one packed array. Derivative passes need a leaf there: inside an
operation, Dr.Jit neither passes tangents on to what was derived from a parameter
before, nor should it unpack a gradient once a frame.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import drjit as dr
import mitsuba as mi

from mi_nerfattack.fields.grid import GridField


@contextmanager
def tangents(field: GridField) -> Iterator[None]:
    """Give the packed array the tangents of ``colour`` and ``density``."""
    before, by_texture = field.packed, dr.zeros(mi.Float, 3 * field.n_vertices)
    colour = field.colours.value
    if dr.grad_enabled(colour):
        by_texture = field.colours.tangent(dr.grad(colour).array)
    tangent = field.pack(by_texture, dr.grad(field.parameters()["density"]))
    field.packed = mi.Float(dr.detach(before))
    dr.enable_grad(field.packed)
    dr.set_grad(field.packed, tangent)
    try:
        yield
    finally:
        field.packed = before


def start_gradient(field: GridField) -> mi.Float:
    """Make the packed array a fresh leaf with gradient zero.

    Returns:
        the array that it replaces.
    """
    before = field.packed
    leaf = mi.Float(dr.detach(before))
    dr.enable_grad(leaf)
    field.packed = leaf
    dr.set_grad(leaf, dr.opaque(mi.Float, 0, dr.width(leaf)))
    return before


def gradient(field: GridField, name: str) -> Any:
    """Return what the packed array has gathered, by one parameter, of its shape.

    Args:
        field: whose gradient was started.
        name: ``texture``, ``colour`` or ``density``.
    """
    packed = dr.grad(field.packed)
    if name == "density":
        return dr.gather(mi.Float, packed, 4 * dr.arange(mi.UInt32, field.n_vertices))
    by_texture = field.texture_gradient(packed)
    return by_texture if name == "texture" else field.colours.gradient(by_texture)
