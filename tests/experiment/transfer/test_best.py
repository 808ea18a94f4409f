"""Which attacks of sweeps are driven elsewhere."""

from __future__ import annotations

import pytest

from mi_nerfattack.errors import InputError
from mi_nerfattack.experiment.sweep.table import write_table
from mi_nerfattack.experiment.transfer.best import best_attacks, chosen_runs


def row(cell, method, seed, error, case="attack", route="right", objects="car"):
    labels = {"cell": cell, "method": method, "seed": seed, "route": route}
    labels["objects"] = objects
    labels |= {"environment": "surrogate", "case": case, "status": "complete"}
    figures = {"run": 0, "frames": 1, "steps": 72, "departed": False}
    return labels | figures | {"cross_track_mean_m": error, "wheel_out_s": 0.0}


def rows():
    """Return two drives an attack: a at 0.3, b at 0.5, c at 0.2, and a look at 9."""
    records = [row("a", "gradient", 1, error) for error in (0.1, 0.5)]
    records += [row("b", "gradient", 2, error) for error in (0.4, 0.6)]
    records += [row("c", "random", 1, error) for error in (0.2, 0.2)]
    return [*records, row("c", "random", 1, 9.0, case="random")]


def test_the_best_of_a_method_at_a_place_stands_for_it(tmp_path):
    """Another sweep's gradient at the first place is better than a, and replaces it."""
    sweeps = [tmp_path / "one", tmp_path / "two"]
    for folder, own in zip(
        sweeps, (rows(), [row("d", "gradient", 1, 0.4)]), strict=True
    ):
        folder.mkdir()
        write_table(folder, own, {})
    names = [path.relative_to(tmp_path) for path in best_attacks(sweeps, 3)]
    assert [str(n) for n in names] == ["one/cells/b", "two/cells/d", "one/cells/c"]
    assert best_attacks(sweeps, 1) == [tmp_path / "one" / "cells" / "b"]
    with pytest.raises(InputError, match="--best: 4; right has 3 attacks"):
        best_attacks(sweeps, 4)
    run = tmp_path / "run"
    assert chosen_runs([run], None) == [run]
    assert chosen_runs([run, *sweeps], 1) == [run, tmp_path / "one" / "cells" / "b"]
    for folders, best, message in (
        (sweeps, None, "one: is of a sweep; say by --best"),
        (sweeps, 0, "--best: 0; at least 1"),
        ([run], 2, "--best: is of sweeps"),
    ):
        with pytest.raises(InputError, match=message):
            chosen_runs(folders, best)


def test_places_with_other_objects_count_each(tmp_path):
    others = [row("e", "gradient", 1, 0.7, objects="cube")]
    write_table(tmp_path, [*rows(), *others], {})
    names = [path.name for path in best_attacks([tmp_path], 4)]
    assert names == ["e", "b", "a", "c"]
