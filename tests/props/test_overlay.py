"""Overlays against rays traced through every pixel by NumPy and OpenCV.

A render's pixel gathers 64 rays. Where between 40 and 60 % of them find white, as where
several boundaries cross one pixel, the render itself does not tell on which side of a
boundary the pixel is; all other pixels are checked, in every pose.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import binary_dilation, distance_transform_edt
from scipy.spatial.transform import Rotation
from support.worlds.attacks import flat_images, made_box

from mi_nerfattack.backend.colour import srgb_to_linear_numpy
from mi_nerfattack.capture.mesh.mesh import CUBE_FACES
from mi_nerfattack.errors import InputError
from mi_nerfattack.props.attacked import FACES, AttackedBox, box_pictures
from mi_nerfattack.props.overlay import Overlay, green_share
from mi_nerfattack.render.camera.intrinsics import Camera, look_at
from mi_nerfattack.render.camera.pose import Pose

cv2 = pytest.importorskip("cv2")

PINHOLE = Camera(183, 94, 90.0, 86.0, 90.0, 48.0)
LENS = Camera(183, 94, 90.0, 86.0, 90.0, 48.0, -0.28, 0.07, 0.002, -0.003)
POSE = Pose(Rotation.from_euler("zyx", [40, 10, -5], True).as_matrix(), np.ones(3), 0.5)
CHECKS = 4
FINE = 8  # rays a pixel, each way
BLACK, WHITE = 10, 250


def checked_box():
    images = {}
    rows, columns = np.indices((256, 256)) // (256 // CHECKS)
    white = (rows + columns) % 2 == 0
    for face in FACES:
        images[face] = np.where(white[..., None], [WHITE] * 3, [BLACK] * 3).astype(
            np.uint8
        )
    return made_box(images, pose=POSE)


def pixel_rays(camera: Camera, fine: int = 1) -> np.ndarray:
    """Return fine x fine unit rays of each pixel, (height, width, fine², 3)."""
    columns, rows = (np.arange(n * fine) + 0.5 for n in (camera.width, camera.height))
    at = np.stack(np.meshgrid(columns, rows), -1).reshape(-1, 1, 2) / fine
    lens = np.array(
        [[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]], float
    )
    criteria = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 60, 1e-10)
    flat = cv2.undistortPoints(at, lens, np.array(camera.distortion), criteria=criteria)
    ray = np.concatenate([flat[:, 0], np.ones((len(at), 1))], 1)
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    ray = ray.reshape(camera.height, fine, camera.width, fine, 3).swapaxes(1, 2)
    return ray.reshape(camera.height, camera.width, fine * fine, 3)


def traced(box, ray: np.ndarray, matrix: np.ndarray):
    """Return per ray (..., 3): hit, whether white, and how far along, metres."""
    shape, pose = ray.shape[:-1], box.pose
    origin = pose.rotation.T @ (matrix[:3, 3] - pose.translation) / pose.scale
    way = pose.rotation.T @ matrix[:3, :3] @ ray.reshape(-1, 3).T / pose.scale
    origin, lower, upper = (v[:, None] for v in (origin, box.lower, box.upper))
    ends = (lower - origin) / way, (upper - origin) / way
    near, far = np.minimum(*ends), np.maximum(*ends).min(0)
    axis, t = near.argmax(0), near.max(0)
    hit = (t < far) & (t > 0)
    local = 2 * (origin + t * way - lower) / (upper - lower) - 1
    white = np.zeros(len(t), bool)
    for normal, right, up in map(np.array, CUBE_FACES.values()):
        side = np.flatnonzero(normal)[0]
        mine = (axis == side) & (way[side] * normal[side] < 0)
        u, v = (1 + right @ local[:, mine]) / 2, (1 - up @ local[:, mine]) / 2
        white[mine] = (np.floor(CHECKS * u) + np.floor(CHECKS * v)) % 2 == 0
    return hit.reshape(shape), (white & hit).reshape(shape), t.reshape(shape)


def poses(count: int) -> np.ndarray:
    rng = np.random.default_rng(3)
    middle = POSE.rotation @ [0, 0, 0.25] + POSE.translation
    away = rng.normal(size=(count, 3)) + [0, 0, 0.4]
    away *= rng.uniform(0.9, 4, (count, 1)) / np.linalg.norm(away, axis=1)[:, None]
    aims = middle + rng.normal(0, 0.15, (count, 3))
    pairs = zip(middle + away, aims, strict=True)
    return np.stack([look_at(eye, aim) for eye, aim in pairs])


def farthest(actual: np.ndarray, expected: np.ndarray, valid=True) -> float:
    """Return how far from the edges of a mask another differs from it, pixels."""
    wrong = (actual != expected) & valid
    if not wrong.any() or expected.all() or not expected.any():
        return float(wrong.any())
    inner, outer = distance_transform_edt(expected), distance_transform_edt(~expected)
    return float((np.maximum(inner, outer) - 0.5)[wrong].max())  # pixels' centres


@pytest.mark.parametrize("camera", [PINHOLE, LENS], ids=["pinhole", "lens"])
def test_within_a_pixel_of_a_render(camera):
    box = checked_box()
    overlay = Overlay(box, camera, keyed=False)
    shape = camera.height, camera.width
    coarse, rays = pixel_rays(camera)[:, :, 0], pixel_rays(camera, FINE)
    light = srgb_to_linear_numpy(np.arange(256) / 255)
    middle = (light[BLACK] + light[WHITE]) / 2
    worst = []
    for matrix in poses(50):
        on_black, on_white = (
            light[overlay.apply(np.full((*shape, 3), v, np.uint8), matrix)[..., 0]]
            for v in (0, 255)
        )
        share = 1 - (on_white - on_black)
        near = binary_dilation(traced(box, coarse, matrix)[0], iterations=2)
        hit, white = np.zeros(shape), np.zeros(shape)
        for mask, samples in zip(
            (hit, white), traced(box, rays[near], matrix), strict=False
        ):
            mask[near] = samples.mean(1)
        inside = (share > 0.99) & (hit == 1)
        valid = inside & (np.abs(white - 0.5) > 0.1)
        checks = farthest((on_black > middle) | ~inside, (white > 0.5) | ~inside, valid)
        worst.append((farthest(share > 0.5, hit > 0.5), checks, valid.sum()))
    edges, checks, pixels = np.array(worst).T
    assert edges.max() <= 1
    assert checks.max() <= 1
    assert pixels.sum() > 3e4


def test_a_flat_object_shows_one_face():
    box = checked_box()
    flat = replace(box, sheet="front")
    frame = np.full((LENS.height, LENS.width, 3), 128, np.uint8)
    counts = []
    for matrix in poses(12):
        one, other = (
            (Overlay(b, LENS, keyed=False).apply(frame, matrix) != 128).any(-1)
            for b in (flat, box)
        )
        assert not (one & ~other).any()
        corner, across, down = box.plane("front")
        is_seen = (matrix[:3, 3] - corner) @ np.cross(down, across) > 0
        assert one.any() == (is_seen and other.any())
        counts.append((int(one.sum()), int(other.sum())))
    assert 0 < sum(few for few, _ in counts) < sum(many for _, many in counts)


@pytest.mark.slow
@pytest.mark.usefixtures("variant")
def test_within_a_pixel_of_the_field():
    """The bundled cube's pictures against its field, marched along 9 rays a pixel.

    The field's surface ends up to a voxel beside the box's, which is 1 px from 0.7 m.
    """
    from mi_nerfattack.fields.io import load_grid
    from mi_nerfattack.render.camera.lens import generate_rays, pose_arrays
    from mi_nerfattack.render.march import march
    from mi_nerfattack.render.posed import PosedField
    from mi_nerfattack.render.rays import Rays
    from mi_nerfattack.scenes import bundled

    field = load_grid(bundled("cube/field.safetensors"))
    lower, upper, images = box_pictures(field)
    box = AttackedBox("cube", "", "", lower, upper, POSE, images)
    overlay, posed = Overlay(box, LENS, keyed=False), PosedField(field, POSE)
    shape, fine = (LENS.height, LENS.width), 3
    camera = LENS.resized(fine * LENS.width, fine * LENS.height)
    light = srgb_to_linear_numpy(np.arange(256) / 255)

    def gathered(values: np.ndarray) -> np.ndarray:
        return values.reshape(shape[0], fine, shape[1], fine, -1).mean((1, 3))

    voxel = POSE.scale * float((field.upper - field.lower).max()) / 64
    edges, colours, voxels_px = [], [], []
    for matrix in poses(50):
        rays = Rays(*generate_rays(camera, *pose_arrays(matrix[None]), 1))
        integrals = march(posed, rays)
        opacity = gathered(integrals.opacity.numpy())[..., 0]
        radiance = gathered(integrals.radiance.numpy().T)
        on_black, on_white = (
            light[overlay.apply(np.full((*shape, 3), v, np.uint8), matrix)]
            for v in (0, 255)
        )
        share = 1 - (on_white - on_black)[..., 0]
        edges.append(farthest(share > 0.5, opacity > 0.5))
        inside = (share > 0.99) & (opacity > 0.99)
        colours.append(np.abs(on_black - radiance)[inside].mean())
        distance = traced(box, pixel_rays(LENS)[:, :, 0], matrix)[2][
            opacity > 0.5
        ].min()
        voxels_px.append(voxel * LENS.fx / distance)
    assert np.quantile(edges, 0.95) <= 1
    assert (np.array(edges) - voxels_px).max() <= 1
    assert np.mean(colours) < 0.01


def test_what_is_nearer_hides_it():
    box = made_box(pose=POSE)
    matrix = poses(1)[0]
    overlay = Overlay(box, PINHOLE, keyed=False)
    frame = np.full((94, 183, 3), 77, np.uint8)
    hit, _, along = traced(box, pixel_rays(PINHOLE)[:, :, 0], matrix)
    depth = np.full(hit.shape, np.inf, np.float32)
    depth[:, :90] = 0.5 * along[hit].min()
    shown = overlay.apply(frame, matrix, depth)
    unhidden = overlay.apply(frame, matrix)
    assert (shown[:, :90] == 77).all() and (unhidden[:, :90] != 77).any()
    np.testing.assert_array_equal(shown[:, 90:], unhidden[:, 90:])
    # the depth of the box itself does not hide it
    own = np.where(hit, along, np.inf)
    np.testing.assert_array_equal(overlay.apply(frame, matrix, own)[hit], unhidden[hit])
    # behind the camera, or with the camera in the box, there is nothing
    for eye in ((5.0, 5, 5), POSE.translation + [0, 0, 0.2]):
        shown = overlay.apply(frame, look_at(np.array(eye), np.array([9.0, 9, 9])))
        np.testing.assert_array_equal(shown, frame)
    with pytest.raises(InputError, match="frame: shape"):
        overlay.apply(frame[:50], np.eye(4))


@pytest.mark.parametrize("exposure", [0.5, 1.0, 1.4])
def test_only_green_is_covered(exposure):
    box = made_box(flat_images(), pose=POSE)
    matrix = poses(1)[0]
    hit, _, _ = traced(box, pixel_rays(PINHOLE)[:, :, 0], matrix)
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
