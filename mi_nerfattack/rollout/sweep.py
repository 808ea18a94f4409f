"""The backward sweep through a drive: costates and gradients."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import drjit as dr
import numpy as np

from mi_nerfattack.backend.arrays import concat, split
from mi_nerfattack.errors import InputError
from mi_nerfattack.rollout.loop import ClosedLoop, OnStep, Step, Trajectory
from mi_nerfattack.rollout.sensor import AbstractDifferentiableSensor
from mi_nerfattack.system.machine import release_heap
from mi_nerfattack.vehicle.dynamics import controls_as, no_control, to_state

#: Images that go back through the policy at once.
POLICY_BATCH = 4


@dataclass(frozen=True)
class Attribution:
    """What each control period contributed to the gradient, object by object.

    Attributes:
        norms: (T, k), Euclidean norms of the periods' texture gradients.
        along: (T, k), their inner products with given directions, e.g. the change
            that an attack made to the texture: to first order, what the period
            contributed to the change of the objective; empty without directions.
    """

    norms: np.ndarray
    along: np.ndarray


@dataclass(frozen=True)
class Gradient:
    """Derivatives of an objective.

    Attributes:
        textures: one tensor (n_vertices, 3) an object.
        initial: (m, n) by the initial states.
        costates: (T, n, m) NumPy: ``l_t``, minus the derivative by ``x_t``.
        attribution: per control period; None where not asked for.
        parameters: by key of the sensor's.
    """

    textures: list[Any]
    initial: Any
    costates: np.ndarray
    attribution: Attribution | None
    parameters: dict[str, Any] = field(default_factory=dict)


class StepRecorder:
    """Takes the texture's gradient apart by control periods.

    Costs a few passes over the texture a period, and one more gradient buffer.

    Args:
        directions: one array (n_vertices, 3) an object, for the inner products.
        on_period: called with the index of each period, last one first, and its
            gradients, one array (3 n_vertices,) an object, to do with as one likes.
    """

    def __init__(
        self,
        directions: Sequence[Any] = (),
        on_period: Callable[[int, list[np.ndarray]], None] | None = None,
    ) -> None:
        self.on_period = on_period
        self.directions: list[np.ndarray] = [
            np.asarray(d, np.float32).ravel() for d in directions
        ]
        self._before: list[np.ndarray] = []
        self._rows: list[tuple[list[float], list[float]]] = []

    def add(self, index: int, textures: list[Any]) -> None:
        """Record one period from the sums so far; periods come last one first."""
        sums = [t.numpy().ravel().copy() for t in textures]
        before = self._before or [np.zeros_like(value) for value in sums]
        # What this period added to the sum of A.11
        gradients = [value - old for value, old in zip(sums, before, strict=True)]
        self._before = sums
        if self.on_period is not None:
            self.on_period(index, gradients)
        norms = [float(np.linalg.norm(gradient)) for gradient in gradients]
        pairs = zip(gradients, self.directions, strict=bool(self.directions))
        self._rows.append((norms, [float(a @ b) for a, b in pairs]))

    def result(self) -> Attribution:
        """Return what was recorded, first period first."""
        norms, along = zip(*reversed(self._rows), strict=True)
        return Attribution(np.array(norms), np.array(along))


@dataclass(frozen=True)
class Options:
    """What a backward pass gives.

    Attributes:
        attached: keep the derivative of the image by the state (A.12 stops it). Only
            attached gradients are those of the whole loop.
        extra_keys: keys of parameters to differentiate by, besides those of the sensor.
        recorder: takes the gradient apart by control periods.
        on_step: called after each control period with its index.
    """

    attached: bool = False
    extra_keys: Sequence[str] = ()
    recorder: StepRecorder | None = None
    on_step: OnStep | None = None


@dataclass
class Sweep:
    """Costates through the control periods of a drive, last one first.

    Attributes:
        loop: the closed loop.
        drive: what it did.
        attached: whether images follow the state.
        together: control periods whose images go through the policy at once, and whose
            observations are held until then; 1 where images follow the state, or the
            gradient is taken apart. With memory, or numbers besides the images, a
            policy takes them one by one.
        on_image: called with the index of a period and the derivative by what the
            sensor gave there, a tensor (n, height, width, 3).
        pending: derivatives by controls that act in periods already visited.
        d_memory: derivative by the policy's memory after the period.
    """

    loop: ClosedLoop
    drive: Trajectory
    attached: bool
    together: int = 1
    on_image: Callable[[int, Any], None] | None = None
    pending: dict[int, Any] = field(default_factory=dict)
    d_memory: tuple[Any, ...] = ()
    _waiting: list[tuple[Step, Any, Any, Any]] = field(default_factory=list)
    _d_still: Any = None  # by the only frame of a drive, of all periods so far

    def __post_init__(self) -> None:
        if self.attached and self.drive.camera_path is not None:
            raise InputError(
                "attached: images along a camera path do not follow the vehicle; set "
                "attached to false"
            )

    def back(self, step: Step, d_after: Any) -> Any:
        """Return the derivative by the state before a period.

        Args:
            step: the period.
            d_after: (m, n), by the state after it.
        """
        loop, index = self.loop, step.index
        # Vehicle: l_t^T dPhi/dx and, for each period whose control acts, l_t^T dPhi/du
        d_state = self.back_blindly(index, step.state, d_after)
        # All that depends on this period's control has been visited: its cotangent
        image = loop.shown(step.observation, index)
        none = no_control(loop.dynamics.control_size, d_state)
        cotangent = controls_as(dr.array_t(image), self.pending.pop(index, none))
        dr.eval(cotangent)
        numbers = loop.numbers(step.state, index)
        self._waiting.append((step, image, cotangent, numbers))
        alone = bool(step.memory or self.d_memory) or numbers is not None
        # Policy and sensor: several periods at a time
        full = alone or len(self._waiting) == self.together
        by_pose, by_numbers = self.finish() if full else (None, None)
        if by_numbers is not None:
            d_state += by_numbers
        if by_pose is not None:
            for axis in range(3):
                d_state[axis] += by_pose[axis]
        dr.eval(d_state, self.pending)
        return d_state

    def back_blindly(self, index: int, state: Any, d_after: Any) -> Any:
        """Do as :meth:`back`, but leave out what the image does, and do not evaluate.

        Args:
            index: of the period.
            state: (m, n), before it.
            d_after: (m, n), by the state after it.
        """
        transition = self.loop.transition
        controls = self.drive.controls[: index + 1]
        acting = transition.controls(controls, index, state)
        d_state, *d_acting = transition.vjp(state, acting, d_after)
        # With a delay, controls of earlier periods act here: their derivatives wait
        sources = transition.sources(index, state)
        for source, value in zip(sources, d_acting, strict=True):
            self.pending[source] = self.pending.get(source, 0) + value
        return d_state

    def finish(self) -> tuple[Any, Any]:
        """Differentiate policy and sensor, for all periods that wait for that.

        Returns:
            Derivatives by the state before the last of these periods: (3, n) through
            its image, None when not `attached`; (m, n) through the numbers that the
            policy gets, or None.
        """
        if not self._waiting:
            return None, None
        steps, images, cotangents, numbers = zip(*self._waiting, strict=True)
        self._waiting.clear()
        loop, by_pose, by_numbers, last = self.loop, None, None, steps[-1]
        # Policy: from controls to images and numbers
        d_images, self.d_memory, d_numbers = loop.policy.step_vjp(
            _batch(images),
            loop.goal,
            last.memory,
            cotangent=_batch(cotangents),
            d_memory=self.d_memory,
            numbers=numbers[-1],
        )
        release_heap()  # or memory grows with the horizon
        if d_numbers is not None:
            by_numbers = loop.numbers_vjp(last.state, last.index, d_numbers)
        for step, d_image in zip(steps, _unbatch(d_images, len(steps)), strict=True):
            # Camera: through disturbance and eight bits (straight through)
            d_seen = loop.shown_vjp(step.observation, step.index, d_image)
            if self.on_image is not None:
                self.on_image(step.index, d_seen)
            # Sensor: from images to parameters and, attached (A.12), to the state
            if self.drive.still is None:
                state, _ = self.drive.camera(step.index)
                by_pose = differentiable(loop).vjp(
                    step.observation, state, d_seen, self.attached
                )
            else:  # the only frame: all periods go back through the sensor at once
                previous = self._d_still
                self._d_still = d_seen if previous is None else previous + d_seen
                dr.eval(self._d_still)
        return by_pose, by_numbers

    def finish_still(self) -> None:
        """Go back through the sensor from the only frame, for all periods so far."""
        d_still, self._d_still = self._d_still, None
        if d_still is not None and self.drive.still is not None:
            state, _ = self.drive.camera(0)
            differentiable(self.loop).vjp(
                self.drive.still, state, d_image=d_still, attached=False
            )


def backward(
    loop: ClosedLoop,
    drive: Trajectory,
    visits: Iterator[Step],
    d_states: np.ndarray,
    options: Options,
) -> Gradient:
    """Pull derivatives by the states back to everything that led to them.

    Args:
        loop: as it was when it drove.
        drive: what it did.
        visits: its control periods, last one first.
        d_states: (T, n, m), derivatives of J by x_1 to x_T.
        options: what to differentiate by.

    Raises:
        TypeError: sensor or policy have no such derivatives.
        InputError: attached, along a camera path.
    """
    sensor = differentiable(loop)
    alone = options.attached or options.recorder is not None  # one period at a time
    together = 1 if alone else max(1, POLICY_BATCH // drive.count)
    if options.recorder is not None and not sensor.textures():
        raise InputError(
            "recorder: takes apart the gradient of objects' colours; the sensor's "
            "parameters have none"
        )
    sweep = Sweep(loop, drive, options.attached, together)
    d_before, costates = to_state(np.zeros_like(d_states[0])), []  # l_{T+1} = 0 (A.10)
    try:
        sensor.start_gradient(options.extra_keys)
        for step in visits:
            # A.9, resolved: minus l_t is dJ/dx_t and the derivative through x_{t+1}
            d_after = d_before + to_state(d_states[step.index])
            d_before = sweep.back(step, d_after)
            costates.append(-np.array(d_after).T)
            if options.recorder is not None:
                sweep.finish_still()
                options.recorder.add(step.index, sensor.texture_gradients())
            if options.on_step is not None:
                options.on_step(step.index)
        # Now the images that still wait; then the sum of A.11 is complete
        sweep.finish()
        sweep.finish_still()
        textures, parameters = sensor.texture_gradients(), sensor.gradients()
        dr.eval(textures)
    finally:
        sensor.stop_gradient()
    attribution = options.recorder.result() if options.recorder else None
    costates = np.stack(costates[::-1])
    return Gradient(textures, d_before, costates, attribution, parameters)


def backward_to_images(
    loop: ClosedLoop,
    drive: Trajectory,
    d_states: np.ndarray,
    steps: Collection[int],
    attached: bool,
) -> dict[int, np.ndarray]:
    """Pull derivatives by the states back to what the sensor gave.

    Renders the frames of these periods; all from the first of them on where images
    follow the state, or the policy has a memory.

    Args:
        loop: as it was when it drove.
        drive: what it did; `tape` is the policy's memory before each period.
        d_states: (T, n, m), derivatives of J by x_1 to x_T.
        steps: control periods.
        attached: keep the derivative of the image by the state.

    Returns:
        by period (n, height, width, 3): derivatives by sRGB values in [0, 1], through
        all that follows.

    Raises:
        TypeError: sensor or policy have no such derivatives.
        InputError: attached, along a camera path.
    """
    sensor, d_images = differentiable(loop), {}

    def keep(index: int, d_image: Any) -> None:
        if index in steps:
            d_images[index] = d_image.numpy().copy()

    sweep, policy = Sweep(loop, drive, attached, on_image=keep), loop.policy
    # Not linked: frames that nobody asked for are skipped
    linked = attached or bool(policy.initial_memory(drive.count) or policy.numbers)
    d_before, start = to_state(np.zeros_like(d_states[0])), min(steps, default=0)
    try:
        sensor.start_gradient()
        for index in reversed(range(start, drive.horizon if steps else 0)):
            state = drive.states[index]
            d_after = d_before + to_state(d_states[index])
            if linked or index in steps:
                observation = drive.observe(sensor, index)
                step = Step(index, state, observation, drive.tape[index])
                d_before = sweep.back(step, d_after)
            else:  # the vehicle alone
                d_before = sweep.back_blindly(index, state, d_after)
                dr.eval(d_before, sweep.pending)
    finally:
        sensor.stop_gradient()
    return d_images


def _batch(arrays: tuple[Any, ...]) -> Any:
    """Lay rows, arrays of rows, or tensors along their first axis, end to end."""
    first = arrays[0]
    if len(arrays) == 1:
        return first
    if not dr.is_tensor_v(first) and dr.depth_v(first) == 2:
        return type(first)(*[_batch(rows) for rows in zip(*arrays, strict=True)])
    if not dr.is_tensor_v(first):
        return concat(arrays, [dr.width(first)] * len(arrays))
    size = dr.width(first.array)
    shape = (len(arrays) * first.shape[0], *first.shape[1:])
    rows = concat([part.array for part in arrays], [size] * len(arrays))
    return type(first)(rows, shape)


def _unbatch(tensor: Any, count: int) -> list[Any]:
    """Undo `_batch` of `count` tensors."""
    if count == 1:
        return [tensor]
    shape = (tensor.shape[0] // count, *tensor.shape[1:])
    arrays = split(tensor.array, dr.width(tensor.array) // count)
    return [type(tensor)(part, shape) for part in arrays]


def differentiable(loop: ClosedLoop) -> AbstractDifferentiableSensor:
    """Return the loop's sensor.

    Raises:
        TypeError: sensor or policy have no derivatives.
    """
    if not isinstance(loop.sensor, AbstractDifferentiableSensor):
        raise TypeError(
            f"{type(loop.sensor).__name__}: has no derivatives; use a SceneSensor, "
            "or use a gradient-free method"
        )
    if not loop.policy.differentiable:
        raise TypeError(
            f"{type(loop.policy).__name__}: a black box has no derivatives; use a "
            "gradient-free method, or give the policy as a torch module, an exported "
            "program, an ONNX file or a Dr.Jit network"
        )
    return loop.sensor
