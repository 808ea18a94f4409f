"""Conversions between Mitsuba, OpenGL and COLMAP against independent references."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mi_nerfattack.errors import InputError
from mi_nerfattack.render.camera import conventions as conv
from mi_nerfattack.render.camera.intrinsics import Camera, look_at

pytestmark = pytest.mark.usefixtures("variant")

LENS = Camera(64, 48, 50.0, 55.0, 30.0, 25.0, -0.1, 0.02, 1e-3, -2e-3)


def turn(axis: np.ndarray, angle: float) -> np.ndarray:
    """Rotate about a unit axis (Rodrigues)."""
    x, y, z = axis
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross


def pose(rotation: np.ndarray, place: np.ndarray) -> np.ndarray:
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = rotation, place
    return matrix


# Frames


def test_conversions_undo_each_other(rng):
    rotations = [turn(a / np.linalg.norm(a), 2.0) for a in rng.normal(size=(5, 3))]
    poses = np.stack([pose(r, rng.normal(size=3)) for r in rotations])
    there_and_back = [
        (conv.opengl_to_opencv, conv.opencv_to_opengl),
        (conv.opencv_to_mitsuba, conv.mitsuba_to_opencv),
    ]
    for there, back in there_and_back:
        np.testing.assert_array_equal(back(there(poses)), poses)
        assert np.all(np.linalg.det(there(poses)[:, :3, :3]) > 0)


def test_blender_camera_by_hand():
    # Blender's new camera looks down with the image's top to +y, whatever it is fed to.
    matrix = conv.opengl_to_opencv(pose(np.eye(3), np.array([0, 0, 5.0])))
    np.testing.assert_array_equal(matrix, look_at([0, 0, 5], [0, 0, 0]))


def test_mitsubas_lookat_is_ours():
    eye, target = [3.0, -1.0, 2.0], [0.5, 0.2, 0.1]
    theirs = mi.ScalarTransform4f().look_at(eye, target, [0, 0, 1])
    ours = conv.opencv_to_mitsuba(look_at(eye, target))
    np.testing.assert_allclose(np.array(theirs.matrix), ours, atol=1e-6)


# COLMAP


@settings(max_examples=50)
@given(
    axis=st.tuples(*[st.floats(-1, 1)] * 3).filter(lambda v: np.linalg.norm(v) > 0.1),
    angle=st.floats(-3.1, 3.1),
    place=st.tuples(*[st.floats(-100, 100)] * 3),
)
def test_colmap_pose_of_any_rotation(axis, angle, place):
    axis = np.array(axis) / np.linalg.norm(axis)
    matrix = pose(turn(axis, angle), np.array(place))
    # world to camera is the opposite turn
    quaternion = np.array([np.cos(angle / 2), *(-np.sin(angle / 2) * axis)])
    for scale in (3, 1e-200, 1e200):
        back = conv.colmap_to_opencv(scale * quaternion, -turn(axis, -angle) @ place)
        np.testing.assert_allclose(back, matrix, atol=1e-9)


def test_colmap_poses_keep_their_shape(rng):
    quaternion, translation = rng.normal(size=(2, 3, 4)), rng.normal(size=(2, 3, 3))
    matrix = conv.colmap_to_opencv(quaternion, translation)
    assert matrix.shape == (2, 3, 4, 4)
    one = conv.colmap_to_opencv(quaternion[1, 2], translation[1, 2])
    np.testing.assert_array_equal(matrix[1, 2], one)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: conv.colmap_to_opencv([0, 0, 0, 0], [0, 0, 0]), "quaternion"),
        (lambda: conv.colmap_to_opencv([np.nan, 0, 0, 1], [0, 0, 0]), "quaternion"),
        (lambda: conv.colmap_to_opencv([1, 0, 0, 0], [np.inf, 0, 0]), "translation"),
        (lambda: conv.colmap_to_opencv([1, 0, 0, 0], [1e39, 0, 0]), "translation"),
        (lambda: conv.from_colmap("FISHEYE", 4, 4, [1.0]), "allowed: SIMPLE_PINHOLE"),
        (lambda: conv.from_colmap("PINHOLE", 4, 4, [4, 2, 2]), r"expected 4 \(fx, fy"),
        (lambda: conv.from_colmap("SIMPLE_PINHOLE", 4, 4, [-4, 2, 2]), "camera.fx"),
    ],
)
def test_what_cannot_be_converted(call, message):
    with pytest.raises(InputError, match=message):
        call()


MODELS = [
    ("SIMPLE_PINHOLE", [50.0, 30, 25], Camera(64, 48, 50, 50, 30, 25)),
    ("PINHOLE", [50.0, 55, 30, 25], Camera(64, 48, 50, 55, 30, 25)),
    ("SIMPLE_RADIAL", [50.0, 30, 25, -0.1], Camera(64, 48, 50, 50, 30, 25, -0.1)),
    ("RADIAL", [50.0, 30, 25, -0.1, 0.02], Camera(64, 48, 50, 50, 30, 25, -0.1, 0.02)),
    ("OPENCV", [50.0, 55, 30, 25, -0.1, 0.02, 1e-3, -2e-3], LENS),
]


@pytest.mark.parametrize(("model", "parameters", "camera"), MODELS)
def test_colmap_models(model, parameters, camera):
    assert conv.from_colmap(model, 64, 48, parameters) == camera


# Mitsuba


@pytest.mark.parametrize(
    ("camera", "kind"),
    [
        (Camera(64, 48, 50.0, 50.0, 30.0, 25.0), "perspective"),
        (Camera(64, 48, 50.0, 55.0, 30.0, 25.0), "opencv_camera"),
        (Camera(64, 48, 50.0, 50.0, 32.0, 24.0, p2=1e-3), "opencv_camera"),
    ],
)
def test_mitsuba_sensor_and_back(camera, kind):
    to_world = look_at([3, -1, 2], [0.5, 0.2, 0.1])
    film = {"crop_width": 8, "crop_height": 4, "crop_offset_x": 9}
    description = conv.mitsuba_sensor_dict(camera, to_world, 1, film)
    assert description["type"] == kind
    back, pose_back = conv.from_mitsuba(mi.load_dict(description, parallel=False))
    np.testing.assert_allclose(pose_back, to_world, atol=1e-6)
    for name in ("width", "height", "fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2"):
        assert getattr(back, name) == pytest.approx(getattr(camera, name), rel=1e-6)


def test_other_sensors_are_refused():
    with pytest.raises(InputError, match="only perspective, thinlens"):
        conv.from_mitsuba(mi.load_dict({"type": "orthographic"}))
