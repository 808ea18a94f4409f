"""Verbs whose folder another process works in, refused before they look at anything."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from mi_nerfattack.errors import InputError
from mi_nerfattack.experiment.refine.refine import refine
from mi_nerfattack.experiment.retrain.anew import attack_anew
from mi_nerfattack.experiment.sweep.sweep import Cells, Sweep
from mi_nerfattack.experiment.transfer.run import run_transfer
from mi_nerfattack.io import locks

NOTHING: Any = None


@pytest.mark.parametrize(
    "work",
    [
        lambda folder: refine(NOTHING, folder, NOTHING, NOTHING),
        lambda folder: attack_anew([], Path("absent"), folder, NOTHING),
        lambda folder: run_transfer(NOTHING, folder, NOTHING),
    ],
    ids=["refine", "retrain", "transfer"],
)
def test_a_second_process_is_refused(work, tmp_path):
    with locks.exclusive(tmp_path), pytest.raises(InputError, match="another process"):
        work(tmp_path)
    assert not list(tmp_path.iterdir())


def test_a_second_sweep_is_refused(tmp_path):
    pytest.importorskip("pyarrow")
    sweep = Sweep(Cells((), tmp_path))
    with locks.exclusive(tmp_path), pytest.raises(InputError, match="another process"):
        sweep.run(NOTHING)
    assert not sweep.table.exists()
