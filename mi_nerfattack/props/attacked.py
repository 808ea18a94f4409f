"""The attacked box of a run: its six pictures, its pose, and who saw it from where."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.ndimage import distance_transform_edt

from mi_nerfattack.capture.mesh.cube_faces import (
    FLAT_FACES,
    CubeFaces,
    flat_share,
    object_box,
    render_faces,
)
from mi_nerfattack.capture.mesh.mesh import CUBE_FACES
from mi_nerfattack.drives.store import read_drives
from mi_nerfattack.errors import InputError
from mi_nerfattack.experiment.run_folder import DRIVES, object_path
from mi_nerfattack.experiment.transfer.found import FoundAttack, read_found
from mi_nerfattack.fields.base import FLAT
from mi_nerfattack.fields.grid import GridField
from mi_nerfattack.fields.io import load_grid
from mi_nerfattack.render.camera.intrinsics import Camera, CameraMount, mount_matrix
from mi_nerfattack.render.camera.pose import Pose
from mi_nerfattack.render.camera.projection import project
from mi_nerfattack.rollout.drive import ATTACK
from mi_nerfattack.scenario.deployment import SURROGATE
from mi_nerfattack.scenario.world import build_surrogate

#: Faces by what they are called in the object's own frame, and in `CUBE_FACES`.
FACES: Mapping[str, str] = {
    "front": "ny",
    "right": "px",
    "back": "py",
    "left": "nx",
    "top": "pz",
    "bottom": "nz",
}
TEXTURE_PX = 512  # of the longest edge: eight for each voxel of a grid of 64
_FLAT = 0.9  # share of the sides; the bundled cube has 1, the car 0.5
_POINTS = 8  # of a face, an edge, that views are asked for


@dataclass(frozen=True, eq=False)
class AttackedBox:
    """A box as an attack left it.

    Attributes:
        name: id of the object.
        run: label of the run folder.
        digest: 64 hexadecimal digits of all attacked textures and poses of the run.
        lower, upper: (3,), of the box in its own frame, metres.
        pose: own frame to world, attacked.
        images: by the names of `FACES`: (h, w, 3), uint8 sRGB, as seen from outside.
        sheet: name of the face that a flat object is; None for a whole box.
    """

    name: str
    run: str
    digest: str
    lower: np.ndarray
    upper: np.ndarray
    pose: Pose
    images: Mapping[str, np.ndarray]
    sheet: str | None = None

    @property
    def edges_m(self) -> np.ndarray:
        """Edge lengths along the box's own axes in the world, (3,), metres."""
        return self.pose.scale * (self.upper - self.lower)

    @property
    def faces(self) -> tuple[str, ...]:
        """Names of the faces that show pictures."""
        return tuple(FACES) if self.sheet is None else (self.sheet,)

    def check_face(self, face: str | None) -> None:
        """Refuse a face that shows nothing; None is any.

        Raises:
            InputError: the box is flat, and this is another face.
        """
        if face is not None and face not in self.faces:
            raise InputError(
                f"--face: {face}; {self.name} is flat and has {self.sheet} alone"
            )

    def edges_mm(self, longest_mm: float | None) -> np.ndarray:
        """Return the edges (3,), millimetres, of a copy whose longest is given.

        Args:
            longest_mm: None for the size that the object has in the run.

        Raises:
            InputError: it is not positive and finite.
        """
        natural = 1e3 * self.edges_m
        if longest_mm is None:
            return natural
        if not 0 < longest_mm < np.inf:
            raise InputError(f"--size-mm: {longest_mm}; must be positive and finite")
        return natural * (longest_mm / natural.max())

    def plane(self, face: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return where a face's picture lies in the world.

        Args:
            face: one of `FACES`.

        Returns:
            top left corner, and vectors along the top edge and down the left edge as
            long as these, (3,) each, metres.
        """
        normal, right, up = np.array(CUBE_FACES[FACES[face]], np.float64)
        middle, half = (self.lower + self.upper) / 2, (self.upper - self.lower) / 2
        corner = middle + half * (normal - right + up)
        pose = self.pose
        turned = pose.scale * pose.rotation
        return (
            turned @ corner + pose.translation,
            turned @ (2 * half * right),
            turned @ (-2 * half * up),
        )


@dataclass(frozen=True, eq=False)
class Views:
    """The camera's poses in a run's drives in the surrogate, with the attacked objects.

    Attributes:
        camera: intrinsics.
        mount: of the camera on the vehicle, from the middle of the rear axle.
        camera_to_world: (n, 4, 4), OpenCV axes, metres; n is 0 without such drives.
        period: of the drives, seconds between two frames.
    """

    camera: Camera
    mount: CameraMount
    camera_to_world: np.ndarray
    period: float


def read_box(
    run: Path, name: str | None = None, texture_px: int = TEXTURE_PX
) -> tuple[AttackedBox, Views]:
    """Read the attacked box of a finished run.

    Args:
        run: folder of `mi-nerfattack attack`.
        name: id of the object; None for the only one that is a box.
        texture_px: of the longest edge, in the pictures.

    Raises:
        InputError: the folder holds no finished attack, no such object, or one that is
            no box; or several are, and none is named.
    """
    (attack,) = read_found([run])
    names = [item.id for item in attack.scenario.objects]
    if name is not None and name not in names:
        raise InputError(f"--box: {name!r}; {run} has {', '.join(names)}")
    fields = {n: load_grid(object_path(run, n)) for n in ([name] if name else names)}
    shares = {
        n: 1.0 if FLAT in field.info else flat_share(field)
        for n, field in fields.items()
    }
    boxes = [n for n, share in shares.items() if share >= _FLAT]
    if not boxes:
        text = ", ".join(f"{n} to {100 * share:.0f} %" for n, share in shares.items())
        raise InputError(
            f"{run}: no box was attacked: its sides are surface, of {text}; only boxes "
            "can be folded, shown and projected: attack one of 'mi-nerfattack asset "
            "cube', bundled:cube/field.safetensors, or a billboard or patch"
        )
    if len(boxes) > 1:
        raise InputError(f"--box: is missing; {run} has {', '.join(boxes)}")
    poses, views = placed(attack)
    number, field = names.index(boxes[0]), fields[boxes[0]]
    moved = poses[number].moved(attack.offsets[number])
    lower, upper, images = box_pictures(field, texture_px)
    sheet = None
    if FLAT in field.info:
        (sheet,) = (k for k, v in FACES.items() if v == FLAT_FACES[field.info[FLAT]])
    box = AttackedBox(
        name=boxes[0],
        run=attack.label,
        digest=attack.digest,
        lower=lower,
        upper=upper,
        pose=moved,
        images=images,
        sheet=sheet,
    )
    return box, views


def seen_most(box: AttackedBox, views: Views) -> str:
    """Return the face that filled most of the image over all views.

    By the solid angle of what lies within the image; nothing hides anything. Of a
    flat object, it is its sheet.

    Raises:
        InputError: there are no views, or no face is in any.
    """
    if box.sheet is not None:
        return box.sheet
    share = (np.arange(_POINTS) + 0.5) / _POINTS
    angles = {face: 0.0 for face in FACES}
    matrices = views.camera_to_world
    for face in FACES:
        corner, across, down = box.plane(face)
        grid = share[:, None, None] * across + share[:, None] * down
        points = (corner + grid).reshape(-1, 3)
        area = np.cross(down, across) / len(points)  # outward
        for matrix in matrices:
            camera_points = (points - matrix[:3, 3]) @ matrix[:3, :3]
            _, inside = project(views.camera, camera_points, 0.1)
            away = matrix[:3, 3] - points[inside]
            facing = np.maximum(away @ area, 0)
            angles[face] += float((facing / np.linalg.norm(away, axis=1) ** 3).sum())
    best = max(angles, key=lambda face: angles[face])
    if not angles[best] > 0:
        raise InputError(
            f"{box.run}: none of its {len(matrices)} views in the surrogate shows "
            f"{box.name}; choose with --face {'|'.join(FACES)}"
        )
    return best


def placed(attack: FoundAttack) -> tuple[list[Pose], Views]:
    """Return where the scenario puts its objects, and where they were seen from."""
    scenario = attack.scenario
    rig = scenario.rig()
    camera, mount = rig.cameras[0], rig.mounts[0]
    if scenario.scene.surrogate is None:
        poses = [item.pose for item in scenario.objects]
    else:
        sensor = build_surrogate(scenario)
        camera = sensor.intrinsics
        poses = [posed.pose for posed in sensor.objects]
    driven = [
        drive.poses
        for drive in read_drives(attack.folder / DRIVES)
        if (drive.environment, drive.case) == (SURROGATE, ATTACK)
    ]
    states = np.concatenate([np.zeros((0, 3)), *driven])
    matrices, period = mount_matrix(states, mount), scenario.vehicle.dt_s
    on_axle = scenario.vehicle.car().from_axle(mount)
    return poses, Views(camera, on_axle, matrices, period=period)


def box_pictures(
    field: GridField, texture_px: int = TEXTURE_PX
) -> tuple[np.ndarray, np.ndarray, dict[str, np.ndarray]]:
    """Return `lower`, `upper` and `images` of `AttackedBox`.

    Args:
        field: of an object that is a box.
        texture_px: of the longest edge, in the pictures.
    """
    lower, upper = object_box(field)
    faces = render_faces(field, texture_px / float((upper - lower).max()))
    return lower, upper, {face: _solid(faces, key) for face, key in FACES.items()}


def _solid(faces: CubeFaces, key: str) -> np.ndarray:
    """Return a picture (h, w, 3) without the haze at its rim.

    A pixel of less than half the opacity takes the colour of the nearest other.
    """
    image = faces.images[key]
    hazy = image[..., 3] < 128
    nearest = np.asarray(
        distance_transform_edt(
            hazy, sampling=None, return_distances=False, return_indices=True
        )
    )
    return np.ascontiguousarray(image[nearest[0], nearest[1], :3])
