"""A finished run, brought back to life to be looked at."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from mi_nerfattack.drives.store import read_drives
from mi_nerfattack.errors import InputError
from mi_nerfattack.experiment.pictures.frames import nominal_drives
from mi_nerfattack.experiment.run_folder import DRIVES
from mi_nerfattack.experiment.transfer.found import FoundAttack, read_found
from mi_nerfattack.render.camera.intrinsics import mount_matrix
from mi_nerfattack.render.camera.pose import Pose
from mi_nerfattack.rollout.drive import ATTACK, NO_OBJECT, Drive
from mi_nerfattack.scenario.deployment import SURROGATE
from mi_nerfattack.scenario.upgrade import upgraded_environment
from mi_nerfattack.scenario.world import Appearance, World, build_world


@dataclass(frozen=True, eq=False)
class ViewedRun:
    """A finished run, with all that its frames are rendered from.

    Attributes:
        attack: of the run.
        world: in which its frames are rendered.
        looks: how the objects look and where they stand, by case; None: nowhere.
        drives: all of them.
    """

    attack: FoundAttack
    world: World
    looks: Mapping[str, Appearance | None]
    drives: tuple[Drive, ...]

    @property
    def shown(self) -> list[Drive]:
        """The first drive of each environment and case whose look is known."""
        return nominal_drives(self.drives, self.looks)

    def drive(self, name: str | None = None) -> Drive:
        """Return a drive that is shown.

        Args:
            name: see :func:`drive_name`; by default the attack in the surrogate.

        Raises:
            InputError: no drive has that name.
        """
        names = {drive_name(drive): drive for drive in self.shown}
        name = name or f"{SURROGATE}: {ATTACK}"
        if name not in names:
            raise InputError(f"--drive: {name!r}; one of {', '.join(names)}")
        return names[name]

    def cameras(self, drive: Drive) -> np.ndarray:
        """Return poses (T+1, 4, 4) of the camera, OpenCV axes, of a car on flat ground.

        Args:
            drive: of T control periods.
        """
        return mount_matrix(drive.poses, self.world.surrogate.mount)

    def poses(self, case: str, moved: Mapping[int, np.ndarray]) -> list[Pose]:
        """Return where the objects stand.

        Args:
            case: of a drive; a case without objects gives the places of `attack`.
            moved: offsets (6,) by number of the object, instead of the case's offsets.
        """
        self.show(case if self.looks[case] is not None else ATTACK, moved)
        return [posed.placed for posed in self.world.surrogate.objects]

    def show(self, case: str, moved: Mapping[int, np.ndarray]) -> None:
        """Give the world's objects the appearance of a case, and their places."""
        look = self.looks[case]
        assert look is not None, "a case with objects"
        offsets = look.offsets.copy()
        for number, offset in moved.items():
            offsets[number] = offset
        self.world.show(Appearance(look.textures, offsets))


def read_viewed(folder: Path) -> ViewedRun:
    """Read a run folder.

    Raises:
        InputError: it holds no finished attack, its drives were removed, or a file
            that its scenario names is missing or has changed.
    """
    (attack,) = read_found([folder])
    values = attack.scenario.model_dump(mode="json")
    drives = tuple(
        replace(drive, environment=upgraded_environment(drive.environment, values))
        for drive in read_drives(folder / DRIVES)
    )
    if not drives:
        raise InputError(
            f"{folder / DRIVES}: no drives; they were removed, attack anew"
        )
    world = build_world(attack.scenario, attack.scenario.build_policy())
    return ViewedRun(
        attack, world, {NO_OBJECT: None, **attack.looks(world)}, drives=drives
    )


def drive_name(drive: Drive) -> str:
    """Name a drive by environment and case."""
    return f"{drive.environment}: {drive.case}"


def offset_of(pose: Pose, position: np.ndarray, wxyz: np.ndarray) -> np.ndarray:
    """Return the offset (6,) that puts an object elsewhere.

    Args:
        pose: that its scenario gives it.
        position: (3,) of its origin, metres.
        wxyz: (4,), unit quaternion, its frame to the world.

    Returns:
        shift in metres and rotation vector in radians, as of `Pose.moved`.
    """
    turned = Rotation.from_quat(wxyz, scalar_first=True).as_matrix() @ pose.rotation.T
    vector = Rotation.from_matrix(turned).as_rotvec()
    return np.concatenate([position - pose.translation, vector])


def to_wxyz(rotation: np.ndarray) -> np.ndarray:
    """Return the unit quaternion (4,), scalar first, of a rotation (3, 3)."""
    return Rotation.from_matrix(rotation).as_quat(scalar_first=True)
