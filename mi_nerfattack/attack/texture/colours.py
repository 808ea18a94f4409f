"""What an attack steps in: the colours of an object, whatever its levels.

An attack steps in the colours c of one level's vertices (sRGB), see `VertexColours`,
from the original ones c0::

    raw(level) = original raw(level) + logit(c) - logit(c0)

Where nothing was changed, the texture is the original to the bit. A step of `rate` is a
change of colour by `rate`, and the projection onto what is allowed is exact.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy.ndimage import convolve1d

from mi_nerfattack.attack.texture.constraints import Allowed, Constraints, vertex_points
from mi_nerfattack.backend.arrays import upload_rows
from mi_nerfattack.errors import InputError
from mi_nerfattack.fields.grid import GridField
from mi_nerfattack.fields.levels import GridLevel

_BINOMIAL = (0.25, 0.5, 0.25)


class AbstractColouring(ABC):
    """Parameters of one object's texture, and what a texture is of them.

    Attributes:
        start: (n, 3) float32, the parameters of the original texture.
    """

    start: np.ndarray

    @abstractmethod
    def texture(self, value: np.ndarray) -> np.ndarray:
        """Return the texture (n_vertices, 3), raw colours, of parameters (n, 3)."""

    @abstractmethod
    def gradient(self, value: np.ndarray, by_texture: np.ndarray) -> np.ndarray:
        """Return the derivative (n, 3) by the parameters, that of the penalty added.

        Args:
            value: (n, 3), the parameters.
            by_texture: (n_vertices, 3), derivative by the texture.
        """

    def near(self, texture: np.ndarray) -> np.ndarray:
        """Return allowed parameters (n, 3) whose texture looks like another one.

        Args:
            texture: (n_vertices, 3), raw colours.

        Raises:
            InputError: there is no way to tell.
        """
        raise InputError(
            f"{type(self).__name__}: has no parameters near a given texture; leave "
            "out opening 'restarts'"
        )

    def smoothed(self, gradient: np.ndarray) -> np.ndarray:
        """Return the direction (n, 3) that parameters step against."""
        return gradient

    def project(self, value: np.ndarray) -> np.ndarray:
        """Return parameters (n, 3) that are allowed, near to given ones."""
        return value

    def penalty(self, value: np.ndarray) -> float:
        """Return what is added to the objective."""
        del value
        return 0.0


class Colours(AbstractColouring):
    """Colours of one level's vertices.

    Adam takes steps of one size everywhere, so neighbours that hardly differ may take
    opposite steps. Smoothing the gradient lets them go together.

    Args:
        field: of the object, with its original texture.
        resolution: the finest level of at most so many vertices an edge is stepped in;
            the finest of all by default.
        smoothing: passes of a binomial filter over neighbouring vertices' gradients.
        constraints: what colours are allowed.

    Attributes:
        extent: (3,), of the lattice along x, y, z of the object's own frame, metres.

    Raises:
        InputError: no level is so coarse, or a fixed region misses the object.
    """

    def __init__(
        self,
        field: GridField,
        resolution: int | None = None,
        smoothing: int = 0,
        constraints: Constraints | None = None,
    ) -> None:
        levels = [
            level
            for level in field.levels()
            if resolution is None or level.resolution <= resolution
        ]
        if not levels:
            raise InputError(
                f"resolution: {resolution}; the coarsest level of the object has "
                f"{field.levels()[0].resolution} vertices an edge"
            )
        self.level: GridLevel = levels[-1]
        self.extent = field.upper - field.lower
        self.smoothing = smoothing
        self._field = field
        self._original = field.texture.numpy().copy()
        # A colour of exactly 0 or 1 has no finite logit
        colours = np.clip(vertex_colours(field, self.level), 1e-4, 1 - 1e-4)
        self._allowed = Allowed(
            constraints or Constraints(), field, self.level, original=colours
        )
        self._raw = _logit(colours)
        self.start: np.ndarray = self._allowed.start

    @property
    def is_limited(self) -> bool:
        """Whether some colours are not allowed, or cost a penalty."""
        return self._allowed.constraints.are_set

    def texture(self, value: np.ndarray) -> np.ndarray:
        """See :meth:`AbstractColouring.texture`."""
        # Levels add up before the sigmoid, so one level can take the whole change
        raw = self._original.copy()
        raw[self.level.vertices] += _logit(value) - self._raw
        return raw

    def gradient(self, value: np.ndarray, by_texture: np.ndarray) -> np.ndarray:
        """See :meth:`AbstractColouring.gradient`."""
        # d logit(c) = dc / (c (1 - c))
        slope = by_texture[self.level.vertices] / (value * (1 - value))
        return slope + self._allowed.penalty(value)[1]

    def smoothed(self, gradient: np.ndarray) -> np.ndarray:
        """Filter along z, y and x, see :meth:`AbstractColouring.smoothed`."""
        # The binomial filter is separable: one axis after the other
        cube = gradient.reshape((self.level.resolution,) * 3 + (3,))
        for _ in range(self.smoothing):
            for axis in range(3):
                cube = convolve1d(cube, _BINOMIAL, axis, mode="constant")
        return cube.reshape(gradient.shape)

    def near(self, texture: np.ndarray) -> np.ndarray:
        """See :meth:`AbstractColouring.near`."""
        # All levels add up to a colour, so the field takes the texture for a moment
        before = self._field.texture.numpy().copy()
        try:
            self._field.set_parameter("texture", texture)
            colours = vertex_colours(self._field, self.level)
        finally:
            self._field.set_parameter("texture", before)
        return self.project(np.clip(colours, 1e-4, 1 - 1e-4))

    def project(self, value: np.ndarray) -> np.ndarray:
        """See :meth:`AbstractColouring.project`."""
        return self._allowed.project(value)

    def penalty(self, value: np.ndarray) -> float:
        """See :meth:`AbstractColouring.penalty`."""
        return self._allowed.penalty(value)[0]


def vertex_colours(
    field: GridField, level: GridLevel, chosen: np.ndarray | None = None
) -> np.ndarray:
    """Return the colours of a level's vertices, (k, 3) float32, sRGB.

    Args:
        field: with its texture.
        level: one of `field.levels()`.
        chosen: (n, n, n) by z, y, x, of bool; all vertices by default.
    """
    points = upload_rows(mi.Point3f, vertex_points(field, level, chosen))
    linear: Any = field.eval_everywhere(points, mi.Vector3f(0, 0, 1), mi.Bool(True))[1]
    return dr.linear_to_srgb(linear).numpy().T


def _logit(colour: np.ndarray) -> np.ndarray:
    return np.log(colour / (1 - colour))
