"""Colours of objects by few coefficients, for searches in few dimensions."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mi_nerfattack.attack.black_box.search import Proposal, propose
from mi_nerfattack.attack.texture.colours import Colours
from mi_nerfattack.errors import InputError


class LowFrequency:
    """Changes of colour on a coarse lattice around each object, interpolated.

    Trilinear between as many vertices as the number of coefficients allows; all zeros
    are the original textures, or others. Colours that are not allowed are projected.

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
        edge = int(np.cbrt(vertices) + 1e-9)
        self.colourings = colourings
        self._middle = [c.start for c in colourings] if middle is None else middle
        self._shape = (len(colourings), edge, edge, edge, 3)
        self.count = int(np.prod(self._shape))
        self._weights = [_weights(c.level.resolution, edge) for c in colourings]

    def propose(self, coefficients: np.ndarray) -> Proposal:
        """Return what coefficients (count,) make."""
        lattices = np.reshape(coefficients, self._shape)
        changes = map(_spread, lattices, self._weights)
        colours = [
            colouring.project(start + change)
            for colouring, start, change in zip(
                self.colourings, self._middle, changes, strict=True
            )
        ]
        return propose(self.colourings, colours)


def _weights(fine: int, coarse: int) -> np.ndarray:
    """Return what (fine, coarse) each coarse vertex is of each fine one, linearly."""
    at = np.linspace(0, coarse - 1, fine)[:, None]
    return np.clip(1 - np.abs(at - np.arange(coarse)), 0, 1)


def _spread(lattice: np.ndarray, weights: np.ndarray) -> np.ndarray:
    w = weights
    dense = np.einsum("zi,yj,xk,ijkc->zyxc", w, w, w, lattice, optimize=True)
    return dense.reshape(-1, 3).astype(np.float32)
