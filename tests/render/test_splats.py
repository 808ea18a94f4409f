"""What rays see of splats, against closed formulas and a float64 reference."""

from __future__ import annotations

from dataclasses import replace

import mitsuba as mi
import numpy as np
import pytest
from helpers import splat_files as made
from scipy.spatial.transform import Rotation

from mi_nerfattack.backend.colour import srgb_to_linear_numpy
from mi_nerfattack.fields.splats import Splats
from mi_nerfattack.render.camera.pose import Pose
from mi_nerfattack.render.rays import March, Rays
from mi_nerfattack.render.splats import SplatBackground

pytestmark = pytest.mark.usefixtures("variant")

RED, BLUE = np.array([0.8, 0.1, 0.2]), np.array([0.1, 0.3, 0.9])


def look(
    splats: Splats,
    origins=(0, 0, 0),
    directions=(1, 0, 0),
    t_max: float = np.inf,
    pose: Pose | None = None,
    stop: float = 0.0,
) -> March:
    """March rays, (n, 3) or (3,), through splats."""
    o, d = np.broadcast_arrays(np.atleast_2d(origins), np.atleast_2d(directions))
    rays = Rays(
        mi.Point3f(o.T.astype(np.float32)),
        mi.Vector3f(d.T.astype(np.float32)),
        mi.Float(t_max),
    )
    return SplatBackground(splats, pose).march(rays, stop)


def linear(display: np.ndarray, opacity: np.ndarray) -> np.ndarray:
    """Decode premultiplied sRGB (n, 3) into premultiplied linear radiance."""
    opacity = np.asarray(opacity)[..., None]
    return opacity * srgb_to_linear_numpy(display / np.where(opacity > 0, opacity, 1))


# The kernel


@pytest.mark.parametrize("distance", [0.05, 1.0, 40.0])
def test_one_gaussian_has_the_closed_form(distance: float) -> None:
    sizes, turn = np.array([0.3, 0.1, 0.2]), Rotation.from_euler("x", 90, degrees=True)
    item = made.splats(
        [distance, 0, 0], RED, 0.7, sizes, turn.as_quat()[[3, 0, 1, 2]]
    )  # its second axis points along z, its third along -y
    y, z = np.meshgrid(np.linspace(-0.59, 0.59, 9), np.linspace(-0.29, 0.29, 9))
    origins = np.stack([0 * y, y, z], -1).reshape(-1, 3)
    seen = look(item, origins)
    squared = (origins[:, 1] / 0.2) ** 2 + (origins[:, 2] / 0.1) ** 2
    opacity = np.where(squared <= 9, 0.7 * np.exp(-squared / 2), 0)
    np.testing.assert_allclose(seen.opacity.numpy(), opacity, atol=2e-6)
    expected = opacity[:, None] * srgb_to_linear_numpy(RED)
    np.testing.assert_allclose(seen.radiance.numpy().T, expected, atol=2e-6)
    depth = np.where(opacity > 0, distance, np.inf)
    np.testing.assert_allclose(seen.depth.numpy(), depth, rtol=1e-5)


def test_an_oblique_ray_peaks_where_the_distance_is_least(rng) -> None:
    turn = Rotation.random(random_state=3)
    item = made.splats([3, 0.1, -0.2], RED, 0.5, [0.5, 0.2, 0.05])
    item = replace(item, quaternions=turn.as_quat()[None, [3, 0, 1, 2]])
    direction = np.array([1, 0.05, -0.06]) / np.linalg.norm([1, 0.05, -0.06])
    t = np.linspace(0, 6, 600001)
    offset = t[:, None] * direction - item.centers[0]
    squared = ((offset @ turn.as_matrix() / [0.5, 0.2, 0.05]) ** 2).sum(1)
    best = squared.argmin()
    seen = look(item, directions=direction)
    assert float(seen.depth[0]) == pytest.approx(t[best], abs=2e-5)
    assert float(seen.opacity[0]) == pytest.approx(
        0.5 * np.exp(-squared[best] / 2), rel=1e-4
    )


@pytest.mark.parametrize("near", [0, 1])
def test_two_along_a_ray_blend_in_srgb_front_to_back(near: int) -> None:
    places = [[2.0, 0, 0], [5.0, 0, 0]]
    item = made.splats(places if near == 0 else places[::-1], [RED, BLUE], [0.6, 0.3])
    colours, alphas = [RED, BLUE], [0.6, 0.3]
    front, back = (0, 1) if near == 0 else (1, 0)
    first, second = alphas[front], (1 - alphas[front]) * alphas[back]
    display = first * colours[front] + second * colours[back]
    seen = look(item)
    assert float(seen.opacity[0]) == pytest.approx(first + second, rel=1e-5)
    assert float(seen.moment[0]) == pytest.approx(2 * first + 5 * second, rel=1e-5)
    expected = linear(display, np.array(first + second))
    np.testing.assert_allclose(seen.radiance.numpy()[:, 0], expected, rtol=1e-5)


def sphere(rng: np.random.Generator, count: int) -> np.ndarray:
    """Return unit vectors in single precision, (count, 3)."""
    v = rng.normal(size=(count, 3))
    return (v / np.linalg.norm(v, axis=1, keepdims=True)).astype(np.float32)


@pytest.mark.parametrize(("giants", "t_max"), [(0, np.inf), (0, 2.5), (6, np.inf)])
def test_a_cloud_is_its_float64_sum(rng, giants: int, t_max: float) -> None:
    item = made.cloud(rng, 400, giants)
    origin, directions = np.array([0.3, -0.2, 0.1]), sphere(rng, 200)
    # among the splats, so that many contain the origin
    display, opacity, moment = made.reference(item, origin, directions, t_max)
    assert (opacity > 0.5).any()
    seen = look(item, origin, directions, t_max)
    np.testing.assert_allclose(seen.opacity.numpy(), opacity, atol=1e-5)
    np.testing.assert_allclose(seen.moment.numpy(), moment, atol=1e-4)
    expected = linear(display, opacity)
    np.testing.assert_allclose(seen.radiance.numpy().T, expected, atol=1e-5)


def test_small_and_thin_splats_far_away_are_not_missed(rng) -> None:
    """Mitsuba's intersection alone loses half of them in metres."""
    sizes = rng.uniform(0.008, 0.012, (300, 3)) * [1, 1, 0.03]
    places = rng.normal(0, 0.05, (300, 3)) + [20, 0, 0]
    item = made.splats(places, RED, 0.3, sizes, rng.normal(size=(300, 4)))
    aims = np.array([20, 0, 0]) + rng.normal(0, 0.04, (200, 3))
    directions = (aims / np.linalg.norm(aims, axis=1)[:, None]).astype(np.float32)
    _, opacity, moment = made.reference(item, np.zeros(3), directions)
    assert np.median(opacity) > 0.5
    seen = look(item, directions=directions)
    for found, expected, scale in (
        (seen.opacity, opacity, 1),
        (seen.moment, moment, 20),
    ):
        error = np.abs(found.numpy() - expected) / scale
        assert np.quantile(error, 0.97) < 1e-4  # now and then two are entered as one
        assert error.max() < 0.02


def test_the_order_in_the_file_does_not_matter(rng) -> None:
    item, directions = made.cloud(rng, 300), sphere(rng, 100)
    order = rng.permutation(item.count)
    arrays = ("centers", "scales", "quaternions", "opacities", "harmonics")
    mixed = replace(item, **{name: getattr(item, name)[order] for name in arrays})
    a, b = (look(x, directions=directions).radiance.numpy() for x in (item, mixed))
    np.testing.assert_allclose(a, b, atol=1e-6)


def test_splats_at_one_place_all_count() -> None:
    seen = look(made.splats([[2, 0, 0]] * 5, RED, 0.3))
    assert float(seen.opacity[0]) == pytest.approx(1 - 0.7**5, rel=1e-5)


def test_a_large_splat_comes_behind_what_it_begins_in_front_of() -> None:
    item = made.splats([[3, 0, 0], [9, 0, 0]], [RED, BLUE], 0.5, [0.1, 2.5])
    first, second = 0.5, 0.25
    expected = linear(first * RED + second * BLUE, np.array(0.75))
    seen = look(item)  # the shell of the second one begins at 1.5
    np.testing.assert_allclose(seen.radiance.numpy()[:, 0], expected, rtol=1e-5)


def test_an_opaque_wall_is_a_coloured_wall() -> None:
    origins = np.random.default_rng(1).uniform(-0.6, 0.6, (50, 3)) * [0, 1, 1]
    seen = look(made.wall(4, RED, half=1, step=0.1), origins, stop=1e-3)
    np.testing.assert_allclose(seen.opacity.numpy(), 1, atol=2e-3)
    expected = np.tile(srgb_to_linear_numpy(RED), (50, 1))
    np.testing.assert_allclose(seen.radiance.numpy().T, expected, atol=2e-3)
    np.testing.assert_allclose(seen.depth.numpy(), 4, rtol=1e-4)


def test_rays_end_where_little_is_passed() -> None:
    item = made.splats([[2, 0, 0], [3, 0, 0], [4, 0, 0]], RED, 0.9)
    assert float(look(item, stop=0.05).opacity[0]) == pytest.approx(0.99, rel=1e-5)
    assert float(look(item).opacity[0]) == pytest.approx(0.999, rel=1e-5)


def test_rays_that_meet_nothing_and_inactive_rays_are_empty() -> None:
    item = made.splats([-2, 0, 0], RED)
    seen = look(item, directions=[[1, 0, 0], [0, 1, 0]])
    assert not seen.opacity.numpy().any() and not seen.radiance.numpy().any()
    assert np.isinf(seen.depth.numpy()).all()
    rays = Rays(mi.Point3f(0), mi.Vector3f(-1, 0, 0), active=mi.Bool(False))
    assert float(SplatBackground(item).march(rays, 0.0).opacity[0]) == 0


# Colour and pose


def test_degree_one_turns_colour_with_the_view() -> None:
    """Colours by hand: C1 (-y a + z b - x c), C1 = sqrt(3 / (4 pi))."""
    rest = np.zeros((1, 3, 3))
    rest[0, :, 0] = 0.1, 0.2, 0.3
    item = made.splats([0, 0, 0], (0.5, 0.4, 0.3), 0.5, rest=rest)
    direction = np.array([0.6, 0.0, 0.8])
    seen = look(item, -2 * direction, direction)
    red = 0.5 + np.sqrt(3 / (4 * np.pi)) * (0.2 * 0.8 - 0.3 * 0.6)
    expected = 0.5 * srgb_to_linear_numpy(np.array([red, 0.4, 0.3]))
    np.testing.assert_allclose(seen.radiance.numpy()[:, 0], expected, rtol=1e-5)


@pytest.mark.parametrize("degree", [2, 3])
def test_higher_degrees_are_orthonormal_to_the_lower(rng, degree: int) -> None:
    """The last harmonic of each degree by its polynomial."""
    rest = np.zeros((1, (degree + 1) ** 2 - 1, 3))
    rest[0, -1, 1] = 0.3
    item = made.splats([0, 0, 0], (0.5, 0.5, 0.5), 0.5, rest=rest)
    x, y, z = direction = sphere(rng, 1)[0].astype(float)
    value = {
        2: np.sqrt(15 / (16 * np.pi)) * (x * x - y * y),
        3: -np.sqrt(35 / (32 * np.pi)) * x * (x * x - 3 * y * y),
    }[degree]
    seen = look(item, -2 * direction, direction)
    expected = 0.5 * srgb_to_linear_numpy(np.array([0.5, 0.5 + 0.3 * value, 0.5]))
    np.testing.assert_allclose(seen.radiance.numpy()[:, 0], expected, rtol=1e-5)


def test_a_pose_moves_splats_with_their_views(rng) -> None:
    item = made.cloud(rng, 100)
    item = replace(
        item,
        harmonics=np.concatenate(
            [item.harmonics, rng.normal(0, 0.2, (100, 3, 3)).astype(np.float32)], 1
        ),
    )
    turn, move, scale = Rotation.random(random_state=1), np.array([1.0, -2, 3]), 2.5
    pose = Pose(turn.as_matrix(), move, scale)
    origin, directions = np.array([0.2, 0.1, 0.0]), sphere(rng, 80)
    still = look(item, origin, directions)
    moved = look(
        item, scale * turn.apply(origin) + move, turn.apply(directions), pose=pose
    )
    np.testing.assert_allclose(
        moved.radiance.numpy(), still.radiance.numpy(), atol=2e-4
    )
    np.testing.assert_allclose(
        moved.moment.numpy(), scale * still.moment.numpy(), rtol=1e-3, atol=1e-3
    )
