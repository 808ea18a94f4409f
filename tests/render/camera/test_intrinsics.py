"""Camera conventions, rays, distortion and colour against independent references."""

from __future__ import annotations

import json
from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from support.files import folders as foreign_folders
from support.reference.derivatives import nothing_compiled
from support.worlds.cameras import NARROW, RADIAL, WIDE, directions, pixels
from support.worlds.views import write_transforms

from mi_nerfattack.backend import colour
from mi_nerfattack.capture.coverage import points_shown
from mi_nerfattack.capture.transforms import read_images
from mi_nerfattack.errors import InputError
from mi_nerfattack.render.camera import distortion, lens
from mi_nerfattack.render.camera import intrinsics as cam
from mi_nerfattack.render.camera.conventions import mitsuba_sensor_dict

pytestmark = pytest.mark.usefixtures("variant")


POSE = cam.look_at([3.0, -2, 1], [0.5, 0.2, 0.4])
POSE[:3, :3] = POSE[:3, [1, 2, 0]]  # askew


def rays_of(camera, **kwargs):
    """Return origins (3, n) and directions (h, w, 3)."""
    o, d = lens.generate_rays(camera, *lens.pose_arrays(POSE), 1, **kwargs)
    return o.numpy(), d.numpy().T.reshape(camera.height, camera.width, 3)


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


def test_a_mount_to_the_left_that_looks_back_to_the_left():
    mount = cam.CameraMount(1.4, 0.5, 0.0, left_m=0.3, yaw_deg=120.0)
    # heading along +y: left is -x
    matrix = cam.mount_matrix(np.array([[2.0, 3.0, np.pi / 2]]), mount)[0]
    c, s = np.cos(np.radians(30)), np.sin(np.radians(30))
    expected = [[-s, 0, -c, 1.7], [c, 0, -s, 3.5], [0, -1, 0, 1.4], [0, 0, 0, 1]]
    np.testing.assert_allclose(matrix, expected, atol=1e-12)


@pytest.mark.parametrize("turned", [(), (0.7, -50.0)])
def test_mount_pose_agrees_with_matrix(turned):
    states = np.random.default_rng(1).normal(size=(7, 3)) * [10, 10, 3]
    mount = cam.CameraMount(1.2, -0.3, 12.0, *turned)
    columns = tuple(mi.Float(np.float32(column)) for column in states.T)
    origin, rotation = lens.mount_pose(columns, 1.2, -0.3, 12.0, *turned)
    matrix = cam.mount_matrix(states, mount)
    np.testing.assert_allclose(origin.numpy().T, matrix[:, :3, 3], atol=1e-5)
    for i, column in enumerate(rotation):
        np.testing.assert_allclose(column.numpy().T, matrix[:, :3, i], atol=1e-6)


@pytest.mark.parametrize(
    "lens", [(11.0, 11.0, 7.5, 8.25), (20.0, 22.0, 10.0, 6.0, -0.2, 0.05, 3e-3, -2e-3)]
)
def test_rays_agree_with_mitsubas_sensor(lens):
    camera = cam.Camera(20, 12, *lens)
    origin, directions = rays_of(camera)
    assert origin.shape == (3, 240)
    row, column = np.mgrid[0:12, 0:20]
    place = np.stack([(column + 0.5) / 20, (row + 0.5) / 12]).reshape(2, -1)
    sensor = mi.load_dict(mitsuba_sensor_dict(camera, POSE, 1))
    film = mi.Point2f(place.astype(np.float32))
    ray, _ = sensor.sample_ray(0.0, 0.0, film, mi.Point2f(0))
    ours = directions.reshape(-1, 3)
    np.testing.assert_allclose(ray.d.numpy().T, ours, atol=2e-6)
    # the sensor starts its rays at the near plane: on our ray, but further
    np.testing.assert_allclose(np.cross((ray.o.numpy() - origin).T, ours), 0, atol=1e-5)


def test_subpixel_moves_the_sample():
    _, directions = rays_of(cam.from_fov(4, 2, 90.0), subpixel=mi.Point2f(0.5, -0.5))
    x, y, z = directions[0, 0] @ POSE[:3, :3]
    np.testing.assert_allclose([x / z, y / z], [-0.5, -0.5], atol=1e-6)


@pytest.mark.parametrize("wrt", [0, 1, 2])
def test_rays_derivative_in_the_state(rng, wrt):
    camera = cam.from_fov(6, 4, 80.0)
    weights = rng.normal(size=(6, 24)).astype(np.float32)

    def objective(value):
        state = [mi.Float(v) for v in (1.0, 2.0, 0.7)]
        state[wrt] = mi.Float(value)
        pose = lens.mount_pose(tuple(state), 1.4, 0.5, 6, left_m=0.4, yaw_deg=50)
        o, d = lens.generate_rays(camera, *pose, 1)
        rows = zip((*o, *d), weights, strict=True)
        return dr.sum(sum(row * mi.Float(weight) for row, weight in rows))

    base = (1.0, 2.0, 0.7)[wrt]
    value = mi.Float(base)
    dr.enable_grad(value)
    dr.backward(objective(value))
    numeric = (objective(base + 1e-2) - objective(base - 1e-2))[0] / 2e-2
    np.testing.assert_allclose(dr.grad(value)[0], numeric, rtol=1e-3, atol=1e-3)


def test_no_kernel_is_compiled_for_another_pose_lens_or_mount():
    def frame(camera, state, *mount):
        pose = lens.mount_pose(state, *(mount or (1.4, 0.5, 6.0)))
        o, d = lens.generate_rays(camera, *pose, 1)
        dr.eval(o, d)

    frame(cam.from_fov(31, 17, 90.0), tuple(dr.opaque(mi.Float, v) for v in (0, 0, 0)))
    with nothing_compiled():
        for value in (0.25, 1.5):
            state = tuple(dr.opaque(mi.Float, value) for _ in range(3))
            frame(cam.from_fov(31, 17, 60.0), state)
            frame(cam.from_fov(31, 17, 60.0), state, 1.0, 0.2, 0.0, 0.4, 50.0)


def test_wrong_number_of_poses():
    with pytest.raises(ValueError, match="2 entries; n_poses is 3"):
        arrays = lens.pose_arrays(np.stack([POSE, POSE]))
        lens.generate_rays(cam.from_fov(2, 2, 90.0), *arrays, 3)


GOOD = {"width": 10, "height": 10, "fx": 10.0, "fy": 10.0, "cx": 5.0, "cy": 5.0}


@pytest.mark.parametrize(
    ("kind", "name", "value"),
    [
        (cam.Camera, "width", 0),
        (cam.Camera, "width", 5.0),
        (cam.Camera, "fx", -1.0),
        (cam.Camera, "cx", np.nan),
        (cam.Camera, "k1, k2, p1, p2", -5.0),
        (cam.CameraMount, "height_m", np.nan),
        (cam.CameraMount, "pitch_deg", -np.inf),
    ],
)
def test_impossible_cameras_and_mounts(kind, name, value):
    good, prefix = (GOOD, "camera") if kind is cam.Camera else ({}, "mount")
    with pytest.raises(InputError) as caught:
        kind(**{**good, name.partition(",")[0]: value})
    assert caught.value.where == f"{prefix}.{name}"


def test_srgb_known_values():
    # IEC 61966-2-1: 8-bit 188 is about half the light, 118 is 18 % grey
    codes = colour.linear_to_uint8(np.array([0.0, 0.5, 0.18, 1.0, 7.0, -1.0]))
    np.testing.assert_array_equal(codes, [0, 188, 118, 255, 255, 0])
    with pytest.raises(ValueError, match="NaN"):
        colour.linear_to_uint8(np.array([float("nan")]))


def test_srgb_round_trip_and_numpy_agree():
    values = np.linspace(0, 1, 1001, dtype=np.float32)
    encoded, decoded = (
        dr.linear_to_srgb(mi.Float(values)),
        dr.srgb_to_linear(mi.Float(values)),
    )
    for actual, expected in (
        (dr.srgb_to_linear(encoded), values),
        (encoded, colour.linear_to_srgb_numpy(values.astype(float))),
        (decoded, colour.srgb_to_linear_numpy(values.astype(float))),
    ):
        np.testing.assert_allclose(actual, expected, atol=1e-6)


# Lenses with distortion, also fisheyes


@pytest.mark.parametrize("camera", [NARROW, WIDE, RADIAL], ids=["narrow", "wide", "no"])
def test_rays_look_where_the_lens_says(camera):
    pose = cam.look_at([1.0, 2, 3], [0, 0, 0])
    _, direction = lens.generate_rays(camera, *lens.pose_arrays(pose), 1)
    local = direction.numpy().T @ pose[:3, :3]
    np.testing.assert_allclose(local, directions(camera, *pixels(camera)), atol=2e-6)
    assert (local[:, 2] < 0).any() == (camera is WIDE)
    lengths = cam.ray_lengths(camera).ravel()
    ahead = local[:, 2] > 0.01
    np.testing.assert_allclose(lengths[ahead], 1 / local[ahead, 2], rtol=1e-3)
    assert np.isnan(lengths[local[:, 2] < -0.01]).all()


@pytest.mark.parametrize("camera", [NARROW, RADIAL], ids=["fisheye", "radial"])
def test_opencv_projects_rays_back_to_their_pixels(camera):
    cv2 = pytest.importorskip("cv2")
    x, y = cam.ray_slopes(camera)
    matrix = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]])
    points = np.stack([x, y, np.ones_like(x)], -1).reshape(-1, 1, 3)
    project = cv2.fisheye.projectPoints if camera.is_fisheye else cv2.projectPoints
    zero, coefficients = np.zeros(3), np.array(camera.distortion[:4])
    projected, _ = project(points, zero, zero, matrix, coefficients)
    np.testing.assert_allclose(projected[:, 0].T, pixels(camera), atol=1e-6)
    # distort is the same projection, and jacobian its derivative
    bent = np.reshape(distortion.distort(x, y, *camera.distortion), (2, -1))
    scaled = bent * [[camera.fx], [camera.fy]] + [[camera.cx], [camera.cy]]
    np.testing.assert_allclose(scaled, pixels(camera), atol=1e-6)
    xx, xy, yy, determinant = distortion.jacobian(x, y, *camera.distortion)
    step = 1e-6
    for dx, dy, expected in ((step, 0, (xx, xy)), (0, step, (xy, yy))):
        ahead = distortion.distort(x + dx, y + dy, *camera.distortion)
        back = distortion.distort(x - dx, y - dy, *camera.distortion)
        slope = (np.array(ahead) - np.array(back)) / (2 * step)
        np.testing.assert_allclose(slope, expected, atol=1e-7)
    np.testing.assert_allclose(determinant, xx * yy - xy * xy, rtol=1e-12)


def test_a_fisheye_shows_its_middle_as_it_is():
    middle = np.zeros(1)
    jacobian = distortion.jacobian(middle, middle, *NARROW.distortion)
    np.testing.assert_allclose(np.ravel(jacobian), [1, 0, 1, 1])


def test_a_lens_far_out_of_true_is_undone_to_the_last_digits():
    x, y = np.meshgrid(np.linspace(-0.6, 0.6, 9), np.linspace(-0.4, 0.4, 7))
    coefficients = -0.2, 0.05, 0.06, -0.05
    bent = distortion.distort(x, y, *coefficients)
    slopes = distortion.undistort(*bent, *coefficients)
    np.testing.assert_allclose(slopes, (x, y), rtol=0, atol=1e-13)


def test_cameras_of_one_lens_are_told_apart():
    cameras = [RADIAL, replace(RADIAL, fx=40.0, k1=0.1)]
    place = np.array([[10.0, 20, 30], [5, 9, 30]])
    index = [1, 0, 1]
    _, ray_directions = lens.lens_rays(
        lens.Lens(cameras).of(mi.UInt32(index)),
        mi.Point3f(0),
        tuple(mi.Vector3f(*row) for row in np.eye(3).tolist()),
        mi.Point2f(place.astype(np.float32)),
    )
    both = np.stack([directions(camera, *place) for camera in cameras])
    np.testing.assert_allclose(
        ray_directions.numpy().T, both[index, range(3)], atol=2e-6
    )


# Files, and what is refused


def test_files_come_back(tmp_path):
    images = np.zeros((3, 48, 64, 3), np.uint8)
    poses = np.stack([cam.look_at([3.0, i, 1], [0, 0, 0]) for i in range(3)])
    write_transforms(tmp_path, images, WIDE, poses)
    back = read_images(tmp_path)
    assert back.camera == WIDE and not back.cameras
    smaller = read_images(tmp_path, 32).camera
    assert smaller == WIDE.resized(32, 24)


def test_a_fisheye_of_instant_ngp(tmp_path):
    source = foreign_folders.instant_ngp(tmp_path) / "transforms.json"
    table = json.loads(source.read_text())
    table |= {"is_fisheye": True, "k1": 0.01, "k2": 0.0, "k3": 0.002, "k4": -0.001}
    source.write_text(json.dumps(table | {"p1": 0.0, "p2": 0.0}))
    assert read_images(source).camera.distortion == (0.01, 0.0, 0.002, -0.001, True)
    source.write_text(json.dumps(table | {"p1": 0.01, "p2": 0.0}))
    with pytest.raises(InputError, match="camera.p1: 0.01; a fisheye has 0"):
        read_images(source)


@pytest.mark.parametrize(
    ("call", "where"),
    [
        (lambda: replace(NARROW, k1=-0.6), "camera.k1, k2, k3, k4"),
        (lambda: replace(NARROW, fx=8.0, fy=8.0), "camera.k1, k2, k3, k4"),  # over 180
        (lambda: replace(NARROW, is_fisheye=False), "camera.k3"),
        (lambda: cam.ray_slopes(WIDE), "camera"),
        (
            lambda: lens.Lens([NARROW, cam.Camera(64, 48, 30.0, 32.0, 31.0, 25.0)]),
            "cameras",
        ),
    ],
)
def test_what_no_such_lens_is(call, where):
    with pytest.raises(InputError) as caught:
        call()
    assert caught.value.where == where


def test_points_beside_the_picture_are_not_shown():
    """A pinhole of this focal length would show 47 degrees, the fisheye 61."""
    pose = np.eye(4)[None]
    inside, outside = np.radians([55.0, 65.0])
    points = np.array([[np.sin(a), 0, np.cos(a)] for a in (inside, outside)])
    points = np.r_[points, [[0, 0, -1.0]]]
    assert points_shown([NARROW], pose, points).tolist() == [[True, False, False]]
