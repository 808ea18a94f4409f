"""What the gradient said that updates would gain, and what they gained."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

_WINDOW = 5  # iterations whose predicted and real gains are compared


def with_gains(
    rows: Sequence[Mapping[str, Any]],
    predicted: Sequence[float],
    gains: np.ndarray,
    first: int,
) -> list[dict[str, Any]]:
    """Add ``predicted_gain`` and ``gain`` to the rows of iterations.

    Args:
        rows: one an iteration.
        predicted: gain by the gradient, of each.
        gains: real ones, (n,).
        first: rows before it have none, for they follow another objective.
    """
    pairs = zip(predicted, gains.tolist(), strict=True)
    told = [pair if k >= first else (None, None) for k, pair in enumerate(pairs)]
    return [
        {**row, "predicted_gain": said, "gain": done}
        for row, (said, done) in zip(rows, told, strict=True)
    ]


def least_gain(
    predicted: Sequence[float], gains: np.ndarray, first: int, end: int
) -> dict[str, Any] | None:
    """Find five iterations in a row that gave the least of the predicted gain.

    Of those that add up to a predicted fall of the objective.

    Args:
        predicted: gain by the gradient, of each iteration.
        gains: real ones, (n,).
        first: the first iteration that counts.
        end: the first that counts no longer.

    Returns:
        see `AbstractAttack.least_gain`.
    """
    windows = [
        {
            "first": start,
            "predicted": sum(predicted[start : start + _WINDOW]),
            "gain": float(gains[start : start + _WINDOW].sum()),
        }
        for start in range(first, end - _WINDOW + 1)
    ]
    falling = [window for window in windows if window["predicted"] > 0]
    return min(falling, key=lambda w: w["gain"] / w["predicted"], default=None)
