"""Random changes of training images (appendix B.2: "random noise augmentation")."""

from __future__ import annotations

from dataclasses import dataclass

import torch

#: Normal numbers that are drawn for a batch; images take theirs from random offsets,
#: because drawing is what takes longest.
_NOISE_POOL = 1 << 18


@dataclass(frozen=True)
class Augmentation:
    """Exposure, white balance, contrast, blur and noise, drawn for each image.

    In this order, which is a camera's; the result is clipped to [0, 1]. What acts on
    single values is looked up in a table of 256 for each image and channel.

    Args:
        exposure_ev: largest change of the light, in powers of two, drawn uniformly
            from [-e, e]; linear light.
        gain: largest factor on the light of single channels, drawn from [1/g, g],
            log-uniform.
        contrast: largest factor on the distance from mid-grey (sRGB), drawn from
            [1/c, c], log-uniform.
        blur: largest weight of the image's 3x3 box blur, drawn from [0, blur].
        noise: largest standard deviation of Gaussian noise on each value (sRGB,
            full scale 1), drawn from [0, noise].
    """

    exposure_ev: float = 1.0
    gain: float = 1.12
    contrast: float = 1.3
    blur: float = 1.0
    noise: float = 0.06

    def apply(self, frames: torch.Tensor, generator: torch.Generator) -> torch.Tensor:
        """Change a batch.

        Args:
            frames: (n, height, width, 3) uint8, sRGB.
            generator: source of all draws, on the frames' device.

        Returns:
            (n, 3, height, width) float32 in [0, 1], in memory as the frames are.
        """
        image = look_up(self._tables(len(frames), generator), frames)
        weight = self.blur * _uniform(generator, len(frames), 1, 1, 1)
        padded = torch.nn.functional.pad(image, (1, 1, 1, 1), mode="replicate")
        blurred = torch.nn.functional.avg_pool2d(padded, 3, stride=1)
        image = torch.lerp(image, blurred, weight)
        return self._add_noise(image, generator).clamp_(0, 1)

    def _tables(self, n: int, generator: torch.Generator) -> torch.Tensor:
        """Draw new values (n, 3, 256) of the levels of each image and channel."""
        levels = torch.linspace(0, 1, 256, device=generator.device)
        light = 2.0 ** (self.exposure_ev * (2 * _uniform(generator, n, 1, 1) - 1))
        light = light * _factor(self.gain, generator, n, 3, 1)
        values = to_srgb((light * to_linear(levels)).clamp(max=1))
        contrast = _factor(self.contrast, generator, n, 1, 1)
        return (0.5 + contrast * (values - 0.5)).clamp(0, 1)

    def _add_noise(
        self, image: torch.Tensor, generator: torch.Generator
    ) -> torch.Tensor:
        n, size = len(image), image[0].numel()
        sd = self.noise * _uniform(generator, n)
        count = max(_NOISE_POOL, 2 * size)
        pool = torch.randn(count, generator=generator, device=image.device)
        starts = (_uniform(generator, n) * (count - size)).long().tolist()
        flat = image.permute(0, 2, 3, 1).reshape(n, size)
        for row, start, scale in zip(flat, starts, sd.tolist(), strict=True):
            row.add_(pool[start : start + size], alpha=scale)
        _, channels, height, width = image.shape
        return flat.view(n, height, width, channels).permute(0, 3, 1, 2)


def look_up(tables: torch.Tensor, frames: torch.Tensor) -> torch.Tensor:
    """Replace levels by values.

    Args:
        tables: (n, 3, 256) float32.
        frames: (n, height, width, 3) uint8.

    Returns:
        (n, 3, height, width) float32, in memory as the frames are.
    """
    n = len(frames)
    start = 256 * torch.arange(3 * n, dtype=torch.int32, device=frames.device)
    index = frames.int() + start.view(n, 1, 1, 3)
    values = tables.reshape(-1).index_select(0, index.view(-1))
    return values.view(frames.shape).permute(0, 3, 1, 2)


def to_linear(value: torch.Tensor) -> torch.Tensor:
    """Decode sRGB values in [0, 1] to linear light."""
    return torch.where(
        value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4
    )


def to_srgb(light: torch.Tensor) -> torch.Tensor:
    """Encode linear light in [0, 1] as sRGB values."""
    curve = 1.055 * light.clamp(min=1e-4) ** (1 / 2.4) - 0.055
    return torch.where(light <= 0.0031308, 12.92 * light, curve)


def _uniform(generator: torch.Generator, *shape: int) -> torch.Tensor:
    return torch.rand(*shape, generator=generator, device=generator.device)


def _factor(largest: float, generator: torch.Generator, *shape: int) -> torch.Tensor:
    return largest ** (2 * _uniform(generator, *shape) - 1)
