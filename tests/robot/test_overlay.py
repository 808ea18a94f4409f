"""Overlays against rays traced through every pixel by NumPy and OpenCV."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.boxes import flat_images, made_box
from scipy.ndimage import distance_transform_edt
from scipy.spatial.transform import Rotation

from mi_nerfattack.capture.mesh.mesh import CUBE_FACES
from mi_nerfattack.errors import InputError
from mi_nerfattack.render.camera.intrinsics import Camera, look_at
from mi_nerfattack.render.camera.pose import Pose
from mi_nerfattack.robot.attacked import FACES
from mi_nerfattack.robot.overlay import Overlay, green_share

cv2 = pytest.importorskip("cv2")

PINHOLE = Camera(183, 94, 90.0, 86.0, 90.0, 48.0)
LENS = Camera(183, 94, 90.0, 86.0, 90.0, 48.0, -0.28, 0.07, 0.002, -0.003)
POSE = Pose(Rotation.from_euler("zyx", [40, 10, -5], True).as_matrix(), np.ones(3), 0.5)
CHECKS = 4


def checked_box():
    images = {}
    rows, columns = np.indices((256, 256)) // (256 // CHECKS)
    white = (rows + columns) % 2 == 0
    for face in FACES:
        images[face] = np.where(white[..., None], [250] * 3, [10] * 3).astype(np.uint8)
    return made_box(images, pose=POSE)


def traced(box, camera: Camera, matrix: np.ndarray):
    """Return per pixel: hit, whether white, and how far along the ray, metres."""
    columns, rows = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    at = np.stack([columns, rows], -1).reshape(-1, 1, 2) + 0.5
    lens = np.array(
        [[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]], float
    )
    criteria = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 60, 1e-10)
    flat = cv2.undistortPoints(at, lens, np.array(camera.distortion), criteria=criteria)
    ray = np.concatenate([flat[:, 0], np.ones((len(at), 1))], 1)
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    pose = box.pose
    origin = pose.rotation.T @ (matrix[:3, 3] - pose.translation) / pose.scale
    way = ray @ matrix[:3, :3].T @ pose.rotation / pose.scale
    ends = np.stack([(bound - origin) / way for bound in (box.lower, box.upper)])
    near, far = ends.min(0), ends.max(0).min(1)
    axis, t = near.argmax(1), near.max(1)
    hit = (t < far) & (t > 0)
    point = (origin + t[:, None] * way - box.lower) / (box.upper - box.lower)
    white = np.zeros(len(t), bool)
    for normal, right, up in map(np.array, CUBE_FACES.values()):
        side = np.flatnonzero(normal)[0]
        mine = (axis == side) & (way[:, side] * normal[side] < 0)
        local = 2 * point[mine] - 1
        u, v = (1 + local @ right) / 2, (1 - local @ up) / 2
        white[mine] = (np.floor(CHECKS * u) + np.floor(CHECKS * v)) % 2 == 0
    shape = camera.height, camera.width
    return hit.reshape(shape), (white & hit).reshape(shape), t.reshape(shape)


def poses(count: int) -> np.ndarray:
    rng = np.random.default_rng(3)
    middle = POSE.rotation @ [0, 0, 0.25] + POSE.translation
    away = rng.normal(size=(count, 3)) + [0, 0, 0.4]
    away *= rng.uniform(0.9, 4, (count, 1)) / np.linalg.norm(away, axis=1)[:, None]
    aims = middle + rng.normal(0, 0.15, (count, 3))
    pairs = zip(middle + away, aims, strict=True)
    return np.stack([look_at(eye, aim) for eye, aim in pairs])


def farthest(found: np.ndarray, wanted: np.ndarray) -> float:
    """Return how far from the edges of a mask another differs from it, pixels."""
    wrong = found != wanted
    if not wrong.any() or wanted.all() or not wanted.any():
        return float(wrong.any())
    inner, outer = distance_transform_edt(wanted), distance_transform_edt(~wanted)
    return float((np.maximum(inner, outer) - 0.5)[wrong].max())  # pixels' centres


@pytest.mark.parametrize("camera", [PINHOLE, LENS], ids=["pinhole", "lens"])
def test_within_a_pixel_of_traced_rays(camera):
    box = checked_box()
    overlay = Overlay(box, camera, keyed=False)
    shape = camera.height, camera.width, 3
    worst = []
    for matrix in poses(200):
        over = [overlay.apply(np.full(shape, v, np.uint8), matrix) for v in (0, 255)]
        share = 1 - (over[1].astype(int) - over[0])[..., 0] / 255
        hit, white, _ = traced(box, camera, matrix)
        inside = share > 0.99
        bright = (over[0][..., 0] > 140) & inside
        checks = farthest(bright | ~inside, white | ~inside)
        worst.append((farthest(share > 0.5, hit), checks))
    edges, checks = np.array(worst).T
    assert edges.max() <= 1
    assert np.quantile(checks, 0.9) <= 1


def test_what_is_nearer_hides_it():
    box = made_box(pose=POSE)
    matrix = poses(1)[0]
    overlay = Overlay(box, PINHOLE, keyed=False)
    frame = np.full((94, 183, 3), 77, np.uint8)
    hit, _, along = traced(box, PINHOLE, matrix)
    depth = np.full(hit.shape, np.inf, np.float32)
    depth[:, :90] = 0.5 * along[hit].min()
    shown = overlay.apply(frame, matrix, depth)
    whole = overlay.apply(frame, matrix)
    assert (shown[:, :90] == 77).all() and (whole[:, :90] != 77).any()
    np.testing.assert_array_equal(shown[:, 90:], whole[:, 90:])
    # the depth of the box itself does not hide it
    own = np.where(hit, along, np.inf)
    np.testing.assert_array_equal(overlay.apply(frame, matrix, own)[hit], whole[hit])


@pytest.mark.parametrize("exposure", [0.5, 1.0, 1.4])
def test_only_green_is_covered(exposure):
    box = made_box(flat_images(), pose=POSE)
    matrix = poses(1)[0]
    hit, _, _ = traced(box, PINHOLE, matrix)
    frame = np.full((94, 183, 3), (90, 80, 85), np.uint8)
    frame[hit] = (45, 150, 60)
    frame[:, 80:95] = (150, 90, 40)  # somebody before it
    frame = np.clip(frame * exposure, 0, 255).astype(np.uint8)
    result = Overlay(box, PINHOLE).apply(frame, matrix)
    pasted = Overlay(box, PINHOLE, keyed=False).apply(frame, matrix)
    np.testing.assert_array_equal(result[:, 80:95], frame[:, 80:95])
    inner = distance_transform_edt(hit) > 2
    inner[:, 78:97] = False
    assert inner.any()
    np.testing.assert_array_equal(result[inner], pasted[inner])
    assert green_share(frame.astype(np.float32))[inner].min() == 1


def test_not_in_view_and_wrong_size():
    overlay = Overlay(made_box(pose=POSE), PINHOLE, keyed=False)
    frame = np.full((94, 183, 3), 77, np.uint8)
    for eye, aim in (
        ((5, 5, 5), (9, 9, 9)),
        (POSE.translation + [0, 0, 0.2], (9, 9, 9)),
    ):
        shown = overlay.apply(frame, look_at(np.array(eye, float), np.array(aim)))
        np.testing.assert_array_equal(shown, frame)
    with pytest.raises(InputError, match="frame: shape"):
        overlay.apply(frame[:50], np.eye(4))
