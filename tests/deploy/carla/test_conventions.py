"""CARLA's frames, units and depth codes, against vectors worked out by hand."""

from __future__ import annotations

import math
from dataclasses import astuple

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.faults.refusals import refusals

from mi_nerfattack.deploy.carla import conventions
from mi_nerfattack.deploy.carla.conventions import CarlaPose
from mi_nerfattack.render.camera.intrinsics import Camera, CameraMount, mount_matrix

FORWARD, LEFT, UP = np.eye(3)
angles = st.floats(-179.0, 179.0)
metres = st.floats(-1000.0, 1000.0)
pitches = st.floats(-85, 85) | st.sampled_from([90.0, -90.0])
poses = st.builds(CarlaPose, metres, metres, metres, pitches, angles, angles)


def axes(pose: CarlaPose) -> np.ndarray:
    return conventions.body_from_carla(pose)[:3, :3].T


def test_y_changes_its_sign_and_centimetres_become_metres():
    np.testing.assert_array_equal(
        conventions.point_from_carla([10, 20, 3]), [10, -20, 3]
    )
    np.testing.assert_array_equal(
        conventions.point_from_unreal([1000, 2000, 300]), [10, -20, 3]
    )


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


def test_a_mounted_camera_is_a_pitched_actor():
    # 1.4 m up, 0.5 m ahead, 6 degrees down, on a car that drives to our left
    matrix = mount_matrix(np.array([[4.0, 7.0, math.pi / 2]]), CameraMount())[0]
    pose = conventions.camera_to_carla(matrix)
    expected = CarlaPose(4.0, -7.5, 1.4, pitch=-6.0, yaw=-90.0, roll=0.0)
    np.testing.assert_allclose(astuple(pose), astuple(expected), rtol=0, atol=1e-9)


@given(poses)
def test_poses_round_trip(pose):
    """Also straight up and down, where only yaw plus or minus roll is known."""
    matrix = conventions.body_from_carla(pose)
    again = conventions.body_from_carla(conventions.body_to_carla(matrix))
    np.testing.assert_allclose(again, matrix, rtol=0, atol=1e-9)


@given(poses)
def test_matrices_are_those_of_the_client_mirrored(carla, pose):
    transform = carla.Transform(
        carla.Location(pose.x, pose.y, pose.z),
        carla.Rotation(pitch=pose.pitch, yaw=pose.yaw, roll=pose.roll),
    )
    mirror = np.diag([1.0, -1.0, 1.0, 1.0])
    expected = mirror @ np.array(transform.get_matrix()) @ mirror
    # the client computes in 32 bits: 1000 m to 0.1 mm, angles to 1e-5
    matrix = conventions.body_from_carla(pose)
    np.testing.assert_allclose(matrix, expected, rtol=0, atol=2e-4)
    np.testing.assert_allclose(matrix[:3, :3], expected[:3, :3], rtol=0, atol=2e-5)


@pytest.mark.parametrize(
    ("rgb", "distance"),
    [
        ((0, 0, 0), 0.0),
        ((254, 255, 255), 1000 * 16777214 / 16777215),
        ((0, 1, 0), 1000 * 256 / 16777215),  # 1.526 cm
        ((255, 255, 255), math.inf),  # the far plane
    ],
)
def test_depth_codes(rgb, distance):
    pixel = np.array([[[*rgb[::-1], 255]]], np.uint8)
    assert conventions.decode_depth(pixel)[0, 0] == pytest.approx(distance, rel=1e-12)


def lens(*numbers, **distortion):
    return lambda: conventions.field_of_view_deg(Camera(8, 6, *numbers, **distortion))


test_cameras_that_carla_has_not_are_refused = refusals(
    (lens(5, 5, 4, 3, k1=0.01), "distortion"),
    (lens(5, 6, 4, 3), "fx 5, fy 6"),
    (lens(5, 5, 4.5, 3), "principal point 0.5, 0 px"),
)
