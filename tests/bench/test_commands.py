"""Each benchmark from its command to its file."""

from __future__ import annotations

import itertools
import json
import math
import sys
from pathlib import Path
from typing import get_type_hints

import pytest

from bench import certificates, end_to_end
from bench.__main__ import COMMANDS, main
from bench.attack import bench as attack
from bench.attack import scaling
from bench.render import bench as render
from mi_nerfattack import cli
from mi_nerfattack.commands.shared.terminal import Result

pytestmark = pytest.mark.usefixtures("variant")


def test_every_benchmark_starts_and_takes_json_if_it_has_figures(capsys):
    for name, command in COMMANDS.items():
        assert main([name, "--help"]) == 0
        output = capsys.readouterr().out
        assert f"python -m bench {name}" in output
        assert get_type_hints(command.run)["return"] is Result and "--json" in output
    assert main(["render", "--sizes", "200"]) == cli.EXIT_INPUT
    assert "--sizes: '200'" in capsys.readouterr().err


@pytest.fixture
def run(capsys, tmp_path):
    """Run a benchmark in its quickest form; return what it prints and has written."""

    def run(name: str, *words: str) -> dict:
        quick = ["--quick", "--repeats", "1", "-o", str(tmp_path / "results")]
        assert main([name, *quick, *words, "--json"]) == 0
        document = json.loads(capsys.readouterr().out)
        [written] = (tmp_path / "results").iterdir()
        assert json.loads(written.read_text()) == document
        assert written.name.startswith(document["date"])
        assert document["command"].startswith(f"python -m bench {name} ")
        return document

    return run


@pytest.mark.slow
def test_render_measures_both_sides(run):
    document = run("render", "--sizes", "16x8")
    assert document["kernels_compiled_after_warmup"] == 0
    row = document["sizes"]["16x8"]
    for side, (_, _, key, _) in itertools.product(("", "torch_"), render.ROWS):
        assert 0 < row[side + key] < math.inf
    assert row["samples"] == pytest.approx(row["torch_samples"], rel=0.02)


@pytest.mark.slow
def test_splats_are_measured_beside_mitsubas(run):
    row = run("splats", "--sizes", "16x8")["sizes"]["16x8"]
    for task in ("frame", "gradient"):
        theirs, own = row[f"volprim_rf_basic_{task}"], row[f"ours_{task}"]
        assert row[f"{task}_ratio"] == theirs / own > 0


@pytest.mark.slow
def test_fit_measures_both_sides(run):
    document = run("fit")
    assert [row["stage"] for row in document["steps"]] == ["early", "late"]
    for row in document["steps"]:
        ours, theirs = row["samples_per_step"], row["torch_samples_per_step"]
        assert theirs == pytest.approx(ours, rel=0.1)
        times = row["torch_seconds_per_step"], row["seconds_per_step"]
        assert row["torch_ratio"] == times[0] / times[1] > 0
    assert document["ratio"] == min(row["torch_ratio"] for row in document["steps"])


@pytest.mark.slow
def test_attack_measures_both_sides(run):
    document = run("attack", "--sizes", "32x16")
    row = document["sizes"]["32x16"]
    for name in attack.TIMES:
        assert row[f"{name}_seconds"] > 0 and row[f"{name}_cpu_seconds"] > 0
    iteration_seconds = row["kept_backgrounds_seconds"]
    assert row["torch_time_ratio"] == row["torch_seconds"] / iteration_seconds
    assert row["iteration_over_rollout"] == iteration_seconds / row["rollout_seconds"]
    assert row["kernels_compiled_after_warmup"] == 0


def test_scaling_is_written_row_by_row_and_goes_on(capsys, monkeypatch, tmp_path):
    path, measured = tmp_path / "scaling.json", []

    def cost(job, repeats):
        measured.append(job)
        if len(measured) == 2:
            raise KeyboardInterrupt
        value = float(job.width * job.poses**0.5)
        keys = (f"{n}_{unit}" for n in scaling.WAYS.values() for unit in ("ms", "mb"))
        return dict.fromkeys(keys, value)

    monkeypatch.setattr(scaling, "cost", cost)
    command = ["scaling", "--sizes", "32x16", "64x16", "--poses", "1", "4"]
    command += ["--objects", "1", "--horizons", "3", "-o", str(path)]
    assert main(command) == cli.EXIT_INTERRUPTED
    assert len(json.loads(path.read_text())["rows"]) == 1
    assert main(command) == 0
    assert [job.poses for job in measured] == [1, 1, 1, 4]
    capsys.readouterr()
    for words, where in (
        (["scaling", "--sizes", "32x16", "16x32"], "--sizes"),
        ([*command, "--repeats", "2"], path.name),
        ([*command, "--poses", "0"], "poses"),
    ):
        assert main(words) == cli.EXIT_INPUT
        assert where in capsys.readouterr().err
    powers = json.loads(path.read_text())["exponents"]
    assert powers.keys() == {"pixels", "poses"}  # none of one size
    assert powers["pixels"]["iteration_ms"] == pytest.approx(1)
    assert powers["poses"]["iteration_mb"] == pytest.approx(0.5)


class TestEndToEnd:
    """Whole commands of two checkouts, which here only note what they were asked."""

    @pytest.fixture
    def checkout(self, tmp_path, monkeypatch):
        other = tmp_path / "other"
        (other / ".venv/bin").mkdir(parents=True)
        (other / ".venv/bin/python").symlink_to(sys.executable)
        (other / "mi_nerfattack").mkdir()
        script = "import sys; open('asked', 'a').write(' '.join(sys.argv[1:]) + '\\n')"
        (other / "mi_nerfattack/cli.py").write_text(script)
        (other / "scenes").mkdir()
        (other / "scenes/demo.toml").write_text("[drive]\nruns = 4\n")
        monkeypatch.setenv("NERFATTACK_DATA", "data")
        words = {"list": "capture scene --help", "attack": "attack --help"}
        monkeypatch.setattr(end_to_end, "COMMANDS", words)
        return other

    def test_turns_are_timed_once(self, checkout, tmp_path, capsys):
        path = tmp_path / "times"
        words = ["end_to_end", "-o", str(path), "--other", str(checkout), "--former"]
        assert main([*words, "--repeats", "1"]) == 0
        assert capsys.readouterr().out.count("|\n") == 4
        assert main([*words, "--repeats", "2", "--json"]) == 0
        rows = json.loads(capsys.readouterr().out)["rows"]
        order = [(row["round"], row["checkout"], row["command"]) for row in rows]
        expected = [
            (turn, name, command)
            for turn in (0, 1)
            for command in ("list", "attack")
            for name in ("this", "other")
        ]
        assert order == expected
        assert all(row["seconds"] > 0 and row["peak_mb"] > 5 for row in rows)
        asked = (checkout / "asked").read_text().splitlines()
        assert asked == ["capture --help", "attack --help"] * 2
        assert "runs = 2" in (path / "other-1/short.toml").read_text()

    def test_leftovers_go_and_failures_end_it(self, checkout, tmp_path, monkeypatch):
        words = {"fit": "fit nothing -o {work}/field.safetensors"}
        monkeypatch.setattr(end_to_end, "COMMANDS", words)
        path = tmp_path / "times"
        (path / "this-0/field.report").mkdir(parents=True)
        with pytest.raises(SystemExit):
            main(["end_to_end", "-o", str(path), "--repeats", "1"])
        assert not (path / "this-0/field.report").exists()
        assert "nothing" in (path / "this-0/log.txt").read_text()

    def test_data_are_asked_for(self, monkeypatch, tmp_path, capsys):
        monkeypatch.delenv("NERFATTACK_DATA", raising=False)
        assert main(["end_to_end", "-o", str(tmp_path)]) == cli.EXIT_INPUT
        assert "NERFATTACK_DATA is not set" in capsys.readouterr().err


def test_certificates_are_made_once_and_counted(tmp_path, monkeypatch, capsys):
    made = []

    def certify(words):
        made.append(words[2])
        rows = [
            {"time_s": 0.5, "is_true": None, "along_predicted": 0.0, "along_real": 0.0},
            {
                "time_s": 1.0,
                "slope": 1.0 if words[2].endswith("one") else 3.0,
                "cosine": 0.9,
                "is_true": words[2].endswith("one"),
                "along_predicted": 2.0,
                "along_real": 1.0,
            },
        ]
        folder = Path(words[4])
        folder.mkdir(parents=True)
        (folder / "certificate.json").write_text(json.dumps({"rows": rows}))

    monkeypatch.setattr(certificates, "run_command", certify)
    words = ["certificates", "runs/one", "runs/two", "-o", str(tmp_path)]
    for _ in range(2):
        assert main(words) == 0
    capsys.readouterr()
    assert main([*words, "--json"]) == 0
    rows = json.loads(capsys.readouterr().out)["rows"]
    assert rows[0]["slope"] is None and rows[1]["slope"] == 1.0
    assert main([*words[:2], "other/one", *words[3:]]) == cli.EXIT_INPUT
    assert main(words) == 0
    assert made == ["runs/one", "runs/two"]
    lines = capsys.readouterr().out.splitlines()
    assert lines[-1] == "| 1.0 s | 1 of 2 | 2.00 | 0.90 | 0.50 |"
    assert "0.5 s" not in "".join(lines)  # nothing changes until then
    assert (tmp_path / "certificates.csv").read_text().count("\n") == 5
