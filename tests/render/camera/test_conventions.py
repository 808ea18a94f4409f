"""Conversions between Mitsuba, OpenGL and COLMAP against independent references."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import expm, polar
from scipy.spatial.transform import Rotation
from support.worlds.cameras import NARROW

from mi_nerfattack.errors import InputError
from mi_nerfattack.render.camera import conventions as conv
from mi_nerfattack.render.camera.intrinsics import Camera, look_at
from mi_nerfattack.render.camera.pose import (
    Pose,
    check_rigid,
    nearest_rigid,
    poses_at,
)

pytestmark = pytest.mark.usefixtures("variant")


# Frames


def test_conversions_undo_each_other(rng):
    poses = moving(rng.normal(size=5))
    there_and_back = [
        (conv.opengl_to_opencv, conv.opencv_to_opengl),
        (conv.opencv_to_mitsuba, conv.mitsuba_to_opencv),
    ]
    for there, back in there_and_back:
        np.testing.assert_array_equal(back(there(poses)), poses)
        assert np.all(np.linalg.det(there(poses)[:, :3, :3]) > 0)


def test_blender_camera_by_hand():
    # Blender's new camera looks down with the image's top to +y, whatever it is fed to.
    matrix = np.eye(4)
    matrix[2, 3] = 5
    there = conv.opengl_to_opencv(matrix)
    np.testing.assert_array_equal(there, look_at([0, 0, 5], [0, 0, 0]))


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
    x, y, z = axis = np.array(axis) / np.linalg.norm(axis)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = expm(angle * cross), place
    # world to camera is the opposite turn
    quaternion = np.array([np.cos(angle / 2), *(-np.sin(angle / 2) * axis)])
    translation = -expm(-angle * cross) @ place
    scales = np.array([[3], [1e-200], [1e200]])
    back = conv.colmap_to_opencv(scales * quaternion, [translation] * 3)
    np.testing.assert_allclose(back, [matrix] * 3, atol=1e-9)


@pytest.mark.parametrize(
    ("call", "where"),
    [
        (lambda: conv.colmap_to_opencv([0, 0, 0, 0], [0, 0, 0]), "quaternion"),
        (lambda: conv.colmap_to_opencv([np.nan, 0, 0, 1], [0, 0, 0]), "quaternion"),
        (lambda: conv.colmap_to_opencv([1, 0, 0, 0], [1e39, 0, 0]), "translation"),
        (lambda: conv.from_colmap("FISHEYE", 4, 4, [1.0]), "camera model"),
        (lambda: conv.from_colmap("PINHOLE", 4, 4, [4, 2, 2]), "camera model PINHOLE"),
        (lambda: conv.from_colmap("SIMPLE_PINHOLE", 4, 4, [-4, 2, 2]), "camera.fx"),
        (lambda: conv.from_mitsuba(mi.load_dict({"type": "orthographic"})), "sensor"),
        (lambda: check_rigid(np.full((4, 4), np.nan), "a.json"), "a.json"),
        (lambda: check_rigid(np.diag([2.0, 1, 1, 1]), "a.json"), "a.json"),
        (lambda: check_rigid(np.diag([1.0, 1, -1, 1]), "a.json"), "a.json"),
        (lambda: check_rigid(np.diag([1.0, 1, 1, 2]), "a.json"), "a.json"),
    ],
)
def test_what_cannot_be_converted(call, where):
    with pytest.raises(InputError) as caught:
        call()
    assert caught.value.where.startswith(where)


MODELS = {
    "SIMPLE_PINHOLE": ([50.0, 30, 25], Camera(64, 48, 50, 50, 30, 25)),
    "PINHOLE": ([50.0, 55, 30, 25], Camera(64, 48, 50, 55, 30, 25)),
    "SIMPLE_RADIAL": ([50.0, 30, 25, -0.1], Camera(64, 48, 50, 50, 30, 25, -0.1)),
    "RADIAL": ([50.0, 30, 25, -0.1, 0.02], Camera(64, 48, 50, 50, 30, 25, -0.1, 0.02)),
    "OPENCV": (
        [50.0, 55, 30, 25, -0.1, 0.02, 1e-3, -2e-3],
        Camera(64, 48, 50.0, 55.0, 30.0, 25.0, -0.1, 0.02, 1e-3, -2e-3),
    ),
    "OPENCV_FISHEYE": ([30.0, 32, 31, 25, -0.03, 0.012, -0.004, 0.0006], NARROW),
}


@pytest.mark.parametrize("model", MODELS)
def test_colmap_models(model):
    parameters, camera = MODELS[model]
    assert conv.from_colmap(model, 64, 48, parameters) == camera


# Mitsuba


@pytest.mark.parametrize(
    ("camera", "kind"),
    [
        (Camera(64, 48, 50.0, 50.0, 30.0, 25.0), "perspective"),
        (Camera(64, 48, 50.0, 55.0, 30.0, 25.0), "opencv_camera"),
        (NARROW, "opencv_camera"),
    ],
)
def test_mitsuba_sensor_and_back(camera, kind):
    to_world = look_at([3, -1, 2], [0.5, 0.2, 0.1])
    film = {"crop_width": 8, "crop_height": 4, "crop_offset_x": 9}
    description = conv.mitsuba_sensor_dict(camera, to_world, 1, film)
    assert description["type"] == kind
    back, pose_back = conv.from_mitsuba(mi.load_dict(description, parallel=False))
    np.testing.assert_allclose(pose_back, to_world, atol=1e-6)
    assert vars(back) == pytest.approx(vars(camera), rel=1e-6)


# Poses by themselves


def test_a_pose_scales_then_turns_then_moves():
    pose = Pose.upright((5.0, 6, 7), np.pi / 2, 2.0)
    points = np.array([[1.0, 0, 0], [0, 1, 3]])
    np.testing.assert_allclose(pose.apply(points), [[5, 8, 7], [3, 6, 13]], atol=1e-12)
    np.testing.assert_allclose(pose.to_local(pose.apply(points)), points, atol=1e-12)


def test_a_rounded_pose_becomes_the_nearest_rigid_one():
    rounded = moving(np.array([0.7]))[0].round(3)
    pose = nearest_rigid(rounded, "a.json")
    np.testing.assert_allclose(pose[:3, :3], polar(rounded[:3, :3])[0], atol=1e-12)
    np.testing.assert_array_equal(pose[:, 3], rounded[:, 3])
    np.testing.assert_array_equal(pose[3], [0, 0, 0, 1])


# Poses between tracked ones, against a motion whose formula is known

AXIS, VELOCITY = np.array([0.3, -0.5, 0.9]), np.array([1.0, -2.0, 0.5])


def moving(times: np.ndarray) -> np.ndarray:
    """Poses of a body with constant velocity and rate, (n, 4, 4)."""
    poses = np.tile(np.eye(4), (len(times), 1, 1))
    start = Rotation.from_rotvec([0.2, 0.1, -0.4])
    poses[:, :3, :3] = (start * Rotation.from_rotvec(times[:, None] * AXIS)).as_matrix()
    poses[:, :3, 3] = times[:, None] * VELOCITY
    return poses


def test_a_steady_motion_is_exact_up_to_half_an_interval_beyond_the_ends():
    known = 1.77e9 + np.array([0.0, 0.04, 0.2, 0.24])
    times = np.array([-0.02, 0.0, 0.01, 0.13, 0.24, 0.26])
    poses, is_known = poses_at(known, moving(known - 1.77e9), 1.77e9 + times)
    assert is_known.all()
    np.testing.assert_allclose(poses, moving(times), atol=1e-5)


def test_what_is_not_known():
    known = np.array([0.0, 0.1, 0.2, 0.6])
    times = np.array([-0.06, -0.04, 0.31, 0.4, 0.49, 0.5, 0.64, 0.66, 9.0])
    poses, is_known = poses_at(known, moving(known), times)
    assert is_known.tolist() == [0, 1, 0, 0, 0, 1, 1, 0, 0]
    # from there on the body stays, 0.05 s beyond the last pose
    np.testing.assert_allclose(poses[-1], moving(np.array([0.65]))[0], atol=1e-12)
    # and so does it near a single pose
    times = np.array([1.01, 1.2])
    poses, is_known = poses_at(np.ones(1), moving(np.ones(1)), times)
    assert is_known.tolist() == [True, False]
    np.testing.assert_allclose(poses[0], moving(np.ones(1))[0], atol=1e-12)
