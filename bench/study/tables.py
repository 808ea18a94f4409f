"""Tables of studies, in Markdown."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
import rich.box
import rich.table

from bench.study.rows import Row


def markdown(
    header: Sequence[str], rows: Iterable[Sequence[str | float]]
) -> rich.table.Table:
    """Return a table; figures have three decimals.

    Args:
        header: of the columns.
        rows: cells.
    """
    table = rich.table.Table(box=rich.box.MARKDOWN)
    for name in header:
        table.add_column(name, overflow="fold")
    for row in rows:
        cells = (c if isinstance(c, str) else f"{c:.3f}" for c in row)
        table.add_row(*cells)
    return table


def geometric_mean(values: Iterable[float]) -> float:
    """Return the geometric mean, which weighs ratios alike."""
    return float(np.exp(np.mean(np.log(list(values)))))


def mean_m(row: Row, environment: str, case: str = "attack") -> float:
    """Return the mean distance from the lane centre of a row of :mod:`jobs`."""
    return float(row["environments"][environment][case]["cross_track_mean_m"])
