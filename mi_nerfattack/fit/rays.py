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
from mi_nerfattack.render.camera.intrinsics import Camera, Lens, lens_rays, pose_arrays
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
            drawn. None draws from all.
        corrections: of the cameras; none by default.

    Raises:
        InputError: depth has another shape than the images, more pixels than
            32 bits can number, or no pixel sees the box.
    """

    def __init__(
        self,
        images: PosedImages,
        indices: np.ndarray,
        depth: np.ndarray | None = None,
        box: tuple[np.ndarray, np.ndarray] | None = None,
        corrections: CameraCorrections | None = None,
    ) -> None:
        if depth is not None and depth.shape != images.images.shape[:3]:
            raise InputError(
                f"depth: shape {depth.shape}; must be {images.images.shape[:3]}, "
                "as the images"
            )
        self.camera: Camera = images.camera
        self.channels = images.images.shape[3]
        self.has_alpha = self.channels == 4
        chosen = images.images[indices]
        if chosen.size >= 1 << 32:
            raise InputError(
                f"images: {chosen.size} values; at most {(1 << 32) - 1} can be fitted "
                "to, reduce the images (long_edge_px) or their number"
            )
        # device arrays of their own: Dr.Jit may alias NumPy's memory
        self._pixels = dr.uint8_array_t(mi.Float)(chosen.ravel().copy())
        self._depth = None
        if depth is not None:
            self._depth = mi.Float(depth[indices].astype(np.float32).ravel().copy())
        self.corrections = corrections or CameraCorrections(len(indices), ())
        self._origin, self._rotation = pose_arrays(images.camera_to_world[indices])
        self._lens = Lens([images.camera_of(index) for index in indices])
        self.count = len(indices) * self.camera.width * self.camera.height
        dr.make_opaque(self._pixels, self._depth, self._origin)
        self._chosen = None
        if box is not None:
            self._chosen = self._seeing(*box)

    def state(self) -> list[Any]:
        """Return all that a kernel reads or was compiled for, for `drjit.freeze`."""
        device = [self._pixels, self._depth, self._origin, self._rotation, self._chosen]
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
        return RayBatch(origin, direction, colour, alpha, depth, image)

    def _rays(self, index: Any) -> tuple[Any, Any, Any]:
        per_image = self.camera.width * self.camera.height
        image = index // per_image
        pixel = index - image * per_image
        row = pixel // self.camera.width
        position = mi.Point2f(pixel - row * self.camera.width, row) + 0.5
        columns = [dr.gather(mi.Vector3f, c, image) for c in self._rotation]
        origin = dr.gather(mi.Point3f, self._origin, image)
        origin, columns = self.corrections.move(image, origin, columns)
        lens = self._lens.of(image)
        rotation = (columns[0], columns[1], columns[2])
        return image, *lens_rays(lens, origin, rotation, position)

    def _seeing(self, lower: np.ndarray, upper: np.ndarray) -> Any:
        box = mi.Point3f(*lower.tolist()), mi.Point3f(*upper.tolist())
        found = []
        for start in range(0, self.count, _CHUNK):
            size = min(_CHUNK, self.count - start)
            index = dr.arange(mi.UInt32, size) + dr.opaque(mi.UInt32, start)
            near, far = meet_box(*self._rays(index)[1:], *box)
            seen = dr.compress((near <= far) & (far > 0))
            if dr.width(seen) > 0:
                found.append(seen + start)
        if not found:
            raise InputError(
                f"bounds: {lower.tolist()} to {upper.tolist()}; no image sees this "
                "box, give bounds around what the cameras look at"
            )
        return dr.concat(found)
