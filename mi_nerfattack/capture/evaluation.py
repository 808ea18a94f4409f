"""How well a field shows given images: PSNR, SSIM, and comparison pictures."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_nerfattack.capture.frames import PosedImages
from mi_nerfattack.colour import linear_to_srgb_numpy, srgb_to_linear_numpy
from mi_nerfattack.fields.base import AbstractField
from mi_nerfattack.render.camera import generate_rays, pose_arrays
from mi_nerfattack.render.march import March, march
from mi_nerfattack.render.posed import PosedField

_WHITE = 1.0  # behind images with alpha, as is usual for Blender's synthetic scenes


@dataclass(frozen=True)
class ViewScore:
    """Agreement of one view.

    Attributes:
        index: of the image.
        name: of the image.
        psnr_db: of sRGB values in [0, 1], infinite for equal images.
        ssim: Wang et al. 2004, Gaussian window of 1.5 px, mean over channels.
    """

    index: int
    name: str
    psnr_db: float
    ssim: float


class FieldViews:
    """Renders a field with one camera; one kernel for all views.

    Args:
        field: the field; its background lies behind it, or white where the images
            have alpha.
        images: whose camera and poses are used.
    """

    def __init__(self, field: AbstractField, images: PosedImages) -> None:
        self.images = images
        self._posed = PosedField(field)

    def march(self, index: int) -> tuple[March, np.ndarray]:
        """Render view `index`: its march, and its sRGB image (h, w, 3), float32."""
        origin, rotation = pose_arrays(self.images.camera_to_world[index])
        o, d = generate_rays(self.images.camera, origin, rotation, 1)
        half, far = mi.Float(0.5), mi.Float(dr.inf)
        with dr.suspend_grad():
            result = march(self._posed, o, d, far, half, mi.Bool(True))
            behind = self._posed.background(d)
            if self.images.images.shape[3] == 4:
                behind = mi.Color3f(_WHITE)
            colour = result.radiance + (1 - result.opacity) * behind
            dr.eval(result, colour)
        size = (self.images.camera.height, self.images.camera.width, 3)
        return result, linear_to_srgb_numpy(colour.numpy().T.reshape(size))

    def reference(self, index: int) -> np.ndarray:
        """Return image `index` over the same background, sRGB (h, w, 3), float32."""
        image = self.images.images[index].astype(np.float32) / 255
        if image.shape[2] == 3:
            return image
        alpha = image[..., 3:]
        linear = alpha * srgb_to_linear_numpy(image[..., :3]) + (1 - alpha) * _WHITE
        return linear_to_srgb_numpy(linear)


def evaluate(
    field: AbstractField, images: PosedImages, indices: Iterable[int]
) -> list[ViewScore]:
    """Score a field against images; those with alpha lie over white."""
    views = FieldViews(field, images)
    scores = []
    for index in map(int, indices):
        psnr, ssim = compare(views.march(index)[1], views.reference(index))
        scores.append(ViewScore(index, images.names[index], psnr, ssim))
    return scores


def compare(image: np.ndarray, reference: np.ndarray) -> tuple[float, float]:
    """Return PSNR (dB) and SSIM of two sRGB images (h, w, 3) in [0, 1]."""
    from skimage.metrics import structural_similarity

    error = float(np.mean((image.astype(np.float64) - reference) ** 2))
    psnr = float("inf") if error == 0 else -10 * float(np.log10(error))
    ssim = structural_similarity(
        image,
        reference,
        data_range=1.0,
        channel_axis=2,
        gaussian_weights=True,
        sigma=1.5,
        use_sample_covariance=False,
    )
    return psnr, float(ssim)


def comparison(
    field: AbstractField, images: PosedImages, scores: Sequence[ViewScore], rows: int
) -> np.ndarray:
    """Lay out the worst views, worst first: image, field, four times the difference.

    Args:
        field: the field.
        images: the posed images.
        scores: of the views to choose from, at least one.
        rows: number of views shown.

    Returns:
        (rows * height, 3 * width, 3), uint8 sRGB.
    """
    views = FieldViews(field, images)
    strips = []
    for score in sorted(scores, key=lambda score: score.psnr_db)[:rows]:
        shown, wanted = views.march(score.index)[1], views.reference(score.index)
        difference = np.clip(4 * np.abs(shown - wanted), 0, 1)
        strips.append(np.concatenate([wanted, shown, difference], axis=1))
    return np.round(255 * np.concatenate(strips)).astype(np.uint8)
