"""Drives and documents of given errors."""

from __future__ import annotations

import numpy as np

from mi_nerfattack.evaluation import metrics
from mi_nerfattack.rollout.drive import Drive, Lane

#: What `metrics.json` of a run folder holds.
RUN_ENVIRONMENTS = ("surrogate", "deployment")
LANES = {"straight": Lane(0.85, 1.75)}
COST = {"wall_s": 12.5, "peak_memory_mb": 900.0, "renders": 240}


def make_drive(
    errors, environment="surrogate", case="random", run=0, route="straight", **changes
):
    """Return a drive along +x in steps of half a metre with the given errors."""
    errors = np.asarray(errors, dtype=float)
    steps = len(errors)
    states = np.zeros((steps + 1, 3))
    states[:, 0] = 0.5 * np.arange(steps + 1)
    states[1:, 1] = errors
    fields = {
        "states": states,
        "controls": np.linspace(-0.1, 0.1, steps),
        "cross_track_m": errors,
        "time_s": 0.1 * np.arange(1, steps + 1),
    }
    return Drive(environment, route, case, run, 100 + run, **{**fields, **changes})


def make_document(drives=None):
    drives = drives or [
        make_drive([0.1, -0.3], case="own"),
        make_drive([0.1, -0.3, 0.2], run=0),
        make_drive([0.5, 0.9, 1.0], run=1),
        make_drive([1.0, 1.2], case="attack", environment="deployment"),
    ]
    return metrics.metrics_document({"name": "x"}, 7, drives, LANES, COST)
