"""From the camera's image to a network's input: differentiable transforms.

A transform maps planes (n, c, h, w) to planes. All but the transfer function of
`ToLinear` are linear or affine; all are differentiable.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence

import numpy as np
import torch

from mi_nerfattack.errors import InputError

#: Luma of BT.601, as image libraries compute it from sRGB values.
LUMA = (0.299, 0.587, 0.114)


class AbstractTransform(ABC):
    """One step of the pre-processing."""

    @abstractmethod
    def apply(self, planes: torch.Tensor) -> torch.Tensor:
        """Map planes (n, c, h, w) to planes.

        Raises:
            InputError: the planes are too small, or have a wrong number of channels.
        """


class Crop(AbstractTransform):
    """Cut margins off.

    Args:
        top: rows to cut off.
        bottom: rows to cut off.
        left: columns to cut off.
        right: columns to cut off.
    """

    def __init__(self, top: int, bottom: int, left: int, right: int) -> None:
        self.margins: tuple[int, int, int, int] = top, bottom, left, right
        if min(self.margins) < 0:
            raise InputError(f"crop_px: {list(self.margins)}; none below 0")

    def apply(self, planes: torch.Tensor) -> torch.Tensor:
        """Return a view of the inner rectangle."""
        return _cut(planes, self.margins)


class FractionalCrop(AbstractTransform):
    """Cut margins off, given in parts of the height and the width.

    Rows and columns are rounded to whole ones, halves up.

    Args:
        top: part of the height to cut off, in [0, 1).
        bottom: part of the height to cut off, in [0, 1).
        left: part of the width to cut off, in [0, 1).
        right: part of the width to cut off, in [0, 1).
    """

    def __init__(self, top: float, bottom: float, left: float, right: float) -> None:
        self.fractions: tuple[float, float, float, float] = top, bottom, left, right
        if min(self.fractions) < 0 or top + bottom >= 1 or left + right >= 1:
            raise InputError(
                f"crop_fraction: {list(self.fractions)}; none below 0, and top with "
                "bottom, and left with right, below 1"
            )

    def apply(self, planes: torch.Tensor) -> torch.Tensor:
        """Return a view of the inner rectangle."""
        height, width = planes.shape[2:]
        sizes = (height, height, width, width)
        margins = [
            int(p * size + 0.5) for p, size in zip(self.fractions, sizes, strict=True)
        ]
        return _cut(planes, margins)


#: Weights (target, size) float64 of one axis, from its size and the target's.
Filter = Callable[[int, int], torch.Tensor]


def bilinear(size: int, target: int) -> torch.Tensor:
    """Weight the two nearest pixels of each target pixel's centre."""
    return _interpolated(size, target)


def antialias(size: int, target: int) -> torch.Tensor:
    """Weight by a triangle, as wide as two target pixels where the image shrinks."""
    return _interpolated(size, target, antialias=True)


def _interpolated(size: int, target: int, antialias: bool = False) -> torch.Tensor:
    unit = torch.eye(size, dtype=torch.float64)[None, None]
    resized = torch.nn.functional.interpolate(
        unit, (target, size), mode="bilinear", antialias=antialias
    )
    return resized[0, 0]


def area(size: int, target: int) -> torch.Tensor:
    """Weight each pixel by the part of the target pixel that it covers."""
    edges = torch.arange(target + 1, dtype=torch.float64) * (size / target)
    low, high = edges[:-1, None], edges[1:, None]
    start = torch.arange(size, dtype=torch.float64)[None]
    covered = torch.minimum(high, start + 1) - torch.maximum(low, start)
    return covered.clamp(min=0) * (target / size)


#: Filters by the names of scenario files.
FILTERS: dict[str, Filter] = {
    "antialias": antialias,
    "bilinear": bilinear,
    "area": area,
}


class Resize(AbstractTransform):
    """Resample to a size, pixel centres at half-integers, borders repeated.

    Each axis is multiplied by a matrix of weights, so that the derivative is the
    transposed product, deterministic on every device. Costs n c h w' (w + h')
    multiplications.

    Args:
        width: columns of the result, at least 1.
        height: rows of the result, at least 1.
        filter: `antialias`, `bilinear` or `area`, or weights of your own.
    """

    def __init__(self, width: int, height: int, filter: Filter = antialias) -> None:
        if min(width, height) < 1:
            raise InputError(f"resize_px: {[width, height]}; at least 1 each")
        self.width: int = width
        self.height: int = height
        self.filter: Filter = filter
        self._weights: dict[tuple[int, int], torch.Tensor] = {}

    def apply(self, planes: torch.Tensor) -> torch.Tensor:
        """Multiply by the weights of the columns, then of the rows."""
        height, width = planes.shape[2:]
        if (height, width) == (self.height, self.width):
            return planes
        across = self._matrix(width, self.width, planes)
        down = self._matrix(height, self.height, planes)
        return down @ (planes @ across.T)

    def _matrix(self, size: int, target: int, like: torch.Tensor) -> torch.Tensor:
        """Return weights (target, size), kept for the next image."""
        matrix = self._weights.get((size, target))
        if matrix is None or matrix.dtype != like.dtype or matrix.device != like.device:
            matrix = self.filter(size, target).to(like.device, like.dtype)
            self._weights[size, target] = matrix
        return matrix


class ToLinear(AbstractTransform):
    """Take sRGB values to linear light, IEC 61966-2-1."""

    def apply(self, planes: torch.Tensor) -> torch.Tensor:
        """Apply the curve; its two branches meet within 1e-8."""
        bent = ((planes.clamp(min=0.04045) + 0.055) / 1.055) ** 2.4
        return torch.where(planes <= 0.04045, planes / 12.92, bent)


class ColourMatrix(AbstractTransform):
    """Mix the three channels: c' = A c + b.

    Args:
        matrix: A, rows of three numbers.
        offset: b, one number per row.
    """

    def __init__(
        self, matrix: Sequence[Sequence[float]], offset: Sequence[float]
    ) -> None:
        self.matrix: torch.Tensor = torch.tensor(matrix, dtype=torch.float64)
        self.offset: torch.Tensor = _column(offset)

    def apply(self, planes: torch.Tensor) -> torch.Tensor:
        """Mix; other numbers of channels than three are refused."""
        _need_channels(planes, 3, "a colour space")
        mixed = torch.einsum("ij,njhw->nihw", self.matrix.to(planes), planes)
        return mixed + self.offset.to(planes)


def to_grey() -> ColourMatrix:
    """Make one channel: the luma of BT.601."""
    return ColourMatrix([LUMA], [0.0])


def to_bgr() -> ColourMatrix:
    """Turn the order of the channels round."""
    return ColourMatrix([(0, 0, 1), (0, 1, 0), (1, 0, 0)], [0.0, 0.0, 0.0])


def to_yuv() -> ColourMatrix:
    """Make luma and two colour differences, as OpenCV's ``COLOR_RGB2YUV``.

    Y = 0.299 R + 0.587 G + 0.114 B, U = 0.492 (B - Y) + 0.5, V = 0.877 (R - Y) + 0.5.
    PilotNet's paper feeds such planes (Bojarski et al. 2016).
    """
    red, green, blue = LUMA
    u = [-0.492 * red, -0.492 * green, 0.492 * (1 - blue)]
    v = [0.877 * (1 - red), -0.877 * green, -0.877 * blue]
    return ColourMatrix([LUMA, u, v], [0.0, 0.5, 0.5])


class Normalise(AbstractTransform):
    """Compute (scale x - mean) / std.

    Args:
        scale: 255 for networks that were trained on bytes.
        mean: one number, or one per channel, in the scaled unit.
        std: one positive number, or one per channel, in the scaled unit.
    """

    def __init__(
        self,
        scale: float = 1.0,
        mean: Sequence[float] = (0.0,),
        std: Sequence[float] = (1.0,),
    ) -> None:
        if not scale or not all(value > 0 for value in std):
            raise InputError(f"scale {scale}, std {list(std)}; not 0, and positive")
        self.scale: float = float(scale)
        self.mean: torch.Tensor = _column(mean)
        self.std: torch.Tensor = _column(std)

    def apply(self, planes: torch.Tensor) -> torch.Tensor:
        """Scale and shift each channel."""
        for values in (self.mean, self.std):
            if len(values) != 1:
                _need_channels(planes, len(values), "mean or std")
        factor = (self.scale / self.std).to(planes)
        return planes * factor - (self.mean / self.std).to(planes)


#: Network's input from frames (n, t, c, h, w), oldest first.
Layout = Callable[[torch.Tensor], torch.Tensor]


def channels_first(frames: torch.Tensor) -> torch.Tensor:
    """Return (n, t c, h, w)."""
    if frames.shape[1] == 1:  # a view with the camera's strides: convolutions see them
        return frames[:, 0]
    return frames.flatten(1, 2)


def channels_last(frames: torch.Tensor) -> torch.Tensor:
    """Return (n, h, w, t c)."""
    return channels_first(frames).permute(0, 2, 3, 1)


def time_first(frames: torch.Tensor) -> torch.Tensor:
    """Return (n, t, c, h, w)."""
    return frames


def time_channels_last(frames: torch.Tensor) -> torch.Tensor:
    """Return (n, t, h, w, c)."""
    return frames.permute(0, 1, 3, 4, 2)


#: Layouts by the names of scenario files: frames, time, channels, height, width.
LAYOUTS: dict[str, Layout] = {
    "NCHW": channels_first,
    "NHWC": channels_last,
    "NTCHW": time_first,
    "NTHWC": time_channels_last,
}


class Preprocess:
    """Transforms one after the other, then a stack of frames in a network's layout.

    Args:
        transforms: applied to each camera image.
        frames: length k of the stack: the image, and the images `stride`, ...,
            (k - 1) `stride` control periods ago. The first image replaces the images
            from before the start of the drive.
        stride: control periods between two frames of the stack.
        layout: of the network's input, oldest frame first.
    """

    def __init__(
        self,
        transforms: Sequence[AbstractTransform] = (),
        frames: int = 1,
        stride: int = 1,
        layout: Layout = channels_first,
    ) -> None:
        if min(frames, stride) < 1:
            raise InputError(f"frames {frames}, stride {stride}; at least 1 each")
        self.transforms: tuple[AbstractTransform, ...] = tuple(transforms)
        self.frames: int = frames
        self.stride: int = stride
        self.layout: Layout = layout

    @property
    def history(self) -> int:
        """Number of earlier images that the stack needs."""
        return (self.frames - 1) * self.stride

    def transform(self, image: torch.Tensor) -> torch.Tensor:
        """Apply the transforms to images (n, height, width, 3), sRGB in [0, 1].

        Returns:
            Planes (n, c, h, w).
        """
        planes = image.permute(0, 3, 1, 2)
        for transform in self.transforms:
            planes = transform.apply(planes)
        return planes

    def planes(self, image: torch.Tensor, past: torch.Tensor) -> np.ndarray:
        """Return (n, k, h, w): the stack that images complete, whatever the layout.

        Args:
            image: as for `transform`.
            past: as for `stack`.
        """
        with torch.no_grad():
            frames, _ = self.select(self.transform(image), past)
            return frames.flatten(1, 2).numpy(force=True)

    def stack(
        self, planes: torch.Tensor, past: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Put a frame on the stack.

        Args:
            planes: (n, c, h, w) from `transform`.
            past: (n, t, c, h, w), oldest first, at most `history` of them; any
                tensor with t = 0 before the first image.

        Returns:
            The network's input, and `past` for the next frame.
        """
        frames, known = self.select(planes, past)
        recent = known[:, max(0, known.shape[1] - self.history) :]
        # a view would keep the frame that has dropped out
        return self.layout(frames), recent if len(recent[0]) == len(
            known[0]
        ) else recent.clone()

    def select(
        self, planes: torch.Tensor, past: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Select the frames of the stack.

        Args:
            planes: as for `stack`.
            past: as for `stack`.

        Returns:
            The frames of the stack, and all known frames, (n, t, c, h, w), oldest
            first.
        """
        known = planes[:, None]
        if past.shape[1]:
            known = torch.cat([past, known], dim=1)
        last = known.shape[1] - 1
        ages = [i * self.stride for i in reversed(range(self.frames))]
        frames = known[:, -1:]
        if self.frames > 1:
            earlier = [known[:, max(0, last - age), None] for age in ages[:-1]]
            frames = torch.cat([*earlier, frames], dim=1)
        return frames, known


def _column(values: Sequence[float]) -> torch.Tensor:
    return torch.tensor(values, dtype=torch.float64)[:, None, None]


def _cut(planes: torch.Tensor, margins: Sequence[int]) -> torch.Tensor:
    top, bottom, left, right = margins
    height, width = planes.shape[2:]
    if top + bottom >= height or left + right >= width:
        raise InputError(
            f"policy.preprocess: crop of {top} + {bottom} rows and {left} + {right} "
            f"columns leaves nothing of an image of {width} x {height} pixels"
        )
    return planes[:, :, top : height - bottom, left : width - right]


def _need_channels(planes: torch.Tensor, count: int, owner: str) -> None:
    if planes.shape[1] != count:
        raise InputError(
            f"policy.preprocess: {owner} for {count} channels meets an image of "
            f"{planes.shape[1]}"
        )
