"""Camera conventions, rays, distortion and colour against independent references."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from helpers.kernels import nothing_compiled
from hypothesis import given, settings
from hypothesis import strategies as st

from mi_nerfattack.backend import colour
from mi_nerfattack.errors import InputError
from mi_nerfattack.render.camera import intrinsics as cam
from mi_nerfattack.render.camera.conventions import mitsuba_sensor_dict
from mi_nerfattack.render.camera.distortion import distort, undistort

FOX = cam.Camera(
    1080,
    1920,
    1375.52,
    1374.49,
    554.558,
    965.268,
    k1=0.0578421,
    k2=-0.0805099,
    p1=-0.000980296,
    p2=0.00015575,
)


pytestmark = pytest.mark.usefixtures("variant")


def random_poses(n: int, seed: int = 0) -> np.ndarray:
    from scipy.spatial.transform import Rotation

    poses = np.tile(np.eye(4), (n, 1, 1))
    poses[:, :3, :3] = Rotation.random(n, rng=seed).as_matrix()
    poses[:, :3, 3] = np.random.default_rng(seed).normal(size=(n, 3)) * 5
    return poses


def rays_of(camera, poses, **kwargs):
    origin, rotation = cam.pose_arrays(poses)
    o, d = cam.generate_rays(camera, origin, rotation, len(poses), **kwargs)
    shape = (len(poses), camera.height, camera.width, 3)
    return o.numpy().T.reshape(shape), d.numpy().T.reshape(shape)


@pytest.mark.parametrize("eye", [(3.0, -2.0, 5.0), (0.0, 0.0, 4.0), (1.0, 0.0, 0.0)])
def test_look_at_is_upright_and_rigid(eye):
    matrix = cam.look_at(np.array(eye), np.zeros(3))
    np.testing.assert_allclose(
        matrix[:3, 2], -np.array(eye) / np.linalg.norm(eye), atol=1e-12
    )
    np.testing.assert_allclose(matrix[:3, :3].T @ matrix[:3, :3], np.eye(3), atol=1e-12)
    assert np.linalg.det(matrix[:3, :3]) == pytest.approx(1)
    assert matrix[2, 0] == 0  # the horizon is level
    assert matrix[2, 1] <= 0  # the image's down is not up in the world


@pytest.mark.parametrize("pitch_deg", [0.0, 6.0, 90.0])
def test_mount_by_hand(pitch_deg):
    mount = cam.CameraMount(height_m=1.4, forward_m=0.5, pitch_deg=pitch_deg)
    # heading along +y: right is +x, the camera is 0.5 m further along y
    matrix = cam.mount_matrix(np.array([[2.0, 3.0, np.pi / 2]]), mount)[0]
    c, s = np.cos(np.radians(pitch_deg)), np.sin(np.radians(pitch_deg))
    expected = [[1, 0, 0, 2], [0, -s, c, 3.5], [0, -c, -s, 1.4], [0, 0, 0, 1]]
    np.testing.assert_allclose(matrix, expected, atol=1e-12)


def test_mount_pose_agrees_with_matrix():
    states = np.random.default_rng(1).normal(size=(7, 3)) * [10, 10, 3]
    mount = cam.CameraMount(1.2, -0.3, 12.0)
    columns = tuple(mi.Float(np.float32(column)) for column in states.T)
    origin, rotation = cam.mount_pose(columns, 1.2, -0.3, 12.0)
    matrix = cam.mount_matrix(states, mount)
    np.testing.assert_allclose(origin.numpy().T, matrix[:, :3, 3], atol=1e-5)
    for i, column in enumerate(rotation):
        np.testing.assert_allclose(column.numpy().T, matrix[:, :3, i], atol=1e-6)


@pytest.mark.parametrize(
    "lens",
    [
        (11.0, 11.0, 10.0, 6.0),
        (11.0, 11.0, 7.5, 8.25),
        (11.0, 12.5, 7.5, 8.25),
        (20.0, 20.0, 10.0, 6.0, -0.2, 0.05, 3e-3, -2e-3),
    ],
)
def test_rays_agree_with_mitsubas_sensor(lens):
    camera = cam.Camera(20, 12, *lens)
    poses = random_poses(3)
    origins, directions = rays_of(camera, poses)
    row, column = np.mgrid[0:12, 0:20]
    film = mi.Point2f(
        mi.Float(((column + 0.5) / 20).ravel()), mi.Float(((row + 0.5) / 12).ravel())
    )
    for i, pose in enumerate(poses):
        sensor = mi.load_dict(mitsuba_sensor_dict(camera, pose, 1))
        ray, _ = sensor.sample_ray(0.0, 0.0, film, mi.Point2f(0))
        ours = directions[i].reshape(-1, 3)
        np.testing.assert_allclose(ray.d.numpy().T, ours, atol=2e-6)
        # the sensor starts its rays at the near plane: on our ray, but further
        offset = ray.o.numpy().T - origins[i].reshape(-1, 3)
        np.testing.assert_allclose(np.cross(offset, ours), 0, atol=1e-5)


def test_subpixel_moves_the_sample():
    camera = cam.from_fov(4, 2, 90.0)
    _, directions = rays_of(camera, np.eye(4)[None], subpixel=mi.Point2f(0.5, -0.5))
    np.testing.assert_allclose(
        directions[0, 0, 0, :2] / directions[0, 0, 0, 2], [-0.5, -0.5], atol=1e-6
    )


@pytest.mark.parametrize("wrt", [0, 1, 2])
def test_rays_derivative_in_the_state(wrt):
    camera = cam.from_fov(6, 4, 80.0)
    rng = np.random.default_rng(3)
    weight_o = mi.Point3f(mi.TensorXf(np.float32(rng.normal(size=(3, 24)))))
    weight_d = mi.Point3f(mi.TensorXf(np.float32(rng.normal(size=(3, 24)))))

    def objective(values):
        state = tuple(mi.Float(v) for v in values)
        dr.enable_grad(state)
        o, d = cam.generate_rays(camera, *cam.mount_pose(state, 1.4, 0.5, 6.0), 1)
        return dr.sum(dr.dot(o, weight_o) + dr.dot(d, weight_d)), state

    point, step = np.array([1.0, 2.0, 0.7]), 1e-2
    value, state = objective(point)
    dr.backward(value)
    delta = np.eye(3)[wrt] * step
    numeric = (objective(point + delta)[0] - objective(point - delta)[0]) / (2 * step)
    np.testing.assert_allclose(dr.grad(state[wrt])[0], numeric[0], rtol=1e-3, atol=1e-3)


def test_no_kernel_is_compiled_for_another_pose_or_lens():
    def frame(camera, state):
        o, d = cam.generate_rays(camera, *cam.mount_pose(state, 1.4, 0.5, 6.0), 1)
        dr.eval(o, d)

    frame(cam.from_fov(31, 17, 90.0), tuple(dr.opaque(mi.Float, v) for v in (0, 0, 0)))
    with nothing_compiled():
        for value in (0.25, 1.5):
            state = tuple(dr.opaque(mi.Float, value) for _ in range(3))
            frame(cam.from_fov(31, 17, 60.0), state)


def test_wrong_number_of_poses():
    origin, rotation = cam.pose_arrays(random_poses(2))
    with pytest.raises(ValueError, match="2 entries; n_poses is 3"):
        cam.generate_rays(cam.from_fov(2, 2, 90.0), origin, rotation, 3)


def test_distorted_rays_project_back_with_opencv():
    import cv2

    camera = FOX.resized(27, 48)
    _, directions = rays_of(camera, np.eye(4)[None])
    matrix = np.array(
        [[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1.0]]
    )
    points, _ = cv2.projectPoints(
        directions.reshape(-1, 3).astype(np.float64),
        np.zeros(3),
        np.zeros(3),
        matrix,
        np.array(camera.distortion),
    )
    row, column = np.mgrid[0:48, 0:27] + 0.5
    np.testing.assert_allclose(
        points[:, 0], np.stack([column.ravel(), row.ravel()], 1), atol=1e-4
    )


@settings(max_examples=50)
@given(
    x=st.floats(-0.6, 0.6),
    y=st.floats(-0.6, 0.6),
    k=st.tuples(*[st.floats(-0.1, 0.1)] * 2, *[st.floats(-0.01, 0.01)] * 2),
)
def test_undistort_inverts_distort(x, y, k):
    np.testing.assert_allclose(undistort(*distort(x, y, *k), *k), (x, y), atol=1e-9)


@pytest.mark.parametrize(
    ("change", "name"),
    [
        ({"width": 0}, "camera.width"),
        ({"width": 5.0}, "camera.width: 5.0; must be an int"),
        ({"height": 2.5}, "camera.height: 2.5; must be an int"),
        ({"fx": -1.0}, "camera.fx"),
        ({"cx": float("nan")}, "camera.cx"),
        ({"k1": -5.0}, "camera.k1"),
    ],
)
def test_impossible_cameras(change, name):
    values = {"width": 10, "height": 10, "fx": 10.0, "fy": 10.0, "cx": 5.0, "cy": 5.0}
    with pytest.raises(InputError, match=name):
        cam.Camera(**{**values, **change})


@pytest.mark.parametrize(
    ("name", "value"),
    [("height_m", np.nan), ("forward_m", np.inf), ("pitch_deg", -np.inf)],
)
def test_impossible_mounts(name, value):
    with pytest.raises(InputError, match=f"mount.{name}: -?(nan|inf); must be finite"):
        cam.CameraMount(**{name: value})


def test_srgb_known_values():
    # IEC 61966-2-1: 8-bit 188 is about half the light, 118 is 18 % grey
    codes = colour.linear_to_uint8(np.array([0.0, 0.5, 0.18, 1.0, 7.0, -1.0]))
    np.testing.assert_array_equal(codes, [0, 188, 118, 255, 255, 0])


def test_srgb_round_trip_and_numpy_agree():
    values = np.linspace(0, 1, 1001, dtype=np.float32)
    encoded = dr.linear_to_srgb(mi.Float(values))
    np.testing.assert_allclose(dr.srgb_to_linear(encoded), values, atol=1e-6)
    np.testing.assert_allclose(
        encoded, colour.linear_to_srgb_numpy(values.astype(float)), atol=1e-6
    )
    np.testing.assert_allclose(
        dr.srgb_to_linear(mi.Float(values)),
        colour.srgb_to_linear_numpy(values.astype(float)),
        atol=1e-6,
    )


def test_eight_bits_refuse_nan():
    with pytest.raises(ValueError, match="NaN"):
        colour.linear_to_uint8(np.array([float("nan")]))
