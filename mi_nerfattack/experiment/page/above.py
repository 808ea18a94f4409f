"""Drives of run folders that were made without pictures, from above."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from pathlib import Path

from mi_nerfattack.errors import InputError
from mi_nerfattack.experiment.kept_drives import read_drive
from mi_nerfattack.experiment.run_folder import DRIVES, SCENARIO, read_finished
from mi_nerfattack.fields import load_grid
from mi_nerfattack.render.posed import PosedField
from mi_nerfattack.report.pages.parts import SHOWN_CASES
from mi_nerfattack.report.plots.drives import overhead
from mi_nerfattack.rollout.drive import Drive, Lane
from mi_nerfattack.scenario.scenario import load_scenario
from mi_nerfattack.scenario.world import driven_route, object_footprints


def draw_above(path: Path, folders: Sequence[Path]) -> None:
    """Plot the first drives of runs on one route, with the objects of all of them.

    Args:
        path: PNG file.
        folders: of finished runs; at least one.

    Raises:
        InputError: a drive is missing or damaged, or a file that a scenario names.
    """
    drives: list[Drive] = []
    footprints, grids = [], cache(load_grid)
    scenario, _ = load_scenario(folders[0] / SCENARIO)
    route = driven_route(scenario, scenario.vehicle.motion())
    for folder in folders:
        own, _ = load_scenario(folder / SCENARIO)
        footprints += object_footprints(
            PosedField(grids(item.field.file), item.pose)
            for item in own.objects
            if item.field is not None  # else it is in a scene in XML
        )
        routes = read_finished(folder)["routes"].values()
        closed = {environment for cases in routes for environment in cases}
        for file in sorted((folder / DRIVES).glob("*_0000.safetensors")):
            drive = read_drive(file, route.name)
            if drive.case in SHOWN_CASES and drive.environment in closed:
                drives.append(drive)
    if not drives:
        raise InputError(f"{folders[0] / DRIVES}: no drives; they were removed")
    limit = Lane.of(route, scenario.vehicle.width_m).wheel_m
    overhead(path, drives, route.points, route.lane_width_m, footprints, limit)
