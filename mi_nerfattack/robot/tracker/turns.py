"""Which meaning the rotations of a VICON stream have, told by two known turns."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from mi_nerfattack.errors import InputError
from mi_nerfattack.robot.tracker.object_stream import (
    CONVENTIONS,
    Convention,
    to_rotation,
)

_FITS_DEG, _FAILS_DEG = 15.0, 30.0  # largest error of the right one, least of the other
_QUARTERS = Rotation.from_rotvec(np.pi / 2 * np.vstack([np.eye(3), -np.eye(3)]))


def tell_convention(
    start_rad: ArrayLike, first_rad: ArrayLike, second_rad: ArrayLike
) -> Convention:
    """Tell the convention by two turns of 90 degrees about two axes of a body.

    Under the right one, each is a quarter turn about one of the body's own axes. Which
    axes, and which way, is free. Start with the body along the room's axes: from some
    other headings both conventions give nearly quarter turns, which is refused.

    Args:
        start_rad: (3,), as received, of the body at first.
        first_rad: (3,), after a turn of 90 degrees about one of its axes.
        second_rad: (3,), after another, about another of its axes.

    Raises:
        InputError: none fits, or both do.
    """
    found = np.array([start_rad, first_rad, second_rad], np.float64)
    errors = {kind: _error_deg(found, kind) for kind in CONVENTIONS}
    told = ", ".join(f"{kind} {error:.0f}" for kind, error in errors.items())
    best, other = sorted(CONVENTIONS, key=lambda kind: errors[kind])
    if not errors[best] <= _FITS_DEG:
        raise InputError(
            f"two turns: no reading makes both quarter turns (degrees off: {told}); "
            "turn the body by 90 degrees about one of its axes, then about another, "
            "and see that these axes are the ones that Tracker shows for it"
        )
    if not errors[other] >= _FAILS_DEG:
        raise InputError(
            f"two turns: both readings fit (degrees off: {told}); start with the body "
            "along the room's axes, and turn about another axis the second time"
        )
    return best


def _error_deg(rotations_rad: np.ndarray, convention: Convention) -> float:
    """Return how far the worse of two turns is from the nearest quarter turn."""
    rotations = to_rotation(rotations_rad, convention)
    turns = rotations[:2].inv() * rotations[1:]
    off = [(_QUARTERS.inv() * turn).magnitude().min() for turn in turns]
    return float(np.degrees(max(off)))
