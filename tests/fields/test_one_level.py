"""Grid fields as one level: its values, its derivatives, attacks that march it."""

from __future__ import annotations

from contextlib import nullcontext

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from support.reference.derivatives import central_difference
from support.worlds import loops as toy

from mi_nerfattack.attack.base import Freedom, offset_gradients
from mi_nerfattack.attack.gradient import GradientAttack
from mi_nerfattack.attack.texture.colours import AbstractColouring
from mi_nerfattack.backend.determinism import deterministic
from mi_nerfattack.deploy.surrogate.scene import field_sensor
from mi_nerfattack.errors import InputError
from mi_nerfattack.fields import GridField, GridLayout, load_grid
from mi_nerfattack.fields.one_level import FEWEST
from mi_nerfattack.fields.vertex_colours import gradient, tangents
from mi_nerfattack.render.camera.intrinsics import CameraMount, from_fov
from mi_nerfattack.render.camera.pose import Pose
from mi_nerfattack.render.posed import PosedField
from mi_nerfattack.scenes import bundled
from mi_nerfattack.vehicle.dynamics import to_state

pytestmark = pytest.mark.usefixtures("variant")


@pytest.fixture
def field(rng) -> GridField:
    layout = GridLayout(3, 5, 12)
    return GridField(
        layout,
        np.zeros(3),
        np.ones(3),
        rng.normal(size=layout.n_vertices),
        rng.normal(size=(layout.n_vertices, 3)),
    )


def at(field: GridField, points: np.ndarray) -> np.ndarray:
    """Return density and colours (n, 4) at points of the unit cube, which is its."""
    direction, active = mi.Vector3f(0, 0, 1), mi.Bool(True)
    density, colour = field.eval_everywhere(mi.Point3f(points.T), direction, active)
    return np.stack([density.numpy(), *colour.numpy()], 1)


def test_it_is_the_field_at_the_vertices_of_the_lattice(field, rng):
    count = 11 * -(-FEWEST // 11)  # cells along an edge
    points = rng.integers(0, count, (500, 3)) / count
    exact = at(field, points)
    with field.one_level(field.levels()[-1]):
        np.testing.assert_allclose(at(field, points), exact, rtol=1e-3, atol=1e-5)
    np.testing.assert_array_equal(at(field, points), exact)


@pytest.mark.parametrize(("stepped", "changed"), [(-1, [-1]), (1, [1]), (-1, [0, -1])])
def test_a_new_texture_counts_at_once(field, rng, stepped, changed):
    """Whether levels are added up again or not."""
    points, levels = rng.random((500, 3)), field.levels()
    texture = field.texture.numpy().copy()
    with field.one_level(levels[stepped]):
        for level in changed:
            shape = texture[levels[level].vertices].shape
            texture[levels[level].vertices] += rng.normal(size=shape)
        field.set_parameter("texture", texture)
        actual = at(field, points)
    fresh = again(field)
    with fresh.one_level(levels[-1]):
        np.testing.assert_allclose(actual, at(fresh, points), atol=2e-5)
    np.testing.assert_array_equal(at(field, points), at(fresh, points))


def again(field: GridField) -> GridField:
    """Make another field of the same numbers."""
    density = field.parameters()["density"]
    arrays = field.lower, field.upper, density, field.texture
    return GridField(field.layout, *arrays)


@pytest.mark.parametrize("changed", [[-1, -1], [-1, 0]])
def test_colours_of_vertices_follow_a_new_texture(field, rng, changed):
    """Whether levels are added up again or not."""
    texture, colours = field.texture.numpy().copy(), field.colours
    for level in changed:
        vertices = field.levels()[level].vertices
        texture[vertices] += rng.normal(size=texture[vertices].shape)
        field.set_parameter("texture", texture)
    expected = again(field).colours.value.numpy()
    np.testing.assert_allclose(colours.value.numpy(), expected, atol=5e-5)


@pytest.mark.parametrize("stepped", [-1, 1])
def test_the_gradient_is_the_transpose(field, rng, stepped):
    level, texture = field.levels()[stepped], field.texture.numpy().copy()
    change = np.zeros_like(texture)
    change[level.vertices] = rng.normal(size=change[level.vertices].shape)
    with field.one_level(level):
        before = field.packed.numpy().astype(float)
        weights = rng.normal(size=before.size).astype(np.float32)
        derivative = field.texture_gradient(mi.Float(weights)).numpy()
        field.set_parameter("texture", texture + change)
        moved = field.packed.numpy() - before
    inside = np.zeros(len(texture), bool)
    inside[level.vertices] = True
    assert np.isnan(derivative[~inside]).all()
    assert np.vdot(derivative[inside], change[inside]) == pytest.approx(
        moved @ weights, rel=1e-4
    )


def test_drives_differentiate_what_they_march():
    loop, item = toy.make_loop()
    rollout = toy.make_rollout(loop, 4, attached=True)
    level, base = item.levels()[-1], toy.texture_of(item)
    (posed,) = loop.sensor.objects
    with item.one_level(level):
        gradients = toy.gradient(rollout, extra_keys=loop.sensor.pose_keys)
        by_texture = gradients.textures[0].numpy()[level.vertices].astype(float)
        direction = toy.unit(by_texture)

        def of_texture(s):
            texture = base.copy()
            texture[level.vertices] += s * direction
            loop.sensor.set_textures([mi.TensorXf(texture)])
            return toy.objective(rollout)

        def of_pose(s):
            posed.move(s * np.eye(6)[0])
            return toy.objective(rollout)

        expected = pytest.approx(np.linalg.norm(by_texture), rel=1e-3)
        assert central_difference(of_texture, 0.2) == expected
        loop.sensor.set_textures([mi.TensorXf(base)])
        by_shift = offset_gradients(loop.sensor, gradients)[0, 0]
        # samples that cross the faces of cells cost accuracy, with all levels, too
        expected = pytest.approx(by_shift, rel=2e-2)
        assert central_difference(of_pose, 2e-3) == expected


def test_an_attack_leaves_the_field_as_it_is_saved():
    objectives = {}
    for one_level in (False, True):
        loop, item = toy.make_loop()
        rollout, initial = toy.make_rollout(loop, 3), loop.initial(toy.INITIAL)
        problem = rollout, toy.ROUTE, initial, Freedom(0.1)
        attack = GradientAttack(*problem, one_level=one_level)
        values = [attack.step().objective for _ in range(3)]
        attack.finish()
        assert dr.width(item.packed) == 4 * item.n_vertices
        value = rollout.measure(initial).value
        assert attack.judged_objective == pytest.approx(value, rel=1e-6)
        objectives[one_level] = values, value
    (exact, judged), (near, near_judged) = objectives[False], objectives[True]
    assert near != exact
    np.testing.assert_allclose(near, exact, rtol=0.02)
    assert near[-1] < near[0] and near_judged == pytest.approx(judged, rel=0.02)


def small_attack() -> GradientAttack:
    loop, _ = toy.make_loop()
    rollout, initial = toy.make_rollout(loop, 3), loop.initial(toy.INITIAL)
    return GradientAttack(rollout, toy.ROUTE, initial, Freedom(0.1), one_level=True)


def test_an_attack_goes_on_to_the_same_bits():
    with deterministic():
        uninterrupted, first, second = small_attack(), small_attack(), small_attack()
        for attack, steps in ((uninterrupted, 4), (first, 2), (second, 2)):
            if attack is second:
                attack.load_tensors(first.tensors())
            for _ in range(steps):
                attack.step()
    expected = uninterrupted.tensors()
    for key, value in second.tensors().items():
        np.testing.assert_array_equal(value, expected[key], key)


def test_what_it_has_no_derivative_by_is_refused(field):
    class Own(AbstractColouring):
        start = np.zeros((1, 3), np.float32)

        texture = gradient = lambda self, *values: None

    loop, _ = toy.make_loop()
    problem = (
        toy.ROUTE,
        loop.initial(toy.INITIAL),
        Freedom(0.1, colouring=lambda _: Own()),
    )
    with field.one_level(field.levels()[-1]):
        with pytest.raises(InputError, match="density: .*one level"):
            field.set_parameter("density", field.parameters()["density"])
        with pytest.raises(InputError, match="density: .*one level"):
            gradient(field, "density")
        with pytest.raises(InputError, match="occupy: .*one level"):
            field.occupy(field.occupancy)
        attached = mi.TensorXf(field.texture)
        dr.enable_grad(attached)
        with pytest.raises(InputError, match="texture: .*one level"):
            field.set_parameter("texture", attached)
        with (
            pytest.raises(InputError, match="forward mode: .*one level"),
            tangents(field),
        ):
            pass
    with pytest.raises(InputError, match="one_level: Own may step in all levels"):
        GradientAttack(toy.make_rollout(loop, 3), *problem, one_level=True)


@pytest.mark.parametrize(
    ("name", "least"), [("hydrant", 45), ("cube", 60), ("car", 38)]
)
def test_bundled_objects_look_alike(name, least):
    """From around them: decibels on their own pixels, and 45 on whole views."""
    field = load_grid(bundled(f"{name}/field.safetensors"))
    camera, squares, shown = from_fov(96, 72, 40.0), [], []
    size = float((field.upper - field.lower).max())
    mount = CameraMount(height_m=0.5 * size, pitch_deg=0.0)
    for turn in np.arange(6) * 60.0:
        posed = PosedField(field, Pose.upright((2.0 * size, 0, 0), np.radians(turn)))
        sensor, images = field_sensor([], [posed], camera, mount), []
        for context in (nullcontext(), field.one_level(field.levels()[-1])):
            with context:
                observation = sensor.observe(to_state(np.zeros((1, 3))), 0)
                images.append(observation.image.numpy()[0].copy())
        squares.append(np.square(images[1] - images[0]).mean(-1))
        shown.append(images[0].sum(-1) > 0.01)
    error, own = np.array(squares), np.array(shown)
    assert own.mean() > 0.1
    assert -10 * np.log10(error[own].mean()) >= least
    assert -10 * np.log10(error.mean()) >= 45
