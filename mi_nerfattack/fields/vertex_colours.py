"""The colours of a grid field's finest level, and derivatives by its parameters.

Kernels read one packed array. Derivative passes need a leaf there: inside an
operation, Dr.Jit neither passes tangents on to what was derived from a parameter
before, nor should it unpack a gradient once a frame.
"""

from __future__ import annotations

import weakref
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import drjit as dr
import mitsuba as mi

from mi_nerfattack.errors import InputError
from mi_nerfattack.fields.levels import colours_of, is_same_beside, without

if TYPE_CHECKING:
    from mi_nerfattack.fields.grid import GridField

_MARGIN = (
    1e-4  # colours of a texture are cut to [margin, 1 - margin]: logits stay finite
)


class VertexColours:
    """The sRGB colours c of the vertices of a grid field's finest level.

    A grid field's colour is the sigmoid of a sum over levels. So equal steps on all
    levels add up, and colours far out on the sigmoid hardly move any more. Steps in c
    have neither effect. Let c0 be the colours that the texture gives. Then::

        raw(finest level) = raw(finest level of the texture) + logit(c) - logit(c0)

    Where c = c0, this is the texture to the bit.

    Args:
        field: whose texture they are of.

    Attributes:
        value: tensor (n, 3), the colours; the same object for good.
    """

    def __init__(self, field: GridField) -> None:
        self._field = weakref.ref(field)  # which has this object
        level = field.levels()[-1]
        self._start: int = level.vertices.start
        index = dr.arange(mi.UInt32, level.resolution**3)
        row = index // level.resolution
        place = mi.Point3f(index % level.resolution, row % level.resolution, 0)
        place.z = row // level.resolution
        self._places = dr.minimum(place / level.scale, 1 - 1e-6)  # in the unit cube
        # Sums of the other levels' raw colours there, and of which texture
        self._others, self._summed = mi.Float(0), mi.Float(0)
        self.value: mi.TensorXf = mi.TensorXf()
        self.read()

    @property
    def field(self) -> GridField:
        """The field whose colours they are."""
        field = self._field()
        assert field is not None, "colours outlive their field"
        return field

    def read(self) -> None:
        """Take the colours from the field's texture, which has been replaced.

        All levels are added up only if others than the finest have changed.
        """
        with dr.suspend_grad():
            texture = mi.Float(dr.detach(self.field.texture.array))
            finest = self.field.levels()[-1]
            if not is_same_beside(finest, texture, self._summed):
                masked = without(finest, texture)
                self._others = mi.Color3f(*self.field.sums(self._places, masked)[1:])
                self._others, self._summed = dr.ravel(self._others), texture
            self._texture = texture
            raw = self._others + colours_of(finest, texture)
            colours = dr.clip(1 / (1 + dr.exp(-raw)), _MARGIN, 1 - _MARGIN)
            self._raw = _logit(colours)
            dr.eval(self._others, self._raw, colours)
            shape = (dr.width(colours) // 3, 3)
            mi.set_property(self.value, mi.TensorXf(colours, shape))

    def replace(self, value: Any) -> mi.Float:
        """Replace the colours.

        Args:
            value: tensor (n, 3) in (0, 1), sRGB.

        Returns:
            the texture (3 n_vertices,), raw colours; differentiable by `value`.

        Raises:
            InputError: another shape, or a colour that is not between 0 and 1.
        """
        # `value` may be the tensor that `mi.traverse` shows and a user has resized
        expected = (dr.width(self._raw) // 3, 3)
        if tuple(value.shape) != expected:
            raise InputError(f"colour: shape {tuple(value.shape)}; expected {expected}")
        flat = mi.Float(value.array)
        good = dr.detach((flat > 0) & (flat < 1))
        if not dr.all(good):
            count = int(dr.count(~good)[0])
            raise InputError(
                f"colour: {count} of {dr.width(flat)} values are not between 0 and 1; "
                "clip them after each step, for instance to 0.01 and 0.99"
            )
        if value is not self.value:
            mi.set_property(self.value, value)
        index = dr.arange(mi.UInt32, dr.width(self._texture))
        finest = index >= 3 * self._start
        place = index - 3 * self._start
        # Gathered first, so that the derivatives of many images add up in place.
        colour = dr.select(finest, dr.gather(mi.Float, flat, place, finest), 0.5)
        start = dr.gather(mi.Float, self._raw, place, finest)
        return self._texture + (_logit(colour) - start)

    def gradient(self, by_texture: mi.TensorXf) -> mi.TensorXf:
        """Return the colours' gradient (n, 3) from the texture's (n_vertices, 3)."""
        value = dr.detach(self.value.array)
        index = 3 * self._start + dr.arange(mi.UInt32, dr.width(value))
        slope = dr.gather(mi.Float, by_texture.array, index) / (value * (1 - value))
        return mi.TensorXf(slope, tuple(self.value.shape))

    def tangent(self, tangent: mi.Float) -> mi.Float:
        """Return the texture's tangent (3 n_vertices,) from that of the colours."""
        value = dr.detach(self.value.array)
        slope = tangent / (value * (1 - value))
        index = dr.arange(mi.UInt32, dr.width(self._texture))
        finest = index >= 3 * self._start
        return dr.gather(mi.Float, slope, index - 3 * self._start, finest) & finest


@contextmanager
def tangents(field: GridField) -> Iterator[None]:
    """Give the packed array the tangents of ``colour`` and ``density``."""
    field.refuse_one_level("forward mode")
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
        field.refuse_one_level(name)
        return dr.gather(mi.Float, packed, 4 * dr.arange(mi.UInt32, field.n_vertices))
    by_texture = field.texture_gradient(packed)
    return by_texture if name == "texture" else field.colours.gradient(by_texture)


def _logit(colour: mi.Float) -> mi.Float:
    return dr.log(colour / (1 - colour))
