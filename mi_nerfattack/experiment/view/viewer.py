"""The viewer in the browser: its controls, and what is rendered when."""

from __future__ import annotations

import threading
import time
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from mi_nerfattack.errors import NerfAttackError
from mi_nerfattack.experiment.view.frames import FrameSource
from mi_nerfattack.experiment.view.run import (
    ViewedRun,
    drive_name,
    offset_of,
    to_wxyz,
)
from mi_nerfattack.experiment.view.scene import Contents, RunScene, first_look
from mi_nerfattack.io import files
from mi_nerfattack.rollout.drive import Drive

if TYPE_CHECKING:
    import viser

PATIENCE_S = 0.5  # between looks at whether something was asked for
_SAME_M = 1e-4
_PICTURES = {
    "attribution.png": "When the failure is made",
    "attribution_object.png": "Where on the objects",
}
CLOUD = (
    "Points: where rays of the drives' own camera end in the surrogate's field. "
    "Objects: the surface where their fields are half opaque, in their own colours."
)
RECORDED_LABEL, MOVED_LABEL = "What the policy saw", "What the policy would see"
HAND_MOVED = (
    "**Moved by hand**: the car stays on the recorded drive, and no policy saw this."
)


class Viewer:
    """Scene and controls of a run on a server.

    What a browser changes is only noted by the server's threads; :meth:`turn` renders
    it in the thread that calls it, the newest alone.

    Args:
        server: empty.
        contents: what is shown.
    """

    def __init__(self, server: viser.ViserServer, contents: Contents) -> None:
        viewed, drive = contents.viewed, contents.drive
        self.viewed, self.frames = viewed, FrameSource(viewed)
        self.scene = RunScene(server.scene, contents)
        eye, target = first_look(viewed, drive)
        server.initial_camera.position, server.initial_camera.look_at = eye, target
        self.moved: dict[int, np.ndarray] = {}
        self._changed = threading.Event()
        self._changed.set()
        self._is_playing = False
        self._due = 0.0  # when the next frame is, while playing
        gui = server.gui
        gui.set_panel_label(viewed.world.scenario.name)
        self._add_time(gui, drive)
        self._add_objects(server)
        self._add_scene(gui)

    def run(self) -> None:
        """Render what is asked for, until an interrupt."""
        try:
            while True:
                self.turn(PATIENCE_S)
        finally:
            self.frames.close()

    def turn(self, patience_s: float) -> bool:
        """Render what is asked for, if it is new; while playing, in time the next.

        Args:
            patience_s: longest that it waits for something new, seconds.

        Returns:
            whether anything was rendered.
        """
        if self._is_playing:
            patience_s = min(patience_s, max(0.0, self._due - time.monotonic()))
        if not self._changed.wait(patience_s):
            if not self._is_playing or time.monotonic() < self._due:
                return False
            self.slider.value = following(self.slider.value, int(self.slider.max))
        self._changed.clear()
        self._due = time.monotonic() + self.viewed.world.scenario.vehicle.dt_s
        self._render()
        return True

    @property
    def drive(self) -> Drive:
        """The drive that is shown."""
        return self.viewed.drive(self.choice.value)

    def _render(self) -> None:
        drive, moved = self.drive, dict(self.moved)
        last = len(drive.controls)
        self.slider.max = last
        step = min(self.slider.value, last)
        self.slider.value = step
        poses = self.viewed.poses(drive.case, moved)
        self.scene.show(drive.case, poses)
        for number, pose in enumerate(poses):
            if number not in moved:
                self._put(number, pose.translation, to_wxyz(pose.rotation))
        try:
            image = self.frames.see(drive, step, moved=moved)
            apart = self.frames.difference(drive, step, image, moved=moved)
        except NerfAttackError as err:  # as a simulator that does not run here
            self.description.content = f"**No frame**: {err}"
            return
        self.picture.image = image
        self.picture.label = MOVED_LABEL if moved else RECORDED_LABEL
        self.scene.look_from(self.viewed.cameras(drive)[step], image)
        self.apart.visible = apart is not None
        if apart is not None:
            self.apart.image = apart
        lines = [describe(self.viewed, drive, step), *([HAND_MOVED] if moved else [])]
        self.description.content = "\n\n".join(lines)

    def _add_time(self, gui: viser.GuiApi, drive: Drive) -> None:
        names = [drive_name(item) for item in self.viewed.shown]
        self.choice = gui.add_dropdown("Drive", names, initial_value=drive_name(drive))
        self.slider = gui.add_slider(
            "Period", min=0, max=len(drive.controls), step=1, initial_value=0
        )
        self.play = gui.add_button("Play")
        self.description = gui.add_markdown("")
        width, height = self.viewed.world.place.rig.size
        black = np.zeros((height, width, 3), np.uint8)
        self.picture = gui.add_image(black, label=RECORDED_LABEL, format="png")
        label = "Where the attack acts: difference to the objects' own textures"
        self.apart = gui.add_image(black, label=label, format="png")
        for handle in (self.choice, self.slider):
            handle.on_update(self._ask)
        self.play.on_click(self._toggle)

    def _add_objects(self, server: viser.ViserServer) -> None:
        """Add a handle in the scene, and a position, for each object."""
        self.handles: list[Any] = []
        self.positions: list[Any] = []
        world = self.viewed.world
        with server.gui.add_folder("Objects"):
            for number, item in enumerate(world.scenario.objects):
                posed = world.surrogate.objects[number]
                box = posed.field.upper - posed.field.lower
                size = posed.pose.scale * float(np.max(box))
                handle = server.scene.add_transform_controls(
                    f"/handles/{item.id}", scale=0.75 * size, depth_test=False
                )
                position = server.gui.add_vector3(
                    f"{item.id}, m", (0.0, 0.0, 0.0), step=0.01
                )
                handle.on_update(partial(self._drag, number))
                position.on_update(partial(self._type, number))
                self.handles.append(handle)
                self.positions.append(position)
            self.back = server.gui.add_button("Put back")
            self.back.on_click(self._put_back)

    def _add_scene(self, gui: viser.GuiApi) -> None:
        with gui.add_folder("Scene"):
            points = gui.add_checkbox("Points", True)
            handles = gui.add_checkbox("Handles", True)
            gui.add_markdown(CLOUD)
        points.on_update(lambda _: setattr(self.scene.cloud, "visible", points.value))

        def hide(_: Any) -> None:
            for handle in self.handles:
                handle.visible = handles.value

        handles.on_update(hide)
        folder = self.viewed.attack.folder
        pictures = {title: folder / name for name, title in _PICTURES.items()}
        pictures = {title: path for title, path in pictures.items() if path.is_file()}
        if pictures:
            with gui.add_folder("Attribution", expand_by_default=False):
                for title, path in pictures.items():
                    gui.add_image(files.read_image(path)[..., :3], label=title)

    def _ask(self, event: Any) -> None:
        del event
        self._changed.set()

    def _toggle(self, event: Any) -> None:
        self._is_playing = not self._is_playing
        self.play.label = "Pause" if self._is_playing else "Play"
        self._ask(event)

    def _drag(self, number: int, event: Any) -> None:
        """Note where an object was dragged to."""
        handle = self.handles[number]
        pose = self.viewed.world.surrogate.objects[number].pose
        self.moved[number] = offset_of(pose, handle.position, handle.wxyz)
        self.positions[number].value = tuple(map(float, handle.position))
        self._ask(event)

    def _type(self, number: int, event: Any) -> None:
        """Note which position was typed; what was dragged comes here, too."""
        handle, position = self.handles[number], np.array(self.positions[number].value)
        if np.abs(handle.position - position).max() > _SAME_M:
            handle.position = position
            self._drag(number, event)

    def _put(self, number: int, position: np.ndarray, wxyz: np.ndarray) -> None:
        """Put a handle where its object stands by itself."""
        handle = self.handles[number]
        handle.position, handle.wxyz = position, wxyz
        self.positions[number].value = tuple(map(float, position))

    def _put_back(self, event: Any) -> None:
        self.moved.clear()
        self._ask(event)


def following(step: int, last: int) -> int:
    """Return the control period that is played next: the first after the last."""
    return step + 1 if step < last else 0


def describe(viewed: ViewedRun, drive: Drive, step: int) -> str:
    """Say when and where a drive is before a control period, and what it does."""
    route, dt_s = viewed.world.route, viewed.world.scenario.vehicle.dt_s
    error = float(route.cross_track_numpy(drive.states[step][None])[0])
    side = "left" if error > 0 else "right"
    text = f"{step * dt_s:.1f} s: {abs(error):.2f} m {side} of the lane's centre"
    if step < len(drive.controls):
        car = viewed.world.scenario.vehicle.car()
        units = car.control_unit, *(control.unit for control in car.more_controls)
        pairs = zip(np.ravel(drive.controls[step]), units, strict=True)
        text += f", control {', '.join(f'{u:+.3f} {unit}' for u, unit in pairs)}"
    return text
