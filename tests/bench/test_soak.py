"""Thousands of iterations without growth or drift, and how either would be told."""

from __future__ import annotations

import json

import numpy as np
import pytest

from bench.__main__ import main
from bench.soak.run import MOST_GROWTH, Soak, faults, figures
from mi_nerfattack.errors import InputError

pytestmark = pytest.mark.usefixtures("variant")

COUNT, SETTLED = 100, 20


def made(**changes):
    """Samples of an attack that takes 40 MB at first, and nothing after that."""
    index = np.arange(COUNT)
    samples = {
        "resident_bytes": 500_000_000 + 2_000_000 * np.minimum(index, SETTLED - 1),
        "compiled": np.where(index < SETTLED, 3, 0),
        "descriptors": np.full(COUNT, 9),
        "threads": np.full(COUNT, 4),
        "cpu_s": 0.02 * index,
        "wall_s": 0.03 * index,
    }
    return samples | changes


def document(samples, **changes):
    same = {"objective": {"tracked": -1.5, "judged": -1.5}, "differing": []}
    return figures(samples, SETTLED) | same | changes


def test_what_is_taken_at_first_is_no_growth():
    found = document(made())
    assert faults(found) == []
    assert found["resident_mb"] == [538.0, 538.0]
    assert found["growth_b_per_iteration"] == pytest.approx(0, abs=1e-3)
    assert found["kernels_compiled"] == 0
    assert found["first_cpu_ms"] == found["last_cpu_ms"] == pytest.approx(20)


def test_growth_and_drift_are_told():
    index = np.arange(COUNT)
    samples = made(
        resident_bytes=500_000_000 + 2 * MOST_GROWTH * index,
        compiled=np.where(index == 50, 1, 0),
        descriptors=9 + index // 60,
        threads=np.where(index < 90, 4, 3),
    )
    found = document(
        samples, objective={"tracked": -1.5, "judged": -1.4}, differing=["best.0"]
    )
    assert found["growth_b_per_iteration"] == pytest.approx(2 * MOST_GROWTH)
    told = "\n".join(faults(found))
    for words in (
        f"{2 * MOST_GROWTH} B",
        "1 kernels",
        "descriptors: 9 to 10",
        "threads: 3 to 4",
    ):
        assert words in told
    assert "another when judged anew" in told and "best.0" in told


def test_what_cannot_be_watched_is_refused():
    for count, settled in ((2010, 200), (780, 200), (80, 0), (0, 20)):
        with pytest.raises(InputError, match=f"iterations: {count}"):
            Soak(count, settled)


@pytest.mark.slow
def test_two_thousand_iterations_neither_grow_nor_drift(capsys):
    assert main(["soak", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert (found["iterations"], found["settled"]) == (2000, 200)
    assert found["objective"]["tracked"] < 0
    assert found["kernels_compiled"] == 0 and not found["differing"]
