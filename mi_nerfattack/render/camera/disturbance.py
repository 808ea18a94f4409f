"""What a camera adds to an image: blur, exposure and noise, and their derivatives.

An image is decoded to linear light, blurred, multiplied by the exposure, clipped,
encoded as sRGB, and noise is added: the order in a camera, whose optics blur light
before the sensor counts it. The noise has one standard deviation in sRGB values,
because the noise of counted photons grows as the root of the light. The sRGB curve is
nearly a root, which makes this noise constant (Anscombe 1948; Foi et al. 2008 on
sensors). Policies are trained with the same noise.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import drjit as dr
import numpy as np

from mi_nerfattack.backend.arrays import concat, split, vjp
from mi_nerfattack.ranges import Natural, NonNegative, checked
from mi_nerfattack.render.camera.rig import Layout, camera_seed

#: Standard deviations at which the blur's kernel ends.
_TRUNCATE = 4.0
_STREAM, _COLOURS = 3, 7  # of the seed; initial poses have others


@dataclass(frozen=True)
@checked("Disturbance")
class Disturbance:
    """Blur and exposure drawn for each drive of a batch, noise for each frame.

    Everything drawn is a function of the seed, the drive's number and the step:
    derivatives see the same numbers, and nothing is kept. Parts of size 0 are left out.

    Cost: some launches of kernels over the image's values, and as many to
    differentiate.

    Args:
        exposure_ev_sd: standard deviation of the exposure, powers of two; normal.
        blur_px_sd: of the normal number whose size is the blur's standard deviation.
        noise_sd: standard deviation of the noise, sRGB in [0, 1]; normal, independent
            of pixel, channel and frame.
        seed: of all draws.
        first: number of the first drive of a batch.
        colour_ev_sd: as of the exposure, of each channel by itself: white balance.

    Source: Athalye et al. 2018, expectation over transformation.
    """

    exposure_ev_sd: NonNegative = 0.0
    blur_px_sd: NonNegative = 0.0
    noise_sd: NonNegative = 0.0
    seed: Natural = 0
    first: Natural = 0
    colour_ev_sd: NonNegative = 0.0

    def __bool__(self) -> bool:
        """Tell whether it changes anything."""
        sizes = self.exposure_ev_sd, self.blur_px_sd, self.noise_sd, self.colour_ev_sd
        return any(sizes)

    def draws(self, count: int) -> tuple[np.ndarray, np.ndarray]:
        """Return exposures (count, 3), powers of two, and blurs (count,), pixels."""
        random = np.random.default_rng([self.seed, _STREAM])
        normal = random.normal(size=(self.first + count, 2))[self.first :]
        colours = np.random.default_rng([self.seed, _COLOURS])
        colours = colours.normal(size=(self.first + count, 3))[self.first :]
        exposures = self.exposure_ev_sd * normal[:, :1] + self.colour_ev_sd * colours
        return exposures, self.blur_px_sd * abs(normal[:, 1])

    def apply(self, image: Any, step: int, layout: Layout | None = None) -> Any:
        """Disturb the images of a batch.

        Args:
            image: tensor (n, height, width, 3), sRGB in [0, 1], one row per drive.
            step: index of the control period, from 0.
            layout: of the images of several cameras in it. All cameras have the same
                exposure and the same blur, which ends at the edges of each image. Their
                noise is independent.

        Returns:
            a tensor like it; differentiable.
        """
        exposures, blurs = self.draws(image.shape[0])
        return disturbed(
            image,
            exposures,
            blurs,
            noise_sd=self.noise_sd,
            seed=self.seed,
            step=step,
            first=self.first,
            layout=layout,
        )

    def vjp(
        self, image: Any, step: int, d_shown: Any, layout: Layout | None = None
    ) -> Any:
        """Return the derivative by the image from the derivative by the result.

        Args:
            image: as given to :meth:`apply`.
            step: as given to :meth:`apply`.
            d_shown: derivative of the objective by the result of :meth:`apply`, of the
                same shape.
            layout: as given to :meth:`apply`.
        """
        result = vjp(lambda x: self.apply(x, step, layout), image, d_shown)
        dr.eval(result)
        return result


def disturbed(
    image: Any,
    exposures: np.ndarray,
    blurs: np.ndarray,
    noise_sd: float,
    seed: int,
    step: int,
    first: int = 0,
    layout: Layout | None = None,
) -> Any:
    """Blur and expose images, and add noise.

    Args:
        image: tensor (n, height, width, 3), sRGB in [0, 1].
        exposures: (n, 3) of the channels, powers of two.
        blurs: (n,), standard deviations, pixels.
        noise_sd: standard deviation of the noise, sRGB in [0, 1].
        seed: of the noise.
        step: index of the control period, on which the noise depends, too.
        first: number of the first image, on which the noise depends, too.
        layout: of the images of several cameras; None for one.

    Returns:
        a tensor like it; differentiable.
    """
    # Several cameras: each image by itself, with noise of its own
    if layout is not None and len(layout.sizes) > 1:
        images = []
        for k, part in enumerate(layout.split(image)):
            own = camera_seed(seed, k)
            images.append(
                disturbed(
                    part,
                    exposures,
                    blurs,
                    noise_sd=noise_sd,
                    seed=own,
                    step=step,
                    first=first,
                )
            )
        return side_by_side(images, layout)
    # One camera: now all values of its images are one flat array
    kind, shape, value = type(image.array), image.shape, image.array
    if exposures.any() or blurs.any():
        # Lens and shutter act on linear light
        value = dr.srgb_to_linear(value)
        if blurs.any():
            value = blur(value, shape, blurs)
        # One gain per drive and channel, (3 n,); the encoding clips to [0, 1]
        gain = _uploaded(kind, (2.0**exposures).ravel())
        index = _drive_and_channel(value, shape)
        value = dr.linear_to_srgb(value * dr.gather(kind, gain, index))
    # The noise is normal in sRGB values, so it follows the encoding
    if noise_sd:
        noise = standard_normal(kind, shape, seed, step=step, first=first)
        value = value + dr.opaque(kind, noise_sd) * noise  # the image itself stays
        value = dr.clip(value, 0, 1)
    return type(image)(value, shape)


def side_by_side(images: Sequence[Any], layout: Layout) -> Any:
    """Lay images side by side, as :meth:`Layout.join` does; differentiable.

    Args:
        images: tensors (n, height, width, 3) of Dr.Jit, of all cameras.
        layout: of the frame.
    """
    width, height = layout.size
    kind = type(images[0].array)
    shape = (images[0].shape[0], height, width, 3)
    # Drive, row, column and channel of each value of the frame
    index = dr.arange(dr.uint32_array_t(kind), math.prod(shape))
    pixel, channel = index // 3, index % 3
    row, column = pixel // width, pixel % width
    image, row = row // height, row % height
    # Each camera fills its columns; below a lower image the frame stays black
    frame = dr.zeros(kind, math.prod(shape))
    for part, columns, (wide, high) in zip(
        images, layout.columns, layout.sizes, strict=True
    ):
        inside = (column >= columns.start) & (column < columns.stop) & (row < high)
        source = ((image * high + row) * wide + column - columns.start) * 3 + channel
        frame += dr.gather(kind, part.array, source, inside)
    return type(images[0])(frame, shape)


def blur(value: Any, shape: tuple[int, ...], blurs: np.ndarray) -> Any:
    """Convolve images with Gaussians; differentiable.

    Edges are mirrored, the outermost pixel too: this makes the matrix of the
    convolution symmetric, so that it is its own transpose.

    Args:
        value: flat values of a tensor of that shape.
        shape: (n, height, width, 3).
        blurs: (n,), standard deviations, pixels.
    """
    return dr.custom(_Blur, value, shape[1:], [_gaussian(sd) for sd in blurs])


class _Blur(dr.CustomOp):
    """A convolution that is its own transpose; Dr.Jit's derivative would scatter."""

    def eval(
        self, value: Any, image: tuple[int, ...], kernels: list[list[float]]
    ) -> Any:
        self.image, self.kernels = image, kernels
        return self._convolve(value)

    def forward(self) -> None:
        self.set_grad_out(self._convolve(self.grad_in("value")))

    def backward(self) -> None:
        self.set_grad_in("value", self._convolve(self.grad_out()))

    def _convolve(self, value: Any) -> Any:
        """Convolve each drive's image; equal reaches share their kernels."""
        size = math.prod(self.image)
        tensor = dr.tensor_t(type(value))
        blurred = [
            dr.convolve(
                tensor(part, self.image),
                kernel,
                axis=(0, 1),
                boundary="reflect",
                mode="symbolic",
            ).array
            for part, kernel in zip(split(value, size), self.kernels, strict=True)
        ]
        return concat(blurred, [size] * len(blurred))


def _gaussian(sd: float) -> list[float]:
    """Sample a Gaussian of a standard deviation in pixels; the sum is 1."""
    reach = int(_TRUNCATE * sd + 0.5)
    weights = np.exp(-0.5 * (np.arange(-reach, reach + 1) / max(sd, 1e-3)) ** 2)
    return (weights / weights.sum()).tolist()


def standard_normal(
    kind: Any, shape: tuple[int, ...], seed: int, step: int, first: int = 0
) -> Any:
    """Draw normal numbers by counters, a function of seed, row and step.

    Args:
        kind: type of the result.
        shape: (n, ...), one row per drive; a row does not depend on n.
        seed: of all numbers.
        step: index of the control period.
        first: number of the first row.

    Returns:
        flat values, mean 0 and variance 1.
    """
    (key,) = np.random.SeedSequence([seed, _STREAM, step]).generate_state(1, np.uint64)
    size = math.prod(shape)
    skipped = first * size // shape[0]
    drawn = dr.rng(seed=int(key)).normal(kind, skipped + size)
    if not skipped:
        return drawn
    return dr.gather(kind, drawn, dr.arange(dr.uint32_array_t(kind), size) + skipped)


def _drive_and_channel(value: Any, shape: tuple[int, ...]) -> Any:
    """Return the index of each flat value among the channels of all drives."""
    index = dr.arange(dr.uint32_array_t(type(value)), dr.width(value))
    return 3 * (index // int(np.prod(shape[1:]))) + index % 3


def _uploaded(kind: Any, values: np.ndarray) -> Any:
    """Make an array whose numbers, and their alignment, kernels do not depend on."""
    result = kind(values.tolist())
    dr.make_opaque(result)
    return result
