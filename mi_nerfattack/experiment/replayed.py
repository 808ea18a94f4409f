"""What an attack changes in a recorded drive: the control, frame by frame.

Nothing that the policy does has an effect there, so that there is no cross-track error
of its own. Each frame is a question asked anew; its answer is compared with that to the
same frame with objects in their own textures.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from mi_nerfattack.evaluation.intervals import mean_interval
from mi_nerfattack.io import files
from mi_nerfattack.report.plots.drives import control_change
from mi_nerfattack.rollout.drive import CASES, OWN, Drive

COLUMNS = ("environment", "case", "run", "step", "time_s", "control", "change")


def control_changes(drives: Sequence[Drive], unit: str, seed: int) -> dict[str, Any]:
    """Return figures by environment and case, for ``metrics.json``.

    ``control_change_mean`` and ``control_change_max`` are of the distance from the
    control with own textures in the same frame, over all frames and runs; the interval
    of the mean is a bootstrap over runs, null for a single one.

    Args:
        drives: of recorded drives; of each environment one past own textures.
        unit: of the control.
        seed: of the bootstrap.
    """
    found: dict[str, Any] = {}
    for environment, group in _environments(drives).items():
        base = _own(group)
        cases: dict[str, Any] = {}
        for case in CASES:
            changes = [abs(d.controls - base.controls) for d in group if d.case == case]
            if not changes or case == OWN:
                continue
            means = np.array([change.mean() for change in changes])
            largest = max(changes, key=np.max)
            cases[case] = {
                "n": len(changes),
                "control_change_mean": float(means.mean()),
                "control_change_mean_ci95": mean_interval(means, seed),
                "control_change_max": float(largest.max()),
                "control_change_max_time_s": float(base.time_s[largest.argmax()]),
            }
        found[environment] = {
            "frames": len(base.controls),
            "control_unit": unit,
            "control_abs_mean": float(abs(base.controls).mean()),
            "cases": cases,
        }
    return found


def write_control_changes(output: Path, drives: Sequence[Drive]) -> None:
    """Write ``controls.csv``, if there are any.

    Args:
        output: the run folder.
        drives: as of :func:`control_changes`.
    """
    if not drives:
        return
    buffer = io.StringIO()
    writer = csv.writer(buffer, lineterminator="\n")
    writer.writerow(COLUMNS)
    for environment, group in _environments(drives).items():
        base = _own(group)
        for drive in group:
            change = (drive.controls - base.controls).tolist()
            columns = drive.time_s.tolist(), drive.controls.tolist(), change
            rows = zip(*columns, strict=True)
            about = environment, drive.case, drive.run
            writer.writerows([*about, k, *row] for k, row in enumerate(rows, start=1))
    files.write_text(output / "controls.csv", buffer.getvalue())


def plot_control_changes(output: Path, drives: Sequence[Drive], unit: str) -> None:
    """Write ``controls_NAME.png`` of each environment.

    Args:
        output: the run folder.
        drives: as of :func:`control_changes`.
        unit: of the control.
    """
    for environment, group in _environments(drives).items():
        path = output / f"controls_{environment}.png"
        control_change(path, group, _own(group), unit)


def _environments(drives: Sequence[Drive]) -> dict[str, list[Drive]]:
    found: dict[str, list[Drive]] = {}
    for drive in drives:
        found.setdefault(drive.environment, []).append(drive)
    return found


def _own(group: Sequence[Drive]) -> Drive:
    return next(drive for drive in group if drive.case == OWN)
