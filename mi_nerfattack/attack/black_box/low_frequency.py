"""Colours of objects by few coefficients, for searches in few dimensions."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mi_nerfattack.attack.black_box.search import Proposal, propose
from mi_nerfattack.attack.texture.colours import Colours
from mi_nerfattack.errors import InputError


class LowFrequency:
    """Changes of colour on a coarse lattice around each object, interpolated.

    Trilinear between as many vertices as the number of coefficients allows, as many of
    each object, and more along its longer edges; all zeros are the original textures,
    or others. Colours that are not allowed are projected.

    Args:
        colourings: of the objects.
        most: coefficients of all objects together, at most.
        middle: (n, 3) colours of each object that zeros give; the original by default.

    Attributes:
        count: of coefficients, 3 a vertex: changes of sRGB values.

    Raises:
        InputError: not even one colour an object is left.
    """

    def __init__(
        self,
        colourings: Sequence[Colours],
        most: int,
        middle: Sequence[np.ndarray] | None = None,
    ) -> None:
        vertices = most // (3 * len(colourings))
        if not vertices:
            raise InputError(
                f"coefficients: {most}; {len(colourings)} objects need at least "
                f"{3 * len(colourings)}"
            )
        self.colourings = colourings
        self._middle = [c.start for c in colourings] if middle is None else middle
        # A coarse lattice for each object, and its interpolation along every axis
        self._weights = [
            [_weights(c.level.resolution, n) for n in lattice(c.extent, vertices)]
            for c in colourings
        ]
        # Where the coefficients of one object end and those of the next object begin
        self._ends = np.cumsum([np.prod(_shape(axes)) for axes in self._weights])
        self.count: int = int(self._ends[-1])

    def propose(self, coefficients: np.ndarray) -> Proposal:
        """Return what coefficients make: (count,), by x, y, z, channel, in C order."""
        per_object = np.split(np.asarray(coefficients), self._ends[:-1])
        colours = [
            colouring.project(start + _spread(part, axes))
            for colouring, start, part, axes in zip(
                self.colourings, self._middle, per_object, self._weights, strict=True
            )
        ]
        return propose(self.colourings, colours)


def lattice(extent: np.ndarray, most: int) -> tuple[int, int, int]:
    """Return numbers of vertices along x, y, z that cover a box most evenly.

    The largest room of a vertex along an edge is as small as can be, then the next.

    Args:
        extent: (3,), of the box.
        most: vertices, at least 1.
    """
    shapes = [
        (x, y, most // (x * y))
        for x in range(1, most + 1)
        for y in range(1, most // x + 1)
    ]
    return min(shapes, key=lambda shape: sorted(extent / shape, reverse=True))


def _weights(fine: int, coarse: int) -> np.ndarray:
    """Return what (fine, coarse) each coarse vertex is of each fine one, linearly."""
    at = np.linspace(0, coarse - 1, fine)[:, None]
    return np.clip(1 - np.abs(at - np.arange(coarse)), 0, 1)


def _shape(axes: Sequence[np.ndarray]) -> tuple[int, ...]:
    """Return vertices along x, y, z, and channels."""
    return *(weights.shape[1] for weights in axes), 3


def _spread(part: np.ndarray, axes: Sequence[np.ndarray]) -> np.ndarray:
    values = part.reshape(_shape(axes))
    dense = np.einsum("xi,yj,zk,ijkc->zyxc", *axes, values, optimize=True)
    return dense.reshape(-1, 3).astype(np.float32)
