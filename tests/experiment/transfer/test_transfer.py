"""Found attacks driven elsewhere: what is driven, kept, counted and refused."""

from __future__ import annotations

import json
import pickle
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mi_nerfattack import cli
from mi_nerfattack.backend.determinism import one_thread
from mi_nerfattack.deploy.driving import drive
from mi_nerfattack.errors import InputError
from mi_nerfattack.experiment.transfer import run as transfer_run
from mi_nerfattack.experiment.transfer.columns import (
    Column,
    Condition,
    make_columns,
)
from mi_nerfattack.experiment.transfer.figures import make_document
from mi_nerfattack.experiment.transfer.found import read_found
from mi_nerfattack.experiment.transfer.work import CASES, Batch, Opened, TransferWork
from mi_nerfattack.fields import load_grid, save_field
from mi_nerfattack.io import files
from mi_nerfattack.report.plots.transfer import plot_quality, quality_condition
from mi_nerfattack.report.table import quality_table, transfer_table
from mi_nerfattack.scenario.scenario import load_scenario

pytestmark = pytest.mark.usefixtures("variant")

SETTINGS = (
    ("surrogate", "mitsuba", "mitsuba_built_in", "mujoco"),
    ("day", "exposure:+1", "placement:0.3,latency:1", "pitch:2"),
)
ROWS = 3 + 3 * 4  # the surrogate has no exposure


def command(run: Path, *more: str) -> list[str]:
    names, conditions = SETTINGS
    words = ["transfer", str(run), "-o", "out", "--workers", "1", "--json"]
    words += ["--starts", "2", "--spp", "1", "--environments", *names]
    return [*words, "--conditions", *conditions, *more]


def small(run: Path, folder: Path, *environments: str, starts: int = 2) -> TransferWork:
    columns = make_columns(environments or ("surrogate",), ("day",), 1)
    return TransferWork(read_found([run]), columns, CASES, starts, 1, folder)


def kept_drive(run: Path, environment: str, case: str, number: int):
    for path in (run / "drives").glob("*.safetensors"):
        tensors, metadata = files.read_safetensors(path)
        record = json.loads(metadata["kept.record"])
        about = record["environment"], record["case"], record["run"]
        if about == (environment, case, number):
            return tensors
    raise AssertionError(f"no drive {environment} {case} {number}")


@pytest.mark.parametrize(
    ("environment", "label"), [("surrogate", "surrogate"), ("mitsuba", "deployment")]
)
def test_attacks_are_driven_unchanged(found_run, environment, label):
    """From a start of the run, drives are the run's, bit by bit.

    Past the attack but for what files of objects round: they have half precision.
    """
    found = read_found([found_run])
    assert found[0].offsets.any()
    opened = Opened(found)
    column = Column(environment, Condition(), 1)
    for case in CASES:
        world = opened.world(0)
        batch = Batch(0, column, case, {"case": case})
        seed = found[0].scenario.seed + 1
        with one_thread():
            result = drive(
                opened.environment(batch, seed),
                world.policy,
                world.route,
                world.initial[1],
                seed,
                world.horizon,
            )
        kept = kept_drive(found_run, label, case, 1)
        for name, array in result.arrays().items():
            atol = 5e-5 if case == "attack" else 0
            np.testing.assert_allclose(array, kept[name], 0, atol, err_msg=case)
    opened.close()


def test_the_command_drives_all_rows_and_goes_on(
    found_run, tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    whole, drives = transfer_run.case_figures, []

    def stop(work, batch, some):
        drives.append(batch)
        if len(drives) == 11:
            raise KeyboardInterrupt
        return whole(work, batch, some)

    monkeypatch.setattr(transfer_run, "case_figures", stop)
    assert cli.main(command(found_run)) == 130
    grown = files.read_json("out/transfer.json")
    assert not grown["complete"] and len(grown["rows"]) == 2 and not grown["columns"]
    times = {p: p.stat().st_mtime_ns for p in Path("out").rglob("*.safetensors")}
    assert len(times) == 2 * 11
    monkeypatch.setattr(transfer_run, "case_figures", whole)
    capsys.readouterr()
    assert cli.main(command(found_run)) == 0
    document = json.loads(capsys.readouterr().out)
    assert document == files.read_json("out/transfer.json")
    assert all(path.stat().st_mtime_ns == time for path, time in times.items())
    assert document["complete"]
    assert len(document["rows"]) == len(document["columns"]) == ROWS
    assert document["rows"][:2] == grown["rows"]
    for row in document["rows"]:
        assert list(row["cases"]) == list(CASES)
        for figures in row["cases"].values():
            assert figures["n"] == len(figures["per_run"]) == 2
            low, high = figures["departure_rate_ci95"]
            assert 0 <= low < high <= 1
    first = document["rows"][0]
    assert (first["environment"], first["condition"]) == ("surrogate", "day")
    assert first["ratio_to_surrogate"] == 1
    assert files.read_image("out/transfer.png").std() > 5
    assert transfer_table(document).row_count == ROWS + len(SETTINGS[0])
    # finished, nothing is opened again
    monkeypatch.setattr(Opened, "world", None)
    assert cli.main(command(found_run)) == 0
    assert json.loads(capsys.readouterr().out) == document
    assert cli.main(command(found_run, "--starts", "0")) == 2


def test_conditions_change_drives_and_own_objects_differ(found_run, tmp_path):
    columns = make_columns(("surrogate",), ("day", "placement:0.3", "pitch:3"), 1)
    work = TransferWork(read_found([found_run]), columns, CASES, 2, 1, tmp_path)
    opened = work.open()
    for index in range(len(work.batches)):
        work.do(opened, index, lambda units: None)
    work.close(opened)
    seen = {}
    for (_, column), row in work.rows.items():
        for case, batch in row.items():
            drives = work.read(batch)
            seen[column.condition.label, case] = [d.controls for d in drives]
    for case in CASES:
        plain, moved, turned = (seen[c.condition.label, case] for c in columns)
        same = [np.array_equal(a, b) for a, b in zip(plain, moved, strict=True)]
        assert all(same) if case == "no_object" else not any(same)
        assert not any(np.array_equal(a, b) for a, b in zip(plain, turned, strict=True))
    assert not np.array_equal(seen["day", "own"], seen["day", "attack"])
    assert not np.array_equal(*seen["day", "own"])  # two starts


def test_drives_without_what_was_found_are_shared(found_run, tmp_path):
    other = another(found_run, tmp_path / "other", 2.0)
    columns = make_columns(("surrogate", "mitsuba"), ("day",), 1)
    attacks = read_found([found_run, other])
    work = TransferWork(attacks, columns, CASES, 2, 1, tmp_path / "drives")
    assert [found.label for found in attacks] == ["run", "other"]
    assert len(work.rows) == 4
    assert len(work.batches) == 2 * (2 + 2 * 2)
    again = pickle.loads(pickle.dumps(work))  # as workers get it
    assert [b.digest for b in again.batches] == [b.digest for b in work.batches]
    figures = dict.fromkeys((b.digest for b in work.batches), made_figures(1.2, 0.5))
    document = make_document(work, figures)
    for column in document["columns"]:
        attack = column["cases"]["attack"]
        assert column["attacks"] == attack["attacks_out"] == 2
        assert column["transfer"] == {
            "of": 2,
            "kept": 2,
            "rate_ci95": attack["attacks_out_rate_ci95"],
        }
        assert attack["cross_track_mean_m"] == 0.5
        assert column["ratio_to_surrogate"] == pytest.approx(1)


@pytest.mark.parametrize("key", ["attached", "jitter"])
def test_what_decides_about_drives_in_the_surrogate(found_run, tmp_path, key):
    """Attached attacks see thin parts of fields; nothing of it is in other worlds."""
    columns = make_columns(("surrogate", "mitsuba"), ("day",), 1)
    (found,) = read_found([found_run])
    attack = found.scenario.attack.model_copy(update={key: True})
    scenario = found.scenario.model_copy(update={"attack": attack})
    one, other = (
        TransferWork([each], columns, CASES, 2, 1, tmp_path).batches
        for each in (found, replace(found, scenario=scenario))
    )
    changed = {
        a.column.environment
        for a, b in zip(one, other, strict=True)
        if a.digest != b.digest
    }
    assert changed == {"surrogate"}


def test_without_objects_it_does_not_matter_how_they_stand(found_run, tmp_path):
    columns = make_columns(("mitsuba", "mitsuba_built_in"), ("day", "turn:9"), 1)
    work = TransferWork(read_found([found_run]), columns, CASES, 2, 1, tmp_path)
    assert len(work.rows) == 4 and len(work.batches) == 4 * 3 + 1
    (empty,) = {row["no_object"] for row in work.rows.values()}
    assert empty.column == columns[0]


def another(run: Path, folder: Path, factor: float) -> Path:
    """Copy a run as if it had found other textures."""
    shutil.copytree(run, folder)
    path = folder / "objects" / "ball.safetensors"
    item = load_grid(path)
    item.set_parameter("texture", item.texture.numpy() * np.float32(factor))
    save_field(path, item)
    return folder


def made_figures(out_s: float, mean_m: float) -> dict:
    return {
        "n": 2,
        "cross_track_mean_m": mean_m,
        "cross_track_max_m": 2 * mean_m,
        "drives_departed": 1,
        "wheel_out_s": out_s,
    }


def test_ratios_and_rates_count_attacks(found_run, tmp_path):
    """Three attacks: two succeed in the surrogate, one of these in deployment."""
    others = [another(found_run, tmp_path / f"{k}", float(k)) for k in (2, 3)]
    columns = make_columns(("surrogate", "mitsuba"), ("day",), 1)
    attacks = read_found([found_run, *others])
    work = TransferWork(attacks, columns, ("attack",), 2, 1, tmp_path / "drives")
    surrogate = [(2.0, 0.4), (1.0, 0.8), (0.9, 0.1)]
    deployed = [(1.0, 0.2), (0.5, 0.2), (3.0, 0.1)]
    figures = {}
    for (number, column), row in work.rows.items():
        made = surrogate if column.environment == "surrogate" else deployed
        figures[row["attack"].digest] = made_figures(*made[number])
    document = make_document(work, figures)
    here, there = document["columns"]
    assert here["transfer"]["of"] == here["transfer"]["kept"] == 2
    assert there["transfer"]["of"] == 2 and there["transfer"]["kept"] == 1
    assert there["cases"]["attack"]["attacks_out"] == 2
    assert there["ratio_to_surrogate"] == pytest.approx((0.5 * 0.25 * 1.0) ** (1 / 3))
    assert there["cases"]["attack"]["cross_track_mean_m"] == pytest.approx(0.5 / 3)
    # a row that is not whole is left out, and the summary with it
    figures.popitem()
    grown = make_document(work, figures)
    assert len(grown["rows"]) == 5 and not grown["columns"]


def test_attacks_in_several_surrogates_are_grouped_by_them(found_run, tmp_path):
    """The better surrogate's attack transfers, the worse one's does not."""
    folders = [with_surrogate(found_run, tmp_path, "good", 28.5)]
    folders += [with_surrogate(found_run, tmp_path, "bad", 15.25)]
    columns = make_columns(("surrogate", "mitsuba"), ("day", "late:1"), 1)
    attacks = read_found(folders)
    work = TransferWork(attacks, columns, ("attack",), 2, 1, tmp_path / "drives")
    figures = {}
    for (number, column), row in work.rows.items():
        lost = number == 1 and column.environment != "surrogate"
        made = made_figures(0.2, 0.1) if lost else made_figures(2.0, 0.6)
        figures[row["attack"].digest] = made
    document = make_document(work, figures)
    bad, good = document["surrogates"]
    assert (bad["psnr_heldout_db"], good["psnr_heldout_db"]) == (15.25, 28.5)
    assert bad["steps"] == good["steps"] == 40
    assert (bad["attacks"], good["attacks"]) == (["bad"], ["good"])
    kept = [s["columns"][2]["transfer"]["kept"] for s in (bad, good)]
    assert kept == [0, 1]
    assert bad["columns"][2]["environment"] == "mitsuba"
    plot_quality(tmp_path / "quality.png", document)
    assert files.read_image(tmp_path / "quality.png").std() > 5
    condition = quality_condition(document)
    assert quality_table(document, condition).row_count == 2 * 2
    # one surrogate is no curve
    single = TransferWork(attacks[:1], columns, ("attack",), 2, 1, tmp_path / "drives")
    assert make_document(single, figures)["surrogates"] == []


def with_surrogate(run: Path, folder: Path, name: str, psnr: float) -> Path:
    """Copy a run as if it had been made in another field."""
    copied = another(run, folder / name, psnr / 10)
    (copied / "checkpoint.safetensors").unlink()
    scenario, _ = load_scenario(run / "scenario.toml")
    field = load_grid(scenario.scene.field.file)
    field.info.update({"fit.psnr_heldout_db": f"{psnr:.3f}", "fit.steps": "40"})
    save_field(folder / f"{name}.safetensors", field)
    path = copied / "scenario.toml"
    text = path.read_text().replace(
        str(scenario.scene.field.file), f"../{name}.safetensors"
    )
    path.write_text(text)
    return copied


def test_starts_are_unseen_and_do_not_depend_on_their_number(found_run, tmp_path):
    (found,) = read_found([found_run])
    starts = [found.start(1, number) for number in range(3)]
    assert len({seed for _, seed in starts}) == 3
    poses = np.array([pose for pose, _ in starts])
    assert (np.ptp(poses[:, 1:], axis=0) > 0).all()
    np.testing.assert_array_equal(found.start(1, 2)[0], poses[2])
    assert not np.array_equal(found.start(2, 0)[0], poses[0])
    found.check_starts(1, 50)
    fixed = tmp_path / "fixed"
    shutil.copytree(found_run, fixed)
    (fixed / "checkpoint.safetensors").unlink()
    text = (fixed / "scenario.toml").read_text()
    still = "[drive]\nlateral_sd_m = 0.0\nheading_sd_deg = 0.0\n"
    (fixed / "scenario.toml").write_text(text.replace("[drive]\n", still))
    with pytest.raises(InputError, match=r"fixed: start 0 is one of the run's own"):
        small(fixed, tmp_path)


def test_what_is_no_found_attack_is_refused(found_run, tmp_path):
    with pytest.raises(InputError, match="holds no finished attack"):
        read_found([tmp_path])
    with pytest.raises(InputError, match="each once"):
        read_found([found_run, found_run / "." / "../run"])
    changed = tmp_path / "changed"
    shutil.copytree(found_run, changed)
    scenario = changed / "scenario.toml"
    scenario.write_text(scenario.read_text().replace("horizon = 2", "horizon = 3"))
    with pytest.raises(InputError, match="scenario.drive.horizon: 2 -> 3"):
        read_found([changed])
    with pytest.raises(InputError, match="is the folder of a run"):
        transfer_run.check_output(found_run)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (["--environments", "moon"], "--environments: 'moon'; one of surrogate"),
        (["--environments", "surrogate_built_in"], "one of surrogate"),
        (["--conditions", "day", "day"], "--conditions: 'day day'; at least one"),
        (["--conditions", "night"], "'night': 'night'; a time of day"),
        (["--conditions", "late:0.5"], "late: invalid literal"),
        (["--conditions", "dropped:2"], "condition.dropped_share: 2.0"),
        (["--conditions", "blur:1,blur:2"], "'blur:2'; a time of day"),
        (["--cases", "random"], "--cases: 'random'; of no_object"),
        (["--spp", "0"], "spp: 0"),
    ],
)
def test_options_that_do_not_fit_are_told(found_run, tmp_path, change, message, capsys):
    words = command(found_run, *change)
    words[words.index("out")] = str(tmp_path / "out")
    assert cli.main(words) == 2
    assert message in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_a_light_that_no_sun_makes_is_told_before_the_first_drive(
    found_run, tmp_path, monkeypatch
):
    columns = make_columns(("mitsuba",), ("day", "evening"), 1)
    work = TransferWork(read_found([found_run]), columns, ("attack",), 1, 1, tmp_path)
    from mi_nerfattack.system.workers import InThisProcess

    with pytest.raises(InputError, match="sunsky"):
        transfer_run.run_transfer(work, tmp_path, InThisProcess())
    assert not list(tmp_path.rglob("*.safetensors"))
