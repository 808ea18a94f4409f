"""Batches of small linear systems in Dr.Jit operations."""

from __future__ import annotations

from typing import Any

import drjit as dr


def solve_columns(columns: list[Any], right: Any) -> Any:
    """Solve n systems of m equations by Gaussian elimination with row pivots.

    Unrolled while it is traced: about `m^3` operations a system, meant for m below 10.

    Args:
        columns: m columns, each (m, n), of matrices that are not near singular.
        right: (m, n).

    Returns:
        (m, n); differentiable in all arguments, in forward and reverse mode.
    """
    size = len(columns)
    # Augmented rows; those above the diagonal are final.
    rows = [[c[i] for c in columns] + [right[i]] for i in range(size)]
    for k in range(size):
        for i in range(k + 1, size):
            rows[k], rows[i] = _larger_first(rows[k], rows[i], k)
        for i in range(k + 1, size):
            factor = rows[i][k] / rows[k][k]
            for j in range(k + 1, size + 1):
                rows[i][j] = rows[i][j] - factor * rows[k][j]
    return type(right)(*_substitute(rows))


def _larger_first(
    first: list[Any], second: list[Any], k: int
) -> tuple[list[Any], list[Any]]:
    """Swap two rows where the second has the larger entry in column k."""
    swap = dr.abs(second[k]) > dr.abs(first[k])
    pairs = list(zip(first, second, strict=True))
    done = first[:k]  # eliminated columns are never read again
    return (
        done + [dr.select(swap, b, a) for a, b in pairs[k:]],
        done + [dr.select(swap, a, b) for a, b in pairs[k:]],
    )


def _substitute(rows: list[list[Any]]) -> list[Any]:
    """Solve an upper triangular system, last row first."""
    size = len(rows)
    solution: list[Any] = [None] * size
    for i in reversed(range(size)):
        rest = rows[i][size]
        for j in range(i + 1, size):
            rest = rest - rows[i][j] * solution[j]
        solution[i] = rest / rows[i][i]
    return solution
