"""An attacked box in a camera's frames, by its pose: on green, or in front of all."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import Any

import numpy as np

from mi_nerfattack.backend.colour import linear_to_uint8, srgb_to_linear_numpy
from mi_nerfattack.errors import InputError
from mi_nerfattack.extras import load_extra
from mi_nerfattack.props.attacked import AttackedBox
from mi_nerfattack.render.camera.distortion import jacobian
from mi_nerfattack.render.camera.intrinsics import Camera, ray_lengths, ray_slopes

_GREEN = 0.12, 0.35  # excess of green over its value: none of it, all of it
_DARK = 24.0  # sRGB levels below which the excess is noise
_TOLERANCE_M = 0.05  # that a recorded depth may be nearer than the box it shows
_PROBES = 8  # of a picture a pixel, at most, where a face is seen almost edge on
_FACING = -0.8  # cosine between edges that a strip or a thin wedge lies between
_STEPS = 16383  # of linear light, so fine that its darkest are a fifth of an sRGB level
_TO_LINEAR = srgb_to_linear_numpy(np.arange(256, dtype=np.float32) / 255)
_TO_SRGB = linear_to_uint8(np.arange(_STEPS + 1, dtype=np.float32) / _STEPS)


class Overlay:
    """Projects the visible faces of a box into frames, edges smooth.

    Each pixel's undistorted ray is known beforehand; a face is a homography of these.
    Coverage falls over one pixel at an edge, and adds up to 1 where faces meet.
    Pictures are reduced to the frame's pixels, as far as each axis needs it, and mixed
    in linear light, as a camera's pixels gather it.

    Args:
        box: its pictures and its pose in the world.
        camera: intrinsics and distortion of the frames.
        keyed: show it only where a frame is green; else in front of everything that is
            not nearer by depth.

    Source: appendix B.4.2.
    """

    def __init__(self, box: AttackedBox, camera: Camera, keyed: bool = True) -> None:
        self._cv2 = load_extra("cv2", "overlay")
        self.box, self.camera, self.keyed = box, camera, keyed
        x, y = ray_slopes(camera)
        stretch = np.ones_like(x)
        if camera.is_distorted:
            stretch = np.sqrt(jacobian(x, y, *camera.distortion)[3])
        self._x, self._y = x.astype(np.float32), y.astype(np.float32)
        # of each column's x and each row's y
        self._spans = (x.min(0), x.max(0)), (y.min(1), y.max(1))
        self._stretch = stretch.astype(np.float32)
        self._lengths = ray_lengths(camera).astype(np.float32)
        self._planes = {face: box.plane(face) for face in box.faces}
        self._pictures = {face: self._reduced(box.images[face]) for face in box.faces}

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
        colour = np.zeros((*frame.shape[:2], 3), np.float32)
        total = np.zeros(frame.shape[:2], np.float32)
        near = None if depth is None else depth + _TOLERANCE_M
        for face, matrix in faces.items():
            self._add(face, matrix, near, colour, total)
        result = frame.copy()
        under = frame[part]
        colour, total = colour[part], total[part]
        share = np.minimum(total, 1)
        if self.keyed:
            share, under = _keyed(under, share)
        colour *= self._thrice(share / np.maximum(total, 1e-6) * _STEPS)
        behind = self._cv2.LUT(np.ascontiguousarray(under), _TO_LINEAR)
        behind *= self._thrice((1 - share) * _STEPS)
        colour += behind
        result[part] = np.take(_TO_SRGB, np.rint(colour).astype(np.intp))
        return result

    def _thrice(self, values: np.ndarray) -> np.ndarray:
        """Return values (h, w) thrice; NumPy multiplies whole channels far faster."""
        return self._cv2.merge([values] * 3)

    def _add(
        self,
        face: str,
        matrix: np.ndarray,
        near: np.ndarray | None,
        colour: np.ndarray,
        total: np.ndarray,
    ) -> None:
        """Add the coverage of a face, and its colour times that.

        The inverse of `matrix` maps a ray (x, y, 1) to (u, v, 1) / z, with u and v from
        0 to 1 on the face and z along the optical axis.
        """
        part = self._part({face: matrix})
        try:
            rows = np.linalg.inv(matrix).astype(np.float32)
        except np.linalg.LinAlgError:  # seen edge on
            return
        if part is None:
            return
        x, y, stretch = self._x[part], self._y[part], self._stretch[part]
        u, v, w = (row[0] * x + row[1] * y + row[2] for row in rows)
        ahead = w > 1e-9
        lines = (u, rows[0]), (w - u, rows[2] - rows[0]), (v, rows[1])
        lines = *lines, (w - v, rows[2] - rows[1])
        cover = self._cover(lines, stretch) * ahead
        if near is not None:
            cover *= self._lengths[part] <= near[part] * w
        total[part] += cover
        scale = float(stretch[stretch.shape[0] // 2, stretch.shape[1] // 2])
        picture, number, way = self._footprint(face, matrix, rows, scale=scale)
        steps = rows[:, :2] @ way
        probes: list[Any] = [np.float32(0)]
        if number > 1:
            first, last = _within([(a, float(row[:2] @ way)) for a, row in lines])
            shares = (np.arange(number, dtype=np.float32) + 0.5) / number
            probes = [first + share * (last - first) for share in shares]
        height, width = picture.shape[:2]
        gathered = np.zeros((*u.shape, 3), np.float32)
        for at in probes:
            z = 1 / np.where(ahead, w + at * steps[2], 1)
            gathered += self._cv2.remap(
                picture,
                (u + at * steps[0]) * z * width - 0.5,
                (v + at * steps[1]) * z * height - 0.5,
                self._cv2.INTER_LINEAR,
                borderMode=self._cv2.BORDER_REPLICATE,
            )
        colour[part] += gathered * self._thrice(cover / number)

    def _cover(
        self, lines: Sequence[tuple[np.ndarray, np.ndarray]], stretch: np.ndarray
    ) -> np.ndarray:
        """Return the share of each pixel that is within four edges.

        Args:
            lines: of an edge: positive within, and its slopes by the ray's x and y.
            stretch: see `__init__`.
        """
        focal = self.camera.fx, self.camera.fy
        normals, sides = [], []
        for line, row in lines:
            slope = row[:2] / focal
            size = max(float(np.hypot(*slope)), 1e-9)
            normals.append(slope / size)
            sides.append(_half(line * stretch * (1 / size), *normals[-1]))
        result = np.minimum(np.minimum(*sides[:2]), np.minimum(*sides[2:]))
        for a, b in itertools.combinations(range(4), 2):
            if normals[a] @ normals[b] < _FACING:
                np.minimum(result, sides[a] + sides[b] - 1, out=result)
        return np.maximum(result, 0)

    def _footprint(
        self, face: str, matrix: np.ndarray, rows: np.ndarray, scale: float
    ) -> tuple[np.ndarray, int, np.ndarray]:
        """Choose what a pixel gathers of a face, by what it covers at its middle.

        A pixel covers an ellipse of the picture. Along its longer axis several probes
        are taken, of a picture whose own pixels are about as large as the shorter.

        Args:
            face: of the box.
            matrix: of the face; see `_add`.
            rows: the inverse of it.
            scale: by how much distortion enlarges here.

        Returns:
            the picture, the number of probes, and the longer axis in the image, from
            side to side of a pixel, as a step of the ray's x and y.
        """
        pictures = self._pictures[face]
        depth = float(matrix[2] @ [0.5, 0.5, 1])
        if depth < 1e-3:
            return pictures[0], 1, np.zeros(2, np.float32)
        pixel = 1 / (scale * np.array([self.camera.fx, self.camera.fy]))
        size = np.array(pictures[0].shape[1::-1])
        steps = depth * (rows[:2, :2] - 0.5 * rows[2, :2]) * size[:, None] * pixel
        _, (longer, shorter), ways = np.linalg.svd(steps)
        number = int(np.clip(np.rint(longer / max(shorter, 1.0)), 1, _PROBES))
        level = round(np.log2(max(shorter, longer / number, 1.0)))
        way = (ways[0] / np.abs(ways[0]).max() * pixel).astype(np.float32)
        return pictures[min(level, len(pictures) - 1)], number, way

    def _part(self, faces: dict[str, np.ndarray]) -> Any:
        """Return the rows and columns that faces can be in, None for none of them."""
        if not faces:
            return None
        full = slice(0, self.camera.height), slice(0, self.camera.width)
        corners = np.concatenate([_corners(matrix) for matrix in faces.values()])
        if (corners[:, 2] <= 0).all():
            return None
        if (corners[:, 2] < 1e-3).any():
            return full
        spots, slices = corners[:, :2] / corners[:, 2:], []
        for low, high, (least, most), focal in zip(
            spots.min(0),
            spots.max(0),
            self._spans,
            (self.camera.fx, self.camera.fy),
            strict=True,
        ):
            pixels = np.flatnonzero(
                (most >= low - 2 / focal) & (least <= high + 2 / focal)
            )
            if not len(pixels):
                return None
            slices.append(slice(int(pixels[0]), int(pixels[-1]) + 1))
        return slices[1], slices[0]

    def _reduced(self, image: np.ndarray) -> list[np.ndarray]:
        """Return a picture in linear light and halves of it, down to some pixels."""
        pyramid = [_TO_LINEAR[image]]
        while min(pyramid[-1].shape[:2]) >= 8:
            height, width = pyramid[-1].shape[:2]
            size = width // 2, height // 2
            pyramid.append(
                self._cv2.resize(pyramid[-1], size, interpolation=self._cv2.INTER_AREA)
            )
        return pyramid


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
    coverage = share * green_share(under.astype(np.float32))
    under = under.copy()
    others = np.maximum(under[..., 0], under[..., 2])
    np.minimum(under[..., 1], others, out=under[..., 1], where=share > 0)
    return coverage, under


def _half(distance: np.ndarray, across: float, down: float) -> np.ndarray:
    """Return the share of a pixel that is on the positive side of a line.

    Args:
        distance: of its middle from the line, pixels.
        across: the line's unit normal in the image,
        down: and the other part of it.
    """
    least, most = sorted((abs(float(across)), abs(float(down))))
    if least < 1e-3:
        return np.clip(distance + 0.5, 0, 1)
    reach = (least + most) / 2
    away = np.minimum(np.abs(distance), reach)
    corner = (reach - away) ** 2 * (0.5 / (least * most))
    cut = np.where(away < reach - least, 0.5 - away * (1 / most), corner)
    return np.where(distance < 0, cut, 1 - cut)


def _within(
    lines: Sequence[tuple[np.ndarray, float]],
) -> tuple[np.ndarray, np.ndarray]:
    """Return from where to where a step of one pixel, to either side, is on a face.

    Args:
        lines: positive on the face, and by how much each grows in the step.
    """
    first = np.full(lines[0][0].shape, -0.5, np.float32)
    last = -first
    for line, growth in lines:
        if abs(growth) > 1e-9:
            ends = line * (-1 / growth)
            if growth > 0:
                np.maximum(first, ends, out=first)
            else:
                np.minimum(last, ends, out=last)
    middle = np.clip((first + last) / 2, -0.5, 0.5)
    return np.minimum(first, middle), np.maximum(last, middle)


def _corners(matrix: np.ndarray) -> np.ndarray:
    """Return the corners (4, 3) of a face in the camera's frame, around it."""
    across, down, corner = matrix.T
    return np.stack([corner, corner + across, corner + across + down, corner + down])
