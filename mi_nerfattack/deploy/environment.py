"""The interface of deployment environments: a world with one vehicle and its camera."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from mi_nerfattack.backend.colour import srgb_to_linear_numpy
from mi_nerfattack.render.camera.intrinsics import Camera
from mi_nerfattack.vehicle.route.route import Route


@dataclass(frozen=True, eq=False)
class CameraFrame:
    """What the vehicle's camera observes.

    Args:
        image: (height, width, 3) uint8, sRGB.
        depth: (height, width) float32, metres along the ray through the pixel's
            centre, infinite where there is nothing.
        camera_to_world: (4, 4) float64, OpenCV axes, metres.
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
            objects: names of those that are shown; not looked at where their geometry
                is the scene's.

        Returns:
            by layer name: the frame as ``""`` (height, width, 4) and ``Z``; in the
            same way ``scene`` and each object as ``NAME`` and ``NAME.Z``, and of the
            surrogate further fields (``scene1``, ...) and what is seen behind all of
            them (``background``). Linear; depths in metres along the ray.
        """
        opaque = np.ones((*self.depth.shape, 1), np.float32)
        whole = {"": np.concatenate([self.light, opaque], axis=-1), "Z": self.depth}
        return whole if self.split is None else whole | self.split(objects)


class AbstractEnvironment(ABC):
    """World that a policy drives in, one control period after the other.

    Everything random follows from the seed: two environments that are made alike and
    reset alike give equal frames for equal controls.

    Attributes:
        name: "surrogate", "mitsuba", "mujoco", ...
        camera: intrinsics of the observed images.
        period: seconds between two images.
        max_control: largest control that has an effect, in the unit that `step` takes.
        control_unit: "rad/s" of a heading rate, or "rad" of a steering angle.
    """

    name: str
    camera: Camera
    period: float
    max_control: float
    control_unit: str

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
    def step(self, control: float) -> CameraFrame:
        """Hold a control for one period.

        Args:
            control: heading rate (rad/s) or steering angle (rad), as the environment
                was made; positive to the left. Beyond `max_control` it saturates.

        Returns:
            The frame at the end of the period.

        Raises:
            InputError: the control is not finite, or nothing was reset before.
        """

    def advance(self, control: float) -> None:
        """Hold a control for one period as `step` does, but look at nothing."""
        self.step(control)

    @property
    @abstractmethod
    def state(self) -> np.ndarray:
        """State (m,) float64, m >= 3: x, y (metres), heading (radians), others."""

    @property
    def is_over(self) -> bool:
        """Whether there is nothing more to observe, as at the end of a recording."""
        return False

    @abstractmethod
    def show(self, objects: Sequence[Any]) -> None:
        """Show radiance fields in place of those shown before.

        The surrogate composes them with its own field; other environments paste them
        by depth as opaque ones (appendix B.3). Frames change from the next one on.

        Args:
            objects: PosedField each; may be empty.
        """

    @abstractmethod
    def close(self) -> None:
        """Let go of what a window, a process or a connection holds."""
