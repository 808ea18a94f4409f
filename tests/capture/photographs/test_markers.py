"""Scale and ground by markers, against frames made by homographies."""

from __future__ import annotations

import re
import sys
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mi_nerfattack.capture.colmap.reconstruct import Structure
from mi_nerfattack.capture.photographs import markers as module
from mi_nerfattack.capture.photographs.alignment import Distance, align
from mi_nerfattack.capture.photographs.estimate import PoseOptions
from mi_nerfattack.capture.photographs.markers import (
    Markers,
    detect_markers,
    find_markers,
)
from mi_nerfattack.errors import InputError, SetupError
from mi_nerfattack.extras import install_hint
from mi_nerfattack.io import files
from mi_nerfattack.render.camera.intrinsics import Camera, from_fov, look_at

cv2 = pytest.importorskip("cv2")

EDGE_M, UNIT_M = 0.16, 1 / 0.37  # of the printed markers; of the structure's unit
CELLS_PX = 40
FAMILY = "6x6_50"
#: place of the top left corner, right and down, of each marker in the true world
LYING = {
    3: ([0.0, 0.3, 0.0], [1.0, 0, 0], [0, -1.0, 0]),
    7: ([0.4, 0.1, 0.0], [0.8, 0.6, 0], [0.6, -0.8, 0]),
}
STANDING = {9: ([-0.4, 0.6, 0.5], [1.0, 0, 0], [0, 0, -1.0])}


def draw(image: np.ndarray, camera: Camera, pose: np.ndarray, marker, place, edge):
    """Paint a marker with its white border into an image by a homography."""
    bits = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_6X6_50)
    pattern = cv2.aruco.generateImageMarker(bits, marker, 8 * CELLS_PX)
    pattern = np.pad(pattern, CELLS_PX, constant_values=255)
    metres = edge / (8 * CELLS_PX)
    corner, right, down = (np.array(v, float) for v in place)
    # pixels of OpenCV, from the centre of the first one, to metres on the marker
    first = (0.5 - CELLS_PX) * metres
    to_metres = np.array([[metres, 0, first], [0, metres, first], [0, 0, 1]])
    plane = np.stack([right, down, corner], axis=1) @ to_metres
    plane[:, 2] -= pose[:3, 3]
    cx, cy = camera.cx - 0.5, camera.cy - 0.5
    lens = np.array([[camera.fx, 0, cx], [0, camera.fy, cy], [0, 0, 1]])
    homography = lens @ pose[:3, :3].T @ plane
    size = camera.width, camera.height
    shown = cv2.warpPerspective(pattern, homography, size, flags=cv2.INTER_AREA)
    mask = cv2.warpPerspective(np.full_like(pattern, 255), homography, size)
    image[...] = np.where(mask > 127, shown, image)


def photographs(folder, places, edges=None):
    """Write frames; return a structure in another unit and frame, and true poses."""
    fine, camera = from_fov(1280, 960, 60.0), from_fov(640, 480, 60.0)
    eyes = [
        [1.2 * np.sin(a), -1.0 * np.cos(a), 0.9 + 0.2 * a]
        for a in np.linspace(-0.6, 0.6, 6)
    ]
    poses = np.stack([look_at(eye, [0.1, 0.3, 0.1]) for eye in eyes])
    names = tuple(f"{i}.png" for i in range(len(poses)))
    for name, pose in zip(names, poses, strict=True):
        image = np.full((960, 1280), 110, np.uint8)
        for marker, place in places.items():
            draw(image, fine, pose, marker, place, (edges or {}).get(marker, EDGE_M))
        small = cv2.resize(image, (640, 480), interpolation=cv2.INTER_AREA)
        files.write_image(folder / name, small)
    turn = Rotation.from_euler("xyz", [0.7, -0.4, 1.1]).as_matrix()
    moved = poses.copy()
    moved[:, :3, :3] = turn @ poses[:, :3, :3]
    moved[:, :3, 3] = (poses[:, :3, 3] @ turn.T + [3, 1, -2]) / UNIT_M
    cameras = (camera,) * len(poses)
    return Structure(names, moved, cameras, np.zeros((0, 3)), 0.5), poses


@pytest.fixture(scope="module")
def lying(tmp_path_factory):
    folder = tmp_path_factory.mktemp("lying")
    return folder, *photographs(folder, LYING)


def test_scale_within_a_percent(tmp_path):
    reconstruction, poses = photographs(tmp_path, {**LYING, **STANDING})
    result, scale = align(reconstruction, tmp_path, Markers(EDGE_M, FAMILY))
    assert set(scale.markers) == {3, 7, 9} and min(scale.markers.values()) >= 4
    assert scale.metres_per_unit == pytest.approx(UNIT_M, rel=0.01)
    assert scale.spread < 0.01
    moved, true = (p[:, :3, 3] - p[0, :3, 3] for p in (result.camera_to_world, poses))
    lengths = [np.linalg.norm(steps, axis=1) for steps in (moved, true)]
    np.testing.assert_allclose(*lengths, atol=0.01)


def test_flat_markers_are_the_ground(lying):
    folder, reconstruction, poses = lying
    result, _ = align(reconstruction, folder, Markers(EDGE_M, FAMILY, flat=True))
    eyes = result.camera_to_world[:, :3, 3]
    np.testing.assert_allclose(eyes[:, 2], poses[:, 2, 3], atol=0.01)
    np.testing.assert_allclose(eyes[:, :2].mean(0), 0, atol=1e-9)
    up = result.camera_to_world[:, :3, :3].transpose(0, 2, 1) @ [0, 0, 1]
    true = poses[:, :3, :3].transpose(0, 2, 1) @ [0, 0, 1]
    assert np.degrees(np.arccos((up * true).sum(1))).max() < 0.5


def test_wrong_corners_count_little_and_doubled_markers_nothing(lying, monkeypatch):
    folder, reconstruction, _ = lying
    image = files.read_image(folder / "2.png")[..., 0]
    assert set(detect_markers(image, FAMILY)) == {3, 7}
    assert detect_markers(np.concatenate([image, image], axis=1), FAMILY) == {}
    off = iter([0.0, 30.0, 0.0, 0.0, 0.0, 0.0])

    def detect(grey, family):
        shift = next(off)
        return {k: c + shift for k, c in detect_markers(grey, family).items()}

    monkeypatch.setattr(module, "detect_markers", detect)
    markers = find_markers(folder, reconstruction, Markers(EDGE_M, FAMILY))
    assert list(off) == []
    assert markers.scale(EDGE_M)[0] == pytest.approx(UNIT_M, rel=0.01)


@pytest.mark.parametrize(
    ("edges", "flat", "message"),
    [
        ({9: 0.22}, False, r"markers: .* 0.16 m, .* \(9: 0.2[12]"),
        ({}, True, "markers: .* common plane"),
    ],
)
def test_markers_that_do_not_fit_are_refused(tmp_path, edges, flat, message):
    reconstruction, _ = photographs(tmp_path, {**LYING, **STANDING}, edges)
    with pytest.raises(InputError, match=message):
        align(reconstruction, tmp_path, Markers(EDGE_M, FAMILY, flat=flat))


def test_a_fisheye_sees_markers_behind_it(tmp_path, monkeypatch):
    """Ideal fisheyes, r = f angle, 95 to 105 degrees turned away from a marker."""
    camera = Camera(640, 640, 160.0, 160.0, 320.0, 320.0, is_fisheye=True)
    corners = np.array([[0, 0, 0], [1, 0, 0], [1, -1, 0], [0, -1, 0]]) * EDGE_M
    poses, sights = [], []
    for k, angle in enumerate(np.linspace(-0.6, 0.6, 6)):
        eye = np.array([1.2 * np.sin(angle), -1.0 * np.cos(angle), 0.9])
        pose = look_at(eye, corners.mean(0))
        aside = Rotation.from_euler("y", 95 + 2 * k, degrees=True).as_matrix()
        pose[:3, :3] = pose[:3, :3] @ aside
        local = (corners - eye) @ pose[:3, :3]
        assert (local[:, 2] < 0).all()
        across = np.hypot(local[:, 0], local[:, 1])
        radius = camera.fx * np.arctan2(across, local[:, 2])
        poses.append(pose)
        sights.append({3: 320 + local[:, :2] * (radius / across)[:, None]})
        files.write_image(tmp_path / f"{k}.png", np.zeros((4, 4, 3), np.uint8))
    names = tuple(f"{k}.png" for k in range(6))
    reconstruction = Structure(
        names, np.array(poses), (camera,) * 6, np.zeros((0, 3)), 0.5
    )
    shown = iter(sights)
    monkeypatch.setattr(module, "detect_markers", lambda grey, family: next(shown))
    markers = find_markers(tmp_path, reconstruction, Markers(EDGE_M, FAMILY))
    np.testing.assert_allclose(markers.corners[3], corners, atol=1e-6)


SCALES = [
    (6, lambda: Markers(EDGE_M, "4x4_50"), "markers: 0 seen of 4x4_50"),
    (1, lambda: Markers(EDGE_M, FAMILY), "markers: 2 seen"),
    (6, lambda: Markers(0.0), "edge_m: 0.0"),
    (6, lambda: Markers(0.1, "7x8"), "markers: '7x8'; .*4x4_50"),
    (6, lambda: Distance("0.png", "x.png", 1.0), "distance: 'x.png' .*0.png"),
    (6, lambda: Distance("0.png", "0.png", 1.0), "distance: 0.png and 0.png"),
    (6, lambda: Distance("0.png", "5.png", -1.0), "distance.metres: -1.0"),
    (6, lambda: PoseOptions(metres_per_unit=2.0, markers=Markers(0.1)), "give one"),
]


@pytest.mark.parametrize(("count", "make", "message"), SCALES)
def test_scales_that_are_none_are_refused(lying, count, make, message):
    folder, reconstruction, _ = lying
    fields = ("names", "camera_to_world", "cameras")
    few = replace(
        reconstruction,
        **{field: getattr(reconstruction, field)[:count] for field in fields},
    )
    with pytest.raises(InputError, match=message):
        align(few, folder, make())


def test_without_opencv(lying, monkeypatch):
    monkeypatch.setitem(sys.modules, "cv2", None)
    with pytest.raises(SetupError, match=re.escape(install_hint("markers"))):
        align(lying[1], lying[0], Markers(EDGE_M, FAMILY))


def test_a_distance_tells_the_scale(lying):
    folder, reconstruction, poses = lying
    apart = float(np.linalg.norm(poses[0, :3, 3] - poses[5, :3, 3]))
    reconstruction = replace(
        reconstruction, names=("a.HEIC.jpg", *reconstruction.names[1:])
    )
    for first in ("a.HEIC", "a.HEIC.jpg"):  # the photograph, or its copy
        _, scale = align(reconstruction, folder, Distance(first, "5.png", apart))
        assert scale.metres_per_unit == pytest.approx(UNIT_M)
