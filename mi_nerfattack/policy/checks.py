"""What every policy checks: images, goals, hidden states and controls."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import drjit as dr
import torch

from mi_nerfattack.backend.torch_arrays import to_torch
from mi_nerfattack.errors import InputError, is_interrupt
from mi_nerfattack.policy.pilotnet import PilotNet

#: Width and height of the images that public driving policies take, pixels.
USUAL_PX = (
    (200, 66),
    (200, 88),
    (320, 160),
    (160, 120),
    (160, 80),
    (100, 33),
    (100, 100),
    (64, 64),
    (84, 84),
    (96, 96),
    (128, 128),
    (224, 224),
    (256, 256),
)
#: Part of the largest value by which two evaluations of one image may differ.
TOLERANCE = 1e-4
#: Part of the largest value by which the control may depend on the size of the batch.
MIXED = 1e-2
_CHANNELS = 16  # at most; a longer axis is one of pixels


def check_hidden(shapes: Sequence[Sequence[int]]) -> tuple[tuple[int, ...], ...]:
    """Check shapes of hidden states: positive sizes and one -1, for the vehicles."""
    for shape in shapes:
        if list(shape).count(-1) != 1 or any(s < 1 and s != -1 for s in shape):
            raise InputError(
                f"recurrent: shape {list(shape)}; sizes of at least 1, and one -1 for "
                "the number of vehicles"
            )
    return tuple(tuple(shape) for shape in shapes)


def check_images(image: torch.Tensor) -> None:
    """Refuse what is not (n, height, width, 3)."""
    if image.ndim != 4 or image.shape[3] != 3:
        raise InputError(
            f"image: shape {tuple(image.shape)}; (n, height, width, 3) is needed"
        )


def expand_goals(goal: Any, image: torch.Tensor) -> torch.Tensor:
    """Expand goals to (n,) int64 on the device of images (n, ...)."""
    if dr.is_array_v(goal):
        goal = to_torch(goal)
    values = torch.as_tensor(goal).to(image.device, torch.int64)
    if values.shape not in (torch.Size([]), image.shape[:1]):
        raise InputError(f"goal: shape {tuple(values.shape)} for {len(image)} images")
    return values.expand(len(image))


def columns_of(
    values: torch.Tensor, count: int, output: int | Sequence[int] | None, name: str
) -> torch.Tensor:
    """Take the control (n,), or several (n, k), out of an answer, and refuse NaN.

    Args:
        values: (n,), (n, 1), or (n, k) where `output` is given; of one image also ()
            and (k,).
        count: n.
        output: column of the control, or columns of several.
        name: of the policy, for messages.
    """
    if count == 1 and values.ndim < 2:  # a network that drops axes of size 1
        values = values.reshape(1, -1)
    shape = tuple(values.shape)
    if isinstance(output, Sequence) and len(output) == 1:
        (output,) = output
    if shape != (count,) or isinstance(output, Sequence):
        column = 0 if output is None and shape == (count, 1) else output
        most = max(column) if isinstance(column, Sequence) else column
        if len(shape) != 2 or shape[0] != count or most is None or most >= shape[1]:
            raise InputError(
                f"{name}: controls {shape} for {count} images; the policy must return "
                "one number for each image, (n,) or (n, 1), or several, (n, k), and "
                f"policy.output (is {output}) must tell the column of the control; "
                "for waypoints, write [policy.trajectory]"
            )
        columns = list(column) if isinstance(column, Sequence) else column
        values = values[:, columns]
    finite = torch.isfinite(values)
    bad = (~finite.reshape(count, -1).all(1)).nonzero().flatten().tolist()
    if bad:
        raise InputError(
            f"{name}: control {values[bad[0]].tolist()} for image {bad[0]} of {count}; "
            "it must be finite: check the weights and policy.preprocess"
        )
    return values


def misfit(expected: Sequence[int | None], actual: Sequence[int]) -> str:
    """Say which image a network takes, which it gets, and what to write.

    Args:
        expected: shape of its images, None where a size is free.
        actual: shape of those that it gets, from `policy.preprocess`.
    """
    sizes = ", ".join("any" if size is None else f"{size}" for size in expected)
    return (
        f"takes images of shape ({sizes}), and gets {tuple(actual)} of the camera and "
        f"policy.preprocess; write {_remedy(expected)}"
    )


def usual_shape(
    module: torch.nn.Module, image: torch.Tensor, further_inputs: Sequence[torch.Tensor]
) -> tuple[int, ...] | None:
    """Find a shape of images that a module takes, among those that are usual.

    Args:
        module: has refused `image`.
        image: (n, ...).
        further_inputs: goal and hidden states, which it gets with each.

    Returns:
        (n, channels, height, width) or (n, height, width, channels); None where it
        takes none of them, or the shape of `image` with other values.
    """
    if _takes(module, torch.zeros_like(image), further_inputs):
        return None
    kernels = [p.shape[1] for p in module.parameters() if p.ndim == 4][:1]
    for width, height in USUAL_PX:
        for channels in kernels or (3, 1):
            planes, pixels = (channels, height, width), (height, width, channels)
            for shape in ((len(image), *planes), (len(image), *pixels)):
                if _takes(module, image.new_zeros(shape), further_inputs):
                    return shape
    return None


def _takes(
    module: torch.nn.Module, image: torch.Tensor, further_inputs: Sequence[torch.Tensor]
) -> bool:
    try:
        with torch.no_grad():
            module(image, *further_inputs)
    except Exception as err:  # a user's module raises whatever it likes
        if is_interrupt(err):
            raise
        return False
    return True


def _remedy(shape: Sequence[int | None]) -> str:
    """Return the keys of [policy.preprocess] that make images of a shape."""
    if len(shape) != 4:
        return "policy.preprocess as the network needs it"
    _, *sizes = shape
    last = sizes[2] is not None and sizes[2] <= _CHANNELS < (sizes[0] or 99)
    height, width, channels = sizes if last else (*sizes[1:], sizes[0])
    keys = []
    if width is not None and height is not None:
        keys.append(f"resize_px = [{width}, {height}]")
    if channels == 1:
        keys.append('colour = "grey"')
    elif channels is not None and channels > 3 and channels % 3 == 0:
        keys.append(f"frames = {channels // 3}")
    if last:
        keys.append('layout = "NHWC"')
    return f"{', '.join(keys) or 'it so'} in [policy.preprocess]"


def check_repeatable(
    module: torch.nn.Module, evaluate: Callable[[], torch.Tensor], name: str
) -> None:
    """Refuse a module that answers the same image twice differently.

    The loop evaluates a control period again for its derivative, and begins every drive
    with the same module. A buffer that has changed shows that a later answer may
    differ, even if no answer has differed yet.

    Args:
        module: the module; `PilotNet` is known to be repeatable.
        evaluate: gives the control (n,).
        name: for messages.

    Raises:
        InputError: the two controls differ, or a buffer has changed.
    """
    if isinstance(module, PilotNet):
        return
    with torch.no_grad():
        before = {key: value.clone() for key, value in module.named_buffers()}
        first, second = evaluate(), evaluate()
        changed = [
            key
            for key, value in module.named_buffers()
            if key in before and not torch.equal(before[key].to(value), value)
        ]
        difference = float((first - second).abs().max())
        limit = TOLERANCE * float(torch.maximum(first.abs(), second.abs()).max())
    if changed or difference > limit:
        what = f"its buffer {changed[0]!r} changes" if changed else "its controls are"
        values = "" if changed else f" {first.tolist()[:2]}, then {second.tolist()[:2]}"
        raise InputError(
            f"{name}: evaluated twice on one image, {what}{values}; it was exported in "
            "training mode (dropout, batch statistics): export network.eval(); or it "
            "keeps a state in itself: take and return it as a hidden state, "
            "policy.recurrent"
        )


def check_alone(
    evaluate: Callable[[int], torch.Tensor], name: str, least: float
) -> None:
    """Refuse a network whose control for one image depends on the rest of the batch.

    Args:
        evaluate: gives the controls (n,) or (n, k) of the first n of two images.
        name: for messages.
        least: difference that rounding explains.

    Raises:
        InputError: the first control differs.
    """
    try:
        with torch.no_grad():
            alone, both = evaluate(1).reshape(1, -1), evaluate(2).reshape(2, -1)
    except InputError:  # it takes batches of another size, and will tell of them
        return
    for one, first, second in torch.cat([alone, both]).T.tolist():
        scale = max(abs(one), abs(second), abs(second - first))
        if abs(first - one) > MIXED * scale + least:
            raise InputError(
                f"{name}: the control for one image is {one:.6g} alone and {first:.6g} "
                "in a batch with another image, so vehicles would influence each "
                "other; batch statistics do that: export network.eval(), and give "
                "normalisation layers running statistics"
            )
