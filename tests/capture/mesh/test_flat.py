"""Flat objects against the picture that they show, and where the sheet lies."""

from __future__ import annotations

import json

import mitsuba as mi
import numpy as np
import pytest
from PIL import ExifTags, Image
from support.faults.refusals import refusals

from mi_nerfattack import cli
from mi_nerfattack.backend.arrays import upload_rows
from mi_nerfattack.backend.colour import srgb_to_linear_numpy
from mi_nerfattack.capture.mesh.cube_faces import FLAT_FACES
from mi_nerfattack.capture.mesh.flat import FlatObject, read_picture
from mi_nerfattack.capture.mesh.surface import field_surface
from mi_nerfattack.deploy.built_in import make_built_in
from mi_nerfattack.errors import InputError
from mi_nerfattack.fields import load_grid, save_field
from mi_nerfattack.io import files
from mi_nerfattack.render.camera.pose import Pose
from mi_nerfattack.render.march import march
from mi_nerfattack.render.posed import PosedField
from mi_nerfattack.render.rays import Rays

pytestmark = pytest.mark.usefixtures("variant")

WIDTH, HEIGHT = 2.0, 1.5
#: sRGB of the picture's quarters, by whether right and whether down.
QUARTERS = np.array(
    [[[220, 40, 30], [40, 200, 60]], [[50, 60, 230], [200, 190, 40]]], np.uint8
)
#: A driver's eye in the frame of the object, which is driven up to along +y.
EYE = np.array([0.7, -6.0, 1.4])
POSE = Pose.upright((3.0, -2.0, 0.1), 0.7, 1.0)


def picture() -> np.ndarray:
    return QUARTERS.repeat(90, 0).repeat(120, 1)


def made(kind: str, pixels_per_m: float = 32.0):
    return FlatObject(kind, WIDTH, HEIGHT, pixels_per_m).field(picture())


def on_sheet(kind: str, right: np.ndarray, down: np.ndarray) -> np.ndarray:
    """Return points (n, 3) of the sheet's face from shares of its width and height."""
    x, up = WIDTH * (right - 0.5), HEIGHT * (1 - down)
    if kind == "billboard":
        return np.stack([x, np.zeros_like(x), up], -1)
    return np.stack([x, up - HEIGHT / 2, np.full_like(x, 0.01 * WIDTH)], -1)


def look(field, points: np.ndarray):
    """March rays from the eye to points (n, 3) of the object's frame and beyond."""
    eye, aims = POSE.apply(EYE[None]), POSE.apply(points)
    way = aims - eye
    length = np.linalg.norm(way, axis=1)
    origin = upload_rows(mi.Point3f, np.repeat(eye, len(points), 0))
    direction = upload_rows(mi.Vector3f, way / length[:, None])
    return march(PosedField(field, POSE), Rays(origin, direction)), length


@pytest.mark.parametrize("kind", FLAT_FACES)
def test_a_driver_sees_the_picture_upright(kind):
    rng = np.random.default_rng(0)
    shares = rng.uniform(0.05, 0.45, (40, 2)) + 0.5 * rng.integers(2, size=(40, 2))
    right, down = shares.T
    integrals, length = look(made(kind), on_sheet(kind, right, down))
    expected = QUARTERS[(down > 0.5).astype(int), (right > 0.5).astype(int)]
    expected = srgb_to_linear_numpy(expected / 255)
    np.testing.assert_allclose(integrals.radiance.numpy().T, expected, atol=2e-3)
    np.testing.assert_allclose(integrals.opacity.numpy(), 1, atol=1e-4)
    depth = integrals.moment.numpy() / integrals.opacity.numpy()
    np.testing.assert_allclose(depth, length, atol=2e-3)


@pytest.mark.parametrize("kind", FLAT_FACES)
def test_beside_the_sheet_is_nothing(kind):
    beyond = np.array([[-0.01, 0.5], [1.01, 0.5], [0.5, -0.01], [0.5, 1.01]])
    integrals, _ = look(made(kind), on_sheet(kind, *beyond.T))
    assert not integrals.opacity.numpy().any()


@pytest.mark.parametrize("kind", FLAT_FACES)
def test_size_and_picture_stay_in_the_file(tmp_path, kind):
    size = (WIDTH, 0.02, HEIGHT) if kind == "billboard" else (WIDTH, HEIGHT, 0.02)
    before = made(kind)
    np.testing.assert_allclose(before.upper - before.lower, size)
    assert before.lower[2] == 0
    save_field(tmp_path / "flat.safetensors", before)
    after = load_grid(tmp_path / "flat.safetensors")
    points = on_sheet(kind, np.array([0.2, 0.9]), np.array([0.7, 0.1]))
    colours = [look(field, points)[0].radiance.numpy() for field in (before, after)]
    np.testing.assert_allclose(*colours, rtol=2e-3)
    mesh = field_surface(after)
    corners = on_sheet(kind, np.array([0.0, 1.0]), np.array([1.0, 0.0]))
    np.testing.assert_allclose(mesh.vertices.min(0), corners[0], atol=1e-9)
    np.testing.assert_allclose(mesh.vertices.max(0), corners[1], atol=1e-9)


@pytest.mark.parametrize("kind", FLAT_FACES)
def test_built_in_the_sheet_has_the_albedo_of_the_picture(kind):
    built_in = make_built_in(made(kind), POSE)
    edges = on_sheet(kind, np.array([0.0, 1.0]), np.array([1.0, 0.0]))
    np.testing.assert_allclose(built_in.vertices.min(0), edges[0], atol=1e-9)
    np.testing.assert_allclose(built_in.vertices.max(0), edges[1], atol=1e-9)
    assert len(built_in.faces) == 2
    height, width, _ = built_in.image.shape
    up_axis, weights = 2 if kind == "billboard" else 1, np.array([0.7, 0.15, 0.15])
    for face in built_in.faces:
        corners, uv = built_in.vertices[face], built_in.uv[face]
        normal = np.cross(corners[1] - corners[0], corners[2] - corners[0])
        assert normal @ (EYE - corners[0]) > 0
        # a point of the triangle that lies inside of one quarter
        point, (u, v) = weights @ corners, weights @ uv
        texel = built_in.image[int((1 - v) * height), int(u * width)]
        middle = (edges[0] + edges[1])[up_axis] / 2
        is_low = point[up_axis] < middle
        quarter = QUARTERS[int(is_low), int(point[0] > 0)]
        np.testing.assert_allclose(texel, quarter, atol=3)


def test_resolution_counts_pixels_of_the_longer_edge():
    assert FlatObject("patch", 1.8, 4.0, 32).pixels == 128
    assert FlatObject("billboard", 2.0, 1.5, 10.2).pixels == 21
    assert FlatObject("billboard", 0.2, 0.3, 1.0).pixels == 1


test_refused = refusals(
    (lambda: FlatObject("wall", 1, 1), "kind: 'wall'.*billboard, patch"),
    (lambda: FlatObject("patch", 0, 1), "width_m: 0"),
    (lambda: FlatObject("patch", 1, float("inf")), "height_m: inf"),
    (lambda: FlatObject("patch", 1, 1, -3), "pixels_per_m: -3"),
    (lambda: FlatObject("patch", 1, 4, 100), "pixels_per_m: 100 .* 400 .* take 64 or"),
)


def test_a_picture_is_as_viewers_show_it(tmp_path):
    """A photograph of a camera that was held upright is stored lying."""
    tags = Image.Exif()
    tags[ExifTags.Base.Orientation] = 6
    stored = np.rot90(picture())  # to the left, so that viewers turn it to the right
    Image.fromarray(stored).save(tmp_path / "a.png", exif=tags)
    np.testing.assert_array_equal(read_picture(tmp_path / "a.png"), picture())
    clear = np.dstack([picture(), np.full(picture().shape[:2], 254, np.uint8)])
    files.write_image(tmp_path / "b.png", clear)
    with pytest.raises(InputError, match="b.png: has transparent pixels"):
        read_picture(tmp_path / "b.png")
    clear[..., 3] = 255
    files.write_image(tmp_path / "b.png", clear)
    np.testing.assert_array_equal(read_picture(tmp_path / "b.png"), picture())


def test_the_command_writes_the_same_field(tmp_path, capsys):
    files.write_image(tmp_path / "a.png", picture())
    out = tmp_path / "board.safetensors"
    size = ["--width-m", str(WIDTH), "--height-m", str(HEIGHT)]
    command = ["asset", "flat", "billboard", "-o", str(out), *size, "--json"]
    assert cli.main([*command, "--picture", str(tmp_path / "a.png")]) == 0
    assert json.loads(capsys.readouterr().out.splitlines()[-1])["pixels"] == 64
    points = on_sheet("billboard", np.array([0.2, 0.9]), np.array([0.7, 0.1]))
    colours = [look(f, points)[0].radiance for f in (load_grid(out), made("billboard"))]
    np.testing.assert_allclose(*(c.numpy() for c in colours), rtol=2e-3)
    assert cli.main([*command[:-1], "--pixels-per-m", "1000"]) == 2
    assert "at most 256" in capsys.readouterr().err
