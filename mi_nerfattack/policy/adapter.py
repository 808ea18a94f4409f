"""Interface of a driving policy to the closed loop, and the bridge to torch."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, ClassVar

import drjit as dr
import torch

from mi_nerfattack.errors import InputError

#: What a policy carries from one control period to the next: arrays of its own kind.
Memory = tuple[Any, ...]


class AbstractPolicy(ABC):
    """Map from images to controls with a vector-Jacobian product.

    Images and controls are Dr.Jit arrays, so that the closed loop needs to know no
    other library. A call starts by waiting for the images. The closed loop calls
    `step` and its derivatives; those here are of policies without memory.

    Attributes:
        differentiable: whether derivatives exist; gradient methods refuse others.
    """

    differentiable: ClassVar[bool] = True

    def initial_memory(self, count: int) -> Memory:
        """Return the memory of `count` vehicles before their first image."""
        del count
        return ()

    def step(self, image: Any, goal: Any, memory: Memory) -> tuple[Any, Memory]:
        """Evaluate the policy and its next memory.

        Args:
            image: as for `control`.
            goal: as for `control`.
            memory: from `initial_memory` or the step before; left unchanged.

        Returns:
            The control, as `control` gives it, and the memory for the next step.
        """
        return self.control(image, goal), memory

    def step_vjp(
        self, image: Any, goal: Any, memory: Memory, cotangent: Any, d_memory: Memory
    ) -> tuple[Any, Memory]:
        """Multiply cotangents by the derivative of `step`.

        Args:
            image: as given to `step`.
            goal: likewise.
            memory: likewise.
            cotangent: row (n,), derivative of the objective by the control.
            d_memory: derivative of the objective by the memory that `step`
                returned, of its structure; ``()`` after the last step.

        Returns:
            Derivatives of the objective by the image and by `memory`.
        """
        del memory, d_memory
        return self.vjp(image, goal, cotangent)[1], ()

    def step_jvp(
        self, image: Any, goal: Any, memory: Memory, t_image: Any, t_memory: Memory
    ) -> tuple[Any, Memory]:
        """Multiply the derivative of `step` by tangents (forward mode).

        Args:
            image: as given to `step`.
            goal: likewise.
            memory: likewise.
            t_image: tangent of the image, a tensor of its shape.
            t_memory: tangent of `memory`, of its structure; ``()`` stands for zeros.

        Returns:
            Tangents of the control, a row (n,), and of the memory that `step` returns.

        Raises:
            InputError: the policy has no forward derivative.
        """
        del image, goal, memory, t_image, t_memory
        raise InputError(
            f"{type(self).__name__}: has no forward derivative; implement step_jvp"
        )

    def memory_bytes(self, memory: Memory) -> int:
        """Return the size of a memory, bytes."""
        assert not memory, "a policy with memory says how large it is"
        return 0

    @abstractmethod
    def control(self, image: Any, goal: Any) -> Any:
        """Evaluate the policy.

        Args:
            image: tensor (n, height, width, 3), sRGB in [0, 1]; taken as a constant.
            goal: an integer, or one for each image.

        Returns:
            Row (n,), evaluated and detached, in the unit of the vehicle's control.
        """

    @abstractmethod
    def vjp(self, image: Any, goal: Any, cotangent: Any) -> tuple[Any, Any]:
        """Multiply a cotangent by the derivative of `control`.

        Args:
            image: as for `control`.
            goal: as for `control`.
            cotangent: row (n,), derivative of the objective by the control.

        Returns:
            The control (n,), and the derivative of the objective by the image, a
            tensor of the image's shape; both evaluated and detached.
        """


class TorchPolicy(AbstractPolicy):
    """Policy given by a torch module; memory is shared, not copied, both ways.

    Args:
        module: maps an image (n, 3, height, width), sRGB in [0, 1], and a goal (n,)
            int64 to a control (n,), changing neither in place. It is switched to
            evaluation mode, its parameters are frozen, and it is moved to the
            device of the images.
        goals: number of goals; `module.goals` unless given.
    """

    def __init__(self, module: torch.nn.Module, goals: int | None = None) -> None:
        """Take over `module`."""
        self.module = module.eval().requires_grad_(False)
        count = getattr(module, "goals", None) if goals is None else goals
        if not isinstance(count, int) or count < 1:
            raise InputError(f"TorchPolicy.goals: {count!r}; an integer of at least 1")
        self.goals = count

    def control(self, image: Any, goal: Any) -> Any:
        """Evaluate the module without recording a graph."""
        with torch.no_grad():
            return to_row(self._evaluate(to_torch(image), goal), image)

    def vjp(self, image: Any, goal: Any, cotangent: Any) -> tuple[Any, Any]:
        """Evaluate the module and its reverse derivative, one graph at a time."""
        leaf = to_torch(image).detach().requires_grad_(True)
        with torch.enable_grad():
            control = self._evaluate(leaf, goal)
        weight = to_torch(cotangent).to(control)
        if weight.shape != control.shape:
            raise InputError(
                f"cotangent: {tuple(weight.shape)} for {tuple(control.shape)} controls"
            )
        (gradient,) = torch.autograd.grad(control, leaf, weight)
        return to_row(control, image), to_tensor(gradient, image)

    def _evaluate(self, image: torch.Tensor, goal: Any) -> torch.Tensor:
        """Apply the module to (n, height, width, 3), in the module's precision."""
        if image.ndim != 4 or image.shape[3] != 3:
            raise InputError(
                f"image: shape {tuple(image.shape)}; (n, height, width, 3) is needed"
            )
        self.module.to(image.device)
        parameter = next(self.module.parameters(), image)
        planes = image.permute(0, 3, 1, 2).to(parameter.dtype)
        control = self.module(planes, self._goals(goal, image))
        if control.shape != image.shape[:1]:
            raise InputError(
                f"policy: controls {tuple(control.shape)} for {len(image)} images; "
                "the module must return one number for each image"
            )
        return control

    def _goals(self, goal: Any, image: torch.Tensor) -> torch.Tensor:
        """Expand and check goals, (n,) int64 on the image's device."""
        if dr.is_array_v(goal):
            goal = to_torch(goal)
        values = torch.as_tensor(goal).to(image.device, torch.int64)
        if values.shape not in (torch.Size([]), image.shape[:1]):
            raise InputError(
                f"goal: shape {tuple(values.shape)} for {len(image)} images"
            )
        if ((values < 0) | (values >= self.goals)).any():
            raise InputError(f"goal: {goal}; at least 0 and below {self.goals}")
        return values.expand(len(image))


@contextmanager
def one_thread() -> Iterator[None]:
    """Let torch use one thread: several wait spinning while the renderer works."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def to_torch(array: Any) -> torch.Tensor:
    """View a Dr.Jit array or tensor, detached, as torch's; waits until it is there."""
    values = dr.detach(array)
    dr.eval(values)
    dr.sync_thread()
    if dr.backend_v(values) == dr.JitBackend.CUDA:
        return values.torch()
    # DLPack runs Python inside of C++ that drops a Ctrl-C; NumPy's memory does not
    return torch.from_numpy(values.numpy())


def to_tensor(value: torch.Tensor, like: Any) -> Any:
    """Make a Dr.Jit tensor of the type of `like`; evaluated, never a literal."""
    return type(like)(_settled(value, like))


def to_row(value: torch.Tensor, like: Any) -> Any:
    """Make a Dr.Jit row (n,) of the scalar type and backend of the tensor `like`."""
    return dr.array_t(like)(_settled(value, like))


def _settled(value: torch.Tensor, like: Any) -> Any:
    """Bring a result into the scalar type of `like` and wait for its device."""
    scalar = torch.float64 if dr.type_v(like) == dr.VarType.Float64 else torch.float32
    value = value.detach().to(scalar).contiguous()
    if not value.is_cuda:
        return value.numpy()  # see `to_torch`
    # Dr.Jit has a stream of its own
    torch.cuda.current_stream(value.device).synchronize()
    return value
