"""When in a drive and where on the objects the failure is made, frame by frame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from mi_nerfattack.attack.base import AbstractAttack
from mi_nerfattack.drives.table import write_csv
from mi_nerfattack.evaluation.summary import mean_interval
from mi_nerfattack.fields.grid import GridField
from mi_nerfattack.io import files
from mi_nerfattack.report.plots.curves import TimeAttribution, plot_attribution
from mi_nerfattack.report.plots.drives import control_change
from mi_nerfattack.report.plots.heat import side_views, write_heat
from mi_nerfattack.rollout.drive import CASES, OWN, Drive
from mi_nerfattack.rollout.loop import OnStep
from mi_nerfattack.rollout.sweep import StepRecorder


def control_changes(drives: Sequence[Drive], unit: str, seed: int) -> dict[str, Any]:
    """Return figures by environment and case, for ``metrics.json``.

    ``control_change_mean`` and ``control_change_max`` are the mean and the largest
    change of the control over all frames and runs. The change compares with the control
    for the original textures in the same frame. The interval of the mean is over runs,
    null for few runs; see `summary.interval`. Of several controls the figures are of
    the first one, which steers.

    Args:
        drives: of recorded drives; each environment has one drive of the case `own`.
        unit: of the control.
        seed: of the bootstrap.
    """
    figures: dict[str, Any] = {}
    for environment, group in _environments(drives).items():
        base = _own(group)
        cases: dict[str, Any] = {}
        for case in CASES:
            own, mine = base.first_controls, [d for d in group if d.case == case]
            changes = [abs(drive.first_controls - own) for drive in mine]
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
        figures[environment] = {
            "frames": len(base.controls),
            "control_unit": unit,
            "control_abs_mean": float(abs(base.first_controls).mean()),
            "cases": cases,
        }
    return figures


def write_control_changes(output: Path, drives: Sequence[Drive]) -> None:
    """Write ``controls.csv``, if there are any: of several controls the first one.

    Args:
        output: the run folder.
        drives: as of :func:`control_changes`.
    """
    if not drives:
        return
    tables = []
    for environment, group in _environments(drives).items():
        base = _own(group)
        for drive in group:
            columns = {"environment": environment, "case": drive.case, "run": drive.run}
            columns |= {"step": range(1, len(drive.time_s) + 1), "time_s": drive.time_s}
            columns["control"] = drive.first_controls
            columns["change"] = drive.first_controls - base.first_controls
            tables.append(pd.DataFrame(columns))
    write_csv(output / "controls.csv", pd.concat(tables))


def plot_control_changes(output: Path, drives: Sequence[Drive], unit: str) -> None:
    """Write ``controls_NAME.png`` of each environment.

    Args:
        output: the run folder.
        drives: as of :func:`control_changes`.
        unit: of the control.
    """
    for environment, group in _environments(drives).items():
        path = output / f"controls_{environment}.png"
        control_change(path, group, _own(group), unit=unit)


def _environments(drives: Sequence[Drive]) -> dict[str, list[Drive]]:
    groups: dict[str, list[Drive]] = {}
    for drive in drives:
        groups.setdefault(drive.environment, []).append(drive)
    return groups


def _own(group: Sequence[Drive]) -> Drive:
    return next(drive for drive in group if drive.case == OWN)


ATTRIBUTION = "attribution.json"
#: The gradient of an attack on poses alone.
UNCHANGED = "gradient by the unchanged texture"


@dataclass(frozen=True, eq=False)
class FailureAttribution:
    """The gradient of a finished attack, taken apart.

    Attributes:
        times: by control periods.
        norms: (T, k), Euclidean norms of each period's texture gradients.
        textures: (n_vertices, 3) an object, the gradient by its texture.
        subject: what the gradient is, in words.
    """

    times: TimeAttribution
    norms: np.ndarray
    textures: list[np.ndarray]
    subject: str = "gradient"


def attribute(
    attack: AbstractAttack,
    objects: Sequence[str],
    limit_m: float,
    on_step: OnStep | None = None,
) -> FailureAttribution:
    """Drive with the best textures found, and take the gradient apart.

    The share of a control period is ``<g_t, g> / <g, g>``, with g its sum over the
    periods. Costs one drive forward and two backward.

    Args:
        attack: finished; its best parameters are installed.
        objects: names, in the order of the sensor's objects.
        limit_m: departure limit, metres.
        on_step: called after each of the 3 x horizon control periods.
    """
    attack.restore_best()
    rollout, route = attack.rollout, attack.route
    evaluation = rollout.run(attack.initial, on_step)
    total = rollout.gradient(evaluation, on_step=on_step)
    textures = [texture.numpy().copy() for texture in total.textures]
    recorder = StepRecorder(textures)
    by_period = rollout.gradient(evaluation, recorder=recorder, on_step=on_step)
    assert by_period.attribution is not None, "asked for by the recorder"
    drive = evaluation.trajectory
    states = drive.states_numpy()[:, 1:]
    error = [route.cross_track_numpy(vehicle) for vehicle in states]
    times = TimeAttribution(
        time_s=drive.dt * np.arange(1, drive.horizon + 1),
        costates=total.costates,
        along=by_period.attribution.along,
        cross_track_m=np.stack(error, axis=1),
        limit_m=limit_m,
        objects=list(objects),
    )
    subject = "gradient" if attack.freedom.texture_rate is not None else UNCHANGED
    return FailureAttribution(
        times, by_period.attribution.norms, textures, subject=subject
    )


def write_attribution(
    folder: Path, attribution: FailureAttribution, fields: Sequence[GridField]
) -> None:
    """Write ``attribution.json``, ``attribution.png``, ``attribution_object.png``.

    Args:
        folder: the run folder.
        attribution: from :func:`attribute`.
        fields: the objects, with the textures that are to be seen.
    """
    times = attribution.times
    data = {
        "time_s": times.time_s.tolist(),
        "costates": times.costates.tolist(),
        "cross_track_m": times.cross_track_m.tolist(),
        "gradient_norm": _columns(times.objects, attribution.norms),
        "gradient_share": _columns(times.objects, times.shares),
    }
    files.write_json(folder / ATTRIBUTION, data)
    plot_attribution(folder / "attribution.png", times, attribution.subject)
    pairs = zip(times.objects, fields, attribution.textures, strict=True)
    sides = {name: side_views(grid, g) for name, grid, g in pairs}
    write_heat(folder / "attribution_object.png", sides)


def _columns(names: Sequence[str], table: np.ndarray) -> dict[str, list[float]]:
    return {name: table[:, i].tolist() for i, name in enumerate(names)}
