"""Training rays: pixels of posed images on the device, and random batches of them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_nerfattack.capture.posed_images import PosedImages
from mi_nerfattack.errors import InputError
from mi_nerfattack.fit.cameras import CameraCorrections
from mi_nerfattack.render.camera.intrinsics import Camera
from mi_nerfattack.render.camera.lens import Lens, lens_rays, pose_arrays
from mi_nerfattack.render.rays import meet_box

_CHUNK = 1 << 22


@dataclass
class RayBatch:
    """Rays and what the images show along them.

    Attributes:
        origin: (3, n), metres in the world.
        direction: (3, n), unit vectors.
        colour: (3, n), sRGB in [0, 1], not premultiplied.
        alpha: (n,), in [0, 1]; 1 where the images have none.
        depth: (n,), metres along the ray, infinite where nothing is hit, NaN where it
            is unknown; None where the images come without depth.
        image: (n,), of the images drawn from.
    """

    origin: Any
    direction: Any
    colour: Any
    alpha: Any
    depth: Any = None
    image: Any = None


class RayBank:
    """Pixels of chosen images, from which random batches of rays are drawn.

    Images and poses lie on the device; a batch is one small kernel, the same for
    every batch.

    Args:
        images: posed images.
        indices: images to draw from, e.g. all that are not held out.
        depth: (n, height, width), metres along the ray, NaN where unknown, of all
            images; or None.
        box: lower and upper corner, metres: only pixels whose rays meet the box are
            drawn. None draws from all. Nor are those drawn that masks leave out.
        corrections: of the cameras; none by default.

    Raises:
        InputError: depth has another shape than the images, more pixels than
            32 bits can number, or no pixel that counts sees the box.
    """

    def __init__(
        self,
        images: PosedImages,
        indices: np.ndarray,
        depth: np.ndarray | None = None,
        box: tuple[np.ndarray, np.ndarray] | None = None,
        corrections: CameraCorrections | None = None,
    ) -> None:
        _check_depth(images, depth)
        self.camera: Camera = images.camera
        self.channels = images.channels
        self.has_alpha = self.channels == 4
        ends = np.cumsum(
            [images.images[i].shape[0] * images.images[i].shape[1] for i in indices]
        )
        self.count = int(ends[-1])
        if self.count * self.channels >= 1 << 32:
            raise InputError(
                f"images: {self.count * self.channels} values; at most "
                f"{(1 << 32) - 1} can be fitted to, reduce the images (long_edge_px) "
                "or their number"
            )
        self._ends, self._widths = None, None
        if not images.has_one_size:
            widths = [images.images[i].shape[1] for i in indices]
            self._ends = mi.UInt32(ends.tolist())
            self._widths = mi.UInt32(widths)
            dr.make_opaque(self._ends, self._widths)
        # device arrays of their own: Dr.Jit may alias NumPy's memory
        self._pixels = dr.uint8_array_t(mi.Float)(_flat(images.images, indices))
        self._depth = None
        if depth is not None:
            self._depth = mi.Float(_flat(depth, indices).astype(np.float32))
        self.corrections = corrections or CameraCorrections(len(indices), ())
        self._origin, self._rotation = pose_arrays(images.camera_to_world[indices])
        self._lens = Lens([images.camera_of(index) for index in indices])
        dr.make_opaque(self._pixels, self._depth, self._origin)
        self._chosen = None
        if box is not None:
            self._chosen = self._seeing(*box)
        if images.masks is not None:
            self._chosen = self._counting(_flat(images.masks, indices))

    def state(self) -> list[Any]:
        """Return all that a kernel reads or was compiled for, for `drjit.freeze`."""
        device = [self._pixels, self._depth, self._origin, self._rotation, self._chosen]
        device += [self._ends, self._widths]
        return [self, device, self._lens.state(), self.corrections.values]

    def draw(self, random: Any) -> Any:
        """Draw pixels with replacement, `mi.UInt32` (n,), as `batch` takes them.

        Args:
            random: `mi.PCG32` of n streams; it is advanced.
        """
        if self._chosen is None:
            return random.next_uint32_bounded(self.count)
        slot = random.next_uint32_bounded(dr.width(self._chosen))
        return dr.gather(mi.UInt32, self._chosen, slot)

    def batch(self, index: Any) -> RayBatch:
        """Return the rays of given pixels, `mi.UInt32` (n,), image by image, by row.

        Origin and direction are differentiable in the corrections of the poses.
        """
        image, origin, direction = self._rays(index)
        byte = type(self._pixels)
        base = index * self.channels
        values = [
            mi.Float(mi.UInt32(dr.gather(byte, self._pixels, base + i))) / 255
            for i in range(self.channels)
        ]
        alpha = values[3] if self.has_alpha else mi.Float(1)
        depth = None
        if self._depth is not None:
            depth = dr.gather(mi.Float, self._depth, index)
        colour = mi.Color3f(*values[:3])
        return RayBatch(
            origin, direction, colour, alpha=alpha, depth=depth, image=image
        )

    def _rays(self, index: Any) -> tuple[Any, Any, Any]:
        image, pixel, width = self._place(index)
        row = pixel // width
        position = mi.Point2f(pixel - row * width, row) + 0.5
        columns = [dr.gather(mi.Vector3f, c, image) for c in self._rotation]
        origin = dr.gather(mi.Point3f, self._origin, image)
        origin, columns = self.corrections.move(image, origin, columns)
        lens = self._lens.of(image)
        rotation = (columns[0], columns[1], columns[2])
        return image, *lens_rays(lens, origin, rotation, position=position)

    def _place(self, index: Any) -> tuple[Any, Any, Any]:
        """Return the image of pixels, their place in it by rows, and its width."""
        ends, widths = self._ends, self._widths
        if ends is None or widths is None:
            per_image = self.camera.width * self.camera.height
            image = index // per_image
            return image, index - image * per_image, self.camera.width
        image = dr.binary_search(
            0, dr.width(ends), lambda i: dr.gather(mi.UInt32, ends, i) <= index
        )
        start = dr.gather(mi.UInt32, ends, image - 1, image > 0)
        width = dr.gather(mi.UInt32, widths, image)
        return image, index - start, dr.maximum(width, 1)  # 0 in lanes without a ray

    def _seeing(self, lower: np.ndarray, upper: np.ndarray) -> Any:
        low, high = mi.Point3f(*lower.tolist()), mi.Point3f(*upper.tolist())
        indices = []
        for start in range(0, self.count, _CHUNK):
            size = min(_CHUNK, self.count - start)
            index = dr.arange(mi.UInt32, size) + dr.opaque(mi.UInt32, start)
            _, origin, direction = self._rays(index)
            near, far = meet_box(origin, direction, lower=low, upper=high)
            hits = dr.compress((near <= far) & (far > 0))
            if dr.width(hits) > 0:
                indices.append(hits + start)
        if not indices:
            raise InputError(
                f"bounds: {lower.tolist()} to {upper.tolist()}; no image sees this "
                "box, give bounds around what the cameras look at"
            )
        return dr.concat(indices)

    def _counting(self, masks: np.ndarray) -> Any:
        pixels = np.flatnonzero(masks)
        if self._chosen is not None:
            pixels = np.intersect1d(pixels, self._chosen.numpy())
        if not len(pixels):
            raise InputError(
                "masks: leave no pixel of the images that sees the box; what is to be "
                "fitted must be white in some"
            )
        return mi.UInt32(pixels.astype(np.uint32))


def _check_depth(images: PosedImages, depth: np.ndarray | None) -> None:
    if depth is None:
        return
    shapes = [each.shape for each in depth]
    image_shapes = [image.shape[:2] for image in images.images]
    if shapes != image_shapes:
        raise InputError(
            f"depth: shape {depth.shape}, maps of {sorted(set(shapes))}; must be "
            f"{len(images)} maps of {sorted(set(image_shapes))}, as the images"
        )


def _flat(arrays: np.ndarray, indices: np.ndarray) -> np.ndarray:
    """Return the values of chosen arrays one after the other."""
    return np.concatenate([arrays[i].ravel() for i in indices])
