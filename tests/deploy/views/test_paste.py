"""Pasting by depth against the geometry of a box of known density and colour."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.kernels import nothing_compiled
from helpers.small_fields import homogeneous, sigmoid_to_linear

from mi_nerfattack.deploy import CameraFrame
from mi_nerfattack.deploy.views.paste import Paster
from mi_nerfattack.errors import InputError
from mi_nerfattack.render.camera.intrinsics import from_fov, look_at
from mi_nerfattack.render.camera.pose import Pose
from mi_nerfattack.render.posed import PosedField

pytestmark = pytest.mark.usefixtures("variant")

CAMERA = from_fov(16, 12, 60.0)
GREY = 90


def directions() -> np.ndarray:
    """Return unit vectors (12, 16, 3) through the pixels, in the camera's frame."""
    x = (np.arange(16) + 0.5 - CAMERA.cx) / CAMERA.fx
    y = (np.arange(12) + 0.5 - CAMERA.cy) / CAMERA.fy
    rays = np.stack([*np.meshgrid(x, y), np.ones((12, 16))], axis=-1)
    return rays / np.linalg.norm(rays, axis=-1, keepdims=True)


def box_interval(pose: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return where rays (12, 16) enter and leave the box [-1, 1]^3, metres."""
    towards = directions() @ pose[:3, :3].T
    with np.errstate(divide="ignore"):
        a, b = ((side - pose[:3, 3]) / towards for side in (-1.0, 1.0))
    near, far = np.minimum(a, b).max(-1), np.maximum(a, b).min(-1)
    return near, far


def frame_at(pose: np.ndarray, depth: float) -> CameraFrame:
    image = np.full((12, 16, 3), GREY, np.uint8)
    return CameraFrame(image, np.full((12, 16), depth, np.float32), pose)


def paste_objects(frame: CameraFrame, camera, objects) -> CameraFrame:
    return Paster(camera, objects).paste(frame)


def rolled(pose: np.ndarray, angle: float) -> np.ndarray:
    turn = np.eye(4)
    c, s = np.cos(angle), np.sin(angle)
    turn[:2, :2] = [[c, -s], [s, c]]
    return pose @ turn


@pytest.mark.parametrize("wall", [np.inf, 9.0])
@pytest.mark.parametrize("angle", [0.0, 0.7])
def test_near_box_covers_what_lies_behind(wall, angle):
    density, raw = 30.0, 0.4
    pose = rolled(look_at((-4.0, 0.7, 0.3), (0.0, 0.2, 0.0)), angle)
    objects = [PosedField(homogeneous(density, raw))]
    frame = frame_at(pose, wall)
    found = paste_objects(frame, CAMERA, objects)
    near, far = box_interval(pose)
    inside, outside = far - near > 0.2, far - near < 0
    assert inside.sum() > 20 and outside.sum() > 20
    linear = sigmoid_to_linear(np.array(raw))
    level = 255 * (1.055 * linear ** (1 / 2.4) - 0.055)
    assert abs(found.image[inside].astype(float) - level).max() <= 1.0
    assert (found.image[outside] == GREY).all()
    assert (found.depth[outside] == np.float32(wall)).all()
    length, passed = far - near, np.exp(-density * (far - near))
    expected = near + 1 / density - length * passed / (1 - passed)
    assert abs(found.depth - expected)[inside].max() < 2e-3
    assert found.depth.dtype == np.float32 and found.image.dtype == np.uint8
    assert (frame.image == GREY).all()


def test_wall_in_front_hides_the_box():
    pose = look_at((-4.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    frame = frame_at(pose, 2.0)
    found = paste_objects(frame, CAMERA, [PosedField(homogeneous(30.0))])
    assert (found.image == frame.image).all()
    assert (found.depth == frame.depth).all()


@pytest.mark.parametrize(("length", "is_pasted"), [(0.6, False), (0.8, True)])
def test_half_opacity_decides(length, is_pasted):
    # 1 - exp(-x) passes one half at x = 0.69; along the axis the box is 2 m thick
    pose = look_at((-4.0, 1e-3, 1e-3), (0.0, 1e-3, 1e-3))
    frame = frame_at(pose, np.inf)
    found = paste_objects(frame, CAMERA, [PosedField(homogeneous(length / 2))])
    assert np.isfinite(found.depth[5:7, 7:9]).all() == is_pasted


def test_object_behind_the_camera_is_not_seen():
    pose = look_at((4.0, 0.0, 0.0), (8.0, 0.0, 0.0))
    found = paste_objects(frame_at(pose, np.inf), CAMERA, [PosedField(homogeneous())])
    assert np.isinf(found.depth).all()


def test_nearer_of_two_objects_is_on_top():
    pose = look_at((-8.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    front = Pose.upright((-3.0, 0.0, 0.0), 0.0, 0.5)
    objects = [PosedField(homogeneous(60, 3.0)), PosedField(homogeneous(60, -3), front)]
    found = paste_objects(frame_at(pose, np.inf), CAMERA, objects)
    assert found.image[6, 8].max() < 100
    assert found.depth[6, 8] == pytest.approx(4.5, abs=0.05)


@pytest.mark.parametrize("order", [1, -1])
def test_wall_between_two_objects_shows_no_outline_of_the_nearer(order):
    # near: thin, so that half of a ray passes it; far: behind the wall
    pose = look_at((-8.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    near = PosedField(homogeneous(0.25, 3.0), Pose.upright((-4.0, 0.0, 0.0), 0.0, 0.5))
    far = PosedField(homogeneous(60, -3.0), Pose.upright((2.0, 0.0, 0.0), 0.0, 2.0))
    frame = frame_at(pose, 7.0)
    for item in (near, far):
        assert (paste_objects(frame, CAMERA, [item]).image == GREY).all()
    found = paste_objects(frame, CAMERA, [near, far][::order])
    assert (found.image == GREY).all() and (found.depth == 7.0).all()


def test_wall_between_two_objects_hides_the_farther_alone():
    pose = look_at((-8.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    near = PosedField(homogeneous(2.0, 3.0), Pose.upright((-4.0, 0.0, 0.0), 0.0, 0.5))
    far = PosedField(homogeneous(60, -3.0), Pose.upright((2.0, 0.0, 0.0), 0.0, 2.0))
    frame = frame_at(pose, 7.0)
    alone = paste_objects(frame, CAMERA, [near])
    assert (alone.depth < 7).sum() > 3
    found = paste_objects(frame, CAMERA, [far, near])
    assert (found.image == alone.image).all() and (found.depth == alone.depth).all()
    layers = found.layers(["far", "near"])
    assert not layers["far"].any() and np.isinf(layers["far.Z"]).all()
    assert layers["near"][..., 3].sum() == (alone.depth < 7).sum()
    total = sum(layers[name] for name in ("scene", "far", "near"))
    assert (total == layers[""]).all()
    nearest = np.minimum(layers["scene.Z"], layers["near.Z"])
    assert (nearest == layers["Z"]).all()


def test_no_kernel_is_compiled_after_the_first_frame():
    posed = PosedField(homogeneous(30.0))
    paster = Paster(CAMERA, [posed])
    first = paster.paste(frame_at(look_at((-4, 0, 0), (0, 0, 0)), np.inf))
    with nothing_compiled():
        texture = posed.field.texture.numpy() - 1.0
        posed.field.set_parameter("texture", texture)
        posed.move(np.array([0.3, 0.1, 0.0, 0, 0, 0]))
        second = paster.paste(frame_at(look_at((-5, 1, 0.5), (0, 0, 0)), np.inf))
    assert second.image[6, 8].max() < first.image[6, 8].min() - 20


def test_cameras_too_far_for_single_precision_are_refused():
    pose = look_at((5e5, 5.4e6, 0.0), (5e5 + 1, 5.4e6, 0.0))
    paste_objects(frame_at(pose, np.inf), CAMERA, [])
    with pytest.raises(InputError, match=r"camera at \[500000.0, 5400000.0, 0.0\] m:"):
        paste_objects(frame_at(pose, np.inf), CAMERA, [PosedField(homogeneous())])


def test_bad_input():
    pose = look_at((-4.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    frame = frame_at(pose, np.inf)
    with pytest.raises(InputError, match="frame: image .12, 16, 3.*6 x 8 pixels"):
        paste_objects(frame, from_fov(8, 6, 60.0), [PosedField(homogeneous())])
    with pytest.raises(InputError, match="objects: GridField; only posed fields"):
        paste_objects(frame, CAMERA, [homogeneous()])
    assert paste_objects(frame, CAMERA, []) is frame
