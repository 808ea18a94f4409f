"""Collection of frames with the expert's controls."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
import torch
from helpers.kernels import nothing_compiled
from helpers.roadside import (
    Grey,
    PaintedSite,
    bent,
    painted,
    small,
    straight,
    surroundings,
)

from mi_nerfattack.deploy.place import Place
from mi_nerfattack.deploy.scatter import Scatter
from mi_nerfattack.deploy.sites import PlaceSite, Weather
from mi_nerfattack.errors import InputError
from mi_nerfattack.io import files
from mi_nerfattack.policy.pilotnet import PilotNet
from mi_nerfattack.render.camera.intrinsics import CameraMount, from_fov
from mi_nerfattack.scenes import bundled
from mi_nerfattack.system.workers import InThisProcess
from mi_nerfattack.training.collect import collect, find_shards
from mi_nerfattack.training.dataset import FrameDataset
from mi_nerfattack.training.sources import (
    ExpertDrives,
    Mixture,
    PolicyDrives,
    Scattered,
)
from mi_nerfattack.vehicle.expert import expert_for
from mi_nerfattack.vehicle.route.route import load_routes

pytestmark = pytest.mark.usefixtures("variant")

HERE = InThisProcess()


def follower(route):
    return expert_for("rad/s", route, 0.1)


@pytest.fixture
def site() -> PaintedSite:
    return PaintedSite()


def states_of(site: PaintedSite) -> np.ndarray:
    return np.concatenate([np.stack(item.states) for item in site.opened])


def record_of(shard: Path) -> dict:
    return json.loads(files.read_safetensors(shard, ())[1]["kept.record"])


def conditions_of(shards: list[Path]) -> list[dict]:
    return [record_of(shard)["conditions"] for shard in shards]


def test_frames_carry_the_experts_control_and_goal(site, tmp_path):
    routes = [straight(), bent()]
    shards = collect(site, routes, Scattered(), small(frames=120), tmp_path, HERE)
    data = FrameDataset.from_shards(shards)
    assert len(data) == 120
    # the last group of a shard may be cut: only what was labelled is written
    states = states_of(site)
    assert len(states) == 120
    assert set(data.goals) == {0, 1}
    for route in routes:
        mine = data.goals == route.goal
        expected = follower(route).control(states[mine])
        np.testing.assert_allclose(data.controls[mine], expected, rtol=1e-6)
        arc = route.project_numpy(states[mine])[0]
        assert arc.min() > -3
        assert arc.max() < route.length + 3
    frames = data.read_frames(np.arange(120))
    levels = [about["level"] for about in conditions_of(shards) for _ in range(12)]
    expected = [painted(s, Grey(k)) for s, k in zip(states, levels, strict=True)]
    np.testing.assert_array_equal(frames[:, 2, 3], expected)


def test_the_last_shard_has_the_rest(site, tmp_path):
    settings = small(frames=17)
    shards = collect(site, [straight()], Scattered(), settings, tmp_path, HERE)
    sizes = [len(FrameDataset.from_shards([shard])) for shard in shards]
    assert sizes == [12, 5]


def test_conditions_change_from_shard_to_shard(site, tmp_path):
    settings = small(frames=120)
    shards = collect(site, [straight()], Scattered(), settings, tmp_path, HERE)
    levels = [about["level"] for about in conditions_of(shards)]
    assert set(levels) == {0, 1, 2}
    # loaded only where they differ
    changes = 1 + sum(a != b for a, b in zip(levels, levels[1:], strict=False))
    assert len(site.opened) == changes


def test_up_to_six_objects_come_and_go_ahead_of_the_vehicles(site, tmp_path):
    settings = small(frames=160, objects=6)
    shards = collect(site, [straight()], Scattered(), settings, tmp_path, HERE)
    seen = [objects for item in site.opened for objects in item.seen]
    assert {len(objects) for objects in seen} == set(range(7))
    assert 0.55 < np.mean([bool(objects) for objects in seen]) < 0.95
    for objects, state in zip(seen, states_of(site), strict=True):
        for posed in objects:
            x, y, _ = posed.pose.translation
            # in view from 3 m before the group to 8 m after it, or at the route's end
            assert -6 < x - state[0] < 34
            assert abs(y) > 1.75 + 0.3 + 0.2
    counts = [record_of(shard)["objects"] for shard in shards]
    groups = sum(int(n) * times for count in counts for n, times in count.items())
    assert 4 * groups == sum(map(len, seen))


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
    site, settings = IslandSite(), small(frames=96, object_share=1.0)
    collect(site, [straight()], Scattered(), settings, tmp_path, HERE)
    shown = [objects for item in site.opened for objects in item.seen]
    late = [o for o, s in zip(shown, states_of(site), strict=True) if s[0] > 36]
    assert late and all(late)
    ends = [posed.pose.translation[0] for objects in shown for posed in objects]
    assert 30 < max(ends) < 40


def test_no_objects_when_none_are_wanted(site, tmp_path):
    settings = small(object_share=0.0)
    collect(site, [straight()], Scattered(), settings, tmp_path / "a", HERE)
    bare = PaintedSite(objects=False)
    collect(bare, [bent()], Scattered(), small(), tmp_path / "b", HERE)
    assert not any(any(item.seen) for item in (*site.opened, *bare.opened))


def test_interrupted_collection_continues_with_the_same_frames(site, tmp_path):
    routes, settings = [straight(), bent()], small(frames=36)
    whole = collect(site, routes, Scattered(), settings, tmp_path / "whole", HERE)
    part = tmp_path / "part"

    def stop(done, total):
        if done == 20:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        collect(site, routes, Scattered(), settings, part, HERE, stop)
    first = part / "painted" / "shard_0000.safetensors"
    written = first.stat().st_mtime_ns
    seen = []
    again = collect(
        site,
        routes,
        Scattered(),
        settings,
        part,
        HERE,
        lambda done, total: seen.append((done, total)),
    )
    assert first.stat().st_mtime_ns == written
    assert seen == [(done, 36) for done in range(12, 37)]
    for one, other in zip(whole, again, strict=True):
        assert one.read_bytes() == other.read_bytes()


def test_expert_drives_recover(site, tmp_path):
    """From 1 m beside the lane the expert comes back within 16 periods (8 m)."""
    scatter = Scatter(lateral_sd_m=0.8, heading_sd=0.01, close_share=0.0)
    settings = small(frames=64, shard=64, scatter=scatter, object_share=0.0)
    collect(site, [straight()], ExpertDrives(16), settings, tmp_path, HERE)
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
    site = PaintedSite(size_px=(200, 66))
    settings = small(frames=12, scatter=Scatter(close_share=1.0), margin_m=-8.0)
    drives = PolicyDrives(weights, horizon=3)
    shards = collect(site, [straight()], drives, settings, tmp_path, HERE)
    data = FrameDataset.from_shards(shards)
    assert len(data) == 12
    (environment,) = site.opened
    for start in environment.starts:
        first, second = environment.states[start : start + 2]
        assert second[2] - first[2] == pytest.approx(0.02, abs=1e-6)
    expected = follower(straight()).control(np.stack(environment.states))
    np.testing.assert_allclose(data.controls, expected, rtol=1e-5, atol=1e-6)


def test_the_expert_drives_its_share_of_the_periods(weights, tmp_path):
    site = PaintedSite(size_px=(200, 66), objects=False)
    settings = small(frames=200, shard=200)
    drives = PolicyDrives(weights, horizon=8, expert_share=0.5)
    collect(site, [straight()], drives, settings, tmp_path, HERE)
    (environment,) = site.opened
    states = np.stack(environment.states)
    turn = np.diff(states[:, 2])
    same = np.setdiff1d(np.arange(len(turn)), np.array(environment.starts) - 1)
    assert 0.35 < np.isclose(turn[same], 0.02, atol=1e-6).mean() < 0.65


def test_drives_end_where_the_vehicle_has_strayed(weights, tmp_path):
    """0.6 lane widths off, frames teach nothing any more."""
    site = PaintedSite(size_px=(200, 66), objects=False)
    drives = PolicyDrives(weights, horizon=60)
    shards = collect(site, [straight()], drives, small(), tmp_path, HERE)
    frames = FrameDataset.from_shards(shards).read_frames(np.arange(24))
    lateral = 0.2 * (frames[:, 0, 0, 1] - 128.0)
    assert np.abs(lateral).max() < 0.6 * 3.5 + 0.5  # grey levels of 0.2 m, up to 2
    assert max(np.diff(site.opened[0].starts)) < 60


def test_a_mixture_takes_from_all_its_sources(site, tmp_path):
    mixture = Mixture((Scattered(), ExpertDrives(3)), (0.5, 0.5))
    settings = small(frames=240, shard=240)
    collect(site, [straight()], mixture, settings, tmp_path, HERE)
    lengths = np.diff(site.opened[0].starts)
    assert {1, 3} <= set(lengths) <= {1, 2, 3}  # 2: past the route's end
    with pytest.raises(InputError, match="one positive share a source"):
        Mixture((Scattered(),), (0.5, 0.5))


def test_folder_of_other_settings_is_refused(site, weights, tmp_path):
    routes = [straight()]

    def again(site=site, routes=routes, source=Scattered(), **changes):  # noqa: B008
        collect(site, routes, source, small(**changes), tmp_path, HERE)

    again()
    with pytest.raises(InputError, match=r"shard_0000.*\n  settings.seed: \d+ -> 6\n"):
        again(seed=6)
    with pytest.raises(InputError, match=r"  routes: (.*\n)+  expert"):
        again(routes=[bent()])
    with pytest.raises(InputError, match=r"here\)\n  routes: .*\nchoose"):
        # where drives end
        again(routes=[dataclasses.replace(straight(), lane_width_m=3.0)])
    with pytest.raises(InputError, match=r"here\)\n  site"):
        again(site=PaintedSite(size_px=(4, 4)))
    with pytest.raises(InputError, match=r"here\)\n  source"):
        again(source=PolicyDrives(weights))
    # a shard is enough, whichever it is
    (tmp_path / "painted" / "shard_0000.safetensors").unlink()
    with pytest.raises(InputError, match="shard_0001"):
        again(seed=6)


def test_exposures_of_the_weather_are_checked():
    with pytest.raises(InputError, match="exposure_ev: nan; must be a finite number"):
        Weather(("day",), (0.0, float("nan")))


def test_folders_without_frames_are_named(tmp_path):
    with pytest.raises(InputError, match="no frames in it"):
        find_shards(tmp_path)


def test_a_full_disk_is_told(site, tmp_path, monkeypatch):
    def full(*arguments):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.write", full)
    with pytest.raises(InputError, match="no space left on the disk"):
        collect(site, [straight()], Scattered(), small(), tmp_path, HERE)


def bundled_site(name: str, **changes) -> PlaceSite:
    place = Place(
        bundled("intersection/scene.xml"),
        bundled("intersection/field.safetensors"),
        bundled("intersection/routes.json"),
        (bundled("hydrant/field.safetensors"),),
        from_fov(24, 8, 90.0),
        CameraMount(),
    )
    return PlaceSite(name, place, Weather(spp=1, **changes))


@pytest.mark.parametrize(
    "name", ["surrogate", pytest.param("mitsuba", marks=pytest.mark.slow)]
)
def test_nothing_is_compiled_after_the_first_shard(name, tmp_path):
    site = bundled_site(name)
    routes = load_routes(site.place.routes)
    settings = small(frames=24, shard=24)
    collect(site, routes, Scattered(), settings, tmp_path / "warm", HERE)
    with nothing_compiled():
        collect(site, routes, Scattered(), settings, tmp_path / "again", HERE)


def test_shards_of_a_place_have_their_light(tmp_path):
    site = bundled_site("mitsuba", skies=("noon",), exposures_ev=(-2.0, 2.0))
    routes = load_routes(site.place.routes)
    settings = small(frames=24, shard=4, object_share=0.0)
    shards = collect(site, routes, Scattered(), settings, tmp_path, HERE)
    means: dict[float, list[float]] = {}
    for shard, about in zip(shards, conditions_of(shards), strict=True):
        frames = FrameDataset.from_shards([shard]).read_frames(np.arange(4))
        means.setdefault(about["exposure_ev"], []).append(frames.mean())
    assert set(means) == {-2.0, 2.0}
    assert max(means[-2.0]) < min(means[2.0]) - 30


def test_unknown_environments_and_skies_are_refused():
    with pytest.raises(InputError, match=r"environment: 'moon'; one of surrogate"):
        bundled_site("moon")
    with pytest.raises(InputError, match="sky: 'dusk'"):
        Weather(("dusk",))
