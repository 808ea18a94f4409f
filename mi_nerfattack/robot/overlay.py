"""An attacked box in a camera's frames, by its pose: on green, or in front of all."""

from __future__ import annotations

from typing import Any

import numpy as np

from mi_nerfattack.capture.posed_images import resize_area
from mi_nerfattack.errors import InputError
from mi_nerfattack.render.camera.distortion import jacobian, undistort
from mi_nerfattack.render.camera.intrinsics import Camera, ray_lengths
from mi_nerfattack.robot.attacked import FACES, AttackedBox
from mi_nerfattack.system.extras import load_extra

_GREEN = 0.12, 0.35  # excess of green over its value: none of it, all of it
_DARK = 24.0  # sRGB levels below which the excess is noise
_TOLERANCE_M = 0.05  # that a recorded depth may be nearer than the box it shows


class Overlay:
    """Projects the visible faces of a box into frames, edges smooth.

    Each pixel's undistorted ray is known beforehand; a face is a homography of these.
    Coverage falls over one pixel at an edge, and adds up to 1 where faces meet.

    Args:
        box: its pictures and its pose in the world.
        camera: intrinsics and distortion of the frames.
        keyed: show it only where a frame is green; else in front of everything that is
            not nearer by depth.

    Source: appendix B.4.2.
    """

    def __init__(self, box: AttackedBox, camera: Camera, keyed: bool = True) -> None:
        self._cv2 = load_extra("cv2", "markers", "overlay")
        self.box, self.camera, self.keyed = box, camera, keyed
        columns, rows = np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5
        x, y = np.meshgrid(
            (columns - camera.cx) / camera.fx, (rows - camera.cy) / camera.fy
        )
        stretch = np.ones_like(x)
        if camera.is_distorted:
            x, y = undistort(x, y, *camera.distortion)
            stretch = np.sqrt(jacobian(x, y, *camera.distortion)[3])
        self._x, self._y = x.astype(np.float32), y.astype(np.float32)
        # of each column's x and each row's y
        self._spans = (x.min(0), x.max(0)), (y.min(1), y.max(1))
        self._stretch = stretch.astype(np.float32)
        self._lengths = ray_lengths(camera).astype(np.float32)
        self._planes = {face: box.plane(face) for face in FACES}
        self._pictures = {face: _reduced(box.images[face]) for face in FACES}

    def apply(
        self,
        frame: np.ndarray,
        camera_to_world: np.ndarray,
        depth: np.ndarray | None = None,
    ) -> np.ndarray:
        """Return a frame with the box in it.

        Args:
            frame: (height, width, 3), uint8 sRGB.
            camera_to_world: (4, 4), OpenCV axes, metres.
            depth: (height, width), metres along the ray, infinite where unknown: what
                is nearer than the box hides it.

        Raises:
            InputError: the frame has another size than the camera.
        """
        camera = self.camera
        if frame.shape != (camera.height, camera.width, 3):
            raise InputError(
                f"frame: shape {frame.shape}; the camera has {camera.height} x "
                f"{camera.width} px, 3 channels"
            )
        to_camera, eye = camera_to_world[:3, :3].T, camera_to_world[:3, 3]
        faces = {}
        for face, (corner, across, down) in self._planes.items():
            if (eye - corner) @ np.cross(down, across) > 0:
                columns = np.stack([across, down, corner - eye], axis=1)
                faces[face] = to_camera @ columns
        part = self._part(faces)
        if part is None:
            return frame.copy()
        colour = np.zeros((*self._x[part].shape, 3), np.float32)
        total = np.zeros(self._x[part].shape, np.float32)
        near = None if depth is None else depth[part] + _TOLERANCE_M
        for face, matrix in faces.items():
            self._add(face, matrix, part, near, colour, total)
        result = frame.copy()
        under = frame[part].astype(np.float32)
        share = np.minimum(total, 1)
        colour /= np.maximum(total, 1e-6)[..., None]
        if self.keyed:
            share, under = _keyed(under, share)
        share = share[..., None]
        result[part] = np.rint(under + share * (colour - under)).astype(np.uint8)
        return result

    def _add(
        self,
        face: str,
        matrix: np.ndarray,
        part: Any,
        near: np.ndarray | None,
        colour: np.ndarray,
        total: np.ndarray,
    ) -> None:
        """Add the coverage of a face, and its colour times that.

        The inverse of `matrix` maps a ray (x, y, 1) to (u, v, 1) / z, with u and v from
        0 to 1 on the face and z along the optical axis.
        """
        try:
            rows = np.linalg.inv(matrix).astype(np.float32)
        except np.linalg.LinAlgError:  # seen edge on
            return
        x, y = self._x[part], self._y[part]
        u, v, w = (row[0] * x + row[1] * y + row[2] for row in rows)
        inside = np.full(x.shape, np.inf, np.float32)
        for line, row in (
            (u, rows[0]),
            (w - u, rows[2] - rows[0]),
            (v, rows[1]),
            (w - v, rows[2] - rows[1]),
        ):
            slope = np.hypot(row[0] / self.camera.fx, row[1] / self.camera.fy)
            np.minimum(inside, line * (1 / max(float(slope), 1e-9)), out=inside)
        cover = np.clip(inside * self._stretch[part] + 0.5, 0, 1)
        ahead = w > 1e-9
        cover *= ahead
        w = np.where(ahead, w, 1)
        if near is not None:
            cover *= self._lengths[part] <= near * w
        picture = self._picture(face, matrix)
        height, width = picture.shape[:2]
        sampled = self._cv2.remap(
            picture,
            u / w * width - 0.5,
            v / w * height - 0.5,
            self._cv2.INTER_LINEAR,
            borderMode=self._cv2.BORDER_REPLICATE,
        )
        colour += cover[..., None] * sampled
        total += cover

    def _part(self, faces: dict[str, np.ndarray]) -> Any:
        """Return the rows and columns that faces can be in, None for none of them."""
        if not faces:
            return None
        whole = slice(0, self.camera.height), slice(0, self.camera.width)
        corners = np.concatenate([_corners(matrix) for matrix in faces.values()])
        if (corners[:, 2] <= 0).all():
            return None
        if (corners[:, 2] < 1e-3).any():
            return whole
        spots, found = corners[:, :2] / corners[:, 2:], []
        for low, high, (least, most), focal in zip(
            spots.min(0),
            spots.max(0),
            self._spans,
            (self.camera.fx, self.camera.fy),
            strict=True,
        ):
            seen = np.flatnonzero(
                (most >= low - 2 / focal) & (least <= high + 2 / focal)
            )
            if not len(seen):
                return None
            found.append(slice(int(seen[0]), int(seen[-1]) + 1))
        return found[1], found[0]

    def _pixels(self, corners: np.ndarray) -> np.ndarray:
        camera, ahead = self.camera, corners[:, :2] / corners[:, 2:]
        return ahead * [camera.fx, camera.fy] + [camera.cx, camera.cy]

    def _picture(self, face: str, matrix: np.ndarray) -> np.ndarray:
        """Choose the reduced picture whose pixels are about as large as the frame's."""
        pictures, corners = self._pictures[face], _corners(matrix)
        if (corners[:, 2] < 1e-3).any():
            return pictures[0]
        x, y = self._pixels(corners).T
        area = 0.5 * abs(float(x @ np.roll(y, -1) - y @ np.roll(x, -1)))
        height, width = pictures[0].shape[:2]
        level = round(0.5 * np.log2(max(1.0, height * width / max(area, 1.0))))
        return pictures[min(level, len(pictures) - 1)]


def green_share(frame: np.ndarray) -> np.ndarray:
    """Tell how much of each pixel is a green target, (h, w), 0 to 1.

    By how far green exceeds red and blue, relative to itself, which hardly depends on
    the exposure.

    Args:
        frame: (h, w, 3), float32 sRGB, 0 to 255.
    """
    red, green, blue = frame[..., 0], frame[..., 1], frame[..., 2]
    excess = (green - np.maximum(red, blue)) / np.maximum(green, _DARK)
    low, high = _GREEN
    return np.clip((excess - low) / (high - low), 0, 1)


def _keyed(under: np.ndarray, share: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Cut a coverage to green pixels, and take the green spill from what it covers."""
    kept = share * green_share(under)
    under = under.copy()
    most = np.maximum(under[..., 0], under[..., 2])
    spill = np.maximum(under[..., 1] - most, 0) * (share > 0)
    under[..., 1] -= spill
    return kept, under


def _corners(matrix: np.ndarray) -> np.ndarray:
    """Return the corners (4, 3) of a face in the camera's frame, around it."""
    across, down, corner = matrix.T
    return np.stack([corner, corner + across, corner + across + down, corner + down])


def _reduced(image: np.ndarray) -> list[np.ndarray]:
    """Return a picture and halves of it, down to some pixels."""
    found = [image]
    while min(found[-1].shape[:2]) >= 8:
        height, width = found[-1].shape[:2]
        found.append(resize_area(found[-1], width // 2, height // 2))
    return found
