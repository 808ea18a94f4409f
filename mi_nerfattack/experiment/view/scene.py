"""What stands in the browser's scene: points, drives, objects, and the camera."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from mi_nerfattack.capture.mesh.gltf_writer import glb_bytes
from mi_nerfattack.capture.mesh.surface import (
    ColouredMesh,
    field_surface,
    seen_colours,
)
from mi_nerfattack.errors import InputError
from mi_nerfattack.experiment.view.points import CELL_M, Cloud, scene_cloud
from mi_nerfattack.experiment.view.run import (
    ViewedRun,
    drive_name,
    read_viewed,
    to_wxyz,
)
from mi_nerfattack.fields.grid import GridField
from mi_nerfattack.render.camera.pose import Pose
from mi_nerfattack.report.plots.drives import CASE_COLOURS
from mi_nerfattack.rollout.drive import ATTACK, Drive

if TYPE_CHECKING:
    import viser

_UP_M = 0.06  # of lines over the ground
_THICK_M, _THIN_M = 0.06, 0.02
_GLTF_TO_WORLD = (math.sqrt(0.5), math.sqrt(0.5), 0.0, 0.0)  # y up to z up
_FRAME_M = 3.0  # width of the frame before the camera
_NEAR_M, _BEHIND_M, _ABOVE_M = 12.0, 8.0, 5.0  # of the first look
_ROUTE = (154, 154, 154)


@dataclass(frozen=True, eq=False)
class ObjectShape:
    """An object's surface, which all its looks share.

    Attributes:
        surface: where its field is opaque; None where it is nowhere.
        looks: colours (n, 3) of the surface's vertices by case, linear.
    """

    surface: ColouredMesh | None
    looks: Mapping[str, np.ndarray]


@dataclass(frozen=True, eq=False)
class Contents:
    """What a browser is shown.

    Attributes:
        viewed: the run.
        drive: that is shown first.
        cloud: points of its place.
        shapes: of its objects.
    """

    viewed: ViewedRun
    drive: Drive
    cloud: Cloud
    shapes: Sequence[ObjectShape]


def read_contents(
    folder: Path, drive: str | None, on_frame: Callable[[int, int], None]
) -> Contents:
    """Read a run folder, look around, and find the objects' surfaces.

    Args:
        folder: of the run.
        drive: shown first, see :meth:`ViewedRun.drive`.
        on_frame: called with frames done and all frames.

    Raises:
        InputError: as of :func:`read_viewed`, or there is no such drive.
    """
    viewed = read_viewed(folder)
    first = viewed.drive(drive)
    cloud = scene_cloud(viewed.world, first.poses, on_frame)
    return Contents(viewed, first, cloud, shapes=object_shapes(viewed))


def object_shapes(viewed: ViewedRun) -> list[ObjectShape]:
    """Return the surfaces of the objects' fields, in their own frames.

    Cost: a second or so an object.
    """
    world, shapes = viewed.world, []
    cases = [case for case, look in viewed.looks.items() if look is not None]
    for field in world.fields:
        try:
            surface = field_surface(field)
        except InputError:  # a mist, which has none
            shapes.append(ObjectShape(None, {}))
            continue
        looks = {}
        for case in cases:
            viewed.show(case, {})
            looks[case] = seen_colours(field, surface.vertices, surface.normals)
        shapes.append(ObjectShape(surface, looks))
    return shapes


class RunScene:
    """The nodes of a run in the scene of a server.

    Args:
        scene: of the server, empty.
        contents: the point cloud, objects and drives of the run.
    """

    def __init__(self, scene: viser.SceneApi, contents: Contents) -> None:
        self._scene, self._viewed = scene, contents.viewed
        viewed, cloud = contents.viewed, contents.cloud
        self.cloud = scene.add_point_cloud(
            "/scene",
            cloud.points.astype(np.float32),
            cloud.colours,
            point_size=CELL_M,
            precision="float32",
            point_shading="flat",
        )
        self._add_lines()
        self._looks: list[dict[str, Any]] = []
        self._frames: list[Any] = []
        world = viewed.world
        for item, posed, field, shape in zip(
            world.scenario.objects,
            world.surrogate.objects,
            world.fields,
            contents.shapes,
            strict=True,
        ):
            name = f"/objects/{item.id}"
            self._frames.append(scene.add_frame(name, show_axes=False))
            self._looks.append(
                self._add_object(name, posed.pose.scale, field, shape=shape)
            )
        camera = viewed.world.surrogate.intrinsics
        high, wide = camera.height / (2 * camera.fy), camera.width / (2 * camera.fx)
        volume = float(np.cbrt(high * wide / 3))  # that viser scales to 1
        self._ahead = _FRAME_M / (2 * wide)  # of the frame, metres
        self._high = 2 * self._ahead * high
        self.camera = scene.add_camera_frustum(
            "/camera",
            fov=2 * math.atan(high),
            aspect=wide / high,
            scale=self._ahead * volume,
            thickness=_THIN_M,
            format="png",
        )
        self._text: viser.LabelHandle | None = None
        self._apart: viser.ImageHandle | None = None

    def show(self, case: str, poses: list[Pose]) -> None:
        """Show the objects of a case.

        Args:
            case: of a drive; without objects they are hidden.
            poses: where they stand.
        """
        hidden = self._viewed.looks[case] is None
        for frame, looks, pose in zip(self._frames, self._looks, poses, strict=True):
            frame.position, frame.wxyz = pose.translation, to_wxyz(pose.rotation)
            for name, node in looks.items():
                node.visible = not hidden and name in (case, "")

    def look_from(self, camera_to_world: np.ndarray, image: np.ndarray) -> None:
        """Put the camera somewhere, and what it sees before it."""
        self.camera.position = camera_to_world[:3, 3]
        self.camera.wxyz = to_wxyz(camera_to_world[:3, :3])
        self.camera.image = self._viewed.world.place.rig.layout.split(image)[0]

    def tell(self, text: str, apart: np.ndarray | None) -> None:
        """Write a line above the camera, and hang a picture there.

        Args:
            text: to write.
            apart: (height, width, 3), uint8, as large as what the cameras see; None
                for none. The first camera's part is shown.
        """
        layout = self._viewed.world.place.rig.layout
        apart = None if apart is None else layout.split(apart)[0]
        if self._text is None:
            self._text = self._scene.add_label(
                "/camera/text",
                text,
                position=(0.0, -1.8 * self._high, self._ahead),
                anchor="bottom-center",
            )
        self._text.text = text
        if apart is None:
            return
        if self._apart is None:
            self._apart = self._scene.add_image(
                "/camera/apart",
                apart,
                render_width=_FRAME_M,
                render_height=self._high,
                format="png",
                position=(0.0, -1.1 * self._high, self._ahead),
            )
        self._apart.image = apart

    def _add_object(
        self, name: str, scale: float, field: GridField, shape: ObjectShape
    ) -> dict[str, Any]:
        """Add an object's looks; of a mist its box, whatever it looks like."""
        if shape.surface is None:
            box = self._scene.add_box(
                f"{name}/box",
                dimensions=tuple(scale * (field.upper - field.lower)),
                position=scale * (field.upper + field.lower) / 2,
                wireframe=True,
            )
            return {"": box}
        nodes = {}
        for case, colours in shape.looks.items():
            data = glb_bytes(replace(shape.surface, colours=colours), case)
            nodes[case] = self._scene.add_glb(
                f"{name}/{case}",
                data,
                scale=scale,
                wxyz=_GLTF_TO_WORLD,
                cast_shadow=False,
                receive_shadow=False,
            )
        return nodes

    def _add_lines(self) -> None:
        route = self._viewed.world.route
        self._add_line("/route", route.points, _ROUTE, m=_THIN_M)
        first = {id(drive) for drive in self._viewed.shown}
        for drive in self._viewed.drives:
            colour = _rgb(CASE_COLOURS[drive.case])
            thick = _THICK_M if id(drive) in first else _THIN_M
            environment, case = drive_name(drive).split(": ")
            name = f"/drives/{environment}/{case}/{drive.run}"
            self._add_line(name, drive.states[:, :2], colour, m=thick)

    def _add_line(self, name: str, points: np.ndarray, colour: Any, m: float) -> None:
        """Draw a line through points (n, 2) of the ground."""
        raised = np.column_stack([points, np.full(len(points), _UP_M)])
        segments = np.stack([raised[:-1], raised[1:]], axis=1)
        self._scene.add_line_segments(name, segments, colour, thickness=m)


def first_look(viewed: ViewedRun, drive: Drive) -> tuple[np.ndarray, np.ndarray]:
    """Return from where a reader looks at first, and at what, (3,) each, metres.

    From behind and above the car, where it first is near the objects.
    """
    stand = [pose.translation for pose in viewed.poses(ATTACK, {})]
    target = np.mean(stand, axis=0)
    away = np.linalg.norm(drive.states[:, :2] - target[:2], axis=1)
    x, y, heading = drive.poses[np.argmax(away <= max(_NEAR_M, away.min()))]
    back = np.array([math.cos(heading), math.sin(heading)]) * _BEHIND_M
    return np.array([*([x, y] - back), _ABOVE_M]), target


def _rgb(colour: str) -> tuple[int, int, int]:
    """Read ``#rrggbb``."""
    red, green, blue = bytes.fromhex(colour[1:])
    return red, green, blue
