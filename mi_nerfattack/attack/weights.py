"""Weights of the control periods of a drive, for objectives that sum over time.

Each function returns (T,) float64; entry t - 1 belongs to the state after t control
periods, t = 1 to T.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mi_nerfattack.errors import InputError


def linear(horizon: int) -> np.ndarray:
    """Weigh late times more: ``t / T``, up to 1 at the end."""
    return np.arange(1, horizon + 1) / horizon


def last_seconds(horizon: int, dt: float, seconds: float) -> np.ndarray:
    """Weigh the states of the last `seconds` with 1 and the others with 0.

    Args:
        horizon: T.
        dt: control period, seconds.
        seconds: rounded to whole control periods.

    Raises:
        InputError: less than half a period, or more than the drive lasts.
    """
    count = round(seconds / dt)
    if not 1 <= count <= horizon:
        raise InputError(
            f"last_s: {seconds!r} s is {count} control periods of {dt!r} s; allowed "
            f"are 1 to {horizon}, what the drive has"
        )
    return (np.arange(horizon) >= horizon - count).astype(np.float64)


def discounted(horizon: int, dt: float, per_second: float) -> np.ndarray:
    """Weigh early times more: ``d^((t - 1) dt)``, 1 at the first.

    Args:
        horizon: T.
        dt: control period, seconds.
        per_second: d, in (0, 1], the factor from one second to the next.

    Raises:
        InputError: d is outside its range.
    """
    if not 0 < per_second <= 1:
        raise InputError(
            f"discount_per_s: {per_second!r}; must be above 0 and at most 1"
        )
    return per_second ** (dt * np.arange(horizon))


def listed(horizon: int, values: Sequence[float]) -> np.ndarray:
    """Check an explicit list.

    Raises:
        InputError: not T finite numbers, or zeros alone.
    """
    weights = np.asarray(values, np.float64)
    if weights.shape != (horizon,):
        raise InputError(
            f"listed_weights: {weights.size} numbers for a horizon of {horizon}; give "
            "one a control period"
        )
    if not np.isfinite(weights).all() or not weights.any():
        raise InputError("listed_weights: must be finite and not all zero")
    return weights
