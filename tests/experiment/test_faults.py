"""Full disks and kills while found attacks are driven elsewhere and searched around."""

from __future__ import annotations

from pathlib import Path

import pytest
from helpers.faults import full_disk, kill, short_of_memory

from mi_nerfattack import cli
from mi_nerfattack.io import files, locks

pytestmark = pytest.mark.usefixtures("variant")

VERBS = {
    "transfer": "--environments surrogate mitsuba --conditions day --starts 1 --spp 1",
    "refine": "--drives 3 --candidates 2 --starts 1 --spp 1",
}
#: Of each verb: files at which the disk is full, one after the other.
WRITTEN = {
    "transfer": (("start_", 3), ("transfer.json", 2), ("transfer.png", 1)),
    "refine": (("search", 2), ("ball", 1), ("start_", 2), ("refine.json", 1)),
}


def command(verb: str, run: Path, output: Path) -> list[str]:
    words = [verb, str(run), "-o", str(output), "--workers", "1"]
    return [*words, *VERBS[verb].split()]


def finished(verb: str, run: Path, output: Path) -> dict:
    """What the command writes when nothing disturbs it any more."""
    assert cli.main(command(verb, run, output)) == 0
    assert not any(locks.is_partial(path) for path in output.rglob(".*"))
    return files.read_json(output / f"{verb}.json")


def drives(output: Path) -> dict[Path, int]:
    """Those that are done, and when they were written."""
    return {path: path.stat().st_mtime_ns for path in output.rglob("start_*")}


@pytest.fixture(scope="module")
def whole(found_run, tmp_path_factory):
    """What each verb writes where nothing disturbs it."""
    folder = tmp_path_factory.mktemp("whole")
    return {verb: finished(verb, found_run, folder / verb) for verb in VERBS}


@pytest.mark.parametrize("verb", VERBS)
def test_what_a_full_disk_left_goes_on(verb, found_run, whole, tmp_path, capsys):
    output, before = tmp_path / "out", {}
    for name, at in WRITTEN[verb]:
        with full_disk(name, at):
            assert cli.main(command(verb, found_run, output)) == 2
        error = capsys.readouterr().err
        assert f"{name}" in error and "no space left on the disk" in error
        for path in output.rglob("*.safetensors"):
            files.read_safetensors(path)
        assert not any(locks.is_partial(path) for path in output.rglob(".*"))
        assert drives(output).items() >= before.items()
        before = drives(output)
    assert finished(verb, found_run, output) == whole[verb]
    assert drives(output).items() >= before.items()


@pytest.mark.parametrize(
    ("verb", "stage"), [("transfer", "driving"), ("refine", "searching")]
)
def test_too_little_memory_keeps_what_is_done(
    verb, stage, found_run, whole, tmp_path, capsys
):
    output = tmp_path / "out"
    with short_of_memory(stage, at=6):
        assert cli.main(command(verb, found_run, output)) == 2
    assert "error: not enough memory: 249 TiB" in capsys.readouterr().err
    before = drives(output)
    assert before or (output / "search.safetensors").is_file()
    assert finished(verb, found_run, output) == whole[verb]
    assert drives(output).items() >= before.items()


@pytest.mark.slow
@pytest.mark.parametrize(("verb", "name"), [("transfer", "start_"), ("refine", "sea")])
def test_what_a_killed_process_left_goes_on(verb, name, found_run, whole, tmp_path):
    output = tmp_path / "out"
    kill(command(verb, found_run, output), tmp_path, name, at=3)
    assert any(locks.is_partial(path) for path in output.rglob(".*"))
    before = drives(output)
    assert len(before) == (2 if verb == "transfer" else 0)
    assert finished(verb, found_run, output) == whole[verb]
    assert drives(output).items() >= before.items()
