"""The command that evaluates policies: its card, kept drives, page and messages."""

from __future__ import annotations

import json
import re
import sys
from pathlib import Path

import numpy as np
import pytest
from helpers.roadside import Grey, PaintedEnvironment, small_grid
from helpers.scenario_text import HEAD, write_named_files

from mi_nerfattack import cli
from mi_nerfattack.commands.evaluate import Evaluate
from mi_nerfattack.commands.shared.evaluate_options import PlaceOptions
from mi_nerfattack.commands.shared.words import command_line
from mi_nerfattack.commands.train import Train
from mi_nerfattack.deploy.registry import make_environment
from mi_nerfattack.evaluation import work as evaluate_work
from mi_nerfattack.fields.io import save_field
from mi_nerfattack.io import files
from mi_nerfattack.policy.pilotnet import PilotNet
from mi_nerfattack.report.pages.policy import policy_name, summary
from mi_nerfattack.scenario.policy import HttpSection, ProgramSection
from mi_nerfattack.system.workers import InThisProcess, Processes

pytestmark = pytest.mark.usefixtures("variant")

ROUTES = {
    "straight": {
        "goal": 0,
        "points_m": [[0, 0], [20, 0], [40, 0]],
        "lane_width_m": 3.5,
        "speed_ms": 5.0,
    }
}
SCENE = """<scene version="3.0.0">
<integrator type="direct"/>
<shape type="rectangle"><transform name="to_world">
<scale x="90" y="90"/></transform></shape>
<emitter type="constant"/>
</scene>"""
CALLABLE = ("--kind", "callable", "--trust-code")
STILL = "def drive(image, goal, step):\n    return [0.0] * len(image)\n"


@pytest.fixture
def place(tmp_path, monkeypatch) -> list[str]:
    """Files of a place and a policy, and the painted environment under every name."""
    (tmp_path / "scene.xml").write_text(SCENE)
    (tmp_path / "still.py").write_text(STILL)
    files.write_json(tmp_path / "routes.json", ROUTES)
    made: list[PaintedEnvironment] = []

    def make(name, where, conditions=None):
        made.append(PaintedEnvironment(where.camera, Grey()))
        made[-1].name = name
        return made[-1]

    monkeypatch.setattr(evaluate_work, "make_environment", make)
    monkeypatch.chdir(tmp_path)
    options = ["--scene", "scene.xml", "--routes-file", "routes.json"]
    options += ["--workers", "1", *CALLABLE, "--runs", "2"]
    return ["evaluate", "still.py:drive", "--environments", "mitsuba", *options]


def with_policy(name: str, place: list[str]) -> list[str]:
    """Name a policy that needs no word about how it is called."""
    return ["evaluate", name, *(word for word in place[2:] if word not in CALLABLE)]


def test_the_command_prints_a_card_as_json(place, capsys):
    assert cli.main([*place, "--json", "-o", "card.json"]) == 0
    printed = json.loads(capsys.readouterr().out)
    assert printed == files.read_json("card.json")
    assert list(printed) == ["mitsuba"]
    assert list(printed["mitsuba"]) == ["straight"]
    # without objects there is no case with objects
    assert list(printed["mitsuba"]["straight"]) == ["no_object"]
    figures = printed["mitsuba"]["straight"]["no_object"]
    assert figures["n"] == len(figures["per_run"]) == 2
    assert figures["expert"]["cross_track_mean_m"] < figures["cross_track_mean_m"]


def test_finished_drives_are_kept_and_more_runs_add_to_them(place, capsys, monkeypatch):
    assert cli.main([*place, "--json"]) == 0
    first = json.loads(capsys.readouterr().out)
    kept = sorted(Path("runs/evaluate").rglob("*.safetensors"))
    assert len(kept) == 4  # two of the policy, two of the expert
    times = [path.stat().st_mtime_ns for path in kept]
    kept[0].unlink()
    assert cli.main([*place, "--json", "--runs", "3"]) == 0
    second = json.loads(capsys.readouterr().out)
    old, new = (card["mitsuba"]["straight"]["no_object"] for card in (first, second))
    assert new["per_run"][:2] == old["per_run"]
    assert [path.stat().st_mtime_ns for path in kept[1:]] == times[1:]
    monkeypatch.setattr(evaluate_work, "make_environment", None)  # nothing is driven
    assert cli.main([*place, "--json", "--runs", "3"]) == 0
    assert json.loads(capsys.readouterr().out) == second


def test_an_interrupted_evaluation_continues(place, capsys, monkeypatch):
    whole = PaintedEnvironment.step
    steps = 0

    def step(self, control):
        nonlocal steps
        steps += 1
        if steps == 100:
            raise KeyboardInterrupt
        return whole(self, control)

    monkeypatch.setattr(PaintedEnvironment, "step", step)
    assert cli.main([*place, "--json", "--drives", "kept"]) == 130
    kept = len(list(Path("kept").rglob("*.safetensors")))
    assert kept == 1  # 76 steps each
    assert cli.main([*place, "--json", "--drives", "kept"]) == 0
    assert steps == 100 + 3 * 76
    capsys.readouterr()


def test_a_folder_that_cannot_be_made_is_told_before_the_first_drive(place, capsys):
    Path("file").write_text("")
    assert cli.main([*place, "--drives", "file"]) == 2
    err = capsys.readouterr().err
    assert "file: " in err and "driving" not in err


def test_drives_without_objects_are_announced(place, capsys):
    assert cli.main([*place, "--horizon", "3"]) == 0
    assert "no drives past objects" in capsys.readouterr().err
    assert cli.main([*place, "--horizon", "3", "--objects", "0"]) == 0
    assert "no drives past objects" not in capsys.readouterr().err


def test_a_damaged_record_is_found_before_the_first_drive(place, capsys):
    PilotNet(1, 0.6, "rad/s").save("net.safetensors")
    Path("net.json").write_text("{")
    place = with_policy("net.safetensors", place)
    assert cli.main([*place, "--page", "out"]) == 2
    assert "net.json" in capsys.readouterr().err
    assert not Path("runs").exists()


def test_conditions_are_rows_of_their_own(place, capsys):
    place += ["--horizon", "3", "--conditions", "day", "evening", "noon:+1"]
    assert cli.main([*place, "--json"]) == 0
    printed = json.loads(capsys.readouterr().out)
    assert list(printed) == ["mitsuba", "mitsuba@evening", "mitsuba@noon+1EV"]


def test_a_page_tells_errors_failures_and_how_they_were_measured(place, capsys):
    # a lane hardly wider than the car: every start is out of it
    narrow = {"straight": {**ROUTES["straight"], "lane_width_m": 1.81}}
    files.write_json("routes.json", narrow)
    assert cli.main([*place, "--page", "out", "--seed", "4"]) == 0
    assert "departed" in capsys.readouterr().out  # the table; failures are figures
    text = Path("out/still-drive.md").read_text()
    assert "2 of 2 drives left the lane" in text
    assert "Drives that left the lane: 2 of 2." in text
    assert "| mitsuba | straight | no_object | 2 |" in text
    assert "There is no record of the training" in text
    assert "mi-nerfattack evaluate still.py:drive --environments mitsuba" in text
    assert "--seed 4" in text and "file_sha256" in text
    assert "Times of day driven in: day" in text
    assert files.read_image("out/still-drive.png").std() > 5
    document = files.read_json("out/still-drive.card.json")
    assert (
        document["environments"]["mitsuba"]["straight"]["no_object"]["drives_departed"]
        == 2
    )
    assert document["training"] is None


def test_commands_are_written_anew_without_the_machine_s_folders():
    options = Evaluate(
        "/home/me/my policy.pt2",
        runs=3,
        routes=("left", "right"),
        where=PlaceOptions(scene=Path("here/scene.xml")),
        json=True,
    )
    assert command_line("evaluate", options) == (
        "mi-nerfattack evaluate 'my policy.pt2' --routes left right --runs 3 "
        "--scene here/scene.xml --json"
    )
    train = Train(Path("/tmp/p.safetensors"), Path("data"), frames={"mitsuba": 8})
    assert command_line("train", train) == (
        "mi-nerfattack train --output p.safetensors --data data --frames mitsuba 8"
    )


def test_pages_are_named_after_the_policy():
    assert policy_name("bundled:policy/pilotnet.safetensors") == "pilotnet"
    assert policy_name("folder/mine.py:Net") == "mine-Net"
    assert policy_name("http://127.0.0.1:8000") == "policy"


def test_a_summary_counts_all_drives():
    figures = {"n": 5, "drives_departed": 1, "cross_track_mean_m": 0.25}
    text = summary({"mitsuba": {"left": {"no_object": figures, "random": figures}}})
    assert text.startswith("2 of 10 drives left the lane")


def test_one_process_asks_a_server_that_may_keep_a_state():
    """It starts anew where step is 0, and cannot tell the drives of two apart."""
    here = ProgramSection(kind="onnx", file="mine.onnx")
    there = HttpSection(kind="http", url="http://a:1")
    assert Evaluate()._workers(there) == InThisProcess()
    assert Evaluate(workers=2)._workers(there) == Processes(2)
    assert Evaluate(workers=3)._workers(here) == Processes(3)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (["--runs", "0"], "EvaluateSettings.runs: 0"),
        (["--workers", "0"], "workers: 0"),
        (["--environments", "moon"], "--environments: 'moon'; one of"),
        (["--environments", "replay"], "--environments: 'replay'"),
        (["--environments", "mitsuba", "mitsuba"], "each once"),
        (["--routes", "loop"], "no route 'loop'; it has 'straight'"),
        (["--conditions", "night"], "--conditions: 'night'"),
        (["--conditions", "day:bright"], "--conditions: 'day:bright'"),
        (["--spp", "0"], "spp: 0"),
        (["--goal", "integer"], "still.py:drive: policy.goal: "),
        (["--routes-file", "nothing.json"], "nothing.json: does not exist"),
        (["--scene", "nothing.xml"], "nothing.xml: does not exist"),
        (["--object", "nothing.safetensors"], "nothing.safetensors: does not exist"),
        (["--output", "no/folder/card.json"], "no/folder/card.json"),
        (["--place", "moon"], "place: 'moon'"),
        (["--scale", "1", "2", "3"], "--scale: 1.0 2.0 3.0; least and most"),
        (["--scale", "2", "1"], "2.0 to 1.0; the smaller comes first"),
        (["--objects", "-1"], "EvaluateSettings.objects: (-1,)"),
    ],
)
def test_bad_options_are_one_message(place, capsys, change, message):
    assert cli.main([*place, *change]) == 2
    errors = capsys.readouterr().err
    assert message in errors and "Traceback" not in errors
    assert not list(Path().rglob("*.safetensors"))


def test_routes_that_cannot_be_measured_are_told_before_the_first_drive(
    place, capsys, monkeypatch
):
    monkeypatch.setattr(evaluate_work, "make_environment", None)  # nothing is driven
    narrow = {"straight": {**ROUTES["straight"], "lane_width_m": 1.7}}
    files.write_json("routes.json", narrow)
    assert cli.main(place) == 2
    assert "route 'straight': its lane is 1.7 m wide" in capsys.readouterr().err
    short = {"straight": {**ROUTES["straight"], "points_m": [[0, 0], [5, 0]]}}
    files.write_json("routes.json", short)
    save_field("box.safetensors", small_grid())
    assert cli.main([*place, "--object", "box.safetensors"]) == 2
    assert "route 'straight': places for 0 of 1" in capsys.readouterr().err


def test_numbers_of_objects_are_cases_and_add_drives(place, capsys):
    save_field("box.safetensors", small_grid())
    command = [*place, "--object", "box.safetensors", "--horizon", "3", "--json"]
    assert cli.main(command) == 0
    first = json.loads(capsys.readouterr().out)["mitsuba"]["straight"]
    kept = {path: path.stat().st_mtime_ns for path in Path("runs").rglob("run_*")}
    assert cli.main([*command, "--objects", "0", "1", "6", "--scale", "1", "2"]) == 0
    scaled = json.loads(capsys.readouterr().out)["mitsuba"]["straight"]
    assert list(scaled) == ["no_object", "random", "random_6"]
    assert cli.main([*command, "--objects", "6", "1", "--page", "page"]) == 0
    found = json.loads(capsys.readouterr().out)["mitsuba"]["straight"]
    assert {case: found[case] for case in first} == first
    assert all(path.stat().st_mtime_ns == then for path, then in kept.items())
    assert "random_6" in Path("page/still-drive.md").read_text()
    starts = [[run["start"] for run in found[case]["per_run"]] for case in found]
    assert starts[0] == starts[1] == starts[2]


def test_an_environment_that_is_not_installed_is_one_message(
    place, capsys, monkeypatch
):
    """And before anything is driven in the environments named before it."""
    monkeypatch.setattr(evaluate_work, "make_environment", make_environment)
    monkeypatch.setitem(sys.modules, "carla", None)
    town = ["--server", "127.0.0.1:2000/Town01", "--workers", "1"]
    assert cli.main([*place, "--environments", "mitsuba", "carla", *town]) == 2
    errors = capsys.readouterr().err
    assert "pip install" in errors and "carla" in errors
    assert "Traceback" not in errors and "step" not in errors
    assert not list(Path("runs").rglob("*.safetensors"))


@pytest.mark.parametrize(
    ("policy", "message"),
    [
        ("nothing.safetensors", "nothing.safetensors: does not exist"),
        ("nothing.toml", "nothing.toml: does not exist"),
        ("empty.toml", "empty.toml: has no section [policy]"),
        ("key.toml", "key.toml: policy.colour"),
        ("small.py:Small", "small.py:Small: fails on an input of shape"),
        ("drawn.py:Drawn", "drawn.py:Drawn: its weights are random"),
        ("nan.py:Bad", "it must be finite"),
        ("noise.bin", "its suffix tells no kind"),
        ("noise.safetensors", "noise.safetensors"),
    ],
)
def test_policies_that_do_not_fit_are_one_message(place, capsys, policy, message):
    Path("empty.toml").write_text("[scene]\n")
    Path("key.toml").write_text('[policy]\nfile = "still.py:drive"\ncolour = "red"\n')
    Path("small.py").write_text(  # for images of 66 x 100 pixels
        "import torch\nfrom torch import nn\n\n\ndef Small():\n"
        "    torch.manual_seed(0)\n"
        "    return nn.Sequential(nn.Flatten(), nn.Linear(3 * 66 * 100, 1))\n"
    )
    Path("drawn.py").write_text(
        "from torch import nn\n\n\ndef Drawn():\n"
        "    return nn.Sequential(nn.Flatten(), nn.Linear(3 * 66 * 200, 1))\n"
    )
    Path("nan.py").write_text(
        "from torch import nn\n\n\nclass Bad(nn.Module):\n"
        "    def forward(self, image):\n"
        "        return image.mean((1, 2, 3)) * float('nan')\n"
    )
    Path("noise.bin").write_bytes(b"noise")
    Path("noise.safetensors").write_bytes(b"noise")
    place = with_policy(policy, place)
    place += ["--trust-code"] * policy.endswith((":Small", ":Drawn", ":Bad"))
    assert cli.main(place) == 2
    errors = capsys.readouterr().err
    assert message in errors and "Traceback" not in errors
    assert not Path("runs").exists()


def test_a_policy_of_another_unit_is_refused(capsys, tmp_path, monkeypatch):
    """The bundled policy gives heading rates, the room's car takes angles."""
    monkeypatch.chdir(tmp_path)
    room = ["evaluate", "--place", "room", "--environments", "mitsuba"]
    assert cli.main(room) == 2
    assert "gives rad/s, the car of the place takes rad" in capsys.readouterr().err


def test_the_experts_camera_suits_every_environment():
    """CARLA's cameras have square pixels."""
    camera = evaluate_work._EXPERT_CAMERA
    assert camera.fx == camera.fy


def test_a_toml_file_says_how_the_policy_is_called(place, capsys):
    Path("mine.toml").write_text(
        '[policy]\nkind = "callable"\nfile = "still.py:drive"\ntrust_code = true\n'
        "[policy.preprocess]\nresize_px = [10, 5]\n"
    )
    place = with_policy("mine.toml", place)
    assert cli.main([*place, "--json", "--horizon", "2"]) == 0
    assert (
        json.loads(capsys.readouterr().out)["mitsuba"]["straight"]["no_object"]["n"]
        == 2
    )
    assert cli.main([*place, "--goals", "3"]) == 2
    assert "mine.toml: says itself" in capsys.readouterr().err


def test_a_toml_file_can_bring_the_policy_s_camera(place, capsys):
    text = '[policy]\nfile = "seen.py:drive"\nkind = "callable"\ntrust_code = true\n'
    text += "[camera]\n"
    Path("mine.toml").write_text(text + "width = 40\nheight = 20\nfov_x_deg = 60.0\n")
    Path("seen.py").write_text(
        "def drive(image, goal, step):\n"
        "    assert image.shape[1:] == (3, 20, 40), image.shape\n"
        "    return [0.0] * len(image)\n"
    )
    place = with_policy("mine.toml", place)
    assert cli.main([*place, "--horizon", "2"]) == 0
    Path("mine.toml").write_text(text + "width = 0\n")
    capsys.readouterr()
    assert cli.main([*place, "--horizon", "2"]) == 2
    assert re.search(r"mine.toml: camera.width: .*\(is .*\)", capsys.readouterr().err)


TURNING = """
[policy]
kind = "callable"
file = "turn.py:drive"
trust_code = true
[camera]
width = 8
height = 4
[vehicle]
model = "ackermann"
speed_ms = 4.0
wheelbase_m = 2.0
width_m = 1.5
dt_s = 0.2
"""


def test_a_toml_file_brings_the_vehicle_whose_control_its_policy_gives(
    place, monkeypatch, capsys
):
    """Radians of steering turn by speed / wheelbase * tan, no heading rate does."""
    monkeypatch.setattr(evaluate_work, "make_environment", make_environment)
    Path("mine.toml").write_text(TURNING)
    Path("turn.py").write_text("def drive(image, goal, step):\n    return [0.2]\n")
    place = with_policy("mine.toml", place)
    assert cli.main([*place, "--horizon", "3", "--runs", "1", "--json"]) == 0
    figures = json.loads(capsys.readouterr().out)["mitsuba"]["straight"]["no_object"]
    assert figures["departure_limit_m"] == pytest.approx((3.5 - 1.5) / 2)
    path = next(Path("runs").rglob("no_object/run_0000.safetensors"))
    states = files.read_safetensors(path)[0]["states"][:, :3]
    turned = np.diff(states[:, 2])
    np.testing.assert_allclose(turned, 0.2 * 4 / 2 * np.tan(0.2), rtol=1e-4)
    driven = np.linalg.norm(np.diff(states[:, :2], axis=0), axis=1)
    np.testing.assert_allclose(driven, 0.2 * 4, rtol=1e-3)
    Path("mine.toml").write_text(TURNING.replace("2.0", "3.0"))
    monkeypatch.setattr(evaluate_work, "make_environment", None)  # other drives
    with pytest.raises(TypeError):
        cli.main([*place, "--horizon", "3", "--runs", "1"])


def test_a_scenario_is_driven_in_its_own_scene(place, monkeypatch, capsys):
    painted, seen = evaluate_work.make_environment, []

    def make(name, where, conditions=None):
        seen.append(where)
        return painted(name, where, conditions)

    monkeypatch.setattr(evaluate_work, "make_environment", make)
    write_named_files(Path())
    Path("deployment.xml").write_text(SCENE)
    files.write_json("routes.json", {**ROUTES, "lane": ROUTES["straight"]})
    policy = 'kind = "callable"\nfile = "still.py:drive"\ntrust_code = true'
    vehicle = '[vehicle]\nmodel = "ackermann"\n'
    text = HEAD.replace('file = "policy.safetensors"', policy) + vehicle
    Path("mine.toml").write_text(text)
    command = with_policy("mine.toml", place)
    own = [word for word in command if word not in ("--scene", "--routes-file")]
    own = [word for word in own if word not in ("scene.xml", "routes.json")]
    short = ["--horizon", "2", "--objects", "0", "--json"]
    assert cli.main([*own, *short]) == 0
    assert list(json.loads(capsys.readouterr().out)["mitsuba"]) == ["lane"]
    assert seen[0].scene.name == "deployment.xml"
    assert seen[0].field.name == "scene.safetensors"
    assert [path.name for path in seen[0].objects] == ["object.safetensors"]
    assert seen[0].car.control_unit == "rad" and seen[0].motion is not None
    seen.clear()
    assert cli.main([*command, *short]) == 0
    assert list(json.loads(capsys.readouterr().out)["mitsuba"]) == ["straight", "lane"]
    assert seen[0].scene.name == "scene.xml" and seen[0].car.control_unit == "rad"


def test_vehicles_that_do_not_fit_are_one_message(place, capsys):
    PilotNet(1, 0.6, "rad/s").save("net.safetensors")
    vehicle = '[vehicle]\nmodel = "ackermann"\n'
    Path("net.toml").write_text(f'[policy]\nfile = "net.safetensors"\n{vehicle}')
    assert cli.main(with_policy("net.toml", place)) == 2
    assert "gives rad/s, the car of the place takes rad" in capsys.readouterr().err
    Path("net.toml").write_text(
        f'[policy]\nfile = "net.safetensors"\n{vehicle}lag = 1\n'
    )
    assert cli.main(with_policy("net.toml", place)) == 2
    assert "net.toml: vehicle.lag: unknown key" in capsys.readouterr().err
    custom = 'model = "custom"\nfunction = "a.py:car"\ncontrol_limit = 1.0\n'
    Path("net.toml").write_text(
        f'[policy]\nfile = "net.safetensors"\n[vehicle]\n{custom}'
    )
    place = [*with_policy("net.toml", place), "--environments", "mujoco"]
    assert cli.main(place) == 2
    assert "mujoco drives a car with wheels" in capsys.readouterr().err
