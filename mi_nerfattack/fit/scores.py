"""How well a field shows pictures: PSNR, SSIM, hazy rays, holes, and what it shows."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_nerfattack.backend.colour import linear_to_srgb_numpy, srgb_to_linear_numpy
from mi_nerfattack.capture.posed_images import PosedImages
from mi_nerfattack.extras import load_extra
from mi_nerfattack.fields.base import AbstractField
from mi_nerfattack.render.camera.intrinsics import Camera
from mi_nerfattack.render.camera.lens import generate_rays, pose_arrays
from mi_nerfattack.render.march import march
from mi_nerfattack.render.posed import PosedField
from mi_nerfattack.render.rays import Rays

HAZY = (0.05, 0.95)  # opacities between are neither a surface nor free space
SOLID = 0.5  # opacity from which on a field stops a ray
MIN_EDGE_PX = 11  # of the window of SSIM
_WINDOW = 5  # half a window of SSIM, pixels: 3.5 standard deviations of 1.5
_WHITE = 1.0  # behind images with alpha, as is usual for Blender's synthetic scenes


@dataclass(frozen=True, eq=False)
class Rendering:
    """What a field shows from one pose, one ray through the centre of each pixel.

    Attributes:
        image: (height, width, 3), float32, sRGB in [0, 1].
        opacity: (height, width), float32.
        depth: (height, width), float32, expected depth along the ray, metres;
            infinite where the opacity is 0.
    """

    image: np.ndarray
    opacity: np.ndarray
    depth: np.ndarray

    @property
    def solid_depth(self) -> np.ndarray:
        """The depth where the field stops half of the light, else infinity."""
        return np.where(self.opacity >= SOLID, self.depth, np.inf)

    def hazy(self, mask: np.ndarray | None = None) -> float:
        """Return the share of rays, of those in a mask, with opacity inside `HAZY`."""
        opacity = self.opacity if mask is None else self.opacity[mask]
        return float(np.mean((opacity > HAZY[0]) & (opacity < HAZY[1])))


@dataclass(frozen=True, eq=False)
class Pictures:
    """One view as it should be and as a field shows it.

    Attributes:
        expected: (height, width, 3), sRGB in [0, 1].
        shown: by the field.
        depth: (height, width), metres along the ray, infinite or NaN where there is
            no surface; None if unknown.
    """

    expected: np.ndarray
    shown: Rendering
    depth: np.ndarray | None = None


@dataclass(frozen=True)
class ViewScore:
    """Agreement of one view.

    Attributes:
        name: of the image, or of the place that the view is from.
        psnr_db: of sRGB values in [0, 1], infinite for equal images.
        ssim: Wang et al. 2004, Gaussian window of 1.5 px, mean over channels.
        hazy: share of rays that are neither solid nor free; see `Rendering.hazy`.
        holes: see `FieldRenderer.holes`; NaN where no depth is known.
        index: of the image.
        route, arc_m, lateral_m: name, arc length and offset to the left of the place.
        ceiling_db: PSNR that the noise of a path-traced image alone would leave.
        depth_median_m, depth_p90_m: quantiles of the difference of depths; infinite
            where the field shows nothing, NaN where no rays are compared.
        wrong: share of rays that the field stops (opacity of at least 0.5) and the
            scene does not, or the other way round.
        pictures: kept for the worst views alone.
    """

    name: str
    psnr_db: float
    ssim: float
    hazy: float = 0.0
    holes: float = float("nan")
    index: int = 0
    route: str = ""
    arc_m: float = 0.0
    lateral_m: float = 0.0
    ceiling_db: float = float("inf")
    depth_median_m: float = float("nan")
    depth_p90_m: float = float("nan")
    wrong: float = 0.0
    pictures: Pictures | None = field(default=None, repr=False, compare=False)

    def entry(self, names: str) -> dict[str, Any]:
        """Return attributes by name; `names` has spaces between them."""
        return {name: getattr(self, name) for name in names.split()}


class FieldRenderer:
    """Renders a field from any pose; one kernel for all views of one size.

    Args:
        field: the field, or one at a pose in the cameras' world.
        over_white: put white behind the field instead of its background.
    """

    def __init__(
        self, field: AbstractField | PosedField, over_white: bool = False
    ) -> None:
        self._posed = field if isinstance(field, PosedField) else PosedField(field)
        self._over_white = over_white

    def render(self, camera: Camera, camera_to_world: np.ndarray) -> Rendering:
        """Render one view.

        Args:
            camera: intrinsics.
            camera_to_world: (4, 4), OpenCV axes, metres.
        """
        o, d = generate_rays(camera, *pose_arrays(camera_to_world), 1)
        with dr.suspend_grad():
            result = march(self._posed, Rays(o, d))
            behind = self._posed.background(d)
            if self._over_white:
                behind = mi.Color3f(_WHITE)
            colour = result.radiance + (1 - result.opacity) * behind
            depth = result.depth
            dr.eval(colour, result.opacity, depth)
        height, width = camera.height, camera.width
        return Rendering(
            linear_to_srgb_numpy(colour.numpy().T.reshape(height, width, 3)),
            result.opacity.numpy().reshape(height, width).copy(),
            depth.numpy().reshape(height, width).copy(),
        )

    def score(
        self,
        name: str,
        camera: Camera,
        camera_to_world: np.ndarray,
        expected: np.ndarray,
        *,
        depth: np.ndarray | None = None,
        mask: np.ndarray | None = None,
    ) -> ViewScore:
        """Render one view and compare it with a picture of the same view.

        Args:
            name: of the view.
            camera: intrinsics.
            camera_to_world: (4, 4), OpenCV axes, metres.
            expected: (height, width, 3), sRGB in [0, 1].
            depth: of the picture; see `Pictures.depth`.
            mask: (height, width), bool, the pixels that count; None for all.

        Returns:
            the score, with its pictures.
        """
        shown = self.render(camera, camera_to_world)
        psnr, ssim = compare(shown.image, expected, mask)
        holes = float("nan")
        if depth is not None:
            counted = depth if mask is None else np.where(mask, depth, np.nan)
            holes = self.holes(shown, camera, camera_to_world, depth=counted)
        pictures = Pictures(expected, shown, depth)
        return ViewScore(
            name, psnr, ssim, hazy=shown.hazy(mask), holes=holes, pictures=pictures
        )

    def holes(
        self,
        rendering: Rendering,
        camera: Camera,
        camera_to_world: np.ndarray,
        depth: np.ndarray,
    ) -> float:
        """Return the share of known surfaces that a view looks through.

        Args:
            rendering: of the view.
            camera: intrinsics.
            camera_to_world: (4, 4), OpenCV axes, metres.
            depth: (height, width), metres along the ray; infinite or NaN without a
                surface. Those outside of the field's box do not count.

        Returns:
            share of opacities below `SOLID`, NaN if there are no surfaces.
        """
        field = self._posed.field
        d = generate_rays(camera, *pose_arrays(camera_to_world), 1)[1].numpy()
        known = np.where(np.isfinite(depth), depth, np.nan)
        point = camera_to_world[:3, 3] + (d * known.ravel()).T
        point = self._posed.pose.to_local(point)
        inside = ((point > field.lower) & (point < field.upper)).all(1)
        if not inside.any():
            return float("nan")
        return float(np.mean(rendering.opacity.ravel()[inside] < SOLID))


def reference(images: PosedImages, index: int) -> np.ndarray:
    """Return an image, over white if it has alpha, sRGB (height, width, 3), float32."""
    image = images.images[index].astype(np.float32) / 255
    if image.shape[2] == 3:
        return image
    alpha = image[..., 3:]
    linear = alpha * srgb_to_linear_numpy(image[..., :3]) + (1 - alpha) * _WHITE
    return linear_to_srgb_numpy(linear)


def evaluate(
    field: AbstractField,
    images: PosedImages,
    indices: Iterable[int],
    depth: np.ndarray | None = None,
    keep: int = 4,
) -> list[ViewScore]:
    """Score a field against the pixels of images that count.

    Those with alpha lie over white.

    Args:
        field: the field; its background lies behind it, or white where the images
            have alpha.
        images: the posed images.
        indices: of the images to score.
        depth: (n, height, width), metres along the ray, NaN where unknown, of all
            images; or None.
        keep: number of views, those of least PSNR, whose rendering is kept.

    Returns:
        a score for each index, in order.
    """
    renderer = FieldRenderer(field, over_white=images.channels == 4)
    scores: list[ViewScore] = []
    for index in map(int, indices):
        score = renderer.score(
            images.names[index],
            images.camera_of(index),
            images.camera_to_world[index],
            expected=reference(images, index),
            depth=None if depth is None else depth[index],
            mask=None if images.masks is None else images.masks[index],
        )
        scores = keep_worst([*scores, replace(score, index=index)], keep)
    return scores


def keep_worst(scores: Sequence[ViewScore], count: int) -> list[ViewScore]:
    """Drop the pictures of all views but those of least PSNR."""
    best = {id(score) for score in worst_views(scores)[count:]}
    return [replace(s, pictures=None) if id(s) in best else s for s in scores]


def worst_views(scores: Iterable[ViewScore]) -> list[ViewScore]:
    """Return the views whose pictures are kept, worst first."""
    views = [score for score in scores if score.pictures is not None]
    return sorted(views, key=lambda score: score.psnr_db)


def mean(scores: Iterable[ViewScore], name: str) -> float:
    """Return the mean of a figure over the views that have it; NaN if none has it."""
    values = np.array([getattr(score, name) for score in scores])
    known = values[~np.isnan(values)]
    return float(known.mean()) if known.size else float("nan")


def least(scores: Iterable[ViewScore], name: str) -> float:
    """Return the least value of a figure over views."""
    return float(min(getattr(score, name) for score in scores))


def compare(
    image: np.ndarray, reference: np.ndarray, mask: np.ndarray | None = None
) -> tuple[float, float]:
    """Return PSNR (dB) and SSIM of two sRGB images (h, w, 3) in [0, 1].

    Args:
        image: to compare.
        reference: with this one.
        mask: (h, w), bool, the pixels that count; None for all. Both images are alike
            in the others, as far as windows of SSIM reach into them.
    """
    metrics = load_extra("skimage.metrics", "the score of a picture")
    mask = np.ones(image.shape[:2], bool) if mask is None else mask
    reference = np.where(mask[..., None], reference, image)
    error = float(np.mean((image.astype(np.float64) - reference)[mask] ** 2))
    psnr = float("inf") if error == 0 else -10 * float(np.log10(error))
    similar: Any = metrics.structural_similarity(
        image,
        reference,
        data_range=1.0,
        channel_axis=2,
        gaussian_weights=True,
        sigma=1.5,
        use_sample_covariance=False,
        full=True,
    )[1]
    interior = np.s_[_WINDOW:-_WINDOW, _WINDOW:-_WINDOW]  # windows within the image
    counted = mask[interior]
    ssim = (
        similar[interior][counted].mean(dtype=np.float64)
        if counted.any()
        else float("nan")
    )
    return psnr, float(ssim)
