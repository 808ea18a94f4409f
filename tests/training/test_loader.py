"""What shards hold beside images, and how PyTorch reads them."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import torch
from support.faults.refusals import refusals
from support.worlds.places import (
    PaintedEnvironment,
    PaintedSite,
    bent,
    small,
    straight,
)
from torch.utils.data import DataLoader

import mi_nerfattack as nf
from mi_nerfattack.errors import InputError
from mi_nerfattack.io import files
from mi_nerfattack.system.workers import InThisProcess
from mi_nerfattack.training import ExpertDrives, FrameDataset, Frames, Scattered
from mi_nerfattack.training.collect import collect
from mi_nerfattack.training.settings import CollectSettings
from mi_nerfattack.training.sources import AbstractSource

pytestmark = pytest.mark.usefixtures("variant")

ROUTES = [straight(), bent()]


def gather(
    folder: Path,
    source: AbstractSource,
    routes=ROUTES,
    site: PaintedSite | None = None,
    **changes,
) -> PaintedSite:
    """Collect frames of a site without objects, and return the site."""
    site = site or PaintedSite(objects=False)
    settings = small(object_share=0.0, **changes)
    collect(site, routes, source, settings, folder, InThisProcess())
    return site


def column(frames: Frames, name: str) -> np.ndarray:
    return np.stack([getattr(frames[i], name).numpy() for i in range(len(frames))])


def states_of(site: PaintedSite) -> np.ndarray:
    return np.concatenate([np.stack(item.states) for item in site.opened])


def test_scattered_frames_keep_pose_route_and_errors(tmp_path):
    """Each is a drive of its own; drives of two shards have different numbers."""
    site = gather(tmp_path, Scattered())
    frames = nf.frames(tmp_path)
    states = states_of(site)
    assert len(frames) == len(states) == 24 and frames.routes == ("straight", "left")
    np.testing.assert_array_equal(column(frames, "pose"), states)
    np.testing.assert_array_equal(column(frames, "drive"), range(24))
    assert not column(frames, "step").any()
    routes = column(frames, "route")
    np.testing.assert_array_equal(routes, column(frames, "goal"))
    assert set(routes) == {0, 1}
    for number, route in enumerate(ROUTES):
        mine = routes == number
        arc, error, _ = route.project_numpy(states[mine])
        np.testing.assert_allclose(column(frames, "arc_length")[mine], arc, rtol=1e-6)
        errors = column(frames, "cross_track")[mine]
        np.testing.assert_allclose(errors, error, rtol=1e-6, atol=1e-6)
    np.testing.assert_array_equal(column(frames, "speed"), np.full(24, 5, "f4"))


def test_waypoints_of_a_drive_are_where_the_expert_came(tmp_path):
    """The painted car drives as the expert's kinematic one does, from the same pose."""
    times = (0.3, 0.5)  # 3 and 5 control periods
    gather(tmp_path, ExpertDrives(10), frames=60, shard=60, waypoints_s=times)
    frames = nf.frames(tmp_path)
    assert frames.waypoints_s == times
    poses, drives, steps = (column(frames, n) for n in ("pose", "drive", "step"))
    waypoints = column(frames, "waypoints")
    compared = 0
    for row, (x, y, heading) in enumerate(poses):
        for index, periods in enumerate((3, 5)):
            later = row + periods
            if later >= len(poses) or drives[later] != drives[row]:
                continue
            assert steps[later] == steps[row] + periods
            offset = complex(*poses[later, :2]) - complex(x, y)
            expected = offset * np.exp(-1j * heading)
            waypoint = complex(*waypoints[row, index])
            assert abs(waypoint - expected) < 1e-5
            compared += 1
    assert compared > 50
    lateral = column(frames, "cross_track")[column(frames, "step") == 0]
    assert np.abs(lateral).max() > 0.3  # recoveries are among them


class Slow(PaintedEnvironment):
    """Drives 3 m/s, whatever the route says."""

    def reset(self, route, pose=None, seed=0):
        return super().reset(dataclasses.replace(route, speed_ms=3.0), pose, seed)


@dataclasses.dataclass(frozen=True)
class SlowSite(PaintedSite):
    def open(self, conditions):
        return Slow(self.rig.cameras[0], conditions)


def test_speed_is_measured_after_the_first_frame_of_a_drive(tmp_path):
    gather(tmp_path, ExpertDrives(4), site=SlowSite(objects=False), frames=32)
    frames = nf.frames(tmp_path)
    expected = np.where(column(frames, "step") == 0, 5.0, 3.0)
    np.testing.assert_allclose(column(frames, "speed"), expected, rtol=1e-6)


@pytest.fixture
def drives(tmp_path) -> Path:
    """Three shards of drives of up to four frames."""
    gather(tmp_path, ExpertDrives(4), frames=32)
    return tmp_path


def test_items_have_the_images_and_labels_of_the_shards(drives):
    frames = nf.frames(drives)
    shards = sorted(drives.rglob("*.safetensors"))
    data = FrameDataset.from_shards(shards)
    images = data.read_frames(np.arange(32))
    for row in (0, 11, 12, 31, -1):
        item = frames[row]
        assert item.image.dtype == torch.float32 and item.image.shape == (3, 4, 8)
        levels = 255 * item.image.permute(1, 2, 0).numpy()
        np.testing.assert_allclose(levels, images[row], atol=1e-4)
        assert item.control.item() == data.controls[row]
        assert item.goal.item() == data.goals[row]
        assert item.waypoints.shape == (4, 2)
    with pytest.raises(IndexError):
        frames[32]
    numbers = column(frames, "drive")
    assert (np.diff(numbers) == (column(frames, "step")[1:] == 0)).all()


def test_a_window_repeats_the_first_frame_of_a_drive(drives):
    single, frames = nf.frames(drives), nf.frames(drives, window=3)
    assert frames[0].image.shape == (3, 3, 4, 8)
    for row in range(len(frames)):
        step = int(single[row].step)
        rows = [row - min(step, age) for age in (2, 1, 0)]
        expected = torch.stack([single[i].image for i in rows])
        assert torch.equal(frames[row].image, expected)


@pytest.mark.parametrize("workers", [0, 2])
def test_a_data_loader_gives_the_same_frames_in_order(drives, workers):
    frames = nf.frames(drives, window=2)
    batches = list(DataLoader(frames, batch_size=12, num_workers=workers))
    assert [len(batch.image) for batch in batches] == [12, 12, 8]
    assert batches[0].image.shape == (12, 2, 3, 4, 8)
    for name in frames[0]._fields:
        values = torch.cat([getattr(batch, name) for batch in batches])
        np.testing.assert_array_equal(values.numpy(), column(frames, name))


def test_an_interrupted_collection_ends_with_the_same_columns(drives, tmp_path):
    def stop(done: int, total: int) -> None:
        if done > 20:
            raise KeyboardInterrupt

    settings = small(object_share=0.0, frames=32)
    call = PaintedSite(objects=False), ROUTES, ExpertDrives(4), settings, tmp_path / "b"
    with pytest.raises(KeyboardInterrupt):
        collect(*call, InThisProcess(), stop)
    assert len(list((tmp_path / "b").rglob("*.safetensors"))) == 1
    collect(*call, InThisProcess())
    for shard in sorted((drives / "painted").iterdir()):
        again = tmp_path / "b/painted" / shard.name
        assert again.read_bytes() == shard.read_bytes()


def test_collections_of_other_routes_go_together(tmp_path):
    """Routes are numbered by name, drives through the folder."""
    gather(tmp_path / "a", Scattered(), routes=[bent()], frames=12)
    gather(tmp_path / "b", Scattered(), routes=[straight(), bent()], frames=12)
    frames = nf.frames(tmp_path)
    assert frames.routes == ("left", "straight")
    goals = {"left": 1, "straight": 0}
    names = [frames.routes[number] for number in column(frames, "route")]
    assert [goals[name] for name in names] == column(frames, "goal").tolist()
    np.testing.assert_array_equal(column(frames, "drive"), range(24))


def of_earlier_version(folder: Path) -> None:
    gather(folder, Scattered(), frames=12)
    (shard,) = folder.rglob("*.safetensors")
    tensors, metadata = files.read_safetensors(shard)
    columns = {name: tensors[name] for name in ("frames", "goals", "controls")}
    metadata["format"] = "mi_nerfattack frames 1"
    files.write_safetensors(shard, columns, metadata)
    assert len(FrameDataset.from_shards([shard])) == 12  # for --more
    with pytest.raises(InputError, match="frames 1.*start again without the file"):
        gather(folder, Scattered(), frames=12)
    nf.frames(folder)


def of_two_kinds(folder: Path) -> None:
    gather(folder / "a", Scattered(), frames=12)
    gather(folder / "b", Scattered(), frames=12, waypoints_s=(1.0,))
    nf.frames(folder)


@dataclasses.dataclass(frozen=True)
class UnitSite(PaintedSite):
    """Says in which unit its labels are."""

    unit: str = "rad"

    def describe(self):
        return super().describe() | {"car": {"control_unit": self.unit}}


def of_two_units(folder: Path) -> None:
    for unit in ("rad/s", "rad"):
        name = unit.replace("/", "")
        site = UnitSite(objects=False, unit=unit)
        gather(folder / name, Scattered(), site=site, frames=12)
        assert nf.frames(folder / name).control_unit == unit
    nf.frames(folder)


test_what_is_refused = refusals(
    (of_earlier_version, "frames 1'.* collect again, into another folder"),
    (of_two_kinds, r"a.painted.* \[0.5, .*; .*b.painted.* after \[1.0\] s"),
    (of_two_units, "controls in rad; .*controls in rad/s: give a folder"),
    (lambda folder: nf.frames(folder), "no frames"),
    (lambda: Frames([Path("any")], window=0), "window: 0; at least 1"),
    (lambda: CollectSettings(waypoints_s=()), "waypoints_s: .*; at least one"),
    (lambda: CollectSettings(waypoints_s=(1.0, 0.5)), "waypoints_s: .*ascending"),
    (lambda: CollectSettings(waypoints_s=(0.0, 0.5)), "waypoints_s: .* above 0"),
)
