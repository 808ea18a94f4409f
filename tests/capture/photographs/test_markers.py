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
from mi_nerfattack.io import files
from mi_nerfattack.render.camera.intrinsics import Camera, from_fov, look_at
from mi_nerfattack.system.extras import install_hint

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
    plane = np.stack([right, down, corner], axis=1) @ np.array(
        [
            [metres, 0, (0.5 - CELLS_PX) * metres],
            [0, metres, (0.5 - CELLS_PX) * metres],
            [0, 0, 1],
        ]
    )
    plane[:, 2] -= pose[:3, 3]
    lens = np.array(
        [
            [camera.fx, 0, camera.cx - 0.5],
            [0, camera.fy, camera.cy - 0.5],
            [0, 0, 1],
        ]
    )
    homography = lens @ pose[:3, :3].T @ plane
    size = camera.width, camera.height
    shown = cv2.warpPerspective(pattern, homography, size, flags=cv2.INTER_AREA)
    mask = cv2.warpPerspective(np.full_like(pattern, 255), homography, size)
    image[...] = np.where(mask > 127, shown, image)


def photographs(folder, places, edges=None):
    """Write frames; return a structure in another unit and frame, and true poses."""
    fine, camera = from_fov(1280, 960, 60.0), from_fov(640, 480, 60.0)
    angles = np.linspace(-0.6, 0.6, 6)
    poses = np.stack(
        [
            look_at([1.2 * np.sin(a), -1.0 * np.cos(a), 0.9 + 0.2 * a], [0.1, 0.3, 0.1])
            for a in angles
        ]
    )
    names = tuple(f"{i}.png" for i in range(len(poses)))
    for name, pose in zip(names, poses, strict=True):
        image = np.full((960, 1280), 110, np.uint8)
        for marker, place in places.items():
            draw(image, fine, pose, marker, place, (edges or {}).get(marker, EDGE_M))
        small = cv2.resize(image, (640, 480), interpolation=cv2.INTER_AREA)
        files.write_image(folder / name, np.repeat(small[..., None], 3, axis=2))
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
    found, poses = photographs(tmp_path, {**LYING, **STANDING})
    result, scale = align(found, tmp_path, Markers(EDGE_M, FAMILY))
    assert set(scale.markers) == {3, 7, 9} and min(scale.markers.values()) >= 4
    assert scale.metres_per_unit == pytest.approx(UNIT_M, rel=0.01)
    assert scale.spread < 0.01
    eyes, true = result.camera_to_world[:, :3, 3], poses[:, :3, 3]
    np.testing.assert_allclose(
        np.linalg.norm(eyes - eyes[0], axis=1),
        np.linalg.norm(true - true[0], axis=1),
        atol=0.01,
    )


def test_flat_markers_are_the_ground(lying):
    folder, found, poses = lying
    result, _ = align(found, folder, Markers(EDGE_M, FAMILY, flat=True))
    eyes = result.camera_to_world[:, :3, 3]
    np.testing.assert_allclose(eyes[:, 2], poses[:, 2, 3], atol=0.01)
    np.testing.assert_allclose(eyes[:, :2].mean(0), 0, atol=1e-9)
    up = result.camera_to_world[:, :3, :3].transpose(0, 2, 1) @ [0, 0, 1]
    true = poses[:, :3, :3].transpose(0, 2, 1) @ [0, 0, 1]
    assert np.degrees(np.arccos((up * true).sum(1))).max() < 0.5


def test_wrong_corners_in_one_photograph_count_little(lying, monkeypatch):
    folder, found, _ = lying
    calls = []

    def detect(grey, family):
        calls.append(None)
        off = 30.0 * (len(calls) == 2)
        return {k: c + off for k, c in detect_markers(grey, family).items()}

    monkeypatch.setattr(module, "detect_markers", detect)
    seen = find_markers(folder, found, Markers(EDGE_M, FAMILY))
    assert len(calls) == len(found.names)
    assert seen.scale(EDGE_M)[0] == pytest.approx(UNIT_M, rel=0.01)


def test_an_id_seen_twice_is_left_out(lying):
    image = files.read_image(lying[0] / "2.png")[..., 0]
    assert set(detect_markers(image, FAMILY)) == {3, 7}
    twice = np.concatenate([image, image], axis=1)
    assert detect_markers(twice, FAMILY) == {}


class TestRefused:
    def test_markers_of_two_sizes(self, tmp_path):
        places = {**LYING, **STANDING}
        found, _ = photographs(tmp_path, places, {9: 0.22})
        with pytest.raises(InputError, match=r"edges are 0.16 m, .* \(9: 0.2[12]"):
            align(found, tmp_path, Markers(EDGE_M, FAMILY))

    def test_markers_that_stand_are_not_flat(self, tmp_path):
        found, _ = photographs(tmp_path, {**LYING, **STANDING})
        with pytest.raises(InputError, match="edges off their common plane"):
            align(found, tmp_path, Markers(EDGE_M, FAMILY, flat=True))

    def test_markers_never_seen(self, lying):
        folder, found, _ = lying
        with pytest.raises(InputError, match="0 seen of 4x4_50 in 6 placed .* family"):
            align(found, folder, Markers(EDGE_M, "4x4_50"))

    def test_one_photograph_gives_no_depth(self, lying):
        folder, found, _ = lying
        parts = ("names", "camera_to_world", "cameras")
        one = replace(found, **{part: getattr(found, part)[:1] for part in parts})
        with pytest.raises(InputError, match="2 seen .* none in two from places apart"):
            align(one, folder, Markers(EDGE_M, FAMILY))

    def test_without_opencv(self, lying, monkeypatch):
        monkeypatch.setitem(sys.modules, "cv2", None)
        with pytest.raises(SetupError, match=re.escape(install_hint("markers"))):
            align(lying[1], lying[0], Markers(EDGE_M, FAMILY))

    @pytest.mark.parametrize(
        ("arguments", "message"),
        [((0.0,), "edge_m: 0.0"), ((0.1, "7x8"), "'7x8'; must be one of 4x4_50")],
    )
    def test_options(self, arguments, message):
        with pytest.raises(InputError, match=message):
            Markers(*arguments)

    def test_one_scale(self):
        with pytest.raises(InputError, match="metres_per_unit, markers: .* give one"):
            PoseOptions(metres_per_unit=2.0, markers=Markers(0.1))


class TestDistance:
    def test_tells_the_scale(self, lying):
        folder, found, poses = lying
        apart = float(np.linalg.norm(poses[0, :3, 3] - poses[5, :3, 3]))
        _, scale = align(found, folder, Distance("0.png", "5.png", apart))
        assert scale.metres_per_unit == pytest.approx(UNIT_M)

    def test_between_photographs_that_were_placed(self, lying):
        with pytest.raises(InputError, match="'x.png' is not one of the 6 .*0.png"):
            align(lying[1], lying[0], Distance("0.png", "x.png", 1.0))
        with pytest.raises(InputError, match="0.png and 0.png were taken at one"):
            align(lying[1], lying[0], Distance("0.png", "0.png", 1.0))
        with pytest.raises(InputError, match="distance.metres: -1.0"):
            Distance("0.png", "5.png", -1.0)
