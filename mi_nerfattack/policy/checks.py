"""What every policy checks: images, goals, hidden states and controls."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import drjit as dr
import torch

from mi_nerfattack.backend.torch_arrays import to_torch
from mi_nerfattack.errors import InputError, is_interrupt

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


#: Column of a control, or columns of several; None where there is one column.
Output = int | Sequence[int] | None
#: Factor of a control, or one for each of several.
Scale = float | Sequence[float]


def chosen_controls(
    values: torch.Tensor, count: int, output: Output, name: str
) -> torch.Tensor:
    """Take the controls out of a network's answer, and refuse NaN.

    Args:
        values: (n,), (n, 1), or (n, j) where `output` is given; of one image also ()
            and (j,).
        count: n.
        output: column of the control, or k columns of several controls.
        name: of the policy, for messages.

    Returns:
        (n,), or (n, k) of several columns.
    """
    if count == 1 and values.ndim < 2:  # a network that drops axes of size 1
        values = values.reshape(1, -1)
    shape = tuple(values.shape)
    several = isinstance(output, Sequence)
    if shape != (count,) or several:
        column = 0 if output is None and shape == (count, 1) else output
        columns = list(column) if isinstance(column, Sequence) else [column]
        if len(shape) != 2 or shape[0] != count or not _are_within(columns, shape[1]):
            raise InputError(
                f"{name}: controls {shape} for {count} images; the policy must return "
                "one number for each image, (n,) or (n, 1), or several, (n, k), and "
                f"policy.output (is {output}) must tell the column of the control, or "
                "the columns where the vehicle has several controls"
            )
        values = values[:, columns if several else columns[0]]
    bad = (~torch.isfinite(values)).nonzero().tolist()
    if bad:
        value = float(values[tuple(bad[0])])
        raise InputError(
            f"{name}: control {value} for image {bad[0][0]} of {count}; it must be "
            "finite: check the weights and policy.preprocess"
        )
    return values


def scaled(values: torch.Tensor, scale: Scale) -> torch.Tensor:
    """Multiply controls (n,) or (n, k) by a factor, or by one for each of k."""
    if isinstance(scale, Sequence):
        return values * values.new_tensor(scale)
    return scale * values


def _are_within(columns: Sequence[int | None], count: int) -> bool:
    return len(columns) > 0 and all(c is not None and c < count for c in columns)


def misfit(wanted: Sequence[int | None], given: Sequence[int]) -> str:
    """Say which image a network takes, which it gets, and what to write.

    Args:
        wanted: shape of its images, None where a size is free.
        given: shape of those that it gets, from `policy.preprocess`.
    """
    sizes = ", ".join("any" if size is None else f"{size}" for size in wanted)
    return (
        f"takes images of shape ({sizes}), and gets {tuple(given)} of the camera and "
        f"policy.preprocess; write {_remedy(wanted)}"
    )


def usual_shape(
    module: torch.nn.Module, image: torch.Tensor, rest: Sequence[torch.Tensor]
) -> tuple[int, ...] | None:
    """Find a shape of images that a module takes, among those that are usual.

    Args:
        module: has refused `image`.
        image: (n, ...).
        rest: goal and hidden states, which it gets with each.

    Returns:
        (n, channels, height, width) or (n, height, width, channels); None where it
        takes none of them, or the shape of `image` with other values.
    """
    if _takes(module, torch.zeros_like(image), rest):
        return None
    kernels = [p.shape[1] for p in module.parameters() if p.ndim == 4][:1]
    for width, height in USUAL_PX:
        for channels in kernels or (3, 1):
            planes, pixels = (channels, height, width), (height, width, channels)
            for shape in ((len(image), *planes), (len(image), *pixels)):
                if _takes(module, image.new_zeros(shape), rest):
                    return shape
    return None


def _takes(
    module: torch.nn.Module, image: torch.Tensor, rest: Sequence[torch.Tensor]
) -> bool:
    try:
        with torch.no_grad():
            module(image, *rest)
    except Exception as err:  # a user's module raises whatever it likes
        if is_interrupt(err):
            raise
        return False
    return True


def _remedy(wanted: Sequence[int | None]) -> str:
    """Return the keys of [policy.preprocess] that make images of a shape."""
    if len(wanted) != 4:
        return "policy.preprocess as the network needs it"
    _, *sizes = wanted
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
