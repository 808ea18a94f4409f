"""What the policy saw: frames of drives as files, and as a strip.

The first drive of each environment and case, whose objects look alike in all drives, is
driven again by its recorded controls, which gives the frames that the policy saw.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mi_nerfattack.capture.transforms import write_poses
from mi_nerfattack.deploy.environment import (
    AbstractEnvironment,
    CameraFrame,
    policy_image,
    policy_numbers,
)
from mi_nerfattack.deploy.surrogate.environment import SurrogateEnvironment
from mi_nerfattack.evaluation.metrics import environment_order
from mi_nerfattack.experiment.cases import OnProgress
from mi_nerfattack.experiment.finished import Finished, Frames
from mi_nerfattack.io import exr, files
from mi_nerfattack.render.camera.rig import Rig
from mi_nerfattack.render.pathtrace.views import describe_lens, frame_metadata
from mi_nerfattack.report.plots.strip import aligned_steps, first_person_strip
from mi_nerfattack.rollout.drive import CASES, Drive
from mi_nerfattack.rollout.function import Rollout
from mi_nerfattack.rollout.loop import Trajectory
from mi_nerfattack.scenario.deployment import SURROGATE
from mi_nerfattack.scenario.world import Appearance, World
from mi_nerfattack.vehicle.dynamics import to_control, to_state

_OURS = re.compile(r"[0-9]{4,}(_input)?\.(exr|png)|transforms\.json|depth\.safetensors")


class FrameFolder:
    """A folder that frames are written to, each as ``STEP.exr`` and ``STEP.png``.

    With ``transforms.json`` and ``depth.safetensors``, which :meth:`finish` writes, it
    is a recording for the environment `replay`; frames of several cameras are none.
    What an earlier run left is removed.

    Args:
        path: of the folder; made.
        rig: cameras of all frames.
    """

    def __init__(self, path: Path, rig: Rig) -> None:
        self.path, self.rig = files.make_folder(path), rig
        for file in list(self.path.iterdir()):
            if _OURS.fullmatch(file.name):
                file.unlink()
        self._names: list[str] = []
        self._times: list[float] = []
        self._poses: list[np.ndarray] = []
        self._depths: list[np.ndarray] = []

    def add(
        self,
        step: int,
        time_s: float,
        frame: CameraFrame,
        layers: Mapping[str, np.ndarray],
        metadata: Mapping[str, str],
        half: bool,
    ) -> None:
        """Write one frame; later ones come later.

        Args:
            step: control periods before it.
            time_s: seconds before it.
            frame: as it was seen.
            layers: for the EXR file. Those that are called ``input.K`` and have a size
                of their own go to ``STEP_input.exr``.
            metadata: of the EXR files.
            half: colour and opacity in half precision.
        """
        name = f"{step:04d}"
        files.write_image(self.path / f"{name}.png", frame.image)
        size = frame.depth.shape
        fitting = {key: a for key, a in layers.items() if a.shape[:2] == size}
        others = {key: a for key, a in layers.items() if key not in fitting}
        exr.write_layers(self.path / f"{name}.exr", fitting, metadata, half=half)
        if others:
            exr.write_layers(
                self.path / f"{name}_input.exr", others, metadata, half=half
            )
        self._names.append(f"{name}.png")
        self._times.append(time_s)
        self._poses.append(frame.camera_to_world)
        self._depths.append(frame.depth)

    def finish(self) -> None:
        """Write what makes a recording of the frames, poses and times last."""
        if self.rig.others is not None:
            return
        depth = np.stack(self._depths).astype(np.float32)
        files.write_safetensors(self.path / "depth.safetensors", {"depth": depth}, {})
        write_poses(
            self.path / "transforms.json",
            self._names,
            self.rig.cameras[0],
            camera_to_world=np.stack(self._poses),
            extra={"units": "metre", "depth_file": "depth.safetensors"},
            times_s=self._times,
        )


STRIP_FRAMES = 6
WORST_S = 1.0


def nominal_drives(drives: Sequence[Drive], cases: Collection[str]) -> list[Drive]:
    """Return the first drive of each environment and case, in the order of plots.

    Args:
        drives: of a run.
        cases: of which drives are wanted.
    """
    nominal = [d for d in drives if d.run == 0 and d.case in cases]
    return sorted(
        nominal, key=lambda d: (environment_order(d.environment), CASES.index(d.case))
    )


def frame_folder(output: Path, drive: Drive) -> Path:
    """Return the folder of a drive's frames."""
    return output / "frames" / f"{drive.environment}_{drive.case}"


def frame_steps(drive: Drive, frames: Frames) -> list[int]:
    """Choose frames of a drive of T control periods.

    Args:
        drive: of which frames are wanted.
        frames: "all": those of all T periods, and the one at the drive's end, so that
            a replay of them has T periods, too. "worst": those of the second that
            ends where the drive is farthest from the lane's centre. A number: so many,
            equally spaced.

    Returns:
        the control periods before each.
    """
    last = len(drive.controls)
    if frames == "all":
        return list(range(last + 1))
    if frames == "worst":
        end = 1 + int(drive.distance_m.argmax())
        count = round(WORST_S / drive.time_s[0])
        return list(range(max(0, end - count), end + 1))
    return np.unique(np.linspace(0, last - 1, frames).round().astype(int)).tolist()


def write_frames(
    output: Path, done: Finished, frames: Frames, on_progress: OnProgress
) -> None:
    """Write ``strip.png`` and ``frames/``.

    Args:
        output: the run folder.
        done: results of the run.
        frames: which frames become files.
        on_progress: called after every time step with stage, steps and a remark.
    """
    world, nominal = done.world, nominal_drives(done.drives, done.looks)
    start_m = world.scenario.drive.start_m
    places, passed = aligned_steps(world.route, nominal, STRIP_FRAMES, start_m)
    rows: dict[str, list[np.ndarray]] = {}
    digests, count = world.scenario.digests(), 0
    total = sum(len(drive.controls) + 1 for drive in nominal)
    for drive, columns in zip(nominal, passed, strict=True):
        look = done.looks[drive.case]
        if look is not None:
            world.show(look)
        label = f"{drive.environment}\n{drive.case.replace('_', ' ')}"
        row, written = rows.setdefault(label, []), frame_steps(drive, frames)
        environment = world.open(drive.environment, empty=look is None)
        try:
            drive_digests = {**digests, **_digests(world, look)}
            film = Film(
                world, drive, environment, empty=look is None, digests=drive_digests
            )
            folder = FrameFolder(frame_folder(output, drive), environment.rig)
            costs = film.cost_by_image(written)
            for moment in film.moments({*columns, *written}):
                shown = columns.count(moment.step)
                row += [moment.rendered_frame.image] * shown if shown else []
                if moment.step in written:
                    film.write(folder, moment, costs.get(moment.step))
                done_so_far = count + moment.step + 1
                on_progress("frames", done_so_far, total, label.replace("\n", ": "))
            folder.finish()
        finally:
            environment.close()
        count += len(drive.controls) + 1
    titles = [f"{place:.1f} m" for place in places]
    first_person_strip(output / "strip.png", rows, titles)


@dataclass(frozen=True, eq=False)
class Moment:
    """A drive after some control periods.

    Attributes:
        step: how many.
        state: (m,), of the vehicle.
        memory: of the policy, before it sees the frame.
        frame: None where nobody asked for it.
    """

    step: int
    state: np.ndarray
    memory: tuple[Any, ...]
    frame: CameraFrame | None

    @property
    def rendered_frame(self) -> CameraFrame:
        """The frame, which was asked for."""
        assert self.frame is not None
        return self.frame


@dataclass(frozen=True, eq=False)
class Film:
    """A drive that is driven again.

    Attributes:
        world: what was driven in, with what it showed.
        drive: as it was.
        environment: in which it was driven.
        empty: whether there are no objects.
        digests: SHA-256 of the scenario's files, and of the textures that are seen.
    """

    world: World
    drive: Drive
    environment: AbstractEnvironment
    empty: bool
    digests: Mapping[str, str]

    def moments(self, steps: Collection[int]) -> Iterator[Moment]:
        """Drive by the recorded controls; a policy with a memory sees all frames.

        Args:
            steps: control periods before the frames that are to be seen.
        """
        policy, route, drive = self.world.policy, self.world.route, self.drive
        memory = policy.initial_memory(1)
        watched = bool(memory)
        frame = self.environment.reset(route, drive.poses[0], drive.seed)
        for step in range(len(drive.controls) + 1):
            if step:
                control = drive.controls[step - 1]
                if watched or step in steps:
                    frame = self.environment.step(control)
                else:
                    self.environment.advance(control)
            shown = frame if step in steps else None
            yield Moment(step, self.environment.state, memory, frame=shown)
            if watched:
                numbers = policy_numbers(policy, self.environment, route, step=step)
                image = policy_image(frame.image)
                _, memory = policy.step(image, route.goal, memory, numbers)

    def cost_by_image(self, steps: Sequence[int]) -> dict[int, np.ndarray]:
        """Differentiate the objective of the drive by its images.

        Args:
            steps: control periods.

        Returns:
            by period (height, width, 3): by sRGB values in [0, 1]. Nothing where
            environment or policy has no derivatives, and of an image no policy saw.
        """
        environment, world = self.environment, self.world
        is_surrogate = isinstance(environment, SurrogateEnvironment)
        if not is_surrogate or not world.policy.differentiable:
            return {}
        moments = list(self.moments(()))
        rows = [to_control(np.reshape(u, (1, -1))) for u in self.drive.controls]
        states = [to_state(moment.state[None]) for moment in moments]
        loop, memories = world.loop(environment.sensor), [m.memory for m in moments]
        drive = Trajectory(tuple(states), tuple(rows), loop.dt, tuple(memories))
        attached = world.scenario.attack.attached
        rollout = Rollout(loop, world.objective, drive.horizon, attached=attached)
        by_images = rollout.by_images(drive, {k for k in steps if k < drive.horizon})
        return {step: image[0] for step, image in by_images.items()}

    def write(
        self, folder: FrameFolder, moment: Moment, cost: np.ndarray | None
    ) -> None:
        """Write the frame of a moment.

        Args:
            folder: where to.
            moment: when.
            cost: derivative of the objective by the image, (height, width, 3).
        """
        frame = moment.rendered_frame
        names = [item.id for item in self.world.scenario.objects]
        names = [] if self.empty else names
        layers = frame.layers(["object"] if len(names) == 1 else names)
        if cost is not None:
            layers |= {f"cost.d{c}": cost[..., i] for i, c in enumerate("RGB")}
        if moment.step < len(self.drive.controls):
            (planes,) = self.world.policy.planes(
                policy_image(frame.image), moment.memory
            )
            layers |= {f"input.{k}": plane for k, plane in enumerate(planes)}
        # path-traced light sources may exceed the range of half precision
        half = self.drive.environment == SURROGATE
        time_s = moment.step * self.environment.period
        folder.add(
            moment.step,
            time_s,
            frame,
            layers=layers,
            metadata=self.describe(moment),
            half=half,
        )

    def describe(self, moment: Moment) -> dict[str, str]:
        """Say what a frame shows; see :func:`frame_metadata`."""
        world, drive, step = self.world, self.drive, moment.step
        label, state, rig = drive.environment, moment.state, self.environment.rig
        return frame_metadata(
            describe_lens(rig.cameras[0]),
            moment.rendered_frame.camera_to_world,
            drive.seed,
            spp=world.surrogate.camera.spp
            if label == SURROGATE
            else world.deployments[label].spp,
            digests=self.digests,
            cameras=None if rig.others is None else rig.described(),
            scenario=world.scenario.name,
            environment=label,
            case=drive.case,
            run=drive.run,
            step=step,
            time_s=step * self.environment.period,
            state=state.tolist(),
            control=None
            if step == len(drive.controls)
            else drive.controls[step].tolist(),
            cross_track_m=float(world.route.cross_track_numpy(state[None])[0]),
        )


def _digests(world: World, look: Appearance | None) -> dict[str, str]:
    """Hash textures as files of fields hold them."""
    if look is None:
        return {}
    digests = {}
    objects = zip(world.scenario.objects, world.fields, look.textures, strict=True)
    for item, field, texture in objects:
        raw = texture[field.held_vertices()].astype(np.float16).tobytes()
        digests[f"texture.{item.id}"] = hashlib.sha256(raw).hexdigest()
    return digests
