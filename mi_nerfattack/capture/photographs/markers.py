"""Printed square markers in placed photographs: metric scale and the ground."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.optimize import least_squares

from mi_nerfattack.capture.colmap.follow import StageCallback
from mi_nerfattack.capture.colmap.reconstruct import Structure
from mi_nerfattack.errors import InputError
from mi_nerfattack.extras import load_extra
from mi_nerfattack.io import files
from mi_nerfattack.ranges import Positive, checked
from mi_nerfattack.render.camera.distortion import direction, undistort
from mi_nerfattack.render.camera.intrinsics import Camera

FAMILIES = (
    "4x4_50",
    "4x4_250",
    "5x5_50",
    "5x5_250",
    "6x6_50",
    "6x6_250",
    "7x7_50",
    "7x7_250",
    "aruco_original",
    "apriltag_16h5",
    "apriltag_25h9",
    "apriltag_36h10",
    "apriltag_36h11",
)
"""OpenCV's predefined dictionaries: ArUco by bits and count, AprilTag."""

_OFF_PX = 2.0  # scale of the robust loss of a corner in an image
_LEAST_ANGLE_DEG = 2.0  # between the views of a corner, for a depth
_SAME = 0.1  # relative difference of markers' edges that contradicts one size
_FLAT = 0.25  # of an edge: how far corners may lie from one plane
_NAMED = 5


@dataclass(frozen=True)
@checked()
class Markers:
    """Markers that stand or lie in the scene, all of one size, each of another id.

    Attributes:
        edge_m: of the black square.
        family: one of `FAMILIES`; of a ChArUco board, that of its markers.
        flat: all lie on the ground, which becomes z = 0.
    """

    edge_m: Positive
    family: str = "apriltag_36h11"
    flat: bool = False

    def __post_init__(self) -> None:
        if self.family not in FAMILIES:
            raise InputError(
                f"markers: {self.family!r}; must be one of {', '.join(FAMILIES)}"
            )


@dataclass(frozen=True, eq=False)
class FoundMarkers:
    """Markers in the world of placed photographs.

    Attributes:
        corners: (4, 3) of each by its id, clockwise from its top left, in the
            structure's unit.
        views: number of photographs that show each.
    """

    corners: Mapping[int, np.ndarray]
    views: Mapping[int, int]

    def edges(self) -> dict[int, float]:
        """Return the median edge of each, of its sides and diagonals over sqrt 2."""
        result = {}
        for marker, corners in self.corners.items():
            sides = np.linalg.norm(corners - np.roll(corners, 1, axis=0), axis=1)
            diagonals = np.linalg.norm(corners[:2] - corners[2:], axis=1) / np.sqrt(2)
            result[marker] = float(np.median([*sides, *diagonals]))
        return result

    def scale(self, edge_m: float) -> tuple[float, float]:
        """Return the metres of one unit, and their relative spread between markers.

        Raises:
            InputError: edges of markers contradict each other.
        """
        edges = self.edges()
        median = float(np.median(list(edges.values())))
        ratios = {marker: edge / median for marker, edge in edges.items()}
        wrong = [marker for marker, ratio in ratios.items() if abs(ratio - 1) > _SAME]
        if wrong:
            wrong_edges = ", ".join(
                f"{marker}: {edge_m * ratios[marker]:.4g} m"
                for marker in wrong[:_NAMED]
            )
            raise InputError(
                f"markers: if most edges are {edge_m} m, some are not ({wrong_edges}); "
                "print all of one size, each id once, or leave the others out of the "
                "scene"
            )
        spread = float(np.std(list(ratios.values())))
        return edge_m / median, spread

    def ground(self) -> tuple[np.ndarray, np.ndarray]:
        """Return a point (3,) of the plane of all corners, and its normal (3,).

        Raises:
            InputError: they do not lie in one plane.
        """
        points = np.concatenate(list(self.corners.values()))
        centre = points.mean(0)
        normal = np.linalg.svd(points - centre)[2][2]
        edge = float(np.median(list(self.edges().values())))
        off = np.abs((points - centre) @ normal) / edge
        if off.max() > _FLAT:
            raise InputError(
                f"markers: corners are up to {off.max():.2f} edges off their common "
                "plane; lay all flat on the ground, or say that they are not flat"
            )
        return centre, normal


def find_markers(
    folder: Path,
    structure: Structure,
    markers: Markers,
    progress: StageCallback = lambda stage, done, total: None,
) -> FoundMarkers:
    """Find markers in placed photographs, and where their corners are.

    A corner is where the rays of all photographs that show it meet best; wrong
    detections count little.

    Args:
        folder: of the photographs.
        structure: their poses and cameras.
        markers: what to look for.
        progress: called with stage, done and total.

    Raises:
        InputError: no marker is seen in two photographs or more, from places apart.
        SetupError: OpenCV is not installed.
    """
    detections: dict[int, list[tuple[int, np.ndarray]]] = {}
    for index, name in enumerate(structure.names):
        progress("markers", index, len(structure.names))
        grey = files.read_image(folder / name)[..., :3].mean(2).astype(np.uint8)
        for marker, pixels in detect_markers(grey, markers.family).items():
            detections.setdefault(marker, []).append((index, pixels))
    progress("markers", len(structure.names), len(structure.names))
    corners, views = {}, {}
    for marker, sightings in sorted(detections.items()):
        at = [
            _meet(structure, [(index, pixels[k]) for index, pixels in sightings])
            for k in range(4)
        ]
        if all(point is not None for point in at):
            corners[marker], views[marker] = np.array(at), len(sightings)
    if not corners:
        shown = sum(map(len, detections.values()))
        raise InputError(
            f"markers: {shown} seen of {markers.family} in {len(structure.names)} "
            "placed photographs, none in two from places apart; check the family, and "
            "let each marker be large and sharp, with a white border, in 3 photographs"
        )
    return FoundMarkers(corners, views)


def detect_markers(grey: np.ndarray, family: str) -> dict[int, np.ndarray]:
    """Return the corners (4, 2) of markers by id, pixels from the image's corner.

    Ids that an image shows twice are left out.
    """
    cv2 = load_extra("cv2", "a capture with markers")
    dictionary = getattr(cv2.aruco, f"DICT_{family.upper()}")
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    detector = cv2.aruco.ArucoDetector(
        cv2.aruco.getPredefinedDictionary(dictionary), parameters
    )
    corners, ids, _ = detector.detectMarkers(np.ascontiguousarray(grey))
    numbers = [] if ids is None else np.ravel(ids).tolist()
    # OpenCV counts from the centre of the first pixel
    quads = [np.reshape(each, (4, 2)).astype(float) + 0.5 for each in corners]
    return {
        marker: pixels
        for marker, pixels in zip(numbers, quads, strict=True)
        if numbers.count(marker) == 1
    }


def _meet(
    structure: Structure, sightings: Iterable[tuple[int, np.ndarray]]
) -> np.ndarray | None:
    """Return the point (3,) that photographs show at pixels; None without depth."""
    indices = [index for index, _ in sightings]
    pixels = np.array([pixel for _, pixel in sightings])
    cameras = [structure.cameras[index] for index in indices]
    poses = structure.camera_to_world[indices]
    rays = np.stack(
        [
            pose[:3, :3] @ _ray(camera, pixel)
            for pose, camera, pixel in zip(poses, cameras, pixels, strict=True)
        ]
    )
    if np.degrees(np.arccos(np.clip((rays @ rays.T).min(), -1, 1))) < _LEAST_ANGLE_DEG:
        return None
    across = np.eye(3) - rays[:, :, None] * rays[:, None, :]
    eyes = poses[:, :3, 3]
    start = np.linalg.solve(across.sum(0), (across @ eyes[..., None]).sum(0)[:, 0])

    focal = np.array([(camera.fx + camera.fy) / 2 for camera in cameras])[:, None]

    def off(point: np.ndarray) -> np.ndarray:
        toward = point - eyes  # as angles, since a fisheye sees what is behind it
        toward /= np.linalg.norm(toward, axis=1, keepdims=True)
        return (focal * (toward - rays)).ravel()

    return least_squares(off, start, loss="cauchy", f_scale=_OFF_PX, x_scale="jac").x


def _ray(camera: Camera, pixel: np.ndarray) -> np.ndarray:
    x, y = (pixel - [camera.cx, camera.cy]) / [camera.fx, camera.fy]
    if camera.is_fisheye:  # sees backwards, too
        return np.array(direction(x, y, *camera.distortion[:4]))
    ray = np.array([*undistort(x, y, *camera.distortion), 1.0])
    return ray / np.linalg.norm(ray)
