"""Whole attacks, from a scenario to the figures of their `metrics.json`."""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

from bench.study.rows import Row
from mi_nerfattack.backend.determinism import one_thread
from mi_nerfattack.experiment.job import Job
from mi_nerfattack.scenario.scenario import load_scenario

_CASE = (
    "n",
    "cross_track_mean_m",
    "cross_track_max_m",
    "wheel_out_s",
    "centre_out_s",
    "drives_departed",
)
_KEPT = ("flags", "converged", "saturated_share", "total_variation", "textures")


def run(write: Callable[[Path], Path]) -> Row:
    """Attack, whatever the checks say, and describe what came of it.

    Args:
        write: writes the scenario to a folder, and returns its file.

    Returns:
        place of the object, figures by environment and case, flags, convergence,
        texture, cost.
    """
    with tempfile.TemporaryDirectory() as name, one_thread():
        folder = Path(name)
        scenario, text = load_scenario(write(folder))
        policy = scenario.build_policy()
        job = Job(scenario, text, policy, folder / "run", frames=None)
        document = job.run(anyway=True)
    return {
        "objects": document["scenario"]["objects"],
        "environments": _environments(document),
        **{key: document[key] for key in _KEPT},
        "cost": document["cost"],
    }


def _environments(document: dict[str, Any]) -> dict[str, Any]:
    [environments] = document["routes"].values()
    return {
        name: {
            case: {key: figures[key] for key in _CASE}
            for case, figures in cases.items()
        }
        for name, cases in environments.items()
    }
