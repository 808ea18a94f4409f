"""The command that evaluates policies: card, kept drives, page, and its inputs."""

from __future__ import annotations

import json
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import tomlkit
from support.files.runs import HEAD, write_named_files
from support.worlds import places

from mi_nerfattack import cli
from mi_nerfattack.commands.evaluate import Evaluate
from mi_nerfattack.commands.shared.evaluate_options import PlaceOptions
from mi_nerfattack.commands.shared.options import command_line
from mi_nerfattack.commands.shared.policy_file import PolicyFile
from mi_nerfattack.deploy.registry import make_environment
from mi_nerfattack.errors import InputError
from mi_nerfattack.evaluation import work as evaluate_work
from mi_nerfattack.fields.io import save_field
from mi_nerfattack.io import files
from mi_nerfattack.report.pages.policy import policy_name, summary
from mi_nerfattack.scenario.policy.kinds import HttpSection, ProgramSection
from mi_nerfattack.scenes import bundled
from mi_nerfattack.system.workers import InThisProcess, Processes

ROOT = Path(__file__).parents[2]

pytestmark = pytest.mark.usefixtures("variant")


@pytest.fixture
def place(tmp_path, monkeypatch) -> list[str]:
    return places.make_place(tmp_path, monkeypatch)


def test_the_command_prints_a_card_as_json(place, capsys):
    assert cli.main([*place, "--json", "-o", "card.json"]) == 0
    printed = json.loads(capsys.readouterr().out)
    assert printed == files.read_json("card.json")
    # without objects there is no case with objects
    figures = printed["mitsuba"]["straight"]["no_object"]
    assert printed == {"mitsuba": {"straight": {"no_object": figures}}}
    assert figures["n"] == len(figures["per_run"]) == 2
    assert figures["expert"]["cross_track_mean_m"] < figures["cross_track_mean_m"]


def card_of(place: list[str], drives: str) -> dict:
    """The card that the command writes."""
    path = Path(f"card of {drives}.json")
    assert cli.main([*place, "--drives", drives, "-o", str(path)]) == 0
    return files.read_json(path)


def test_two_processes_share_a_folder_of_drives(place, monkeypatch):
    """A second evaluation, from its beginning to its end within a drive of the first.

    Each drive that both make is one's or the other's, whole.
    """
    original, cards, steps = places.PaintedEnvironment.step, [], 0

    def step(self, control):
        nonlocal steps
        steps += 1
        if steps == 100:
            cards.append(card_of(place, "kept"))
        return original(self, control)

    monkeypatch.setattr(places.PaintedEnvironment, "step", step)
    card = card_of(place, "kept")
    assert card == cards[0] == card_of(place, "whole")
    assert {path.suffix for path in Path("kept").rglob("*.*")} == {".safetensors"}


def test_conditions_are_rows_of_their_own(place, capsys):
    place += ["--horizon", "3", "--conditions", "day", "evening", "noon,exposure:+1"]
    assert cli.main([*place, "--json"]) == 0
    printed = json.loads(capsys.readouterr().out)
    assert list(printed) == ["mitsuba", "mitsuba@evening", "mitsuba@noon+1EV"]


def test_a_page_tells_errors_failures_and_how_they_were_measured(place, capsys):
    # a lane hardly wider than the car: every start is out of it
    narrow = {"straight": {**places.ROUTES["straight"], "lane_width_m": 1.81}}
    files.write_json("routes.json", narrow)
    assert cli.main([*place, "--page", "out", "--seed", "4"]) == 0
    text = Path("out/still-drive.md").read_text()
    assert "| mitsuba | straight | no_object | 2 |" in text
    called = "--set policy.kind=callable --set policy.trust_code=true"
    assert f"mi-nerfattack evaluate still.py:drive {called} --environments" in text
    assert "--seed 4" in text and "file_sha256" in text
    document = files.read_json("out/still-drive.card.json")
    figures = document["environments"]["mitsuba"]["straight"]["no_object"]
    assert figures["drives_departed"] == 2 and document["training"] is None


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


def test_pages_are_named_after_the_policy_and_count_all_drives():
    assert policy_name("bundled:policy/pilotnet.safetensors") == "pilotnet"
    assert policy_name("folder/mine.py:Net") == "mine-Net"
    assert policy_name("http://127.0.0.1:8000") == "policy"
    figures = {"n": 5, "drives_departed": 1, "cross_track_mean_m": 0.25}
    text = summary({"mitsuba": {"left": {"no_object": figures, "random": figures}}})
    assert text.startswith("2 of 10 drives")


def test_one_process_asks_a_server_that_may_keep_a_state():
    """It starts anew where step is 0, and cannot tell the drives of two apart."""
    local = ProgramSection(kind="onnx", file="mine.onnx")
    remote = HttpSection(kind="http", url="http://a:1")
    assert Evaluate()._workers(remote) == InThisProcess()
    assert Evaluate(workers=2)._workers(remote) == Processes(2)
    assert Evaluate(workers=3)._workers(local) == Processes(3)


def test_numbers_of_objects_are_cases_and_add_drives(place, capsys):
    save_field("one.safetensors", places.small_grid())
    save_field("two.safetensors", places.small_grid(0.6))
    command = [*place, "--object", "one.safetensors", "two.safetensors"]
    command += ["--horizon", "3", "--json", "--runs", "4"]
    assert cli.main(command) == 0
    first = json.loads(capsys.readouterr().out)["mitsuba"]["straight"]
    files_there = Path("runs").rglob("*_000*.safetensors")
    times_ns = {path: path.stat().st_mtime_ns for path in files_there}
    assert cli.main([*command, "--objects", "0", "1", "6", "--scale", "1", "2"]) == 0
    scaled = json.loads(capsys.readouterr().out)["mitsuba"]["straight"]
    assert list(scaled) == ["no_object", "random", "random_6"]
    assert cli.main([*command, "--objects", "6", "1", "--page", "page"]) == 0
    figures = json.loads(capsys.readouterr().out)["mitsuba"]["straight"]
    assert {case: figures[case] for case in first} == first
    assert all(path.stat().st_mtime_ns == then for path, then in times_ns.items())
    assert "random_6" in Path("page/still-drive.md").read_text()
    starts = [[run["start"] for run in figures[case]["per_run"]] for case in figures]
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
    assert "pip install" in errors and "carla" in errors and "step" not in errors
    assert not list(Path("runs").rglob("*.safetensors"))


TURNING = """\
[policy]
kind = "callable"
file = "turn.py:drive"
trust_code = true
preprocess = { resize_px = [4, 2] }
[camera]
width = 8
height = 4
[vehicle]
kind = "ackermann"
speed_ms = 4.0
wheelbase_m = 2.0
width_m = 1.5
dt_s = 0.2
"""


def test_a_toml_file_brings_camera_and_vehicle_of_its_policy(
    place, monkeypatch, capsys
):
    """Radians of steering turn by speed / wheelbase * tan, no heading rate does."""
    monkeypatch.setattr(evaluate_work, "make_environment", make_environment)
    Path("mine.toml").write_text(TURNING)
    assertion = "    assert image.shape[1:] == (3, 2, 4), image.shape\n"
    Path("turn.py").write_text(f"def drive(image, *_):\n{assertion}    return [0.2]\n")
    place = places.with_policy("mine.toml", place)
    assert cli.main([*place, "--horizon", "3", "--runs", "1", "--json"]) == 0
    figures = json.loads(capsys.readouterr().out)["mitsuba"]["straight"]["no_object"]
    assert figures["departure_limit_m"] == pytest.approx((3.5 - 1.5) / 2)
    path = next(Path("runs").rglob("no_object_0000-*.safetensors"))
    states = files.read_safetensors(path)[0]["states"][:, :3]
    turned = np.diff(states[:, 2])
    np.testing.assert_allclose(turned, 0.2 * 4 / 2 * np.tan(0.2), rtol=1e-4)
    driven = np.linalg.norm(np.diff(states[:, :2], axis=0), axis=1)
    np.testing.assert_allclose(driven, 0.2 * 4, rtol=1e-3)
    Path("mine.toml").write_text(TURNING.replace("2.0", "3.0"))
    monkeypatch.setattr(evaluate_work, "make_environment", None)  # other drives
    with pytest.raises(TypeError):
        cli.main([*place, "--horizon", "3", "--runs", "1"])


CUSTOM = """\
kind = "custom"
function = "car.py:car"
trust_code = true
control_limit = 0.5
width_m = 1.5
"""
CAR = """\
import drjit as dr

def car(state, control):
    theta = state[2]
    return 5 * dr.cos(theta), 5 * dr.sin(theta), 5 / 2 * dr.tan(control)
"""


@pytest.mark.parametrize(
    ("unit", "has_expert"),
    [
        ("", False),
        ('control_unit = "other"', False),
        ('control_unit = "rad"\nwheelbase_m = 2.0', True),
    ],
)
def test_no_expert_drives_a_vehicle_whose_control_nobody_knows(
    place, monkeypatch, capsys, unit, has_expert
):
    """An expert that knows it drives as it drives the same car of another kind."""
    monkeypatch.setattr(evaluate_work, "make_environment", make_environment)
    Path("car.py").write_text(CAR)
    Path("turn.py").write_text("def drive(image, *_):\n    return [0.02]\n")
    steer = float(np.degrees(0.5))
    known = (
        f'kind = "ackermann"\nwheelbase_m = 2\nmax_steer_deg = {steer!r}\nwidth_m = 1.5'
    )
    cards = []
    for name, vehicle in (("known", known), ("mine", f"{CUSTOM}{unit}")):
        Path(f"{name}.toml").write_text(
            TURNING.partition('kind = "ackermann"')[0] + vehicle
        )
        command = [
            *places.with_policy(f"{name}.toml", place),
            "--horizon",
            "9",
            "--json",
        ]
        assert cli.main([*command, "--page", name]) == 0
        cards.append(
            json.loads(capsys.readouterr().out)["mitsuba"]["straight"]["no_object"]
        )
    other, mine = cards
    assert mine["cross_track_mean_m"] == pytest.approx(other["cross_track_mean_m"])
    (row,) = (
        x
        for x in Path("mine/turn-drive.md").read_text().split("\n")
        if x.startswith("| mitsuba | straight | no_object | 2 |")
    )
    assert row.endswith("| – |") != has_expert
    assert mine["expert"] == (pytest.approx(other["expert"]) if has_expert else None)


def test_a_scenario_is_driven_in_its_own_scene(place, monkeypatch, capsys):
    painted, opened = evaluate_work.make_environment, []

    def make(name, where, conditions=None):
        opened.append(where)
        return painted(name, where, conditions)

    monkeypatch.setattr(evaluate_work, "make_environment", make)
    write_named_files(Path())
    Path("deployment.xml").write_text(places.PAINTED)
    files.write_json(
        "routes.json", {**places.ROUTES, "lane": places.ROUTES["straight"]}
    )
    policy = 'kind = "callable"\nfile = "still.py:drive"\ntrust_code = true'
    vehicle = '[vehicle]\nkind = "ackermann"\n'
    text = HEAD.replace('file = "policy.safetensors"', policy) + vehicle
    Path("mine.toml").write_text(text)
    command = places.with_policy("mine.toml", place)
    own = [word for word in command if word not in ("--scene", "--routes-file")]
    own = [word for word in own if word not in ("scene.xml", "routes.json")]
    short = ["--horizon", "2", "--objects", "0", "--json"]
    assert cli.main([*own, *short]) == 0
    assert list(json.loads(capsys.readouterr().out)["mitsuba"]) == ["lane"]
    assert opened[0].scene.name == "deployment.xml"
    assert opened[0].field.name == "scene.safetensors"
    assert [path.name for path in opened[0].objects] == ["object.safetensors"]
    assert opened[0].car.control_unit == "rad" and opened[0].motion is not None
    # other objects stand in the scenario's scene, too
    opened.clear()
    save_field("mine.safetensors", places.small_grid())
    assert cli.main([*own, *short, "--object", "mine.safetensors"]) == 0
    assert list(json.loads(capsys.readouterr().out)["mitsuba"]) == ["lane"]
    assert opened[0].scene.name == "deployment.xml"
    assert [path.name for path in opened[0].objects] == ["mine.safetensors"]
    # another scene
    opened.clear()
    assert cli.main([*command, *short]) == 0
    assert list(json.loads(capsys.readouterr().out)["mitsuba"]) == ["straight", "lane"]
    assert opened[0].scene.name == "scene.xml" and opened[0].car.control_unit == "rad"


def test_options_replace_parts_of_a_scenarios_place():
    room = PolicyFile.read(str(bundled("room.toml")))
    unchanged = room.place(PlaceOptions())
    for key, option in (("field", "field"), ("routes", "routes_file")):
        changed = room.place(PlaceOptions(**{option: Path("mine")}))
        assert changed == replace(unchanged, **{key: Path("mine")})
    changed = room.place(PlaceOptions(object=(Path("mine"),)))
    assert changed == replace(unchanged, objects=(Path("mine"),))
    other = room.place(PlaceOptions(scene=Path("s.xml"), routes_file=Path("r.json")))
    assert (other.scene, other.field, other.objects) == (Path("s.xml"), None, ())


def test_files_of_objects_stand_for_a_scenarios_flat_objects():
    flat = PolicyFile.read(str(ROOT / "docs/examples/flat.toml"))
    with pytest.raises(InputError, match="a flat object without a file.*--object"):
        flat.place(PlaceOptions())
    assert flat.place(PlaceOptions(object=(Path("a"),))).objects == (Path("a"),)


TURNED = [[0.0, -2.0, 0.0, 3.0], [2.0, 0.0, 0.0, -1.0], [0, 0, 2.0, 0], [0, 0, 0, 1]]


@pytest.mark.parametrize("to_world", [None, TURNED])
def test_the_field_stands_where_the_scenario_puts_it(tmp_path, to_world):
    table = tomlkit.parse(bundled("room.toml").read_text(encoding="utf-8")).unwrap()
    if to_world is not None:
        table["scene"]["to_world"] = to_world
    path = tmp_path / "scenario.toml"
    path.write_text(tomlkit.dumps(table), encoding="utf-8")
    place = PolicyFile.read(str(path)).place(PlaceOptions())
    assert place.field == bundled("room/field.safetensors")
    assert (place.field_pose is None) == (to_world is None)
    if place.field_pose is not None:
        moved = place.field_pose.apply(np.array([[1.0, 0, 0]]))
        assert moved[0].tolist() == pytest.approx([3, 1, 0])


@pytest.mark.usefixtures("variant")
def test_a_place_that_is_named_counts_though_it_is_the_usual_one(tmp_path):
    room = Evaluate(str(bundled("room.toml")), drives=tmp_path)
    assert room._work().place.scene == bundled("room/scene.xml")
    # of that place, which the policy of the room cannot drive
    with pytest.raises(InputError, match=r"goal: \[1\]; at least 0"):
        replace(room, where=PlaceOptions(place="intersection"))._work()


def test_set_keys_come_before_those_of_the_file():
    room = str(bundled("room.toml"))
    settings = ["policy.control_scale=2.0", "seed=7", "vehicle.width_m=0.25"]
    file = PolicyFile.read(room, settings)
    assert file.scenario is not None and file.scenario.seed == 7
    assert file.section.control_scale == 2.0
    assert file.vehicle is not None and file.vehicle.width_m == 0.25
    own = PolicyFile.read("mine.pt2", ["policy.kind=exported", "camera.width=80"])
    assert own.policy is not None and own.policy.kind == "exported"
    assert own.rig is not None and own.rig.size[0] == 80
