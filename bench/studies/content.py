"""What a page of docs/results/findings shows."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from mi_nerfattack.evaluation.summary import Interval, interval, share_interval
from mi_nerfattack.scenario.deployment import SURROGATE

HALF = 0.5  # of the error in the surrogate, and of the places
#: Column of the mean distance from the lane centre.
ERROR = "cross_track_mean_m"


@dataclass(frozen=True)
class Finding:
    """What a page shows.

    Attributes:
        title: the finding, a sentence without its full stop.
        sentences: three.
        head: of the table.
        rows: of the table.
        draw: draws the chart in an empty figure.
        pandas: the second and the third line that read the data.
        threats: to validity, which depend on the rows.
    """

    title: str
    sentences: tuple[str, str, str]
    head: Sequence[str]
    rows: Sequence[Sequence[str]]
    draw: Callable[[Figure], None]
    pandas: str
    threats: tuple[str, ...] = ()


def with_labels(drives: pd.DataFrame) -> pd.DataFrame:
    """Return drives of a transfer with the method and the seed of each attack.

    The name of an attack ends with the method, the seed of the place and a digest.
    """
    fields = drives["attack"].str.split("-")
    return drives.assign(method=fields.str[-3], seed=fields.str[-2])


def deployment_of(drives: pd.DataFrame) -> str:
    """Return the first environment of drives that is not the surrogate."""
    return next(name for name in drives["environment"].unique() if name != SURROGATE)


def geometric_interval(logs: np.ndarray) -> Interval:
    """Return the 95 % interval of a geometric mean from natural logarithms, (n,)."""
    ends = interval(np.mean, (logs,), 0)
    return None if ends is None else np.exp(ends).tolist()


def ends_cell(ends: Interval, digits: int = 3) -> str:
    """Return an interval as a cell of a table."""
    return "–" if ends is None else f"{ends[0]:.{digits}f} to {ends[1]:.{digits}f}"


def interval_words(ends: Interval, digits: int) -> str:
    """Return an interval as words."""
    few = "too few places for an interval"
    return few if ends is None else f"95 % interval {ends_cell(ends, digits)}"


def share_words(count: int, places: int) -> str:
    """Return the interval of a share of places as words."""
    return interval_words(share_interval(count, places), 2)


def metres(value: float | None) -> str:
    """Return a length as words."""
    return "unknown" if value is None else f"{value:.2f} m"
