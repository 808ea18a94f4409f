"""Random changes of training images (appendix B.2: "random noise augmentation")."""

from __future__ import annotations

from dataclasses import dataclass

import torch


@dataclass(frozen=True)
class Augmentation:
    """Brightness, contrast, blur and noise, drawn for each image, clipped to [0, 1].

    Args:
        brightness: largest factor on all channels; drawn from [1/b, b], log-uniform.
        contrast: largest factor on the distance from mid-grey, drawn likewise.
        tint: largest factor on single channels, drawn likewise.
        blur: largest weight of the image's 3x3 box blur, drawn from [0, blur].
        noise: largest standard deviation of Gaussian noise on each value (sRGB,
            full scale 1), drawn from [0, noise].
    """

    brightness: float = 1.4
    contrast: float = 1.3
    tint: float = 1.05
    blur: float = 1.0
    noise: float = 0.06

    def apply(self, image: torch.Tensor, generator: torch.Generator) -> torch.Tensor:
        """Change a batch.

        Args:
            image: (n, 3, height, width), sRGB in [0, 1].
            generator: source of all draws, on the image's device.

        Returns:
            (n, 3, height, width) in [0, 1].
        """

        def uniform(*shape: int) -> torch.Tensor:
            return torch.rand(
                *shape, generator=generator, device=image.device, dtype=image.dtype
            )

        def factor(largest: float, *shape: int) -> torch.Tensor:
            return torch.tensor(largest).log().mul(2 * uniform(*shape) - 1).exp()

        n = len(image)
        weight = self.blur * uniform(n, 1, 1, 1)
        padded = torch.nn.functional.pad(image, (1, 1, 1, 1), mode="replicate")
        image = torch.lerp(
            image, torch.nn.functional.avg_pool2d(padded, 3, stride=1), weight
        )
        gain = factor(self.brightness, n, 1, 1, 1) * factor(self.tint, n, 3, 1, 1)
        image = 0.5 + factor(self.contrast, n, 1, 1, 1) * (gain * image - 0.5)
        noise = torch.randn(
            image.shape, generator=generator, device=image.device, dtype=image.dtype
        )
        return (image + self.noise * uniform(n, 1, 1, 1) * noise).clamp(0, 1)
