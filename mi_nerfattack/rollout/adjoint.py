"""Ways to go back through a drive: what is kept, and what is computed again.

For ``J`` of the states ``x_1 .. x_T`` under ``G_t(x_{t-1}, x_t, theta) = 0`` the
adjoint method solves ``(dG_t/dx_t)^T l_t = -(dJ/dx_t)^T - (dG_{t+1}/dx_t)^T l_{t+1}``
backwards from ``l_{T+1} = 0``; then ``dJ/dtheta = sum_t l_t^T dG_t/dtheta``. G is
taken in resolved form, ``G_t = x_t - Phi(x_{t-1}, u)``, also for implicit integrators
(the derivative of whose Phi is that of the implicit function), so that ``l_t`` is
minus the derivative of J by ``x_t``. Source: appendix A.9 to A.12.

All members solve these equations; they differ in what they keep. m is the number of
rows of the state, T the number of control periods.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Literal

from mi_nerfattack.ranges import Count, checked
from mi_nerfattack.rollout.loop import ClosedLoop, Step, Trajectory
from mi_nerfattack.rollout.objective import Cost
from mi_nerfattack.rollout.sweep import Gradient, Options, backward, differentiable


class AbstractAdjoint(ABC):
    """How a drive is differentiated in reverse."""

    @abstractmethod
    def keep(self, loop: ClosedLoop, step: Step) -> Any:
        """Return what to keep of a control period during the forward pass."""

    @abstractmethod
    def visit(self, loop: ClosedLoop, drive: Trajectory) -> Iterator[Step]:
        """Go through the control periods of a drive, last one first."""

    def gradient(
        self, loop: ClosedLoop, drive: Trajectory, cost: Cost, options: Options
    ) -> Gradient:
        """Differentiate a cost: solve for the costates, period by period.

        Args:
            loop: as it was when it drove.
            drive: what it did, with what :meth:`keep` kept.
            cost: of the states.
            options: what to differentiate by.

        Raises:
            TypeError: sensor or policy have no such derivatives.
        """
        visits = self.visit(loop, drive)
        return backward(
            loop, drive, visits, d_states=cost.by_states(drive), options=options
        )


@dataclass(frozen=True)
@checked()
class Replay(AbstractAdjoint):
    """Keeps states, and the policy's memory where it has one; renders all again.

    Memory: 8 m bytes a vehicle and period, and the policy's memory; besides that
    independent of the horizon: up to four images wait for the policy's derivative.
    Time: a backward pass renders every frame once more, then costs a product with the
    policy's derivative, and march derivatives of the rays that meet objects; forward
    and backward together about 2.2 forward passes.
    """

    kind: Literal["replay"] = "replay"

    def keep(self, loop: ClosedLoop, step: Step) -> Any:
        """See :meth:`AbstractAdjoint.keep`."""
        del loop
        return step.memory

    def visit(self, loop: ClosedLoop, drive: Trajectory) -> Iterator[Step]:
        """See :meth:`AbstractAdjoint.visit`."""
        for index in reversed(range(drive.horizon)):
            # Now the frame is rendered again
            observation = drive.observe(loop.sensor, index)
            yield Step(index, drive.states[index], observation, drive.tape[index])


@dataclass(frozen=True)
@checked()
class KeptBackgrounds(AbstractAdjoint):
    """Keeps how scene and objects looked in each frame; renders nothing again.

    Memory: as for :class:`Replay`, and per sample and period 20 bytes of the scene, and
    24 bytes of each object that the sample's ray meets. They hold colour, opacity and
    depth in single precision. The scene at nine rays per pixel is 2.4 MB per vehicle
    and period at 200x66, or 12 MB at 366x188. The `interleaved` composite keeps 20
    bytes of every layer, and 20 more. Time: as for Replay without rendering. So forward
    and backward together take less than 2 forward passes where the objects fill little
    of the frame. Choose this method as long as the memory suffices.
    """

    kind: Literal["kept_backgrounds"] = "kept_backgrounds"

    def keep(self, loop: ClosedLoop, step: Step) -> Any:
        """See :meth:`AbstractAdjoint.keep`."""
        return differentiable(loop).keep(step.observation), step.memory

    def visit(self, loop: ClosedLoop, drive: Trajectory) -> Iterator[Step]:
        """See :meth:`AbstractAdjoint.visit`."""
        sensor = differentiable(loop)
        for index in reversed(range(drive.horizon)):
            record, memory = drive.tape[index]
            # Now the frame is restored from the record, without a march
            observation = drive.restore(sensor, index, record)
            yield Step(index, drive.states[index], observation, memory)


@dataclass(frozen=True)
@checked("Checkpointed")
class Checkpointed(AbstractAdjoint):
    """Keeps the policy's memory once a segment; drives each segment again.

    For policies with a large memory (stacks of frames) and long drives. Memory: states,
    the policy's memory once every `segment` periods, and for one segment what
    :class:`KeptBackgrounds` keeps, that memory included; least near ``segment =
    sqrt(T)``. Time: as Replay, and the policy is evaluated once more.

    Args:
        segment: control periods, at least 1.
    """

    segment: Count = 16
    kind: Literal["checkpointed"] = "checkpointed"

    def keep(self, loop: ClosedLoop, step: Step) -> Any:
        """See :meth:`AbstractAdjoint.keep`."""
        del loop
        return step.memory if step.index % self.segment == 0 else None

    def visit(self, loop: ClosedLoop, drive: Trajectory) -> Iterator[Step]:
        """See :meth:`AbstractAdjoint.visit`."""
        sensor = differentiable(loop)
        starts = range(0, drive.horizon, self.segment)
        for start in reversed(starts):
            end = min(start + self.segment, drive.horizon)
            # Forward through a segment: keep its frames, and drive the policy's memory
            memory, tape = drive.tape[start], []
            for index in range(start, end):
                observation = drive.observe(sensor, index)
                tape.append((sensor.keep(observation), memory))
                if index + 1 < end:
                    image = loop.shown(observation, index)
                    numbers = loop.numbers(drive.states[index], index)
                    _, memory = loop.policy.step(image, loop.goal, memory, numbers)
                del observation
            # Back through the segment
            for index in reversed(range(start, end)):
                record, memory = tape.pop()
                observation = drive.restore(sensor, index, record)
                yield Step(index, drive.states[index], observation, memory)
