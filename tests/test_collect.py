"""Collection of frames with the expert's controls."""

from __future__ import annotations

import mi_nerfattack  # noqa: F401  before drjit

# isort: split
import drjit as dr
import numpy as np
import pytest
from roadside import (
    Constant,
    StateSensor,
    bent,
    flat_ground,
    kerb_scene,
    small,
    small_grid,
    straight,
)

from mi_nerfattack.deploy.mitsuba import PathTracedSensor
from mi_nerfattack.errors import InputError
from mi_nerfattack.fields.grid import GridField, GridLayout
from mi_nerfattack.policy.collect import (
    CollectSettings,
    World,
    collect,
    collect_visited,
    to_uint8,
)
from mi_nerfattack.policy.dataset import FrameDataset
from mi_nerfattack.policy.placement import Roadside, Scatter, scene_ground
from mi_nerfattack.render.camera import from_fov
from mi_nerfattack.render.posed import PosedField
from mi_nerfattack.rollout.field_sensor import FieldSensor
from mi_nerfattack.rollout.loop import to_state
from mi_nerfattack.vehicle.expert import LaneFollower

pytestmark = pytest.mark.usefixtures("variant")


@pytest.fixture
def grid(variant) -> GridField:
    return small_grid()


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


def test_images_are_rounded_to_the_nearest_level():
    values = np.array([0.0, 0.4 / 255, 0.6 / 255, 1.0, 1.2])
    np.testing.assert_array_equal(to_uint8(values), [0, 0, 1, 255, 255])
