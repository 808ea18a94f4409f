"""Collection of frames with the expert's controls."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
import torch
from support.faults.refusals import refusals
from support.reference.derivatives import nothing_compiled
from support.worlds.places import (
    BlankView,
    Grey,
    PaintedSite,
    bent,
    painted,
    small,
    straight,
    surroundings,
)

from mi_nerfattack.deploy.car import CAR, Control
from mi_nerfattack.deploy.place import Scatter, bundled_place
from mi_nerfattack.deploy.simulated import SimulatedEnvironment
from mi_nerfattack.deploy.sites import PlaceSite, Weather
from mi_nerfattack.deploy.vehicle import KinematicVehicle, Motion
from mi_nerfattack.errors import InputError
from mi_nerfattack.io import files
from mi_nerfattack.policy.pilotnet import PilotNet
from mi_nerfattack.render.camera.intrinsics import CameraMount, from_fov
from mi_nerfattack.render.camera.rig import Rig
from mi_nerfattack.system.workers import InThisProcess
from mi_nerfattack.training.collect import collect
from mi_nerfattack.training.dataset import FrameDataset, find_shards
from mi_nerfattack.training.sources import (
    ExpertDrives,
    Mixture,
    PolicyDrives,
    Scattered,
)
from mi_nerfattack.vehicle import KinematicSingleTrack
from mi_nerfattack.vehicle.expert import expert_for
from mi_nerfattack.vehicle.route.route import load_routes

pytestmark = pytest.mark.usefixtures("variant")

LOCAL, SOURCE, ROUTES = InThisProcess(), Scattered(), (straight(),)


def follower(route):
    return expert_for("rad/s", route, 0.1)


@pytest.fixture
def site() -> PaintedSite:
    return PaintedSite()


def gather(folder, site, source=SOURCE, routes=ROUTES, **changes):
    shards = collect(site, list(routes), source, small(**changes), folder, LOCAL)
    return shards, FrameDataset.from_shards(shards)


def states_of(site: PaintedSite) -> np.ndarray:
    return np.concatenate([np.stack(item.states) for item in site.opened])


def record_of(shard: Path) -> dict:
    return json.loads(files.read_safetensors(shard, ())[1]["kept.record"])


def conditions_of(shards: list[Path]) -> list[dict]:
    return [record_of(shard)["conditions"] for shard in shards]


def test_frames_carry_the_experts_control_and_goal(site, tmp_path):
    routes = [straight(), bent()]
    shards, data = gather(tmp_path, site, routes=routes, frames=120)
    assert len(data) == 120
    # the last group of a shard may be cut: only what was labelled is written
    states = states_of(site)
    assert len(states) == 120 and set(data.goals) == {0, 1}
    for route in routes:
        mine = data.goals == route.goal
        expected = follower(route).control(states[mine])
        np.testing.assert_allclose(data.controls[mine], expected, rtol=1e-6)
        arc = route.project_numpy(states[mine])[0]
        assert -3 < arc.min() and arc.max() < route.length + 3
    frames = data.read_frames(np.arange(120))
    levels = [
        conditions["level"] for conditions in conditions_of(shards) for _ in range(12)
    ]
    expected = [painted(s, Grey(k)) for s, k in zip(states, levels, strict=True)]
    np.testing.assert_array_equal(frames[:, 2, 3], expected)


def test_conditions_change_from_shard_to_shard(site, tmp_path):
    shards, _ = gather(tmp_path, site, frames=113, object_share=0.0)
    sizes = [len(FrameDataset.from_shards([shard])) for shard in shards]
    assert sizes == [12] * 9 + [5]  # the last one has the rest
    levels = [conditions["level"] for conditions in conditions_of(shards)]
    assert set(levels) == {0, 1, 2}
    # loaded only where they differ
    changes = 1 + sum(a != b for a, b in zip(levels, levels[1:], strict=False))
    assert len(site.opened) == changes
    bare = PaintedSite(objects=False)
    gather(tmp_path / "bare", bare, routes=[bent()])
    assert not any(any(item.shown) for item in (*site.opened, *bare.opened))


def test_up_to_six_objects_come_and_go_ahead_of_the_vehicles(site, tmp_path):
    shards, _ = gather(tmp_path, site, frames=160, objects=6)
    shown = [objects for item in site.opened for objects in item.shown]
    assert {len(objects) for objects in shown} == set(range(7))
    assert 0.55 < np.mean([bool(objects) for objects in shown]) < 0.95
    for objects, state in zip(shown, states_of(site), strict=True):
        for posed in objects:
            x, y, _ = posed.pose.translation
            # in view from 3 m before the group to 8 m after it, or at the route's end
            assert -6 < x - state[0] < 34
            assert abs(y) > 1.75 + 0.3 + 0.2
    counts = [record_of(shard)["objects"] for shard in shards]
    groups = sum(int(n) * times for count in counts for n, times in count.items())
    assert 4 * groups == sum(map(len, shown))


@dataclasses.dataclass(frozen=True)
class IslandSite(PaintedSite):
    """Ends where its route does, at x = 40 m, and 8 m before it begins."""

    def load_surroundings(self):
        to_world = mi.ScalarTransform4f().translate([16, 0, 0]).scale([24, 50, 1])
        ground = {"type": "rectangle", "to_world": to_world}
        scene = mi.load_dict({"type": "scene", "ground": ground})
        return surroundings(straight(), scene=scene)


def test_no_ground_is_wanted_beyond_a_routes_end(tmp_path):
    """Near the end objects stand before it, or there are fewer."""
    site = IslandSite()
    gather(tmp_path, site, frames=96, object_share=1.0)
    shown = [objects for item in site.opened for objects in item.shown]
    late = [o for o, s in zip(shown, states_of(site), strict=True) if s[0] > 36]
    assert late and all(late)
    ends = [posed.pose.translation[0] for objects in shown for posed in objects]
    assert 30 < max(ends) < 40


def test_expert_drives_recover(site, tmp_path):
    """From 1 m beside the lane the expert comes back within 16 periods (8 m)."""
    scatter = Scatter(lateral_sd_m=0.8, heading_sd=0.01, close_share=0.0)
    options = {"frames": 64, "shard": 64, "object_share": 0.0}
    gather(tmp_path, site, ExpertDrives(16), scatter=scatter, **options)
    (environment,) = site.opened
    drives = np.split(np.stack(environment.states), environment.starts[1:])
    error = np.abs([(drive[0, 1], drive[15, 1]) for drive in drives if len(drive) > 15])
    assert error[:, 0].max() > 0.5
    assert error[:, 1].max() < 0.3 * error[:, 0].max()


@pytest.fixture
def weights(tmp_path) -> Path:
    """A policy that always gives 0.2 rad/s."""
    module = PilotNet(2)
    torch.nn.init.zeros_(module.head[-1].weight)
    torch.nn.init.constant_(module.head[-1].bias, np.arctanh(0.2 / 1.5))
    module.save(tmp_path / "constant.safetensors")
    return tmp_path / "constant.safetensors"


def test_visited_states_are_those_of_the_policy(weights, tmp_path):
    """At a constant rate of 0.2 rad/s the vehicle drives arcs."""
    site, options = PaintedSite(size_px=(200, 66)), {"frames": 12, "margin_m": -8.0}
    drives, scatter = PolicyDrives(weights, horizon=3), Scatter(close_share=1.0)
    _, data = gather(tmp_path, site, drives, scatter=scatter, **options)
    (environment,) = site.opened
    for start in environment.starts:
        first, second = environment.states[start : start + 2]
        assert second[2] - first[2] == pytest.approx(0.02, abs=1e-6)
    expected = follower(straight()).control(np.stack(environment.states))
    np.testing.assert_allclose(data.controls, expected, rtol=1e-5, atol=1e-6)


def test_the_expert_drives_its_share_of_the_periods(weights, tmp_path):
    site = PaintedSite(size_px=(200, 66), objects=False)
    drives = PolicyDrives(weights, horizon=8, expert_share=0.5)
    gather(tmp_path, site, drives, frames=200, shard=200)
    (environment,) = site.opened
    turn = np.diff(np.stack(environment.states)[:, 2])
    same = np.setdiff1d(np.arange(len(turn)), np.array(environment.starts) - 1)
    assert 0.35 < np.isclose(turn[same], 0.02, atol=1e-6).mean() < 0.65


def test_drives_end_where_the_vehicle_has_strayed(weights, tmp_path):
    """0.6 lane widths off, frames teach nothing any more."""
    site = PaintedSite(size_px=(200, 66), objects=False)
    _, data = gather(tmp_path, site, PolicyDrives(weights, horizon=60))
    lateral = 0.2 * (data.read_frames(np.arange(24))[:, 0, 0, 1] - 128.0)
    assert np.abs(lateral).max() < 0.6 * 3.5 + 0.5  # grey levels of 0.2 m, up to 2
    assert max(np.diff(site.opened[0].starts)) < 60


def test_a_mixture_takes_from_all_its_sources(site, tmp_path):
    mixture = Mixture((Scattered(), ExpertDrives(3)), (0.5, 0.5))
    gather(tmp_path, site, mixture, frames=240, shard=240)
    lengths = np.diff(site.opened[0].starts)
    assert {1, 3} <= set(lengths) <= {1, 2, 3}  # 2: past the route's end


test_refused = refusals(
    (lambda: Mixture((Scattered(),), (0.5, 0.5)), "one positive share a source"),
    (lambda: Weather(("day",), (0.0, float("nan"))), "exposure_ev: nan"),
    (lambda: Weather(("dusk",)), "sky: 'dusk'"),
    (lambda: bundled_site("moon"), "environment: 'moon'; one of surrogate"),
    (find_shards, "no frames"),
)


@pytest.mark.parametrize(
    ("key", "changes"),
    [
        ("settings.seed: [0-9]+ -> 6", {"seed": 6}),
        ("routes", {"routes": [bent()]}),
        ("routes", {"routes": [dataclasses.replace(straight(), lane_width_m=3.0)]}),
        ("site", {"site": PaintedSite(size_px=(4, 4))}),
        ("source", {"source": ExpertDrives(3)}),
    ],
)
def test_folder_of_other_settings_is_refused(tmp_path, key, changes):
    """A shard is enough, whichever it is."""
    gather(tmp_path, PaintedSite())[0][0].unlink()
    with pytest.raises(InputError, match=rf"shard_0001.*\n(.*\n)*  {key}"):
        gather(tmp_path, **{"site": PaintedSite(), **changes})


def bundled_site(name: str, **changes) -> PlaceSite:
    place = bundled_place("intersection")
    place = dataclasses.replace(place, camera=from_fov(24, 8, 90.0))
    return PlaceSite(name, place, Weather(spp=1, **changes))


@pytest.mark.parametrize(
    "name", ["surrogate", pytest.param("mitsuba", marks=pytest.mark.slow)]
)
def test_nothing_is_compiled_after_the_first_shard(name, tmp_path):
    site = bundled_site(name)
    options = {"routes": load_routes(site.place.routes), "frames": 24, "shard": 24}
    gather(tmp_path / "warm", site, **options)
    with nothing_compiled():
        gather(tmp_path / "again", site, **options)


def test_shards_of_a_place_have_their_light(tmp_path):
    site = bundled_site("mitsuba", skies=("noon",), exposures_ev=(-2.0, 2.0))
    options = {"routes": load_routes(site.place.routes), "object_share": 0.0}
    shards, data = gather(tmp_path, site, frames=24, shard=4, **options)
    means: dict[float, list[float]] = {-2.0: [], 2.0: []}
    for number, conditions in enumerate(conditions_of(shards)):
        frames = data.read_frames(np.arange(4) + 4 * number)
        means[conditions["exposure_ev"]].append(frames.mean())
    assert max(means[-2.0]) < min(means[2.0]) - 30


@dataclasses.dataclass(frozen=True)
class AcceleratedSite(PaintedSite):
    """A car with steering and acceleration, whose model drives."""

    @property
    def car(self):
        controls = (Control("acceleration", "m/s^2", -8.0, 3.0),)
        limits = {"control_unit": "rad", "max_control": 0.6, "more_controls": controls}
        return dataclasses.replace(CAR, **limits)

    def open(self, conditions):
        car, motion = self.car, Motion(KinematicSingleTrack())
        limits = car.max_control, car.control_unit, car.more_controls
        vehicle = KinematicVehicle(motion, self.period, *limits)
        view = BlankView()
        rig = Rig.of_one(view.camera, CameraMount())
        return SimulatedEnvironment("blank", vehicle, [view], rig, self.period)


def test_frames_of_a_car_with_two_controls_have_both(tmp_path):
    """The expert's, in the order of the controls; the car keeps its speed."""
    made = AcceleratedSite(objects=False)
    source = ExpertDrives(4)
    _, data = gather(tmp_path, made, source, frames=8, shard=8, object_share=0.0)
    assert data.controls.shape == (8, 2) and data.controls[:, 0].any()
    np.testing.assert_allclose(data.controls[:, 1], 0, atol=0.02)
