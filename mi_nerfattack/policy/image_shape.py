"""The image that a network takes, told to whoever gave it another one."""

from __future__ import annotations

from collections.abc import Sequence

import torch

from mi_nerfattack.errors import is_interrupt

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
        takes none of them.
    """
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
