"""Positions that come in from files: how far from the origin they may be."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from mi_nerfattack.errors import InputError

#: From here on, single precision loses a millimetre.
FAR_M = 10_000.0


def require_near(
    where: str | Path, positions: np.ndarray, extents: float = 2.0
) -> None:
    """Refuse positions that are far from the origin, as those of maps are.

    Rays and states are computed in single precision, which loses centimetres there.
    The outermost twentieths do not count: they may be outliers.

    Args:
        where: what holds the positions, for the message.
        positions: (n, k), n >= 1, metres, finite.
        extents: how many of the positions' own extents away they may be.

    Raises:
        InputError: the middle of the positions is farther from the origin than `FAR_M`
            and than `extents`; the message has the shift to subtract.
    """
    low, high = np.percentile(np.asarray(positions, np.float64), [5, 95], axis=0)
    middle, extent = low / 2 + high / 2, float((high / 2 - low / 2).max()) * 2
    if np.abs(middle).max() > max(FAR_M, extents * extent):
        shift = ", ".join(f"{value:.0f}" for value in middle)
        raise InputError(
            f"{where}: positions around ({shift}) m, as of a map; single precision "
            f"loses centimetres there: subtract ({shift}) from all positions, also "
            "from those of other files of this place"
        )
