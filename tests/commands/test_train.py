"""The commands that train and retrain: what they make, count and refuse."""

from __future__ import annotations

import json
import pickle
import shutil
import sys
from dataclasses import replace
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
from support.faults.refusals import refusals
from support.worlds.places import write_place

import mi_nerfattack as nf
from mi_nerfattack import cli
from mi_nerfattack.commands.retrain import Retrain
from mi_nerfattack.commands.shared.policy_file import PolicyFile
from mi_nerfattack.commands.train import Train
from mi_nerfattack.deploy.place import bundled_place
from mi_nerfattack.drives.table import TEXT, read_csv
from mi_nerfattack.experiment.retrain.solvable import drive_expert
from mi_nerfattack.experiment.transfer.figures import TABLE
from mi_nerfattack.experiment.transfer.found import read_found
from mi_nerfattack.io import files
from mi_nerfattack.policy.pilotnet import PilotNet
from mi_nerfattack.rollout.drive import departure_limit
from mi_nerfattack.scenes import bundled
from mi_nerfattack.training.presets import find_preset
from mi_nerfattack.vehicle.expert import expert_for
from mi_nerfattack.vehicle.route.route import load_routes
from tests.faults import worlds

pytestmark = pytest.mark.usefixtures("variant")


@pytest.fixture(scope="module")
def run(tmp_path_factory) -> Path:
    """The folder of a finished attack on PilotNet, without pictures."""
    mi.set_variant("llvm_ad_rgb")
    folder = tmp_path_factory.mktemp("scenario")
    worlds.pilotnet(folder)
    return folder / "run"


def changed(run: Path, folder: Path, *changes: tuple[str, str]) -> Path:
    """Copy a run, with a changed scenario that no checkpoint contradicts."""
    shutil.copytree(run, folder)
    (folder / "checkpoint.safetensors").unlink()
    path = folder / "scenario.toml"
    text = path.read_text()
    for old, new in changes:
        assert old in text
        text = text.replace(old, new)
    path.write_text(text)
    return folder


def retrain(folder: Path, *arguments: object) -> int:
    words = ["retrain", "-o", folder / "new.safetensors", "--data", folder / "data"]
    words += ["--workers", 1, "--epochs", 1, "--card-runs", 1, "--runs", 1]
    words += [*arguments, "--environments", "surrogate"]
    return cli.main([str(word) for word in words])


def test_a_policy_is_tuned_on_old_and_new_frames(run, tmp_path, capsys):
    """A scenario with a blocked lane does not count."""
    blocked = changed(run, tmp_path / "blocked", ("-13.0, 3.4", "-13.0, 0.4"))
    frames = ["--frames", "surrogate", 64, "--exposures-ev", 0]
    assert retrain(tmp_path, run, blocked, *frames, "--json") == 0
    printed, err = capsys.readouterr()
    assert "blocked: left out: an object stands" in err and "no --more" in err
    old = PilotNet.load(run.parent / "policy.safetensors")
    new = PilotNet.load(tmp_path / "new.safetensors")
    assert (new.goals, new.max_control) == (old.goals, old.max_control)
    pairs = zip(new.parameters(), old.parameters(), strict=True)
    steps = [float((a - b).abs().max().detach()) for a, b in pairs]
    assert 0 < max(steps) < 0.01  # a training of its own would be far away
    document = files.read_json(tmp_path / "new-retrain.json")
    assert json.loads(printed).items() >= document.items()
    assert [item["label"] for item in document["runs"]] == ["run"]
    assert list(document["left_out"]) == ["blocked"]
    assert document["policy"]["sha256"] == files.sha256(
        run.parent / "policy.safetensors"
    )
    record = files.read_json(tmp_path / "new.json")
    assert record["data"] == {"round_0/surrogate": 64}
    # other runs are other frames
    near = changed(run, tmp_path / "near", ("-13.0, 3.4", "-12.0, 3.4"))
    assert retrain(tmp_path, run, near, *frames) == 2
    assert "staging.found" in capsys.readouterr().err
    # old frames are trained on, too, and attacks driven that nothing was trained on
    other = tmp_path / "other"
    other.mkdir()
    options = ["--more", tmp_path / "data", "--held-out", run]
    assert retrain(other, near, *frames, *options) == 0
    check_table(files.read_json(other / "new-retrain.json"), other)
    record = files.read_json(other / "new.json")
    assert record["data"] == {"round_0/surrogate": 64, "earlier/surrogate": 64}
    check_adaptive(other, near, *frames, *options)
    page = other / "page.html"
    words = ["report", str(other / "new-retrain.json"), "-o", str(page), "--json"]
    assert cli.main(words) == 0
    assert "Adaptive" in page.read_text()


def check_adaptive(folder: Path, run: Path, *arguments) -> None:
    """The new policy is attacked later, and not trained again."""
    weights = (folder / "new.safetensors").read_bytes()
    assert retrain(folder, run, *arguments, "--adaptive") == 0
    document = files.read_json(folder / "new-retrain.json")
    assert (folder / "new.safetensors").read_bytes() == weights
    check_table(document, folder, "adaptive")
    (cell,) = (folder / "data" / "adaptive" / "cells").iterdir()
    assert (cell / "_complete").exists()
    (adaptive,), (old,) = read_found([cell]), read_found([run])
    assert adaptive.scenario.policy.file.file == folder / "new.safetensors"
    same = {"policy": old.scenario.policy}
    assert adaptive.scenario.model_copy(update=same).digest() == old.scenario.digest()
    (anew,) = document["adaptive"]
    assert anew["label"] == cell.name and anew["found_sha256"] == adaptive.digest
    made = cell.stat().st_mtime_ns
    assert retrain(folder, run, *arguments, "--adaptive") == 0
    assert cell.stat().st_mtime_ns == made
    assert files.read_json(folder / "new-retrain.json") == document


def check_table(document: dict, folder: Path, *extra_groups: str) -> None:
    """Before and after are the drives of a transfer of each group by each policy."""
    rows = document["table"]
    assert [row["group"] for row in rows] == ["old", "held_out", *extra_groups]
    types = {"group": TEXT, "policy": TEXT} | TABLE
    drives = read_csv(folder / "new-retrain.csv", types)
    drives = drives.set_index(["group", "policy", "case"])["cross_track_mean_m"]
    assert len(drives) == 4 * len(rows)  # two policies, two cases, one start
    assert [item["label"] for item in document["held_out"]] == ["run"]
    for row in rows:
        for stage in ("before", "after"):
            is_later = row["group"] == "adaptive" and stage == "before"
            group = "old" if is_later else row["group"]
            path = folder / "data" / f"{group}_{stage}" / "transfer.json"
            (column,) = files.read_json(path)["columns"]
            assert row[stage] == column["cases"]
            assert row[stage]["attack"]["drives"] == 1
            clean, attacked = (
                row[stage][case]["cross_track_mean_m"]
                for case in ("no_object", "attack")
            )
            assert row["attack_to_clean"][stage] == pytest.approx(attacked / clean)
            assert drives[row["group"], stage, "attack"] == attacked
            assert drives[row["group"], stage, "no_object"] == clean
        before, after = (row[s]["no_object"] for s in ("before", "after"))
        assert before["cross_track_mean_m"] != after["cross_track_mean_m"]
        ratio = after["cross_track_mean_m"] / before["cross_track_mean_m"]
        assert row["clean_ratio"] == pytest.approx(ratio)


def test_workers_make_the_vehicle_of_a_runs_user(run, tmp_path, monkeypatch):
    """A process that never loaded the user's file opens the place."""
    vehicle = f"[vehicle]\n{CUSTOM}trust_code = true\n".replace('"rad"', '"rad/s"')
    custom = changed(run, tmp_path / "custom", ("[drive]", f"{vehicle}[drive]"))
    (custom / "car.py").write_text(CAR)
    (attack,) = read_found([custom])
    command = Retrain((custom,), tmp_path / "o", tmp_path / "d", exposures_ev=(0.0,))
    place = command._place([attack])
    settings = command._settings(attack.scenario.policy, place)
    sent = pickle.dumps(command._sites(place, settings, attack.scenario.vehicle))
    for name in [name for name in sys.modules if name.startswith("mi_nerfattack_user")]:
        monkeypatch.delitem(sys.modules, name)
    for site in pickle.loads(sent):
        environment = site.open(site.typical())
        environment.reset(attack.route)
        environment.step(0.0)
        moved = np.hypot(*(environment.state[:2] - attack.route.points[0]))
        assert moved == pytest.approx(0.6, rel=1e-3)  # 6 m/s, as only its file says
        environment.close()


def test_the_expert_decides_what_can_be_driven(run, tmp_path):
    (attack,) = read_found([run])
    driven = drive_expert(attack)
    assert driven.trouble == ""
    # a box 3 m wide around y = 3.4 m, and a car 1.8 m wide within 0.3 m of y = 0
    assert driven.gap_m == pytest.approx(3.4 - 1.5 - 0.9, abs=0.3)
    late = changed(run, tmp_path / "late", ("[drive]", "[drive]\nlateral_sd_m = 5.0"))
    (attack,) = read_found([late])
    assert "leaves its lane" in drive_expert(attack).trouble


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (("[policy]", "[policy]\ncontrol_scale = 0.5"), "only PilotNet of"),
        (("policy.safetensors", "other.safetensors"), "retrain one policy at a time"),
        (("[drive]", "[vehicle]\nwidth_m = 1.5\n[drive]"), "one place at a time"),
    ],
)
def test_runs_that_do_not_go_together_are_refused(
    run, tmp_path, change, message, capsys
):
    PilotNet(4).save(run.parent / "other.safetensors")
    other = changed(run, tmp_path / "other", change)
    assert retrain(tmp_path, run, other) == 2
    assert message in capsys.readouterr().err
    assert not (tmp_path / "data").exists()


def test_options_that_do_not_fit_are_told(run, tmp_path, capsys):
    assert retrain(tmp_path, run, "--frames", "carla", 8) == 2
    assert "--frames: 'carla'; of surrogate" in capsys.readouterr().err
    assert retrain(tmp_path, run, "--held-out", run) == 2
    assert "each once" in capsys.readouterr().err
    policy = run.parent / "policy.safetensors"
    before = policy.read_bytes()
    assert retrain(tmp_path, run, "-o", policy) == 2
    assert "is the policy that was attacked" in capsys.readouterr().err
    assert policy.read_bytes() == before
    twin = Path(shutil.copytree(run, tmp_path / "twin"))
    assert retrain(tmp_path, run, "--held-out", twin) == 2
    assert f"twin: is a copy of {run}" in capsys.readouterr().err
    # a copy of the policy, which another run needs
    near = changed(run, tmp_path / "near", ("-13.0, 3.4", "-12.0, 3.4"))
    copy = Path(shutil.copy(policy, tmp_path / "copy.safetensors"))
    toml = (near / "scenario.toml").read_text()
    (near / "scenario.toml").write_text(toml.replace(str(policy), str(copy)))
    assert retrain(tmp_path, run, near, "-o", copy) == 2
    assert "is the policy that was attacked" in capsys.readouterr().err
    assert copy.read_bytes() == before
    blocked = changed(run, tmp_path / "blocked", ("-13.0, 3.4", "-13.0, 0.4"))
    assert retrain(tmp_path, blocked) == 2
    assert "none can be driven by the expert" in capsys.readouterr().err


@pytest.mark.parametrize("name", ["policy.safetensors", "policy.pt2", "policy.json"])
def test_what_cannot_be_written_is_told_before_the_first_frame(tmp_path, capsys, name):
    if name.endswith("tensors"):
        (tmp_path / name).symlink_to(tmp_path / "nowhere" / name)
    else:
        (tmp_path / name).mkdir()
    words = ["train", "-o", tmp_path / "policy.safetensors", "--data", tmp_path / "a"]
    assert cli.main([*map(str, words), "--frames", "moon", "1"]) == 2
    assert str(tmp_path / name) in capsys.readouterr().err


def test_frames_of_rounds_that_are_not_done_need_no_environment():
    """The preset's rounds have surrogate frames, and this room has no field."""
    train = Train(Path("d"), frames={"mitsuba": 8}, dagger_rounds=0)
    preset, room = train._preset(), replace(bundled_place("room"), field=None)
    sites = train._sites(preset, room, train._settings(preset, room), train._file())
    assert [site.name for site in sites] == ["mitsuba"]


def test_a_rooms_policy_is_validated_within_its_lane():
    room = bundled_place("room")
    settings = Train(Path("d"))._settings(find_preset("room"), room)
    (route,) = load_routes(room.routes)
    for chosen in (settings.validation, settings.final):
        assert departure_limit(route.lane_width_m, chosen.car_width_m) > 0.15
    assert settings.final.seed != settings.validation.seed


LIKE = """[policy]
file = "not_trained_yet.pt"
[camera]
width = 24
height = 10
[vehicle]
dt_s = 0.05
"""
ACKERMANN = """kind = "ackermann"
speed_ms = 6.0
wheelbase_m = 2.9
"""
CUSTOM = """kind = "custom"
function = "car.py:car"
control_limit = 0.6
control_unit = "rad"
wheelbase_m = 2.9
"""
CAR = """import drjit as dr
def car(state, control):
    return 6 * dr.cos(state[2]), 6 * dr.sin(state[2]), 6 / 2.9 * dr.tan(control)
"""


def like(folder: Path, vehicle: str) -> str:
    """Write a policy's file and a vehicle, and return the name of the former."""
    (folder / "car.py").write_text(CAR)
    (folder / "like.toml").write_text(LIKE + vehicle)
    return str(folder / "like.toml")


@pytest.mark.parametrize(
    ("vehicle", "speed"), [(ACKERMANN, 6.0), (CUSTOM, 5.0)], ids=["built-in", "custom"]
)
def test_frames_have_the_camera_and_the_vehicle_of_a_policys_file(
    tmp_path, vehicle, speed, capsys
):
    """The expert knows the speed of a custom vehicle from the route alone."""
    place = write_place(tmp_path)
    words = ["train", "--frames-only", "--data", tmp_path / "data", "--workers", 1]
    words += ["--scene", place.scene, "--routes-file", place.routes, "--seed", 3]
    words += ["--frames", "mitsuba", 40, "--most-objects", 0, "--spp", 1, "--json"]
    words += ["--like", like(tmp_path, vehicle), "--set", "vehicle.trust_code=true"]
    if vehicle == ACKERMANN:
        words = words[:-2]
    assert cli.main([str(word) for word in words]) == 0
    assert json.loads(capsys.readouterr().out) == {"data": {"round_0/mitsuba": 40}}
    frames = nf.frames(tmp_path / "data")
    assert len(frames) == 40 and frames[0].image.shape == (3, 10, 24)
    routes = {
        route.name: replace(route, speed_ms=speed)
        for route in load_routes(place.routes)
    }
    limit = float(np.radians(34.0)) if vehicle == ACKERMANN else 0.6
    measured = []
    for item in (frames[row] for row in range(40)):
        route = routes[frames.routes[int(item.route)]]
        expert = expert_for("rad", route, 0.05, limit, 2.9)
        (control,) = expert.control(item.pose.numpy())
        assert item.control.item() == pytest.approx(control, rel=1e-5, abs=1e-7)
        if item.step:
            measured.append(item.speed.item())
    assert measured and measured == pytest.approx([6.0] * len(measured), rel=1e-5)


@pytest.mark.parametrize("preset", ["laptop", "room"])
def test_frames_come_from_the_place_of_a_scenario(preset):
    """Also if options name other objects, but not if they name another scene."""
    file, cube = PolicyFile.read(str(bundled("room.toml"))), (Path("mine"),)
    command = Train(Path("data"), preset=preset, object=cube)
    place = command._place(find_preset(preset), file)
    assert place.scene == bundled("room/scene.xml") and place.objects == cube
    other = replace(command, scene=Path("s.xml"), routes_file=Path("r.json"), object=())
    place = other._place(find_preset(preset), file)
    assert place.scene == Path("s.xml") and place.field is None and place.objects


def training(change: dict, vehicle: str = ACKERMANN):
    """Return a call of train with a policy's file, and other options."""

    def call(folder: Path) -> None:
        options = {"frames": {"surrogate": 128}, "like": like(folder, vehicle)}
        options |= {"data": folder / "data"} | change
        Train(**options).run()

    return call


def without_sections(folder: Path) -> None:
    (folder / "bare.toml").write_text('[policy]\nfile = "a.pt"\n')
    training({"like": str(folder / "bare.toml"), "frames_only": True})(folder)


ONLY, UNIT = {"frames_only": True}, 'control_unit = "rad"\nwheelbase_m = 2.9\n'
test_what_cannot_be_collected_is_refused = refusals(
    (training({}), "-o: is missing; .*--frames-only"),
    (training(ONLY | {"output": Path("a")}), "--output: has no effect"),
    (training(ONLY | {"more": (Path("a"),)}), "--more: has no effect"),
    (training(ONLY | {"like": None, "settings": ("a=1",)}), "--set: .*--like"),
    (without_sections, r"bare.toml; has neither \[camera\] nor \[vehicle\]"),
    (training(ONLY, CUSTOM.replace(UNIT, "")), "vehicle.control_unit: is missing"),
    (
        training(ONLY | {"frames": {"mujoco": 8}}, CUSTOM + "trust_code = true"),
        "--frames: mujoco drives a car with wheels",
    ),
    (training({"output": Path("a.safetensors")}), "24 x 10 px; .*--frames-only"),
)
