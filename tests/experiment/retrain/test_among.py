"""Frames among found attacks: what they show, and where they are taken."""

from __future__ import annotations

import dataclasses
import shutil
from itertools import islice
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import pytest
from support.worlds import attacks as attack_jobs
from support.worlds.places import PaintedSite, small

import mi_nerfattack as nf
from mi_nerfattack.capture.mesh.flat import FlatObject
from mi_nerfattack.deploy.environment import drive
from mi_nerfattack.deploy.sites import PlaceSite, Weather, expert_of
from mi_nerfattack.errors import InputError
from mi_nerfattack.experiment.retrain import anew, solvable
from mi_nerfattack.experiment.retrain.among import (
    AmongFound,
    attacked_drives,
    attacked_objects,
    found_place,
)
from mi_nerfattack.experiment.retrain.anew import attack_anew, check_scenarios
from mi_nerfattack.experiment.retrain.solvable import drive_expert
from mi_nerfattack.experiment.transfer.found import FoundAttack
from mi_nerfattack.fields import GridField, load_grid, save_field
from mi_nerfattack.io import locks
from mi_nerfattack.render.camera.pose import Pose
from mi_nerfattack.render.posed import PosedField
from mi_nerfattack.rollout.drive import ATTACK
from mi_nerfattack.scenario.policy.kinds import PolicySection
from mi_nerfattack.scenario.scenario import load_scenario
from mi_nerfattack.scenario.section import read_section
from mi_nerfattack.scenario.world import build_world, driven_route
from mi_nerfattack.system.workers import InThisProcess, Processes
from mi_nerfattack.training.collect import collect
from mi_nerfattack.training.sources import Scattered, Scenery
from tests.experiment.conftest import CAMERA

pytestmark = pytest.mark.usefixtures("variant")

CHANGES = {
    "[drive]": CAMERA,
    "horizon = 2": "horizon = 200",
    "[7.0, 4.2, 1.6]": "[-5.0, 2.6, 1.6]",
}
SHIFT = np.array([0.5, 0.2, 0.0, 0.0, 0.0, 0.7])


@pytest.fixture(scope="module")
def attacks(tmp_path_factory) -> tuple[FoundAttack, ...]:
    """Two attacks on one object: here, and 17 m on, shifted and turned."""
    mi.set_variant("llvm_ad_rgb")
    folder = attack_jobs.write_scenario(tmp_path_factory.mktemp("scenario"), CHANGES)
    path = folder / "scenario.toml"
    text = path.read_text()
    attack_jobs.make_dense(folder)
    runs = []
    for number, (x, offset) in enumerate(((-5.0, 0 * SHIFT), (12.0, SHIFT))):
        path.write_text(text.replace("[-5.0,", f"[{x},"))
        run = folder / f"run{number}"
        item = load_grid(folder / "object.safetensors")
        item.set_parameter("texture", item.texture.numpy() + np.float32(number + 1))
        (run / "objects").mkdir(parents=True)
        save_field(run / "objects" / "ball.safetensors", item)
        runs.append(read(path, run, offset, number))
    return tuple(runs)


def read(path: Path, run: Path, offset: np.ndarray, number: int) -> FoundAttack:
    scenario, _ = load_scenario(path)
    route = driven_route(scenario, scenario.vehicle.motion())
    outcome = offset[None], None, scenario.identity(), f"digest {number}", {}
    return FoundAttack(run, run.name, scenario, route, *outcome)


def take(attacks, folder: Path, frames: int = 96) -> PaintedSite:
    site, settings = PaintedSite(), small(frames=frames, margin_m=0.0)
    routes, staging, workers = (
        [attacks[0].route],
        AmongFound(tuple(attacks)),
        InThisProcess(),
    )
    collect(site, routes, Scattered(), settings, folder, workers, staging=staging)
    return site


def test_a_shard_shows_one_runs_objects_where_its_attack_left_them(attacks, tmp_path):
    site = take(attacks, tmp_path)
    objects = [items for item in site.opened for items in item.shown]
    states = [state for item in site.opened for state in item.states]
    assert len(objects) == len(states) == 96
    frames = nf.frames(tmp_path)  # as those of train
    poses = np.stack([frames[row].pose.numpy() for row in range(96)])
    np.testing.assert_array_equal(poses, states)
    assert frames.routes == (attacks[0].route.name,)
    numbers = set()
    for (posed,), state in zip(objects, states, strict=True):
        number = int(posed.pose.translation[0] == 12)
        run, pose = attacks[number], posed.placed
        item = run.scenario.objects[0]
        moved = np.array(item.position_m) + run.offsets[0, :3]
        np.testing.assert_allclose(pose.translation, moved)
        assert pose.scale == item.scale
        turn = np.arctan2(pose.rotation[1, 0], pose.rotation[0, 0])
        assert turn == pytest.approx(run.offsets[0, 5])
        grid = load_grid(run.folder / "objects" / "ball.safetensors")
        assert isinstance(posed.field, GridField)
        np.testing.assert_array_equal(posed.field.texture.numpy(), grid.texture.numpy())
        # from the drive's start to where it passes the object
        assert run.route.pose_at(0.0)[0] - 1e-6 <= state[0] <= moved[0] + 1e-6
        numbers.add(number)
    assert numbers == {0, 1}


def test_the_order_of_the_runs_decides_nothing(attacks, tmp_path):
    orders = attacks, attacks[::-1]
    sites = [take(runs, tmp_path / str(k), 32) for k, runs in enumerate(orders)]
    states = [[s for item in site.opened for s in item.states] for site in sites]
    np.testing.assert_array_equal(*states)


def test_frames_are_those_of_the_attack(attacks):
    """A vehicle of the collection sees what it sees in a drive of the run."""
    place = found_place(attacks)
    for name in ("surrogate", "mitsuba"):
        site = PlaceSite(name, place, Weather(spp=1))
        taken = site.open(site.typical())
        for run in attacks:
            x = run.scenario.objects[0].position_m[0]
            pose = run.route.pose_at(x - run.route.points[0, 0] - 6.0)
            empty = taken_image(taken, run, pose, [])
            image = taken_image(taken, run, pose, attacked_objects(run))
            world = build_world(run.scenario, run.scenario.policy.build())
            world.show(run.looks(world)[ATTACK])
            environment = world.open(name)
            driven = environment.reset(run.route, pose, 3).image
            environment.close()
            assert np.abs(image.astype(int) - empty).max() > 20
            assert np.abs(image.astype(int) - driven).max() <= 1
        taken.close()


def taken_image(environment, run, pose, objects):
    environment.show(objects)
    return environment.reset(run.route, pose, 3).image


REMEMBERS = """\
def steer(image, goal, step):
    return image.mean((1, 2, 3)) - 0.5 + 0.2 * step
"""


def test_an_attacked_policy_of_any_kind_drives_as_in_a_drive(attacks, tmp_path):
    """One that remembers, too; the expert labels what it sees."""
    (tmp_path / "mine.py").write_text(REMEMBERS)
    keys = {"kind": "callable", "file": "mine.py:steer", "trust_code": True}
    section = read_section("policy", PolicySection, keys, tmp_path)
    source, run = attacked_drives(section, found_place(attacks).rig), attacks[0]
    assert source.describe()["policy"]["kind"] == "callable"
    site = PlaceSite("surrogate", found_place(attacks))
    pose, expert = run.route.pose_at(2.0, 0.3), expert_of(site, run.route)
    environment = site.open(site.typical())
    driven = drive(environment, section.build(), run.route, pose, 0, 9)
    rng = np.random.default_rng(0)
    scenery = Scenery(environment, run.route, expert, pose[None], rng)
    frames = list(islice(source.frames(source.prepare(), scenery), 10))
    environment.close()
    assert [frame.step for frame in frames] == list(range(10))
    np.testing.assert_array_equal(
        [frame.pose for frame in frames], driven.states[:, :3]
    )
    for frame in frames:
        assert frame.control == pytest.approx(expert.control(frame.pose)[0])


def test_frames_among_other_attacks_are_refused(attacks, tmp_path):
    take(attacks, tmp_path, frames=12)
    other = dataclasses.replace(attacks[0], digest="another")
    for changed in (attacks[:1], [other, attacks[1]]):
        with pytest.raises(InputError, match=r"  staging.found"):
            take(changed, tmp_path, frames=12)


def test_runs_of_other_places_are_refused(attacks, tmp_path):
    path = tmp_path / "scenario.toml"
    shutil.copytree(attacks[0].folder.parent, tmp_path, dirs_exist_ok=True)
    text = path.read_text()
    path.write_text(text.replace("[drive]", "[vehicle]\ndt_s = 0.2\n[drive]"))
    other = read(path, tmp_path / "run0", 0 * SHIFT, 3)
    with pytest.raises(InputError, match=r"vehicle.dt_s: 0.2 -> 0.1\n"):
        found_place([attacks[0], other])


CAR = """\
import drjit as dr

def car(state, control):
    theta = state[2]
    return 5 * dr.cos(theta), 5 * dr.sin(theta), control
"""
CUSTOM = """\
[vehicle]
kind = "custom"
function = "car.py:car"
trust_code = true
control_limit = 1.5
"""


def test_an_expert_drives_a_vehicle_whose_control_it_knows(attacks, tmp_path):
    """It drives the function of a Dubins vehicle as it drives that vehicle."""
    path = tmp_path / "scenario.toml"
    shutil.copytree(attacks[0].folder.parent, tmp_path, dirs_exist_ok=True)
    (tmp_path / "car.py").write_text(CAR)
    text, driven = path.read_text(), []
    for vehicle in ("", f'{CUSTOM}control_unit = "rad/s"\n', CUSTOM):
        path.write_text(text.replace("[drive]", f"{vehicle}[drive]"))
        run = read(path, tmp_path / "run0", 0 * SHIFT, 3)
        if vehicle == CUSTOM:
            with pytest.raises(InputError, match="vehicle.control_unit: "):
                drive_expert(run)
        else:
            driven.append(drive_expert(run))
    one, other = driven
    assert other.error_m == pytest.approx(one.error_m, abs=1e-6)


def test_a_car_drives_over_what_is_low(attacks, monkeypatch):
    run = attacks[0]
    (standing, *_) = attacked_objects(run)
    path = run.route.pose_at(run.route.length / 2)
    for kind in ("patch", "billboard"):
        field = FlatObject(kind, 1.0, 2.0).field()
        pose = Pose.upright((path[0], path[1], 0.0), 0.0, 1.0)
        objects = [standing, PosedField(field, pose)]
        monkeypatch.setattr(solvable, "attacked_objects", lambda _, o=objects: o)
        if kind == "patch":
            low = drive_expert(run).gap_m
        else:
            assert drive_expert(run).gap_m < 0 < low
    monkeypatch.setattr(solvable, "attacked_objects", lambda _: [])
    assert drive_expert(run).gap_m == np.inf


def test_a_second_process_is_refused_before_it_attacks_anew(tmp_path):
    nothing: Any = None
    with locks.exclusive(tmp_path), pytest.raises(InputError, match="another process"):
        attack_anew([], "policy.file=absent", tmp_path, nothing)
    assert not list(tmp_path.iterdir())


def test_runs_of_one_scenario_are_not_attacked_anew(attacks):
    check_scenarios(attacks)
    again = dataclasses.replace(attacks[0], folder=Path("again"))
    with pytest.raises(InputError, match="again: its scenario is that of .*leave out"):
        check_scenarios([*attacks, again])


def test_each_attack_anew_has_a_process_of_its_own(tmp_path, monkeypatch):
    crews = []

    def note(crew, work, pieces, report, on_end):
        crews.append((crew.count, crew.pieces_each, list(pieces)))

    monkeypatch.setattr(Processes, "_do", note)
    monkeypatch.setattr(anew, "_cell", lambda attack, policy: attack)
    monkeypatch.setattr(anew, "folder_of", lambda folder, cell: folder / cell)
    monkeypatch.setattr(anew, "read_found", lambda folders: folders)
    attacks: Any = ["one", "two", "three"]
    attack_anew(attacks, "policy.file=absent", tmp_path, Processes(2))
    assert crews == [(2, 1, [0, 1, 2])]
