"""Environments, each a world with one vehicle and its camera, and a drive in one."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any

import mitsuba as mi
import numpy as np

from mi_nerfattack.backend.arrays import aligned
from mi_nerfattack.backend.colour import srgb_to_linear_numpy
from mi_nerfattack.deploy.car import Control, control_names
from mi_nerfattack.deploy.vehicle import Controls
from mi_nerfattack.errors import InputError
from mi_nerfattack.policy.base import AbstractPolicy
from mi_nerfattack.render.camera.intrinsics import Camera, CameraMount
from mi_nerfattack.render.camera.rig import Layout, Rig
from mi_nerfattack.rollout.drive import Drive
from mi_nerfattack.rollout.loop import numbers_of, stacked
from mi_nerfattack.vehicle.dynamics import require_controls, to_state
from mi_nerfattack.vehicle.route.route import Route


@dataclass(frozen=True, eq=False)
class CameraFrame:
    """What the vehicle's camera observes, or its cameras, side by side.

    Args:
        image: (height, width, 3) uint8, sRGB.
        depth: (height, width) float32, metres along the ray through the pixel's
            centre, infinite where there is nothing.
        camera_to_world: (4, 4) float64, OpenCV axes, metres; of the first camera.
        linear: (height, width, 3) float32, what the image was made of; None where the
            environment gives eight bits alone.
        split: takes the frame apart: called with the names of the objects, gives layers
            as `layers` does; None where objects are part of the scene, or there are
            none.
    """

    image: np.ndarray
    depth: np.ndarray
    camera_to_world: np.ndarray
    linear: np.ndarray | None = None
    split: Callable[[Sequence[str]], dict[str, np.ndarray]] | None = None

    @property
    def light(self) -> np.ndarray:
        """What the image was made of, or was decoded to: (height, width, 3), linear."""
        if self.linear is not None:
            return self.linear
        return srgb_to_linear_numpy(self.image / np.float32(255))

    def layers(self, objects: Sequence[str]) -> dict[str, np.ndarray]:
        """Take the frame apart, for a file.

        A layer is what reaches the camera of one thing, premultiplied: colours and
        opacities of all layers add up to those of the frame.

        Args:
            objects: names of the objects that are shown; ignored where the scene
                contains their geometry.

        Returns:
            by layer name: the frame as ``""`` (height, width, 4) and ``Z``. In the
            same way ``scene``, and each object as ``NAME`` and ``NAME.Z``. The
            surrogate adds its further fields (``scene1``, ...) and the background
            behind all of them (``background``). Colours are linear, depths in metres
            along the ray.
        """
        opaque = np.ones((*self.depth.shape, 1), np.float32)
        layers = {"": np.concatenate([self.light, opaque], axis=-1), "Z": self.depth}
        return layers if self.split is None else layers | self.split(objects)


def join_frames(frames: Sequence[CameraFrame], layout: Layout) -> CameraFrame:
    """Lay the frames of a vehicle's cameras side by side.

    Below those that are lower, the image is black, nothing is seen, and all depths are
    infinite.

    Args:
        frames: of all cameras; a single one stays as it is.
        layout: where they lie.
    """
    if len(frames) == 1:
        return frames[0]
    light = None
    if all(frame.linear is not None for frame in frames):
        light = layout.join([frame.light for frame in frames])
    return CameraFrame(
        layout.join([frame.image for frame in frames]),
        _join_depths([frame.depth for frame in frames], layout),
        frames[0].camera_to_world,
        linear=light,
        split=partial(_join_layers, frames, layout),
    )


def first_frame(frame: CameraFrame, layout: Layout) -> CameraFrame:
    """Return what the first of several cameras sees of a frame; undoes `join_frames`.

    Args:
        frame: of all.
        layout: of their images.
    """
    if len(layout.sizes) == 1:
        return frame
    linear = None if frame.linear is None else layout.split(frame.linear)[0]
    return CameraFrame(
        layout.split(frame.image)[0],
        layout.split(frame.depth[..., None])[0][..., 0],
        frame.camera_to_world,
        linear=linear,
    )


def _join_depths(depths: Sequence[np.ndarray], layout: Layout) -> np.ndarray:
    return layout.join([depth[..., None] for depth in depths], np.inf)[..., 0]


def _join_layers(
    frames: Sequence[CameraFrame], layout: Layout, objects: Sequence[str]
) -> dict[str, np.ndarray]:
    """Join the layers of frames; see :meth:`CameraFrame.layers`."""
    layers = [frame.layers(objects) for frame in frames]
    return {
        name: _join_depths([each[name] for each in layers], layout)
        if first.ndim == 2
        else layout.join([each[name] for each in layers])
        for name, first in layers[0].items()
    }


class AbstractEnvironment(ABC):
    """World that a policy drives in, one control period after the other.

    Everything random follows from the seed: two environments that are made alike and
    reset alike give equal frames for equal controls.

    Attributes:
        name: "surrogate", "mitsuba", "mujoco", ...
        camera: intrinsics of the observed images, of several the first ones.
        period: seconds between two images.
        max_control: largest control that has an effect, in the unit that `step` takes;
            of several controls, the first one's.
        control_unit: "rad/s" of a heading rate, or "rad" of a steering angle.
        more_controls: those that `step` takes after the first one.
    """

    name: str
    camera: Camera
    period: float
    max_control: float
    control_unit: str
    more_controls: tuple[Control, ...] = ()

    @cached_property
    def rig(self) -> Rig:
        """The cameras whose images are observed, side by side; by default one."""
        return Rig.of_one(self.camera, CameraMount())

    @property
    def control_names(self) -> tuple[str, ...]:
        """Names of the controls, in their order."""
        return control_names(self.control_unit, self.more_controls)

    @abstractmethod
    def reset(
        self, route: Route, pose: np.ndarray | None = None, seed: int = 0
    ) -> CameraFrame:
        """Put the vehicle at rest of all but its nominal speed.

        Args:
            route: that is followed; some environments take their speed from it.
            pose: (3,), x and y in metres, heading in radians; None for the route's
                start.
            seed: of everything random until the next reset, at least 0.

        Returns:
            The first frame.
        """

    @abstractmethod
    def step(self, control: Controls) -> CameraFrame:
        """Hold a control for one period.

        Args:
            control: heading rate (rad/s) or steering angle (rad), as the environment
                was made; positive to the left. Beyond `max_control` it saturates. Of
                several controls one number each, in the order of `control_names`.

        Returns:
            The frame at the end of the period.

        Raises:
            InputError: the control is not finite, there are more or fewer than the
                vehicle takes, or nothing was reset before.
        """

    def advance(self, control: Controls) -> None:
        """Hold a control for one period as `step` does, but look at nothing."""
        self.step(control)

    @property
    @abstractmethod
    def state(self) -> np.ndarray:
        """State (m,) float64, m >= 3: x, y (metres), heading (radians), others.

        The other rows are those of the vehicle's model in `surrogate`, `mitsuba` and
        `carla`; those of `MujocoVehicle` in `mujoco` and `mujoco_gl`; `replay` has
        none.
        """

    @property
    def speed(self) -> float:
        """Speed along the heading, metres per second.

        Raises:
            InputError: the environment does not measure it.
        """
        raise InputError(
            f"environment {self.name!r}: it knows no speed, which the policy is told"
        )

    @property
    def is_over(self) -> bool:
        """Whether there is nothing more to observe, as at the end of a recording."""
        return False

    @abstractmethod
    def show(self, objects: Sequence[Any]) -> None:
        """Show radiance fields instead of the former ones.

        The surrogate composes them with its own field; other environments paste them
        by depth as opaque ones (appendix B.3). Frames change from the next one on.

        Args:
            objects: PosedField each; may be empty.
        """

    @abstractmethod
    def close(self) -> None:
        """Let go of what a window, a process or a connection holds."""


class OpenEnvironment:
    """At most one environment, open for as long as the same one is asked for."""

    def __init__(self) -> None:
        self._open: tuple[Any, AbstractEnvironment] | None = None

    def get(
        self, key: Any, make: Callable[[], AbstractEnvironment]
    ) -> AbstractEnvironment:
        """Return the environment of a key.

        Args:
            key: equal for what one environment serves.
            make: opens it, after the one of another key was closed.
        """
        if self._open is None or self._open[0] != key:
            self.close()
            self._open = key, make()
        return self._open[1]

    def close(self) -> None:
        """Close the environment, where one is open."""
        if self._open is not None:
            self._open[1].close()
        self._open = None


def drive(
    environment: AbstractEnvironment,
    policy: AbstractPolicy,
    route: Route,
    pose: np.ndarray,
    seed: int,
    steps: int,
    on_step: Callable[[int], None] | None = None,
    case: str = "no_object",
    run: int = 0,
    label: str | None = None,
) -> Drive:
    """Let a policy drive in an environment.

    Args:
        environment: is reset; what it shows is left alone.
        policy: sees sRGB frames (1, height, width, 3) of eight bits, in [0, 1]; one
            with memory starts with its initial one.
        route: whose goal the policy gets, and to which errors are measured.
        pose: (3,), of the start, metres and radians.
        seed: of the environment.
        steps: control periods; fewer where the environment is over before.
        on_step: called after each with its index; an exception ends the drive.
        case: of the result.
        run: of the result.
        label: what the result calls the environment; its name by default.

    Raises:
        InputError: the policy does not take the camera's images, its control is not
            finite, or it gives more or fewer than the vehicle takes.
    """
    frame = environment.reset(route, np.asarray(pose, np.float64), seed)
    memory = policy.initial_memory(1)
    states, controls = [environment.state], []
    for index in range(steps):
        image = policy_image(frame.image)
        numbers = policy_numbers(policy, environment, route, step=index)
        row, memory = policy.step(image, route.goal, memory, numbers)
        controls.append(single_control(row, environment.control_names))
        frame = environment.step(controls[-1])
        states.append(environment.state)
        if on_step is not None:
            on_step(index)
        if environment.is_over:
            break
    return Drive(
        environment=label or environment.name,
        route=route.name,
        case=case,
        run=run,
        seed=seed,
        states=np.stack(states),
        controls=np.array(controls),
        cross_track_m=route.cross_track_numpy(np.stack(states[1:])),
        time_s=environment.period * np.arange(1, len(controls) + 1),
    )


def single_control(row: Any, names: Sequence[str]) -> float | np.ndarray:
    """Return what a policy gave for one image: a number, or (k,) of k > 1 controls.

    Args:
        row: (1,) or (k, 1), of Dr.Jit.
        names: of the controls that the vehicle takes.

    Raises:
        InputError: there are not as many.
    """
    values = np.array(row, np.float64).reshape(-1)
    require_controls(len(values), names)
    return float(values[0]) if len(values) == 1 else values


def policy_numbers(
    policy: AbstractPolicy, environment: AbstractEnvironment, route: Route, step: int
) -> Any:
    """Return the numbers that a policy asks for, (1, k); None if it asks for none.

    Args:
        policy: that asks.
        environment: in which it drives.
        route: whose points the policy gets.
        step: control periods since the start.

    Raises:
        InputError: the environment does not know it.
    """
    if not policy.numbers:
        return None
    state, row = to_state(environment.state[None]), None
    if policy.numbers.speed:
        row = to_state(np.full((1, 3), environment.speed))[0]  # opaque
    time = step * environment.period
    return stacked(numbers_of(policy.numbers, state, row, time=time, route=route))


def trial_numbers(policy: AbstractPolicy) -> Any:
    """Return numbers for a first try, (1, k): a speed of 1 m/s; None for nothing."""
    kind: Any = mi.TensorXf
    size = policy.numbers.size
    return kind(np.ones((1, size), np.float32)) if size else None


def policy_image(image: np.ndarray) -> mi.TensorXf:
    """Return what a policy gets: (1, height, width, 3), sRGB in [0, 1].

    Args:
        image: (height, width, 3), uint8 sRGB.
    """
    return mi.TensorXf(aligned(np.divide(image[None], 255, dtype=np.float32)))
