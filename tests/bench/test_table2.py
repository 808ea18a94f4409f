"""The page of Table 2, of made drives whose figures are known by hand."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from bench.table2.page import page
from bench.table2.rows import read_retrained
from mi_nerfattack.errors import InputError
from mi_nerfattack.experiment.sweep.cell import Cell, changed
from mi_nerfattack.experiment.sweep.grid import load_cells
from mi_nerfattack.experiment.sweep.summary import summarise
from mi_nerfattack.experiment.sweep.table import read_table
from mi_nerfattack.rollout.drive import RANDOM

SCENES = Path(__file__).parents[2] / "scenes"
#: Mean errors by environment and route: without objects, past random looks, and past
#: the attacks of two seeds.
ERRORS = {
    ("surrogate", "straight"): (0.05, 0.1, (0.2, 0.4)),
    ("surrogate", "right"): (0.05, 0.1, (0.4, 0.6)),
    ("deployment", "straight"): (0.05, 0.2, (0.2, 0.4)),
    ("deployment", "right"): (0.05, 0.2, (0.4, 0.6)),
}
MADE = {"date": "2030-01-01", "machine": {"cores": 2}, "command": "the command"}


def rows(method="gradient"):
    found = []
    for (environment, route), (clean, chance, attacks) in ERRORS.items():
        for seed, error in enumerate(attacks):
            labels = {"cell": f"{route}-{seed}", "route": route, "objects": "six"}
            labels |= {"method": method, "budget": None, "seed": seed, "error": None}
            labels |= {"status": "complete", "environment": environment, "frames": 9}
            labels |= {"digests": '{"scenario": "s", "policy.file": "abc"}'}
            labels |= {"versions": '{"mitsuba": "3"}', "steps": 72, "departed": False}
            for case, value in {
                "no_object": clean,
                "random": chance,
                "attack": error,
            }.items():
                figures = {"case": case, "run": 0, "cross_track_mean_m": value}
                figures["wheel_out_s"] = 1.5 if value == 0.6 else 0.0
                found.append(labels | figures)
    return found


def write_retrained(folder):
    """Write what `retrain` leaves: past attacks from 0.4 m to 0.09 m."""
    means = {"before": (0.08, 0.4), "after": (0.1, 0.09)}
    for stage, values in means.items():
        cases = {
            case: {"cross_track_mean_m": value, "wheel_out_s": 0.0}
            for case, value in zip(("no_object", "attack"), values, strict=True)
        }
        row = {"attack": "right-0", "environment": "mitsuba", "cases": cases}
        document = {"attacks": [{"label": "right-0", "route": "right"}], "rows": [row]}
        (folder / f"old_{stage}").mkdir()
        path = folder / f"old_{stage}" / "transfer.json"
        path.write_text(json.dumps(document))
    return folder


def lines(text, begin):
    return [line for line in text.splitlines() if line.startswith(f"| {begin} |")]


def test_rows_by_hand(tmp_path):
    retrained = read_retrained(write_retrained(tmp_path), {"right-0", "right-1"})
    text = page(summarise(rows()), rows(), retrained, MADE)
    # 0.3 and 0.5 m; Wilson's intervals of 0 and 1 of 2; deployment comes first
    deployed, driven, paper, *_ = lines(text, "right")
    assert "0.050 ± 0.000 [0.050, 0.050] (2); 0/2 out [0, 66]" in deployed
    assert "0.500 ± 0.141 [0.400, 0.600] (2); 1/2 out [9, 91]" in deployed
    assert deployed.endswith("| 0.090 (1); 0/1 out [0, 79] |")
    assert "| 0.500 ± 0.141 [0.400, 0.600] (2); 1/2 out [9, 91] |  |" in driven
    # (2101 - 1200) / 600 = 1.5017; 1200 + 600 x 0.5 and 600 x 0.1414
    assert "| 2101 ± 75 (+1.502 m) | 1307 (+0.178 m) |" in paper
    ours = [line for line in lines(text, "") if "ours, deployment" in line]
    assert "| 1320 ± 0 (0.200 m) | 1500 ± 85 (0.500 m) | 1254 (0.090 m) |" in ours[1]
    # without objects there is one drive, whatever the attack
    driven, _ = lines(text, "mitsuba")
    assert driven == (
        "| mitsuba | right | 0.080 | 0.100 | 0.400 (1); 0/1 out [0, 79] "
        "| 0.090 (1); 0/1 out [0, 79] |"
    )
    # in all 0.4 m, of which 0.2 m by chance; 0.01 m more without objects
    aims = [line for line in text.splitlines() if line.endswith("met** |")]
    assert aims.pop(0).startswith("| straight: mean error at least 2 times")
    assert len(aims) == 2 and "| 1/4 out [5, 70] |" in aims[0]
    assert "without objects at most 1.1 times" in aims[1] and "| 1.25 |" in aims[1]
    met = [line for line in text.splitlines() if line.endswith("| met |")]
    routes = [line.split(":")[0] for line in met[:5]]
    expected = ["straight", "right", "all routes", "right", "all routes"]
    assert routes == [f"| {route}" for route in expected]
    assert "| 4.00 [" in met[2] and "| 2.00 [" in met[4]
    assert "| 0 of 4 drives |" in met[5] and "| 1.12 |" in met[6]
    assert "- policy.file: SHA-256 abc" in text and "with: mitsuba 3" in text


def test_more_budget_stands_beside_the_same_attacks():
    """0.9 m for each attack: 1.8 times the 0.5 m on average on the right."""
    more = [
        row
        | {"method": "starts_4", "cell": f"{row['cell']}-more", "frames": 36}
        | ({"cross_track_mean_m": 0.9} if row["case"] == "attack" else {})
        for row in rows()
    ]
    text = page(summarise(rows()), rows(), {}, MADE, summarise([*rows(), *more]))
    own = [line for line in lines(text, "right") if "| starts_4 | 36 |" in line]
    assert len(own) == 2 and "0.900 ± 0.000" in own[0] and "| 1.80 [" in own[0]
    assert "scenes/budgets.toml -o BUDGETS" in text
    assert "8 of 8 attacks are complete" in text


@pytest.mark.slow
@pytest.mark.usefixtures("variant")
def test_budgets_have_the_attacks_of_table_2():
    cells = load_cells(SCENES / "budgets.toml")
    first = [cell for cell in cells if cell.method == "gradient"]
    assert [c.id for c in first] == [c.id for c in load_cells(SCENES / "table2.toml")]
    assert len(cells) == 3 * len(first)


def test_flags_and_failures_are_told():
    failed = {"status": "failed", "error": "no room", "cell": "left-0", "route": "left"}
    failed |= {"objects": "six", "method": "gradient", "budget": None, "seed": 0}
    failed |= {"versions": None, "digests": "{}"}
    failed |= {"environment": None, "case": None}
    some = [*rows(), failed]
    text = page(summarise(some), some, {}, MADE)
    assert "4 of 5 attacks are complete." in text
    # straight, deployment: 0 and 0.2 m more than random, 0.1 m on average
    assert "- **noise larger:** the effect of the attack" in text
    assert "- **failed:** left-0: no room" in text
    assert "after retraining, " not in text


def test_without_chance_there_is_no_ratio():
    """Where random looks have no error, no ratio is told, and none is met."""
    some = [
        row | {"cross_track_mean_m": 0.0} for row in rows() if row["case"] == RANDOM
    ]
    some += [row for row in rows() if row["case"] != RANDOM]
    text = page(summarise(some), some, {}, MADE)
    aims = [line for line in text.splitlines() if "times that of random" in line]
    assert len(aims) == 6 and all(line.endswith("|  | **not met** |") for line in aims)


def test_other_retrainings_are_refused(tmp_path):
    with pytest.raises(InputError, match="right-0: no cells of the sweep; give"):
        read_retrained(write_retrained(tmp_path), {"left-0"})


def test_other_sweeps_are_refused():
    with pytest.raises(InputError, match="no complete attack by 'gradient'"):
        page(summarise(rows("blocks")), rows("blocks"), {}, MADE)


def test_the_committed_rows_can_be_repeated():
    """A key that scenarios get later must leave their digests as they are."""
    committed = Path(__file__).parents[2] / "docs" / "table2" / "results.parquet"
    labels = ["route", "objects", "method", "budget", "seed"]
    rows = read_table(committed, ["cell", *labels, "scenario", "digests"])
    cells = {row["cell"]: row for row in rows}
    assert len(cells) == 15
    for row in cells.values():
        about = [row[key] for key in labels]
        digests = json.loads(row["digests"])
        assert changed(Cell(*about, row["scenario"], digests)) == []
