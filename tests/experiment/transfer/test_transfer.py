"""Found attacks driven elsewhere: what is driven, kept, counted and refused."""

from __future__ import annotations

import json
import pickle
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from support.faults.refusals import refused_at
from support.pages.read import drawn

from mi_nerfattack import cli
from mi_nerfattack.backend.determinism import one_thread
from mi_nerfattack.drives.run import run_drives
from mi_nerfattack.drives.spec import DriveSpec
from mi_nerfattack.drives.store import Store, read_drives
from mi_nerfattack.errors import InputError
from mi_nerfattack.experiment.transfer import figures as transfer_run
from mi_nerfattack.experiment.transfer.columns import (
    Column,
    Condition,
    make_columns,
)
from mi_nerfattack.experiment.transfer.figures import make_document
from mi_nerfattack.experiment.transfer.found import read_found
from mi_nerfattack.experiment.transfer.work import (
    CASES,
    Batch,
    TransferDriver,
    TransferDrives,
)
from mi_nerfattack.fields import load_grid, save_field
from mi_nerfattack.io import files
from mi_nerfattack.report.plots.transfer import plot_quality, quality_condition
from mi_nerfattack.report.table import quality_table, transfer_table
from mi_nerfattack.scenario.scenario import load_scenario
from mi_nerfattack.system.workers import InThisProcess

pytestmark = pytest.mark.usefixtures("variant")

SETTINGS = (
    ("surrogate", "mitsuba", "mitsuba_built_in", "mujoco"),
    ("day", "exposure:+1", "placement:0.3,latency:1", "pitch:2"),
)
ROWS = 3 + 3 * 4  # the surrogate has no exposure


def command(run: Path, *options: str) -> list[str]:
    names, conditions = SETTINGS
    words = ["transfer", str(run), "-o", "out", "--workers", "1", "--json"]
    words += ["--runs", "2", "--spp", "1", "--environments", *names]
    return [*words, "--conditions", *conditions, *options]


def planned(folder, runs, environments, conditions="day", cases=CASES, starts=2):
    """Return drives of found attacks, of starts of seed 1."""
    attacks = read_found(runs)
    columns = make_columns(environments.split(), conditions.split(), 1)
    return TransferDrives(Store(folder), attacks, columns, cases, starts, 1)


def digests(work, number=0):
    """Return the batches of an attack by environment, condition and case."""
    return {
        (column.environment, column.condition.label, case): batch.digest
        for (index, column), row in work.rows.items()
        for case, batch in row.items()
        if index == number
    }


def kept_drive(run: Path, environment: str, case: str, number: int):
    (arrays,) = (
        drive.arrays()
        for drive in read_drives(run / "drives")
        if (drive.environment, drive.case, drive.run) == (environment, case, number)
    )
    return arrays


@pytest.mark.parametrize("environment", ["surrogate", "mitsuba"])
def test_attacks_are_driven_unchanged(found_run, environment):
    """From a start of the run, drives are the run's, bit by bit.

    Past the attack but for what files of objects round: they have half precision.
    """
    attacks = read_found([found_run])
    assert attacks[0].offsets.any()
    opened = TransferDriver(attacks)
    column, seed = Column(environment, Condition(), 1), attacks[0].scenario.seed + 1
    for case in CASES:
        world, identity = opened.world(0), {"case": case}
        batch = Batch(0, column, case, identity)
        labels = environment, "line", case, 1, seed, world.horizon, identity
        spec = DriveSpec(*labels, context=(batch, world.initial[1]))
        with one_thread():
            result = opened.drive(spec, lambda step: None)
        stored = kept_drive(found_run, environment, case, 1)
        for name, array in result.arrays().items():
            atol = 5e-5 if case == "attack" else 0
            np.testing.assert_allclose(array, stored[name], 0, atol, err_msg=case)
    opened.close()


def test_the_command_drives_all_rows(found_run, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert cli.main(command(found_run)) == 0
    document = json.loads(capsys.readouterr().out)
    assert document == files.read_json("out/transfer.json") and document["complete"]
    assert len(document["rows"]) == len(document["columns"]) == ROWS
    for row in document["rows"]:
        assert list(row["cases"]) == list(CASES)
        for figures in row["cases"].values():
            assert figures["n"] == len(figures["per_run"]) == 2
    first = document["rows"][0]
    assert (first["environment"], first["condition"]) == ("surrogate", "day")
    assert first["ratio_to_surrogate"] == 1
    assert Path("out/transfer.png").is_file()
    assert transfer_table(document).__rich__().row_count == ROWS + len(SETTINGS[0])
    # finished, nothing is opened again
    monkeypatch.setattr(TransferDriver, "world", None)
    assert cli.main(command(found_run)) == 0
    assert json.loads(capsys.readouterr().out) == document
    for option, value, where in (
        ("--runs", "0", "transfer.starts"),
        ("--cases", "random", "--cases"),
    ):
        assert cli.main(command(found_run, option, value)) == 2
        assert f"error: {where}: " in capsys.readouterr().err


def test_conditions_change_drives_and_own_objects_differ(found_run, tmp_path):
    conditions = ("day", "placement:0.3", "pitch:3")
    work = planned(tmp_path, [found_run], "surrogate", " ".join(conditions))
    driven = run_drives(work, InThisProcess())
    controls = {
        batch.digest: [item.drive.controls for item in items]
        for batch, items in zip(work.batches, driven, strict=True)
    }
    by_case = {key[1:]: controls[digest] for key, digest in digests(work).items()}
    for case in CASES:
        plain, moved, turned = (by_case[condition, case] for condition in conditions)
        same = [np.array_equal(a, b) for a, b in zip(plain, moved, strict=True)]
        assert all(same) if case == "no_object" else not any(same)
        assert not any(np.array_equal(a, b) for a, b in zip(plain, turned, strict=True))
    assert not np.array_equal(by_case["day", "own"], by_case["day", "attack"])
    assert not np.array_equal(*by_case["day", "own"])  # two starts


def test_drives_without_what_was_found_are_shared(found_run, tmp_path):
    other = another(found_run, tmp_path / "other", 2.0)
    work = planned(tmp_path / "drives", [found_run, other], "surrogate mitsuba")
    assert [attack.label for attack in work.attacks] == ["run", "other"]
    assert len(work.rows) == 4
    assert len(work.batches) == 2 * (2 + 2 * 2)
    again = pickle.loads(pickle.dumps(work))  # as workers get it
    assert [b.digest for b in again.batches] == [b.digest for b in work.batches]
    # nor does it matter how objects stand where there are none
    work = planned(tmp_path, [found_run], "mitsuba mitsuba_built_in", "day turn:9")
    assert len(work.rows) == 4 and len(work.batches) == 4 * 3 + 1
    (empty,) = {row["no_object"] for row in work.rows.values()}
    assert empty.column == next(iter(work.rows))[1]


@pytest.mark.parametrize("key", ["attached", "jitter"])
def test_what_decides_about_drives_in_the_surrogate(found_run, tmp_path, key):
    """Attached attacks see thin parts of fields; nothing of it is in other worlds."""
    work = planned(tmp_path, [found_run], "surrogate mitsuba")
    (original,) = work.attacks
    attack = original.scenario.attack.model_copy(update={key: True})
    scenario = original.scenario.model_copy(update={"attack": attack})
    other = replace(work, attacks=(replace(original, scenario=scenario),))
    one, two = digests(work), digests(other)
    assert {name[0] for name in one if one[name] != two[name]} == {"surrogate"}


def another(run: Path, folder: Path, factor: float) -> Path:
    """Copy a run as if it had found other textures."""
    shutil.copytree(run, folder)
    path = folder / "objects" / "ball.safetensors"
    item = load_grid(path)
    item.set_parameter("texture", item.texture.numpy() * np.float32(factor))
    save_field(path, item)
    return folder


def made_figures(out_s: float, mean_m: float) -> dict:
    run = {
        "cross_track_mean_m": mean_m,
        "cross_track_max_m": 2 * mean_m,
        "wheel_out_s": out_s,
    }
    runs = [run | {"run": k, "steps_departed": k} for k in range(2)]
    return {"n": 2, **run, "drives_departed": 1, "per_run": runs}


def test_ratios_and_rates_count_attacks(found_run, tmp_path):
    """Three attacks: two succeed in the surrogate, one of these in deployment."""
    others = [another(found_run, tmp_path / f"{k}", float(k)) for k in (2, 3)]
    runs, folder = [found_run, *others], tmp_path / "drives"
    work = planned(folder, runs, "surrogate mitsuba", cases=("attack",))
    made = {
        "surrogate": [(2.0, 0.4), (1.0, 0.8), (0.9, 0.1)],
        "mitsuba": [(1.0, 0.2), (0.5, 0.2), (3.0, 0.1)],
    }
    figures = {
        row["attack"].digest: made_figures(*made[column.environment][number])
        for (number, column), row in work.rows.items()
    }
    document = make_document(work, figures)
    surrogate, deployment = document["columns"]
    assert surrogate["transfer"]["of"] == surrogate["transfer"]["kept"] == 2
    attack = deployment["cases"]["attack"]
    assert (deployment["transfer"]["of"], deployment["transfer"]["kept"]) == (2, 1)
    assert attack["attacks_out"] == 2
    assert deployment["ratio_to_surrogate"] == pytest.approx(
        (0.5 * 0.25 * 1.0) ** (1 / 3)
    )
    assert attack["cross_track_mean_m"] == pytest.approx(0.5 / 3)
    # a row that is not whole is left out, and the summary with it
    figures.popitem()
    grown = make_document(work, figures)
    assert len(grown["rows"]) == 5 and not grown["columns"]


def test_attacks_in_several_surrogates_are_grouped_by_them(
    found_run, tmp_path, monkeypatch
):
    """The better surrogate's attack transfers, the worse one's does not."""
    runs = [
        with_surrogate(found_run, tmp_path, name, psnr)
        for name, psnr in (("good", 28.5), ("bad", 15.25))
    ]
    folder, figures = tmp_path / "drives", {}
    work = planned(folder, runs, "surrogate mitsuba", "day late:1", ("attack",))
    for (number, column), row in work.rows.items():
        lost = number == 1 and column.environment != "surrogate"
        made = made_figures(0.2, 0.1) if lost else made_figures(2.0, 0.6)
        figures[row["attack"].digest] = made
    document = make_document(work, figures)
    bad, good = document["surrogates"]
    assert (bad["psnr_heldout_db"], good["psnr_heldout_db"]) == (15.25, 28.5)
    assert bad["steps"] == good["steps"] == 40
    assert (bad["attacks"], good["attacks"]) == (["bad"], ["good"])
    transferred = [s["columns"][2]["transfer"]["kept"] for s in (bad, good)]
    assert transferred == [0, 1]
    assert bad["columns"][2]["environment"] == "mitsuba"
    figures_drawn = drawn(monkeypatch)
    plot_quality(tmp_path / "quality.png", document)
    shares = figures_drawn[0].axes[0].lines[0].get_xydata()
    np.testing.assert_allclose(shares, [[15.25, 0], [28.5, 1]])
    assert len(quality_table(document, quality_condition(document)).records) == 2 * 2
    # one surrogate is no curve
    single = replace(work, attacks=work.attacks[:1])
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
    (attack,) = read_found([found_run])
    starts = [attack.start(1, number) for number in range(3)]
    assert len({seed for _, seed in starts}) == 3
    poses = np.array([pose for pose, _ in starts])
    assert (np.ptp(poses[:, 1:], axis=0) > 0).all()
    np.testing.assert_array_equal(attack.start(1, 2)[0], poses[2])
    assert not np.array_equal(attack.start(2, 0)[0], poses[0])
    attack.check_starts(1, 50)
    fixed = another(found_run, tmp_path / "fixed", 1.0)
    (fixed / "checkpoint.safetensors").unlink()
    text = (fixed / "scenario.toml").read_text()
    still = "[drive]\nlateral_sd_m = 0.0\nheading_sd_deg = 0.0\n"
    (fixed / "scenario.toml").write_text(text.replace("[drive]\n", still))
    with refused_at(fixed, "start 0 is"):
        planned(tmp_path, [fixed], "surrogate")


def test_what_is_no_found_attack_is_refused(found_run, tmp_path):
    changed = Path(shutil.copytree(found_run, tmp_path / "changed"))
    scenario = changed / "scenario.toml"
    scenario.write_text(scenario.read_text().replace("horizon = 2", "horizon = 3"))
    for runs, where in (
        ([tmp_path], str(tmp_path)),
        ([found_run, found_run / "." / "../run"], "RUN"),
    ):
        with refused_at(where):
            read_found(runs)
    with refused_at(changed / "checkpoint.safetensors", "drive.horizon: 2 -> 3"):
        read_found([changed])
    with refused_at(found_run):
        transfer_run.check_output(found_run)


def test_a_light_that_no_sun_makes_is_told_before_the_first_drive(found_run, tmp_path):
    work = planned(tmp_path, [found_run], "mitsuba", "day evening", ("attack",), 1)
    with pytest.raises(InputError, match="sunsky"):
        transfer_run.run_transfer(work, tmp_path, InThisProcess())
    assert not list(tmp_path.rglob("*.safetensors"))
