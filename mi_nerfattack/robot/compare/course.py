"""The stretch of a route that a run's drives and real ones are compared on."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mi_nerfattack.errors import InputError
from mi_nerfattack.experiment.kept_drives import read_drive
from mi_nerfattack.experiment.run_folder import DRIVES, object_path
from mi_nerfattack.experiment.transfer.found import FoundAttack, read_found
from mi_nerfattack.fields.io import load_grid
from mi_nerfattack.render.camera.intrinsics import Camera, CameraMount
from mi_nerfattack.render.posed import PosedField
from mi_nerfattack.rollout.drive import CASES, Drive, Lane
from mi_nerfattack.scenario.world import build_surrogate, object_footprints
from mi_nerfattack.vehicle.route.route import Route


@dataclass(frozen=True, eq=False)
class Course:
    """Where drives are compared, and how they are read.

    Attributes:
        route: the lane centre, with the vehicle's speed.
        start_m: arc length where the run's drives begin.
        end_m: where one at the vehicle's speed ends.
        lane: of the route.
        camera: of the scenario, for recordings without intrinsics.
        mount: of the camera on the vehicle.
        period: seconds between two controls.
        control_unit: "rad/s" of a heading rate, or "rad" of a steering angle.
        wheelbase: metres.
    """

    route: Route
    start_m: float
    end_m: float
    lane: Lane
    camera: Camera
    mount: CameraMount
    period: float
    control_unit: str
    wheelbase: float

    @classmethod
    def of(cls, found: FoundAttack) -> Course:
        """Return that of a run."""
        scenario, route = found.scenario, found.route
        camera, mount = scenario.camera.build()
        if scenario.scene.surrogate is not None:
            camera = build_surrogate(scenario).intrinsics
        period, car = scenario.vehicle.dt_s, scenario.vehicle.car()
        stretch = scenario.drive.stretch(route, period)
        rest = camera, mount, period, car.control_unit, car.wheelbase
        return cls(route, *stretch, found.lane, *rest)

    @property
    def length_m(self) -> float:
        """Arc length of the stretch."""
        return self.end_m - self.start_m

    def arcs(self, states: np.ndarray) -> np.ndarray:
        """Return arc lengths (n,) of states (n, 3), in order along the stretch.

        On a closed route they go on from lap to lap, and are of the laps by which they
        cover most of the stretch, of the first such.
        """
        arcs = self.route.project_numpy(states).arc_length
        if not self.route.closed:
            return arcs
        lap = self.route.length
        arcs = np.unwrap(arcs, period=lap)
        later = arcs + lap * np.ceil((self.start_m - arcs[0]) / lap)
        return max((later, later - lap), key=self.covered_m)

    def covered_m(self, arcs: np.ndarray) -> float:
        """Return how much of the stretch arc lengths cover; negative where none."""
        return float(min(arcs.max(), self.end_m) - max(arcs[0], self.start_m))

    def controls(self, states: np.ndarray, times: np.ndarray) -> np.ndarray:
        """Return the control that led from each state to the next, as driven.

        By the change of heading: per second, or per metre by the single-track model.

        Args:
            states: (n, 3), metres and radians.
            times: (n,), seconds, increasing.

        Returns:
            (n - 1,), in `control_unit`, positive to the left.

        Source: appendix A.7 and A.8.
        """
        turn = np.diff(states[:, 2])
        turn = np.arctan2(np.sin(turn), np.cos(turn))
        if self.control_unit == "rad/s":
            return turn / np.diff(times)
        way = np.hypot(*np.diff(states[:, :2], axis=0).T)
        return np.arctan2(self.wheelbase * turn, way)


def read_run(folder: Path) -> tuple[FoundAttack, Course]:
    """Read a finished run.

    Raises:
        InputError: as of :func:`read_found`.
    """
    (found,) = read_found([folder])
    return found, Course.of(found)


def read_surrogate(found: FoundAttack, environment: str) -> dict[str, list[Drive]]:
    """Return the drives of a run in an environment, by case, in their order.

    Raises:
        InputError: there are none, or a file is damaged.
    """
    folder = found.folder / DRIVES
    drives = {
        case: [read_drive(path, found.route.name) for path in sorted(paths)]
        for case in CASES
        if (paths := list(folder.glob(f"{environment}_{case}_[0-9]*.safetensors")))
    }
    if not drives:
        names = {path.stem.rpartition("_")[0] for path in folder.glob("*.safetensors")}
        known = ", ".join(sorted(names)) or "none"
        raise InputError(
            f"{folder}: no drives in {environment!r}; there are: {known}; choose with "
            "--environment"
        )
    return drives


def footprints(found: FoundAttack) -> list[np.ndarray]:
    """Return the outlines of the attacked objects on the ground, (4, 2) metres each.

    None where a Mitsuba scene says where they stand.
    """
    scenario = found.scenario
    if scenario.scene.surrogate is not None:
        return []
    placed = []
    for item, offset in zip(scenario.objects, found.offsets, strict=True):
        field = load_grid(object_path(found.folder, item.id))
        placed.append(PosedField(field, item.pose.moved(offset)))
    return object_footprints(placed)
