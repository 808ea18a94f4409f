"""CARLA's frames, units and depth codes, against vectors worked out by hand."""

from __future__ import annotations

import math
from dataclasses import astuple

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mi_nerfattack.deploy.carla import conventions
from mi_nerfattack.deploy.carla.conventions import CarlaPose
from mi_nerfattack.errors import InputError
from mi_nerfattack.render.camera.intrinsics import (
    Camera,
    CameraMount,
    mount_matrix,
)

FORWARD, LEFT, UP = np.eye(3)
angles = st.floats(-179.0, 179.0)
metres = st.floats(-1000.0, 1000.0)
poses = st.builds(CarlaPose, metres, metres, metres, st.floats(-85, 85), angles, angles)


def axes(pose: CarlaPose) -> np.ndarray:
    """Forward, left and up of an actor in our world, one a row."""
    return conventions.body_from_carla(pose)[:3, :3].T


def test_y_changes_its_sign_and_centimetres_become_metres():
    np.testing.assert_array_equal(
        conventions.point_from_carla([10, 20, 3]), [10, -20, 3]
    )
    np.testing.assert_array_equal(
        conventions.point_from_unreal([1000, 2000, 300]), [10, -20, 3]
    )


@pytest.mark.parametrize(
    ("yaw_deg", "heading"),
    [
        (0, 0),
        (90, -math.pi / 2),
        (-90, math.pi / 2),
        (45, -math.pi / 4),
        (450, -1.5708),
    ],
)
def test_yaw_is_clockwise(yaw_deg, heading):
    assert conventions.heading_from_carla(yaw_deg) == pytest.approx(heading, abs=1e-5)


def test_axes_at_rest_and_turned():
    np.testing.assert_allclose(axes(CarlaPose(0, 0, 0)), np.eye(3), atol=1e-12)
    # yaw 90 looks along CARLA's +y, which is our -y; its left is then our +x
    turned = axes(CarlaPose(0, 0, 0, yaw=90))
    np.testing.assert_allclose(turned, [-LEFT, FORWARD, UP], atol=1e-12)
    # pitch 90 looks up
    nose_up = axes(CarlaPose(0, 0, 0, pitch=90))
    np.testing.assert_allclose(nose_up, [UP, LEFT, -FORWARD], atol=1e-12)
    # roll 90 leans to the right: the left side goes up
    leaning = axes(CarlaPose(0, 0, 0, roll=90))
    np.testing.assert_allclose(leaning, [FORWARD, UP, -LEFT], atol=1e-12)


def test_a_camera_at_yaw_0_looks_along_x():
    matrix = conventions.camera_from_carla(CarlaPose(1, 2, 3))
    right, down, forward = matrix[:3, :3].T
    np.testing.assert_allclose(forward, FORWARD, atol=1e-12)
    np.testing.assert_allclose(right, -LEFT, atol=1e-12)
    np.testing.assert_allclose(down, -UP, atol=1e-12)
    np.testing.assert_allclose(matrix[:3, 3], [1, -2, 3])


def test_a_mounted_camera_is_a_pitched_actor():
    # 1.4 m up, 0.5 m ahead, 6 degrees down, on a car that drives to our left
    matrix = mount_matrix(np.array([[4.0, 7.0, math.pi / 2]]), CameraMount())[0]
    pose = conventions.camera_to_carla(matrix)
    expected = CarlaPose(4.0, -7.5, 1.4, pitch=-6.0, yaw=-90.0, roll=0.0)
    np.testing.assert_allclose(astuple(pose), astuple(expected), rtol=0, atol=1e-9)


@given(poses)
def test_poses_round_trip(pose):
    back = conventions.body_to_carla(conventions.body_from_carla(pose))
    np.testing.assert_allclose(astuple(back), astuple(pose), rtol=0, atol=1e-7)


@given(poses)
def test_poses_are_proper_rotations(pose):
    rotation = conventions.body_from_carla(pose)[:3, :3]
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(rotation) == pytest.approx(1)


@pytest.mark.parametrize("pitch", [90.0, -90.0])
@given(yaw=angles)
def test_straight_up_and_down_keep_their_matrix(pitch, yaw):
    matrix = conventions.body_from_carla(CarlaPose(0, 0, 0, pitch=pitch, yaw=yaw))
    again = conventions.body_from_carla(conventions.body_to_carla(matrix))
    np.testing.assert_allclose(again, matrix, atol=1e-9)


@given(poses)
def test_matrices_are_those_of_the_client_mirrored(carla, pose):
    transform = carla.Transform(
        carla.Location(pose.x, pose.y, pose.z),
        carla.Rotation(pitch=pose.pitch, yaw=pose.yaw, roll=pose.roll),
    )
    mirror = np.diag([1.0, -1.0, 1.0, 1.0])
    expected = mirror @ np.array(transform.get_matrix()) @ mirror
    # the client computes in 32 bits: 1000 m to 0.1 mm, angles to 1e-5
    found = conventions.body_from_carla(pose)
    np.testing.assert_allclose(found, expected, rtol=0, atol=2e-4)
    np.testing.assert_allclose(found[:3, :3], expected[:3, :3], rtol=0, atol=2e-5)


@pytest.mark.parametrize(
    ("rgb", "distance"),
    [
        ((0, 0, 0), 0.0),
        ((254, 255, 255), 1000 * 16777214 / 16777215),
        ((0, 0, 128), 1000 * 8388608 / 16777215),  # 500.00003 m
        ((0, 1, 0), 1000 * 256 / 16777215),  # 1.526 cm
        ((1, 0, 0), 1000 / 16777215),  # 0.06 mm
        ((255, 255, 255), math.inf),  # the far plane
    ],
)
def test_depth_codes(rgb, distance):
    pixel = np.array([[[*rgb[::-1], 255]]], np.uint8)
    assert conventions.decode_depth(pixel)[0, 0] == pytest.approx(distance, rel=1e-12)


@pytest.mark.parametrize(
    ("camera", "message"),
    [
        (Camera(8, 6, 5, 5, 4, 3, k1=0.01), "distortion"),
        (Camera(8, 6, 5, 6, 4, 3), "not square, fx 5, fy 6"),
        (Camera(8, 6, 5, 5, 4.5, 3), "principal point 0.5, 0 px off"),
    ],
)
def test_cameras_that_carla_has_not_are_refused(camera, message):
    with pytest.raises(InputError, match=message):
        conventions.field_of_view_deg(camera)
