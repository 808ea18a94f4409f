"""The closed loop as a function of parameters and initial states."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from typing import Any

import drjit as dr
import numpy as np

from mi_nerfattack.errors import InputError
from mi_nerfattack.rollout.adjoint import AbstractAdjoint, Replay
from mi_nerfattack.rollout.loop import (
    CameraPath,
    ClosedLoop,
    OnStep,
    Step,
    Trajectory,
    simulate,
)
from mi_nerfattack.rollout.objective import (
    AbstractObjective,
    AbstractReduction,
    Cost,
    Mean,
)
from mi_nerfattack.rollout.sweep import (
    Gradient,
    Options,
    StepRecorder,
    backward_to_images,
    differentiable,
)


@dataclass(frozen=True)
class Evaluation:
    """What a batch of drives gave.

    Attributes:
        value: the cost that is minimised.
        costs: (n,) that of each drive.
        trajectory: the drives, with what their derivatives need.
    """

    value: float
    costs: np.ndarray
    trajectory: Trajectory

    def __repr__(self) -> str:
        return f"Evaluation({self.value:.6g}, {self.trajectory!r})"

    def _repr_png_(self) -> bytes:
        return self.trajectory._repr_png_()


@dataclass(frozen=True)
class Rollout:
    """``J(parameters, initial states)`` of a batch of drives.

    Call it with Dr.Jit arrays and differentiate by `dr.backward`; for torch tensors
    wrap it by ``dr.wrap(source="torch", target="drjit")``. Or, without either's graph,
    :meth:`run` and :meth:`gradient`.

    Attributes:
        loop: the closed loop; its sensor's parameters are replaced.
        objective: cost of one drive.
        horizon: control periods.
        reduction: of the costs of the batch.
        adjoint: how derivatives are made; each states what it costs.
        attached: keep the derivative of the image by the state. By default it is
            stopped (A.12); only attached derivatives are those of the whole loop.
        camera_path: where frames are rendered from, if not from the vehicles; see
            :meth:`open_loop`.
    """

    loop: ClosedLoop
    objective: AbstractObjective
    horizon: int
    reduction: AbstractReduction = field(default_factory=Mean)
    adjoint: AbstractAdjoint = field(default_factory=Replay)
    attached: bool = False
    camera_path: CameraPath | None = None

    def __repr__(self) -> str:
        components = self.objective, self.reduction, self.adjoint
        names = ", ".join(type(component).__name__ for component in components)
        images = "attached" if self.attached else "detached"
        return f"Rollout({self.horizon} periods, {names}, {images}, {self.loop!r})"

    @property
    def frames(self) -> int:
        """Frames that are rendered for a drive of one vehicle."""
        path = self.camera_path
        return self.horizon if path is None or path.frame is None else 1

    def open_loop(self, initial: Any, frame: int | None = None) -> Rollout:
        """Return this rollout with the camera path of the present textures' drive.

        Textures change what the policy sees, but not from where: the vehicle still
        answers to the policy, the policy no longer to the vehicle.

        Args:
            initial: (m, n) initial states; one drive is made from them.
            frame: show this one alone, at all times, rendered once; None for all.

        Raises:
            InputError: the frame lies beyond the drive.
            TypeError: sensor or policy have no derivatives.
        """
        if frame is not None and not 0 <= frame < self.horizon:
            raise InputError(f"frame: {frame}; the drive has {self.horizon}, from 0 on")
        differentiable(self.loop)
        states = self.measure(initial).trajectory.states[:-1]
        return replace(self, camera_path=CameraPath(states, frame))

    def run(self, initial: Any, on_step: OnStep | None = None) -> Evaluation:
        """Drive with the parameters that the sensor has.

        Args:
            initial: (m, n) from :meth:`ClosedLoop.initial`.
            on_step: called after each control period with its index.

        Raises:
            InputError: the objective is not finite.
        """

        def keep(step: Step) -> Any:
            return self.adjoint.keep(self.loop, step)

        return self._evaluate(initial, on_step, keep)

    def measure(self, initial: Any, on_step: OnStep | None = None) -> Evaluation:
        """Drive as :meth:`run` does, without keeping what a derivative needs.

        Args:
            initial: (m, n) from :meth:`ClosedLoop.initial`.
            on_step: called after each control period with its index.

        Raises:
            InputError: the objective is not finite.
        """
        return self._evaluate(initial, on_step, None)

    def _evaluate(
        self,
        initial: Any,
        on_step: OnStep | None,
        keep: Callable[[Step], Any] | None,
    ) -> Evaluation:
        drive = simulate(
            self.loop,
            initial,
            self.horizon,
            on_step=on_step,
            keep=keep,
            camera_path=self.camera_path,
        )
        value, costs = Cost(self.objective, self.reduction).of(drive)
        if not np.isfinite(value):
            raise InputError(
                f"objective: {value}; check policy, vehicle and costs for NaN"
            )
        return Evaluation(value, costs, drive)

    def gradient(
        self,
        evaluation: Evaluation,
        extra_keys: Sequence[str] = (),
        recorder: StepRecorder | None = None,
        on_step: OnStep | None = None,
        scale: float = 1.0,
    ) -> Gradient:
        """Differentiate what :meth:`run` gave; nothing may have changed since.

        Args:
            evaluation: from :meth:`run`.
            extra_keys: keys of parameters to differentiate by, besides the sensor's.
            recorder: takes the texture's gradient apart by control periods.
            on_step: called after each control period with its index.
            scale: factor of all derivatives.

        Raises:
            TypeError: there are no such derivatives.
        """
        cost = Cost(self.objective, self.reduction, scale)
        options = Options(self.attached, extra_keys, recorder, on_step=on_step)
        drive = evaluation.trajectory
        return self.adjoint.gradient(self.loop, drive, cost, options)

    def by_images(
        self, drive: Trajectory, steps: Collection[int]
    ) -> dict[int, np.ndarray]:
        """Differentiate by what the sensor gave; see ``backward_to_images``.

        Args:
            drive: through the loop; `tape` is the policy's memory before each period,
                as :class:`Replay` keeps it.
            steps: control periods.

        Raises:
            InputError: the drive has no such memory.
        """
        if not isinstance(self.adjoint, Replay) or len(drive.tape) < drive.horizon:
            raise InputError(
                "drive: derivatives by images need the policy's memory of each period; "
                "take a drive of run(), of a Rollout with adjoint=Replay()"
            )
        d_states = Cost(self.objective, self.reduction).by_states(drive)
        return backward_to_images(
            self.loop, drive, d_states, steps=steps, attached=self.attached
        )

    def __call__(self, values: Mapping[str, Any], initial: Any) -> Any:
        """Evaluate J as one differentiable operation of Dr.Jit.

        Args:
            values: parameters of the sensor by key, for instance the result of
                ``mi.traverse(scene)`` or an optimiser; all are set, and those that are
                attached are differentiated.
            initial: (m, n) from :meth:`ClosedLoop.initial`.

        Returns:
            one entry, attached to whatever of both is. Reverse mode only.
        """
        # Attached parameters are inputs of the operation; the others are constants
        every = dict(values.items())  # also of Mitsuba's parameters and optimisers
        attached = {k: v for k, v in every.items() if dr.grad_enabled(v)}
        others = {k: v for k, v in every.items() if k not in attached}
        return dr.custom(_RolloutOp, _Held(self, others), attached, initial)


class _Held:
    """A rollout that Dr.Jit does not look into for arrays."""

    def __init__(self, rollout: Rollout, constants: Mapping[str, Any]) -> None:
        self.rollout = rollout
        self.constants = constants


class _RolloutOp(dr.CustomOp):
    """Forward: a batch of drives. Backward: the rollout's adjoint."""

    def eval(self, held: _Held, values: dict[str, Any], initial: Any) -> Any:
        self.rollout = held.rollout
        self.keys = list(values)
        # Detached values, so that Dr.Jit records no graph of the drive
        self.values = dict(held.constants)
        self.values |= {key: type(v)(dr.detach(v)) for key, v in values.items()}
        with self._installed():
            self.evaluation = self.rollout.run(dr.detach(initial))
        return dr.value_t(type(initial))([self.evaluation.value])

    def backward(self) -> None:
        scale = float(dr.detach(self.grad_out())[0])
        # Now the costates are solved for and the gradient is summed up (A.9, A.11)
        with self._installed():  # others may have driven
            gradient = self.rollout.gradient(self.evaluation, scale=scale)
        self.set_grad_in("values", gradient.parameters)
        self.set_grad_in("initial", gradient.initial)

    @contextmanager
    def _installed(self) -> Iterator[None]:
        """Set the parameters, and differentiate by those that were attached."""
        sensor = differentiable(self.rollout.loop)
        before = sensor.keys
        sensor.set_parameters(self.values)
        sensor.select(self.keys)
        try:
            yield
        finally:
            sensor.select(before)
