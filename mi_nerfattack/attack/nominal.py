"""Attacks that ignore how the vehicle answers: what the closed loop is worth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import drjit as dr
import numpy as np

from mi_nerfattack.errors import InputError
from mi_nerfattack.fields.grid import GridField
from mi_nerfattack.rollout.function import Rollout
from mi_nerfattack.rollout.sensor import AbstractDifferentiableSensor, Observation
from mi_nerfattack.rollout.sweep import differentiable


class NominalSensor(AbstractDifferentiableSensor):
    """Shows what is seen from given states, wherever the vehicle is.

    With the states of an unattacked drive, a loop through it is open: textures are
    optimised on the observations along the nominal path.

    Args:
        sensor: that looks.
        states: (m, n) a control period.
    """

    def __init__(
        self, sensor: AbstractDifferentiableSensor, states: Sequence[Any]
    ) -> None:
        self.sensor, self.states = sensor, states

    def observe(self, state: Any, step: int) -> Observation:
        """See :meth:`AbstractSensor.observe`; `state` counts for nothing."""
        del state
        return self.sensor.observe(self.states[step], step)

    def keep(self, observation: Observation) -> Any:
        """See :meth:`AbstractDifferentiableSensor.keep`."""
        return self.sensor.keep(observation)

    def restore(self, state: Any, step: int, kept: Any) -> Observation:
        """See :meth:`AbstractDifferentiableSensor.restore`."""
        del state
        return self.sensor.restore(self.states[step], step, kept)

    def vjp(
        self, observation: Observation, state: Any, d_image: Any, attached: bool
    ) -> Any:
        """See :meth:`AbstractDifferentiableSensor.vjp`.

        Raises:
            InputError: the image does not depend on the state.
        """
        if attached:
            raise InputError(
                "attached: images along a nominal path do not follow the vehicle; set "
                "attached to false"
            )
        return self.sensor.vjp(observation, state, d_image, False)

    def start_gradient(self, poses: bool = False) -> None:
        """See :meth:`AbstractDifferentiableSensor.start_gradient`."""
        self.sensor.start_gradient(poses)

    @property
    def fields(self) -> Sequence[GridField]:
        """See :attr:`AbstractDifferentiableSensor.fields`."""
        return self.sensor.fields

    def texture_gradients(self) -> list[Any]:
        """See :meth:`AbstractDifferentiableSensor.texture_gradients`."""
        return self.sensor.texture_gradients()

    def textures(self) -> list[Any]:
        """See :meth:`AbstractDifferentiableSensor.textures`."""
        return self.sensor.textures()

    def set_textures(self, textures: list[Any]) -> None:
        """See :meth:`AbstractDifferentiableSensor.set_textures`."""
        self.sensor.set_textures(textures)

    def offsets(self) -> np.ndarray | None:
        """See :meth:`AbstractDifferentiableSensor.offsets`."""
        return self.sensor.offsets()

    def set_offsets(self, offsets: np.ndarray) -> None:
        """See :meth:`AbstractDifferentiableSensor.set_offsets`."""
        self.sensor.set_offsets(offsets)

    def offset_gradients(self) -> np.ndarray:
        """See :meth:`AbstractDifferentiableSensor.offset_gradients`."""
        return self.sensor.offset_gradients()


class StillSensor(NominalSensor):
    """Shows one frame of a drive all the time, which is rendered once.

    Args:
        sensor: that looks.
        states: (m, n) a control period.
        frame: the period.
    """

    def __init__(
        self, sensor: AbstractDifferentiableSensor, states: Sequence[Any], frame: int
    ) -> None:
        super().__init__(sensor, states)
        self.frame = frame
        self._seen: Observation | None = None
        self._d_image: Any = None  # of all periods, which go back at once

    def frames(self, horizon: int) -> int:
        """See :meth:`AbstractSensor.frames`."""
        del horizon
        return 1

    def observe(self, state: Any, step: int) -> Observation:
        """See :meth:`AbstractSensor.observe`; a drive's first period renders."""
        if step == 0 or self._seen is None:
            self._seen = super().observe(state, self.frame)
        return self._seen

    def keep(self, observation: Observation) -> Any:
        """See :meth:`AbstractDifferentiableSensor.keep`."""
        return observation

    def restore(self, state: Any, step: int, kept: Any) -> Observation:
        """See :meth:`AbstractDifferentiableSensor.restore`."""
        del state, step
        return kept

    def vjp(
        self, observation: Observation, state: Any, d_image: Any, attached: bool
    ) -> Any:
        """See :meth:`NominalSensor.vjp`."""
        if attached:
            return super().vjp(observation, state, d_image, attached)
        self._seen = observation
        self._d_image = d_image if self._d_image is None else self._d_image + d_image
        dr.eval(self._d_image)
        return None

    def start_gradient(self, poses: bool = False) -> None:
        """See :meth:`AbstractDifferentiableSensor.start_gradient`."""
        self._d_image = None
        super().start_gradient(poses)

    def texture_gradients(self) -> list[Any]:
        """See :meth:`AbstractDifferentiableSensor.texture_gradients`."""
        self._finish()
        return super().texture_gradients()

    def offset_gradients(self) -> np.ndarray:
        """See :meth:`AbstractDifferentiableSensor.offset_gradients`."""
        self._finish()
        return super().offset_gradients()

    def _finish(self) -> None:
        d_image, self._d_image = self._d_image, None
        if d_image is not None:
            assert self._seen is not None
            state = self.states[self.frame]
            self.sensor.vjp(self._seen, state, d_image, False)


def open_loop(rollout: Rollout, initial: Any, frame: int | None = None) -> Rollout:
    """Return a rollout whose images are those of the present textures' drive.

    An attack by its gradient changes what is seen there, but not from where: the
    vehicle still answers to the policy, the policy no longer to the vehicle.

    Args:
        rollout: in a closed loop; one drive is made with it.
        initial: (m, n) initial states, as the attack's.
        frame: show this one alone, at all times, rendered once; None for all.

    Raises:
        InputError: the frame lies beyond the drive.
        TypeError: sensor or policy have no derivatives.
    """
    if frame is not None and not 0 <= frame < rollout.horizon:
        raise InputError(f"frame: {frame}; the drive has {rollout.horizon}, from 0 on")
    sensor = differentiable(rollout.loop)
    states = rollout.measure(initial).trajectory.states[:-1]
    shown = (
        NominalSensor(sensor, states)
        if frame is None
        else StillSensor(sensor, states, frame)
    )
    return replace(rollout, loop=replace(rollout.loop, sensor=shown))
