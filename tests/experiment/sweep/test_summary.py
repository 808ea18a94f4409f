"""What is told of made drives, whose figures are known by hand."""

from __future__ import annotations

import math

import pytest

from mi_nerfattack.experiment.sweep.summary import summarise
from mi_nerfattack.experiment.sweep.table import make_table, with_total

#: Mean errors by cell (route, method, seed) and case: of two starts, of random looks
#: from starts 0, 1, 0.
ERRORS = {
    ("right", "gradient", 0): {
        "no_object": [0.1, 0.1],
        "random": [0.1, 0.2, 0.3],
        "attack": [0.4, 0.6],
    },
    ("right", "gradient", 1): {
        "no_object": [0.1, 0.1],
        "random": [0.1, 0.1, 0.1],
        "attack": [0.8, 1.0],
    },
    ("right", "blocks", 0): {"random": [0.3, 0.3, 0.3], "attack": [0.3, 0.3]},
    ("right", "blocks", 1): {"random": [0.1, 0.1, 0.1], "attack": [0.5, 0.5]},
    ("left", "gradient", 0): {"random": [0.5, 0.5, 0.5], "attack": [1.3, 1.3]},
}
#: Seconds with a wheel out, of the same drives; 0 of others.
OUT = {("right", "gradient", 0): [0.0, 1.9], ("right", "gradient", 1): [2.0, 0.5]}


def rows():
    records = []
    for (route, method, seed), cases in ERRORS.items():
        labels = {"cell": f"{route}-{method}-{seed}", "route": route, "objects": "car"}
        labels |= {"method": method, "budget": 100, "seed": seed, "error": None}
        labels |= {"status": "complete", "environment": "surrogate", "frames": 90}
        for case, errors in cases.items():
            out = OUT.get((route, method, seed)) if case == "attack" else None
            for run, error in enumerate(errors):
                wheel_out_s = out[run] if out else 0.0
                figures = {"steps": 10, "cross_track_mean_m": error}
                figures |= {"wheel_out_s": wheel_out_s, "departed": wheel_out_s > 0}
                records.append(labels | {"case": case, "run": run} | figures)
    failed = {"cell": "left-gradient-1", "route": "left", "objects": "car", "seed": 1}
    failed |= {"method": "gradient", "budget": 100, "error": "no room"}
    return with_total(make_table([*records, failed | {"status": "failed"}]))


def attack(route, method, seed, frames, objective, *flags, attack_method=None):
    record = {"cell": f"{route}-{method}-{seed}", "route": route, "objects": "car"}
    record |= {"method": method, "budget": 100, "seed": seed, "flags": flags}
    record |= {"attack_method": attack_method or method, "converged": not flags}
    return record | {"curve": {"frames": frames, "objective": objective}}


def pick(table, **labels):
    [row] = [
        row for row in table if all(row[key] == value for key, value in labels.items())
    ]
    return row


def test_groups_by_hand():
    """Attacks count, not drives; cells that failed are named."""
    summary = summarise(rows())
    assert (summary["cells"], summary["complete"]) == (6, 5)
    [failed] = summary["failed"]
    assert (failed["cell"], failed["error"]) == ("left-gradient-1", "no room")
    labels = {"method": "gradient", "case": "attack"}
    right = pick(summary["groups"], route="right", **labels)
    assert (right["attacks"], right["places"], right["seeds"]) == (2, 1, 2)
    assert right["cross_track_mean_m"] == pytest.approx((0.5 + 0.9) / 2)
    assert right["cross_track_sd_m"] == pytest.approx(math.sqrt(2 * 0.2**2))
    assert right["cross_track_total"] == pytest.approx(7.0)
    # 0.95 s and 1.25 s on average; a wheel is out in 3 of 4 drives
    out = [right[name] for name in ("attacks_out", "drives_departed", "drives")]
    assert out == [1, 3, 4]
    few = "cross_track_mean_ci95_m", "attacks_out_rate_ci95", "departure_rate_ci95"
    assert [right[name] for name in few] == [None] * 3
    together = pick(summary["groups"], route=None, **labels)
    assert together["cross_track_mean_m"] == pytest.approx((0.5 + 0.9 + 1.3) / 3)
    assert (together["attacks"], together["places"], together["seeds"]) == (3, 2, 2)
    left = pick(summary["groups"], route="left", **labels)
    assert left["cross_track_sd_m"] is None and left["cross_track_mean_ci95_m"] is None


def test_comparisons_by_hand():
    comparisons = summarise(rows())["comparisons"]
    chance = pick(comparisons, route="right", method="gradient", other_case="random")
    # 0.5 less 0.2 and 0.9 less 0.1
    assert chance["effect"]["difference"] == pytest.approx(0.55)
    assert chance["effect"]["ratio"] == pytest.approx(0.7 / 0.15)
    assert chance["effect"]["spread"] == pytest.approx(0.25 * math.sqrt(2))
    assert (chance["departures"]["one"], chance["departures"]["neither"]) == (1, 1)
    clean = pick(comparisons, route="right", method="gradient", other_case="no_object")
    assert clean["effect"]["difference"] == pytest.approx(0.6)
    blocks = pick(comparisons, route="right", other_method="gradient", method="blocks")
    assert blocks["other_case"] == "attack"
    assert blocks["effect"]["difference"] == pytest.approx(0.4 - 0.7)
    # two drives of the left route have no partner among those of blocks
    together = pick(comparisons, route=None, other_method="gradient", method="blocks")
    assert (together["effect"]["attacks"], together["effect"]["unpaired"]) == (2, 2)
    assert together["effect"]["difference"] == pytest.approx(-0.3)


def test_flags_of_the_sweep():
    """A search that finds more; an effect that seeds exceed; what attacks told."""
    attacks = [
        attack("right", "gradient", 0, [10, 30], [0.0, -5.0], "not converged: wait"),
        attack("right", "gradient", 1, [10, 30], [0.0, -5.0], "not converged: stay"),
        # a poorer setting of the gradient is no opponent
        attack("right", "slow", 1, [10, 30], [0.0, -1.0], attack_method="gradient"),
        attack("right", "blocks", 0, [10, 20, 40], [-1.0, -6.0, -7.0]),
        attack("right", "blocks", 1, [10, 20, 40], [-1.0, -2.0, -7.0]),
        attack(
            *("right", "ahead", 0, [10, 30], [-1.0, -9.0]), attack_method="open_loop"
        ),
    ]
    better, noise, own = summarise(rows(), attacks)["flags"]
    for flag, name, words in (
        (
            better,
            "black box better",
            ["30 frames, blocks (right-blocks-0)", "-6", "-5"],
        ),
        (better, "black box better", ["1 of 2 comparisons on right"]),
        # by blocks: 0.3 less 0.3 and 0.5 less 0.1, on average less than they differ
        (noise, "noise larger", ["right blocks 100 (m), is 0.2"]),
        (own, "not converged", ["2 of 6 attacks", "right-gradient-0: wait"]),
    ):
        assert flag.startswith(f"{name}: ")
        assert all(word in flag for word in words), flag
