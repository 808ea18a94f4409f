"""The command that evaluates policies: its card, kept drives, page and messages."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import pytest
from helpers.faults import full_disk, kill, short_of_memory
from helpers.painted_place import ROUTES, make_place, with_policy
from helpers.roadside import PaintedEnvironment, small_grid

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


@pytest.fixture
def place(tmp_path, monkeypatch) -> list[str]:
    return make_place(tmp_path, monkeypatch)


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


def card_of(place: list[str], drives: str) -> dict:
    """The card that the command writes."""
    path = Path(f"card of {drives}.json")
    assert cli.main([*place, "--drives", drives, "-o", str(path)]) == 0
    return files.read_json(path)


@pytest.mark.slow
def test_a_killed_evaluation_continues(place, tmp_path):
    setup = (
        "import pytest\n"
        "from helpers.painted_place import make_place\n"
        "make_place(Path('.'), pytest.MonkeyPatch())\n"
    )
    kill([*place, "--drives", "kept"], tmp_path, "run_", at=3, setup=setup)
    kept = {p: p.stat().st_mtime_ns for p in Path("kept").rglob("run_*")}
    assert len(kept) == 2
    found = card_of(place, "kept")
    assert all(path.stat().st_mtime_ns == then for path, then in kept.items())
    assert found == card_of(place, "whole")


def test_too_little_memory_keeps_whole_drives(place, capsys):
    with short_of_memory("driving", at=200):
        assert cli.main([*place, "--drives", "kept"]) == 2
    assert "error: not enough memory: 249 TiB" in capsys.readouterr().err
    kept = {p: p.stat().st_mtime_ns for p in Path("kept").rglob("run_*")}
    assert len(kept) == 2
    assert card_of(place, "kept") == card_of(place, "whole")
    assert all(path.stat().st_mtime_ns == then for path, then in kept.items())


def test_a_full_disk_keeps_whole_drives(place, capsys):
    words = [*place, "--drives", "kept", "-o", "card.json"]
    with full_disk("run_", at=2):
        assert cli.main(words) == 2
    assert "no space left on the disk" in capsys.readouterr().err
    kept = {p: p.stat().st_mtime_ns for p in Path("kept").rglob("*.*")}
    assert len(kept) == 1 and not Path("card.json").exists()
    assert all(files.read_safetensors(path) for path in kept)
    with full_disk("card"):
        assert cli.main(words) == 2
    assert "card.json: no space left on the disk" in capsys.readouterr().err
    assert cli.main(words) == 0
    assert all(path.stat().st_mtime_ns == then for path, then in kept.items())
    assert files.read_json("card.json") == card_of(place, "whole")


def test_two_processes_share_a_folder_of_drives(place, monkeypatch):
    """A second evaluation, from its beginning to its end within a drive of the first.

    Each drive that both make is one's or the other's, whole.
    """
    whole, cards, steps = PaintedEnvironment.step, [], 0

    def step(self, control):
        nonlocal steps
        steps += 1
        if steps == 100:
            cards.append(card_of(place, "kept"))
        return whole(self, control)

    monkeypatch.setattr(PaintedEnvironment, "step", step)
    found = card_of(place, "kept")
    assert found == cards[0] == card_of(place, "whole")
    assert {path.suffix for path in Path("kept").rglob("*.*")} == {".safetensors"}


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
