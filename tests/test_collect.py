"""Random textures, placement, collection, closed-loop validation."""

from __future__ import annotations

import mi_nerfattack  # noqa: F401  before drjit

# isort: split

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mi_nerfattack import files
from mi_nerfattack.attack.textures import KINDS, level_resolution, random_texture
from mi_nerfattack.colour import linear_to_srgb_numpy
from mi_nerfattack.deploy.mitsuba import PathTracedSensor
from mi_nerfattack.errors import InputError
from mi_nerfattack.fields.grid import GridField, GridLayout
from mi_nerfattack.policy.adapter import AbstractPolicy
from mi_nerfattack.policy.collect import (
    CollectSettings,
    World,
    collect,
    collect_visited,
    to_uint8,
)
from mi_nerfattack.policy.dataset import FrameDataset
from mi_nerfattack.policy.evaluate import (
    EvaluateSettings,
    card_table,
    drive_routes,
    policy_card,
)
from mi_nerfattack.policy.imitate import ImitationSettings, imitate
from mi_nerfattack.policy.placement import Roadside, Scatter, scene_ground
from mi_nerfattack.policy.train import TrainSettings
from mi_nerfattack.render.camera import from_fov
from mi_nerfattack.render.march import PosedField
from mi_nerfattack.rollout.loop import to_state
from mi_nerfattack.rollout.sensor import FieldSensor, Observation
from mi_nerfattack.vehicle.expert import LaneFollower
from mi_nerfattack.vehicle.route import Route

pytestmark = pytest.mark.usefixtures("variant")

KERB_M = 0.12


def straight() -> Route:
    return Route("straight", 0, np.array([[0.0, 0.0], [20.0, 0.0], [40.0, 0.0]]))


def bent() -> Route:
    angle = np.linspace(0, np.pi / 2, 30)
    arc = np.stack([10 + 8 * np.sin(angle), 8 - 8 * np.cos(angle)], axis=1)
    return Route("left", 1, np.concatenate([[[0, 0]], arc, [[18, 30]]]))


def flat_ground(points: np.ndarray) -> np.ndarray:
    return np.zeros(len(points))


@pytest.fixture
def grid(variant) -> GridField:
    layout = GridLayout(levels=3, base_resolution=5, max_resolution=12)
    return GridField(
        layout,
        np.array([-0.2, -0.2, 0.0]),
        np.array([0.2, 0.2, 0.8]),
        density_scale=50.0,
    )


class StateSensor:
    """Paints the state into flat images, and remembers states and objects."""

    def __init__(self) -> None:
        self.objects: list[PosedField] = []
        self.states: list[np.ndarray] = []
        self.seen: list[list[PosedField]] = []

    def observe(self, state, step) -> Observation:
        states = np.array(state).T
        self.states.append(states)
        self.seen.append(list(self.objects))
        shade = np.clip(0.5 + states / 100, 0, 1)[:, None, None, :]
        image = np.broadcast_to(shade, (len(states), 66, 200, 3))
        return Observation(mi.TensorXf(np.ascontiguousarray(image, np.float32)))


class Constant(AbstractPolicy):
    """Returns one control whatever it sees."""

    def __init__(self, value: float) -> None:
        self.value = value

    def control(self, image, goal):
        return dr.opaque(mi.Float, self.value, image.shape[0])

    def vjp(self, image, goal, cotangent):
        raise AssertionError("collection needs no derivative")


def colours(field: GridField, texture: np.ndarray) -> np.ndarray:
    """sRGB colours (3, n) at random points of the field."""
    field.set_parameter("texture", texture)
    unit = np.random.default_rng(0).uniform(0, 1, (3, 4000))
    point = field.lower[:, None] + unit * (field.upper - field.lower)[:, None]
    up = mi.Vector3f(0, 0, 1)
    _, radiance = field.eval(mi.Point3f(point.astype(np.float32)), up, mi.Bool(True))
    return linear_to_srgb_numpy(radiance.numpy())


@pytest.mark.parametrize("layout", [(3, 5, 12), (1, 7, 7), (4, 16, 33)])
def test_level_resolution_is_that_of_the_encoding(layout, variant):
    field = GridField(GridLayout(*layout), -np.ones(3), np.ones(3))
    for level in range(layout[0]):
        scale = layout[1] * field.layout.growth**level - 1
        # the encoding has ceil(scale) cells along an edge, up to rounding
        cells = level_resolution(field, level) - 1
        assert scale - 1e-4 <= cells < scale + 1 + 1e-4
    assert level_resolution(field, 0) == layout[1]


@pytest.mark.parametrize("kind", KINDS)
def test_textures_cover_the_range_of_colours(grid, kind):
    all_colours = np.stack(
        [colours(grid, random_texture(grid, kind, seed)) for seed in range(40)]
    )
    low, high = np.percentile(all_colours, [5, 95])
    assert low < 0.2
    assert high > 0.8
    assert abs(all_colours.mean() - 0.5) < 0.06
    assert np.isfinite(all_colours).all()


def test_flat_texture_has_one_colour(grid):
    for seed in range(3):
        found = colours(grid, random_texture(grid, "flat", seed))
        np.testing.assert_allclose(found, found[:, :1].repeat(4000, 1), atol=2e-6)


def test_blobs_are_smoother_than_noise(grid):
    def roughness(kind: str) -> float:
        """Mean square change over 0.02 of the box, by the variance."""
        ratio = []
        for seed in range(10):
            grid.set_parameter("texture", random_texture(grid, kind, seed))
            unit = np.random.default_rng(1).uniform(0, 0.98, (3, 3000))
            values = []
            for shift in (0.0, 0.02):
                point = grid.lower[:, None] + (unit + shift) * np.array(
                    [[0.4], [0.4], [0.8]]
                )
                at = mi.Point3f(point.astype(np.float32))
                seen = grid.eval(at, mi.Vector3f(0, 0, 1), mi.Bool(True))[1]
                values.append(linear_to_srgb_numpy(seen.numpy()))
            ratio.append(
                np.mean((values[1] - values[0]) ** 2) / values[0].var(1).mean()
            )
        return float(np.mean(ratio))

    assert roughness("blobs") < 0.5 * roughness("noise")


def test_textures_depend_on_the_seed_alone(grid):
    first = random_texture(grid, "mixed", 3)
    np.testing.assert_array_equal(first, random_texture(grid, "mixed", 3))
    assert first.shape == (grid.n_vertices, 3)
    assert first.dtype == np.float32
    different = {random_texture(grid, "mixed", seed).tobytes() for seed in range(12)}
    assert len(different) == 12


def test_unknown_kind_and_negative_seed_are_refused(grid):
    with pytest.raises(InputError, match="'stripes'.*flat"):
        random_texture(grid, "stripes", 0)
    with pytest.raises(InputError, match="-1"):
        random_texture(grid, "flat", -1)


def test_scatter_has_its_deviations_and_cuts(rng):
    scatter = Scatter(close_share=0.0)
    states = scatter.states(straight(), np.full(4000, 7.0), rng)
    assert np.abs(states[:, 1]).max() <= 1.5
    assert np.abs(states[:, 2]).max() <= 0.4
    # of a normal cut at three standard deviations: 0.9867 of the deviation
    assert states[:, 1].std() == pytest.approx(0.4933, rel=0.04)
    np.testing.assert_allclose(states[:, 0], 7.0)


def test_close_states_deviate_a_fifth(rng):
    states = Scatter(close_share=1.0).states(straight(), np.full(500, 7.0), rng)
    assert np.abs(states[:, 1]).max() <= 0.3
    assert np.abs(states[:, 2]).max() <= 0.08


@pytest.mark.parametrize("route", [straight(), bent()], ids=lambda r: r.name)
def test_objects_keep_clear_of_the_lane(grid, rng, route):
    sides = []
    for _ in range(50):
        pose = Roadside().place(grid, route, (2.0, 20.0), flat_ground, rng)
        state = np.array([*pose.translation[:2], 0.0])
        (error,) = route.cross_track_numpy(state)
        radius = pose.scale * np.hypot(0.2, 0.2)
        assert abs(error) >= max(2.0, 0.9 + radius)
        assert abs(error) <= 5.01
        assert 1.0 <= pose.scale * 0.8 <= 2.5
        assert pose.translation[2] == 0
        sides.append(error > 0)
    assert 5 < sum(sides) < 45


def test_blocked_roadside_is_an_error(grid, rng):
    def nowhere(points):
        return np.full(len(points), np.nan)

    with pytest.raises(InputError, match="'straight'.*no free ground"):
        Roadside().place(grid, straight(), (2.0, 20.0), nowhere, rng)


def kerb_scene():
    """Road at z = 0 for y < 3, pavement above; a wall; nothing beyond 50 m."""

    def plate(z, y, half_y):
        to_world = mi.ScalarTransform4f().translate([0, y, z]).scale([50, half_y, 1])
        return {"type": "rectangle", "to_world": to_world}

    wall = mi.ScalarTransform4f().translate([20, 0, 1.5]).scale([0.5, 0.5, 1.5])
    return mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "direct"},
            "road": plate(0.0, 0.0, 50.0),
            "pavement": plate(KERB_M, 26.5, 23.5),
            "wall": {"type": "cube", "to_world": wall},
            "light": {"type": "constant"},
        },
        parallel=False,
    )


def test_ground_is_the_highest_low_surface(variant):
    points = np.array([[0.0, 0.0], [0.0, 10.0], [20.0, 0.0], [200.0, 0.0]])
    height = scene_ground(kerb_scene())(points)
    np.testing.assert_allclose(height, [0, KERB_M, np.nan, np.nan], atol=1e-5)


def small(**changes) -> CollectSettings:
    base = {"frames": 24, "group": 4, "groups_a_shard": 3, "seed": 5}
    return CollectSettings(**(base | changes))


def test_frames_carry_the_experts_control_and_goal(grid, tmp_path):
    sensor = StateSensor()
    world = World("surrogate", sensor, (grid,), flat_ground)
    routes = [straight(), bent()]
    shards = collect(world, routes, small(frames=120), tmp_path)
    data = FrameDataset.from_folders(shards)
    assert len(data) == 120
    states = np.concatenate(sensor.states)
    assert set(data.goals) == {0, 1}
    for route in routes:
        mine = data.goals == route.goal
        expected = LaneFollower(route).control(states[mine])
        np.testing.assert_allclose(data.controls[mine], expected, rtol=1e-6)
        arc = route.project_numpy(states[mine])[0]
        assert arc.min() > -3
        assert arc.max() < route.length + 3
    shade = np.round(255 * np.clip(0.5 + states / 100, 0, 1))
    frames = data.read_frames(np.arange(120))
    np.testing.assert_array_equal(frames[:, 30, 100], shade.astype(np.uint8))


def test_objects_come_and_go_ahead_of_the_vehicles(grid, tmp_path):
    sensor = StateSensor()
    world = World("surrogate", sensor, (grid,), flat_ground)
    own = grid.texture.numpy()
    collect(world, [straight()], small(frames=480), tmp_path)
    present = [bool(objects) for objects in sensor.seen]
    assert 0.55 < np.mean(present) < 0.95
    for objects, states in zip(sensor.seen, sensor.states, strict=True):
        for posed in objects:
            ahead = posed.pose.translation[0] - states[:, 0]
            assert 0 < ahead.min()
            assert ahead.max() < 24
    np.testing.assert_array_equal(grid.texture.numpy(), own)
    assert sensor.objects == []


def test_no_objects_when_none_are_wanted(grid, tmp_path):
    sensor = StateSensor()
    world = World("surrogate", sensor, (grid,), flat_ground)
    collect(world, [straight()], small(object_share=0.0), tmp_path / "a")
    collect(World("surrogate", sensor, (), flat_ground), [bent()], small(), tmp_path)
    assert not any(sensor.seen)


def test_interrupted_collection_continues_with_the_same_frames(grid, tmp_path):
    world = World("surrogate", StateSensor(), (grid,), flat_ground)
    whole = collect(world, [straight(), bent()], small(frames=36), tmp_path / "whole")

    def stop(done, total):
        if done == 20:
            raise KeyboardInterrupt

    for broken in (stop, lambda done, total: None):
        try:
            part = collect(
                world,
                [straight(), bent()],
                small(frames=36),
                tmp_path / "part",
                progress=broken,
            )
        except KeyboardInterrupt:
            first = tmp_path / "part" / "surrogate" / "shard_0000"
            assert (first / "shard.json").is_file()
            written = (first / "frames.npy").stat().st_mtime_ns
    assert (first / "frames.npy").stat().st_mtime_ns == written
    for one, other in zip(whole, part, strict=True):
        for name in ("frames", "goals", "controls"):
            path = f"{name}.npy"
            assert (one / path).read_bytes() == (other / path).read_bytes()


def test_folder_of_other_settings_is_refused(tmp_path):
    world = World("surrogate", StateSensor(), (), flat_ground)
    collect(world, [straight()], small(), tmp_path, origin="a")
    with pytest.raises(InputError, match="manifest.json.*origin"):
        collect(world, [straight()], small(), tmp_path, origin="b")
    with pytest.raises(InputError, match="differ in settings"):
        collect(world, [straight()], small(seed=6), tmp_path, origin="a")
    with pytest.raises(InputError, match="differ in routes"):
        collect(world, [bent()], small(), tmp_path, origin="a")


@pytest.mark.parametrize("change", [{"frames": 0}, {"object_share": 1.5}])
def test_settings_out_of_range_are_refused(change):
    with pytest.raises(InputError, match=next(iter(change))):
        CollectSettings(**change)


def compiled() -> int:
    history = dr.kernel_history((dr.KernelType.JIT,))
    return sum(not entry["cache_hit"] for entry in history)


def worlds_of(grid: GridField) -> list[World]:
    camera = from_fov(200, 66, 90.0)
    scene = kerb_scene()
    layout = GridLayout(levels=1, base_resolution=3, max_resolution=3)
    ground = GridField(layout, np.array([-60, -60, -1]), np.array([60, 60, 0.0]))
    ground.step_m = 0.5
    surrogate = FieldSensor(PosedField(ground), [], camera)
    path_traced = PathTracedSensor(scene, [], camera, spp=1)
    return [
        World("surrogate", surrogate, (grid,), scene_ground(scene)),
        World("deployment", path_traced, (grid,), scene_ground(scene)),
    ]


@pytest.mark.parametrize("index", [0, 1], ids=["surrogate", "deployment"])
def test_nothing_is_compiled_after_the_first_groups(grid, tmp_path, index):
    world = worlds_of(grid)[index]
    world.sensor.observe(to_state(np.zeros((4, 3))), 0)
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        collect(world, [straight()], small(frames=36), tmp_path / "warm")
        dr.kernel_history_clear()
        collect(world, [bent()], small(frames=36, seed=8), tmp_path / "again")
        assert compiled() == 0


def test_objects_stand_in_both_worlds_at_the_same_pixels(grid):
    """A green object before white, grey or black covers the same part of both."""
    green = np.tile(np.float32([-2, 2, -2]), (grid.n_vertices, 1))
    grid.set_parameter("texture", green)
    grid.set_parameter("density", np.full(grid.n_vertices, 1.0, np.float32))
    masks = []
    for world in worlds_of(grid):
        rng = np.random.default_rng(4)
        pose = Roadside().place(grid, straight(), (8.0, 9.0), world.ground, rng)
        state = to_state(np.zeros((1, 3)))
        without = np.array(world.sensor.observe(state, 0).image)
        world.sensor.objects = [PosedField(grid, pose)]
        with_object = np.array(world.sensor.observe(state, 0).image)
        masks.append(np.abs(with_object - without).max(-1)[0] > 0.05)
    assert masks[0].sum() > 50
    assert (masks[0] & masks[1]).sum() > 0.9 * (masks[0] | masks[1]).sum()


def test_visited_states_are_those_of_the_policy(tmp_path):
    """At a constant rate of 0.2 rad/s the vehicle drives arcs."""
    sensor = StateSensor()
    world = World("surrogate", sensor, (), flat_ground)
    settings = small(scatter=Scatter(close_share=1.0))
    shards = collect_visited(
        world, [straight()], Constant(0.2), settings, tmp_path, horizon=3
    )
    data = FrameDataset.from_folders(shards)
    assert len(data) == 24
    for start in range(0, len(sensor.states), 3):
        first, _, third = sensor.states[start : start + 3]
        np.testing.assert_allclose(third[:, 2] - first[:, 2], 0.2 * 2 * 0.1, atol=1e-6)
    drive = np.concatenate(sensor.states[:3])
    expected = LaneFollower(straight()).control(drive)
    np.testing.assert_allclose(data.controls[:12], expected, rtol=1e-5, atol=1e-6)


def test_visited_states_far_from_the_route_are_dropped(tmp_path):
    sensor = StateSensor()
    world = World("surrogate", sensor, (), flat_ground)
    shards = collect_visited(
        world, [straight()], Constant(1.4), small(), tmp_path, horizon=40
    )
    data = FrameDataset.from_folders(shards)
    assert len(data) == 24
    # at 1.4 rad/s (radius 3.6 m) a vehicle comes 7 m off the route
    states = np.concatenate(sensor.states)
    assert np.abs(states[:, 1]).max() > 4
    frames = data.read_frames(np.arange(24))[:, 0, 0, 1] / 255
    assert np.abs((frames - 0.5) * 100).max() < 2 + 100 / 255


def test_errors_of_a_straight_drive_are_the_initial_ones():
    """With control 0 the error is e0 + v t sin(psi0)."""
    settings = EvaluateSettings(runs=5, horizon=20)
    world = World("surrogate", StateSensor(), (), flat_ground)
    drives = drive_routes(Constant(0.0), [world], [straight()], settings)
    assert [drive.run for drive in drives] == list(range(5))
    for drive in drives:
        _, lateral, heading = drive.states[0]
        expected = lateral + 5.0 * drive.time_s * np.sin(heading)
        np.testing.assert_allclose(drive.cross_track_m, expected, atol=1e-6)
    laterals = [drive.states[0, 1] for drive in drives]
    assert 0.02 < np.std(laterals) < 0.3
    card = policy_card(drives, [straight()])
    figures = card["routes"]["straight"]["surrogate"]["unperturbed"]
    assert figures["n"] == 5
    errors = [np.abs(drive.cross_track_m) for drive in drives]
    assert figures["cross_track_mean_m"] == pytest.approx(np.mean(errors))
    assert card_table(card).row_count == 1


def test_validation_ends_before_the_route_does():
    settings = EvaluateSettings(margin_m=2.0)
    assert settings.steps(straight()) == 76  # (40 - 2) m at 0.5 m a step
    assert EvaluateSettings(horizon=9).steps(straight()) == 9


def test_random_objects_are_the_same_in_both_worlds(grid):
    seen, textures = [], []
    for name in ("surrogate", "deployment"):
        sensor = StateSensor()
        world = World(name, sensor, (grid,), flat_ground)
        settings = EvaluateSettings(runs=2, objects=2)
        drives = drive_routes(Constant(0.0), [world], [straight()], settings)
        cases = [(drive.case, drive.run) for drive in drives]
        assert cases[:2] == [("unperturbed", 0), ("unperturbed", 1)]
        assert cases[2:] == [("random", run) for run in range(4)]
        assert not any(sensor.seen[:76])
        assert all(sensor.seen[76:])
        seen.append([objects[0].pose.translation for objects in sensor.seen[76::76]])
        textures.append(grid.texture.numpy())
    np.testing.assert_array_equal(seen[0], seen[1])
    assert not np.array_equal(seen[0][0], seen[0][1])
    np.testing.assert_array_equal(textures[0], 0)  # its own are back


def test_images_are_rounded_to_the_nearest_level():
    values = np.array([0.0, 0.4 / 255, 0.6 / 255, 1.0, 1.2])
    np.testing.assert_array_equal(to_uint8(values), [0, 0, 1, 255, 255])


def test_imitation_runs_from_frames_to_card_and_resumes(grid, tmp_path):
    world = World("surrogate", StateSensor(), (grid,), flat_ground)
    settings = ImitationSettings(
        frames={"surrogate": 64},
        dagger_frames=32,
        dagger_rounds=1,
        dagger_epochs=1,
        collecting=small(groups_a_shard=8),
        training=TrainSettings(epochs=1, batch=32),
        validation=EvaluateSettings(runs=2, objects=0, horizon=3),
    )
    routes = [straight(), bent()]
    stages: list[str] = []

    def note(stage, done, total, state):
        assert 0 < done <= total
        if stage not in stages:
            stages.append(stage)

    first = imitate([(world, "x")], routes, settings, tmp_path, note)
    assert stages == [
        "frames, surrogate",
        "training 0",
        "round 1, surrogate",
        "training 1",
        "closed loop",
    ]
    assert [len(rows) for rows in first.history] == [1, 1]
    assert set(first.card["routes"]) == {"straight", "left"}
    files.write_json(tmp_path / "card.json", first.card)
    stages.clear()
    again = imitate([(world, "x")], routes, settings, tmp_path, note)
    assert "training 0" not in stages
    for one, other in zip(
        first.module.parameters(), again.module.parameters(), strict=True
    ):
        np.testing.assert_array_equal(one.numpy(force=True), other.numpy(force=True))
