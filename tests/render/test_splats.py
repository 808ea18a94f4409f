"""What rays see of splats, against closed formulas and a float64 reference."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.files import objects as made
from support.reference.derivatives import central_difference, nothing_compiled
from support.worlds import fields as small
from support.worlds import loops as toy
from support.worlds.loops import along_texture, make_rollout, texture_gradient, unit

from mi_nerfattack.backend.colour import srgb_to_linear_numpy
from mi_nerfattack.deploy.surrogate.scene import field_sensor
from mi_nerfattack.errors import InputError
from mi_nerfattack.fields.splats import Splats
from mi_nerfattack.render.camera.pose import Pose
from mi_nerfattack.render.composite import DepthComposite
from mi_nerfattack.render.interleaved import InterleavedComposite
from mi_nerfattack.render.posed import PosedField
from mi_nerfattack.render.rays import March, Rays
from mi_nerfattack.render.splatting.background import SplatBackground
from mi_nerfattack.rollout.function import Rollout
from mi_nerfattack.rollout.objective import StageSum
from mi_nerfattack.vehicle.dynamics import to_state

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
    integrals = look(item, origins)
    squared = (origins[:, 1] / 0.2) ** 2 + (origins[:, 2] / 0.1) ** 2
    opacity = np.where(squared <= 9, 0.7 * np.exp(-squared / 2), 0)
    np.testing.assert_allclose(integrals.opacity.numpy(), opacity, atol=2e-6)
    expected = opacity[:, None] * srgb_to_linear_numpy(RED)
    np.testing.assert_allclose(integrals.radiance.numpy().T, expected, atol=2e-6)
    depth = np.where(opacity > 0, distance, np.inf)
    np.testing.assert_allclose(integrals.depth.numpy(), depth, rtol=1e-5)


@pytest.mark.parametrize(
    ("far", "size"), [(5.0, 0.1), (9.0, 2.5)], ids=["small", "its shell begins first"]
)
@pytest.mark.parametrize("order", [1, -1])
def test_two_along_a_ray_blend_in_srgb_front_to_back(far, size, order: int) -> None:
    rows = [([2.0, 0, 0], RED, 0.6, 0.1), ([far, 0, 0], BLUE, 0.3, size)][::order]
    integrals = look(made.splats(*map(list, zip(*rows, strict=True))))
    first, second = 0.6, 0.4 * 0.3
    assert float(integrals.opacity[0]) == pytest.approx(first + second, rel=1e-5)
    assert float(integrals.moment[0]) == pytest.approx(
        2 * first + far * second, rel=1e-5
    )
    expected = linear(first * RED + second * BLUE, np.array(first + second))
    np.testing.assert_allclose(integrals.radiance.numpy()[:, 0], expected, rtol=1e-5)


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
    integrals = look(item, origin, directions, t_max)
    np.testing.assert_allclose(integrals.opacity.numpy(), opacity, atol=1e-5)
    np.testing.assert_allclose(integrals.moment.numpy(), moment, atol=1e-4)
    expected = linear(display, opacity)
    np.testing.assert_allclose(integrals.radiance.numpy().T, expected, atol=1e-5)


def test_small_and_thin_splats_far_away_are_not_missed(rng) -> None:
    """Mitsuba's intersection alone loses half of them in metres."""
    sizes = rng.uniform(0.008, 0.012, (300, 3)) * [1, 1, 0.03]
    places = rng.normal(0, 0.05, (300, 3)) + [20, 0, 0]
    item = made.splats(places, RED, 0.3, sizes, rng.normal(size=(300, 4)))
    aims = np.array([20, 0, 0]) + rng.normal(0, 0.04, (200, 3))
    directions = (aims / np.linalg.norm(aims, axis=1)[:, None]).astype(np.float32)
    _, opacity, moment = made.reference(item, np.zeros(3), directions)
    assert np.median(opacity) > 0.5
    integrals = look(item, directions=directions)
    for actual, expected, scale in (
        (integrals.opacity, opacity, 1),
        (integrals.moment, moment, 20),
    ):
        error = np.abs(actual.numpy() - expected) / scale
        assert np.quantile(error, 0.97) < 1e-4  # now and then two are entered as one
        assert error.max() < 0.02


@pytest.mark.parametrize(("count", "each"), [(3, 40), (3, 1), (90, 40)])
def test_rays_may_come_from_many_origins(rng, count: int, each: int) -> None:
    """Vehicles side by side, or places in the aperture of a lens."""
    item = made.cloud(rng, 300)
    origins = rng.uniform(-0.4, 0.4, (count, 3)).astype(np.float32) + [-6, 0, 0]
    aims = np.array([3, 0, 0]) + rng.normal(0, 0.4, (count, each, 3))
    aims = (aims / np.linalg.norm(aims, axis=2)[..., None]).astype(np.float32)
    integrals = look(item, np.repeat(origins, each, 0), aims.reshape(-1, 3))
    sums = integrals.opacity.numpy().reshape(count, each), integrals.moment.numpy()
    for k, (origin, directions) in enumerate(zip(origins, aims, strict=True)):
        _, opacity, moment = made.reference(item, origin, directions)
        np.testing.assert_allclose(sums[0][k], opacity, atol=1e-5)
        np.testing.assert_allclose(sums[1].reshape(count, each)[k], moment, atol=2e-4)


def test_many_along_a_ray_are_sorted_by_depth(rng) -> None:
    places = rng.permutation(np.linspace(0.5, 60, 300))[:, None] * [1, 0, 0]
    sizes = rng.uniform(0.02, 0.2, 300)
    item = made.splats(places, rng.random((300, 3)), 0.02, sizes)
    # against their order in memory
    ray = np.array([61.0, 0, 0]), np.array([[-1.0, 0, 0]])
    display, opacity, moment = made.reference(item, *ray)
    integrals = look(item, *ray)
    assert float(integrals.opacity[0]) == pytest.approx(opacity[0], rel=1e-4)
    assert float(integrals.moment[0]) == pytest.approx(moment[0], rel=1e-4)
    expected = linear(display, opacity)
    np.testing.assert_allclose(integrals.radiance.numpy().T, expected, rtol=1e-4)


def test_rays_end_where_little_is_passed_or_nothing_is_met() -> None:
    item = made.splats([[2, 0, 0], [2, 0, 0], [4, 0, 0]], RED, 0.9)
    assert float(look(item, stop=0.05).opacity[0]) == pytest.approx(0.99, rel=1e-5)
    assert float(look(item).opacity[0]) == pytest.approx(0.999, rel=1e-5)
    integrals = look(item, directions=[[-1, 0, 0], [0, 1, 0]])
    assert not integrals.opacity.numpy().any() and not integrals.radiance.numpy().any()
    assert np.isinf(integrals.depth.numpy()).all()
    rays = Rays(mi.Point3f(0), mi.Vector3f(1, 0, 0), active=mi.Bool(False))
    assert float(SplatBackground(item).march(rays, 0.0).opacity[0]) == 0


# Colour and pose


@pytest.mark.parametrize("degree", [1, 2, 3])
def test_colour_turns_with_the_view(rng, degree: int) -> None:
    """By the polynomials of degree 1 and of the last harmonic of the others."""
    harmonics = np.zeros((1, (degree + 1) ** 2 - 1, 3))
    harmonics[0, -1, 1] = 0.3
    x, y, z = direction = sphere(rng, 1)[0].astype(float)
    value = {
        1: 0.3 * -x,
        2: 0.3 * np.sqrt(15 / (16 * np.pi)) * (x * x - y * y),
        3: 0.3 * -np.sqrt(35 / (32 * np.pi)) * x * (x * x - 3 * y * y),
    }[degree]
    if degree == 1:
        harmonics[0, :2, 1] = 0.1, 0.2
        value = np.sqrt(3 / (4 * np.pi)) * (value - 0.1 * y + 0.2 * z)
    item = made.splats([0, 0, 0], (0.5, 0.4, 0.3), 0.5, bands=harmonics)
    integrals = look(item, -2 * direction, direction)
    expected = 0.5 * srgb_to_linear_numpy(np.array([0.5, 0.4 + value, 0.3]))
    np.testing.assert_allclose(integrals.radiance.numpy()[:, 0], expected, rtol=1e-5)


def test_a_pose_moves_splats_with_their_views(rng) -> None:
    item = made.cloud(rng, 100)
    of_views = rng.normal(0, 0.2, (100, 3, 3)).astype(np.float32)
    item = replace(item, harmonics=np.concatenate([item.harmonics, of_views], 1))
    turn, move, scale = Rotation.random(random_state=1), np.array([1.0, -2, 3]), 2.5
    pose = Pose(turn.as_matrix(), move, scale)
    origin, directions = np.array([0.2, 0.1, 0.0]), sphere(rng, 80)
    still = look(item, origin, directions)
    turned = scale * turn.apply(origin) + move, turn.apply(directions)
    moved = look(item, *turned, pose=pose)
    pair = moved.radiance.numpy(), still.radiance.numpy()
    np.testing.assert_allclose(*pair, atol=2e-4)
    pair = moved.moment.numpy(), scale * still.moment.numpy()
    np.testing.assert_allclose(*pair, rtol=1e-3, atol=1e-3)


# Among fields


@pytest.mark.parametrize("x", [2, 9])
def test_a_splat_hides_and_is_hidden_by_depth(x: float) -> None:
    """A splat before or behind a cube of edge 2 at x = 5."""
    cube = PosedField(small.homogeneous(0.7, 0.3), Pose.upright((5, 0, 0), 0.0))
    rays = Rays(mi.Point3f(0, 0, 0), mi.Vector3f(1, 0, 0))
    dr.make_opaque(rays)
    layers = [SplatBackground(made.splats([x, 0, 0], RED, 0.6)), cube]
    primal = DepthComposite().render(layers, rays, 0.0)
    splat = 0.6, srgb_to_linear_numpy(RED), x
    grey = np.full(3, small.sigmoid_to_linear(np.array(0.3)))
    slab = 1 - np.exp(-1.4), grey, float(primal.layers[1].depth[0])
    (a, front, near), (b, back, far) = (splat, slab) if x < 5 else (slab, splat)
    expected = a * front + (1 - a) * b * back
    np.testing.assert_allclose(primal.total.radiance.numpy()[:, 0], expected, rtol=2e-4)
    assert float(primal.total.opacity[0]) == pytest.approx(a + (1 - a) * b, rel=2e-4)
    moment = a * near + (1 - a) * b * far
    assert float(primal.total.moment[0]) == pytest.approx(moment, rel=2e-4)


# Derivatives


class Derived:
    """A cloud of 60 splats, its rays, and the derivatives of a random objective."""

    def __init__(self, rng: np.random.Generator) -> None:
        self.item, n = made.cloud(rng, 60), 200
        aims = np.array([3, 0, 0]) + rng.normal(0, 0.3, (n, 3))
        aims /= np.linalg.norm(aims, axis=1)[:, None]
        self.origin, self.directions = np.array([-6, 0.1, 0.2]), aims.astype(np.float32)
        self.rays = Rays(mi.Point3f(self.origin), mi.Vector3f(self.directions.T))
        self.cotangent = small.random_march(rng, n)
        self.splats = SplatBackground(self.item)
        self.primal = self.splats.march(self.rays, 0.0)
        self.values = {"harmonics": self.splats.harmonics, "opacity": None}
        self.values["opacity"] = self.splats.opacity
        dr.enable_grad(self.splats.harmonics, self.splats.opacity)

    def derive(self, mode: dr.ADMode, cotangent: March) -> Any:
        args = self.rays, self.primal, cotangent, 0.0, mode == dr.ADMode.Backward
        return self.splats.derivative(mode, *args)

    def expected(self, origin=0.0, directions=0.0, **changes: Any) -> np.ndarray:
        """Return the objective in float64, ray by ray."""
        item = replace(self.item, **changes)
        where = self.origin + origin, self.directions + directions
        display, opacity, moment = made.reference(item, *where)
        by = [self.cotangent.radiance.numpy().T.astype(float)]
        by += [
            x.numpy().astype(float)
            for x in (self.cotangent.opacity, self.cotangent.moment)
        ]
        colour = (linear(display, opacity) * by[0]).sum(1)
        return colour + opacity * by[1] + moment * by[2]


@pytest.fixture
def derived(rng) -> Derived:
    return Derived(rng)


def agree(actual: np.ndarray, expected: np.ndarray) -> None:
    assert np.linalg.norm(actual - expected) < 1e-4 * np.linalg.norm(expected)


STEP = 1e-6  # of differences in float64


@pytest.mark.parametrize("name", ["harmonics", "opacity"])
def test_derivatives_by_shades_are_those_of_the_float64_sum(derived, name) -> None:
    derived.derive(dr.ADMode.Backward, derived.cotangent)
    gradient = dr.grad(derived.values[name]).numpy()
    key = {"opacity": "opacities"}.get(name, name)
    values = getattr(derived.item, key).astype(float)
    expected = []
    for k in range(values.size):
        pair = []
        for step in (STEP, -STEP):
            changed = values.copy()
            changed.flat[k] += step
            pair.append(derived.expected(**{key: changed}).sum())
        expected.append((pair[0] - pair[1]) / (2 * STEP))
    agree(gradient, np.array(expected))


@pytest.mark.parametrize("name", ["origin", "direction"])
def test_derivatives_by_rays_are_those_of_the_float64_sum(derived, name) -> None:
    _, by_rays = derived.derive(dr.ADMode.Backward, derived.cotangent)
    gradient = getattr(by_rays, name).numpy()
    key = {"direction": "directions"}.get(name, name)
    for axis in range(3):
        step = STEP * np.eye(3)[axis]
        pair = [derived.expected(**{key: sign * step}) for sign in (1, -1)]
        agree(gradient[axis], (pair[0] - pair[1]) / (2 * STEP))


def test_derivatives_by_rays_are_0_unless_asked_for(derived) -> None:
    _, by_rays = derived.splats.derivative(
        dr.ADMode.Backward, derived.rays, derived.primal, derived.cotangent, stop=0.0
    )
    assert not by_rays.origin.numpy().any() and not by_rays.direction.numpy().any()


def test_tangents_are_the_transpose(derived, rng) -> None:
    derived.derive(dr.ADMode.Backward, derived.cotangent)
    expected = 0.0
    for value in derived.values.values():
        tangent = rng.normal(size=dr.width(value)).astype(np.float32)
        expected += float(tangent.astype(float) @ dr.grad(value).numpy())
        dr.set_grad(value, mi.Float(tangent))
    tangent, _ = derived.derive(dr.ADMode.Forward, March())
    assert small.pairing(tangent, derived.cotangent) == pytest.approx(expected, 1e-4)


def test_colours_that_change_with_the_view_move_with_the_origin(rng) -> None:
    harmonics = rng.normal(0, 0.2, (4, 3, 3))
    centers = [[8, 0.3, 0.1], [10, -0.2, 0.2], [12, 0, -0.3], [14, 0.1, 0]]
    item = SplatBackground(made.splats(centers, 0.5, 0.5, 3.0, bands=harmonics))
    aims = [[10, y, z] for y in (-0.5, 0.5) for z in (-0.5, 0.5)]
    directions = np.array(aims) / np.linalg.norm(aims, axis=1)[:, None]
    cotangent = small.random_march(rng, 4)

    def rays(x: np.ndarray) -> Rays:
        return Rays(mi.Point3f(x), mi.Vector3f(directions.T.astype(np.float32)))

    primal = item.march(rays(np.zeros(3)), 0.0)
    args = rays(np.zeros(3)), primal, cotangent, 0.0, True
    _, by_rays = item.derivative(dr.ADMode.Backward, *args)
    for axis in range(3):
        step = 0.02 * np.eye(3)[axis]
        pair = [item.march(rays(sign * step), 0.0) for sign in (1, -1)]
        expected = small.pairing(pair[0], cotangent) - small.pairing(pair[1], cotangent)
        by_origin = float(dr.sum(by_rays.origin[axis])[0])
        assert by_origin == pytest.approx(25 * expected, rel=5e-3, abs=1e-3)


@pytest.fixture
def loop() -> Any:
    """The toy loop among splats."""
    loop, _ = toy.make_loop()
    rng = np.random.default_rng(3)
    places = rng.uniform([2, -6, 0], [20, 6, 4], (200, 3))
    street = made.splats(places, rng.random((200, 3)), 0.5, rng.uniform(0.1, 0.8, 200))
    old = loop.sensor
    view = old.intrinsics, old.mount
    sensor = field_sensor(SplatBackground(street), old.objects, *view, stop=0.0)
    return replace(loop, sensor=sensor)


def test_nothing_is_compiled_after_the_first_steps(loop) -> None:
    start = np.array([[0.0, 0.35, 0.02]])
    rollout = Rollout(loop, StageSum(toy.square_error), 3)
    rollout.gradient(rollout.run(to_state(start)))
    with nothing_compiled():
        rollout.gradient(rollout.run(to_state(start + 0.07)))


def test_a_gradient_goes_through_a_camera_among_splats(loop) -> None:
    """Steering turns what the next frame shows, splats too; held cameras miss that."""
    (posed,) = loop.sensor.objects
    rollout = make_rollout(loop, 10, attached=True)
    gradient = texture_gradient(rollout)
    direction = unit(gradient)
    expected = central_difference(along_texture(rollout, posed.field, direction), 0.2)
    assert float((gradient * direction).sum()) == pytest.approx(expected, rel=0.01)
    held = texture_gradient(make_rollout(loop, 10))
    assert float((held * direction).sum()) != pytest.approx(expected, rel=0.03)


def test_splats_are_not_interleaved(loop) -> None:
    sensor, composite = loop.sensor, InterleavedComposite()
    rays = Rays(mi.Point3f(0, 0, 0), mi.Vector3f(1, 0, 0))
    arguments = sensor.layers[:1], sensor.objects, sensor.intrinsics
    for call in (
        lambda: composite.check(sensor.layers),
        lambda: composite.render(sensor.layers, rays, 0.0),
        lambda: field_sensor(*arguments, composite="interleaved"),
    ):
        with pytest.raises(InputError, match="set composite to depth"):
            call()
