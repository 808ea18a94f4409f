"""The page of results says what its folders hold, and needs nothing else."""

from __future__ import annotations

import base64
import io
import re
import shutil

import numpy as np
import pytest
from PIL import Image
from support.files.runs import PICTURES, make_retraining, make_run, make_transfer
from support.pages.read import PageReader

from mi_nerfattack import cli
from mi_nerfattack.experiment.page.run import read_run
from mi_nerfattack.experiment.page.write import _settings, write_page
from mi_nerfattack.io import files
from mi_nerfattack.report.pages.elements import FRAMES, PageContents, RunPart

pytestmark = pytest.mark.usefixtures("variant")


@pytest.fixture
def page_of(tmp_path):
    """Return what writes the page of folders, and its text and what a reader finds."""

    def read(*names, options=()):
        path, folders = tmp_path / "page.html", [str(tmp_path / name) for name in names]
        assert cli.main(["report", *folders, "-o", str(path), *options]) == 0
        page = files.read_text(path)
        reader = PageReader(page)
        reader.check_alone()
        return page, reader

    return read


def decoded(address):
    kind, _, data = address.partition(",")
    assert kind == "data:image/webp;base64"
    return np.asarray(Image.open(io.BytesIO(base64.b64decode(data))).convert("RGB"))


def test_a_run_is_on_one_page(tmp_path):
    document = make_run(tmp_path / "run", frames=4)
    shutil.rmtree(tmp_path / "run" / "frames" / "surrogate_random")
    shares = {"ball": [0.1, 0.1, 0.3, -0.2], "cone": [0.2, 0.1, 0.3, 0.1]}
    files.write_json(tmp_path / "run/attribution.json", {"gradient_share": shares})
    contents = PageContents(runs=[read_run(tmp_path / "run", "run")])
    write_page(tmp_path / "page.html", contents, tmp_path)
    page = files.read_text(tmp_path / "page.html")
    reader = PageReader(page)
    reader.check_alone()
    assert "<title>a &lt;ball&gt;</title>" in page
    assert 'name = "</pre>a <ball>"' in reader.text  # the scenario, escaped
    for sentence in (*document["flags"], *document["verdict"]):
        assert sentence in reader.text
    assert reader.text.index(document["flags"][0]) < reader.text.index("Figures")
    shown = [
        [figure[name] for name in ("n", "cross_track_mean_m", "cross_track_max_m")]
        for cases in document["routes"]["straight"].values()
        for figure in cases.values()
    ]
    cells = [row for row in reader.rows if len(row) == 10][1 : 1 + len(shown)]
    assert [[row[3], row[4], row[6]] for row in cells] == [
        [str(count), f"{mean:.3f}", f"{largest:.3f}"] for count, mean, largest in shown
    ]
    command = f"mi-nerfattack attack {tmp_path / 'run' / 'scenario.toml'} -o RUN"
    assert ["run", "7", command] in reader.rows
    sizes = [decoded(image["src"]).shape for image in reader.images]
    assert sizes.count((5, 6, 3)) == len(PICTURES)
    # frames of two cases, and a turntable
    sheets = [i for i in reader.images if "frame by frame" in i["alt"]]
    assert [i["alt"].split(", ")[1] for i in sheets] == ["no object", "attack"]
    assert len(sizes) == len(PICTURES) + 2 + 1
    # the attack acts most after 2 periods of 0.1 s, where the slider begins
    assert "0.2 s, -1.20 m</span>" in page and 'value="2"' in page
    for number, sheet in zip((0, 2), sheets, strict=True):
        pixels = decoded(sheet["src"])
        assert pixels.shape == (4 * 4, 8, 3)
        means = pixels.reshape(4, -1).mean(axis=1)
        np.testing.assert_allclose(means, 60 * number + 10 * np.arange(4), atol=3)


@pytest.mark.parametrize("gone", ["", "random"])
def test_without_an_attribution_the_slider_begins_where_frames_differ(tmp_path, gone):
    make_run(tmp_path / "run", frames=4)
    frames = tmp_path / "run" / "frames"
    if gone:
        shutil.rmtree(frames / f"surrogate_{gone}")
    shutil.copy(
        frames / "surrogate_attack/0003.png", frames / "surrogate_attack/0001.png"
    )
    (scrubber,) = read_run(tmp_path / "run", "run").scrubbers[FRAMES]
    assert scrubber.start == 1


def test_several_runs_stand_side_by_side(tmp_path, page_of):
    documents = {}
    for name, attacked, linf in (("one", 1.2, None), ("two", 2.4, 0.1)):
        attack = {
            "method": {"kind": "gradient"},
            "freedom": {"kind": "texture", "linf": linf},
        }
        scenario = {"name": name, "vehicle": {"dt_s": 0.1}, "objects": []}
        scenario["attack"] = attack
        changes = {"pictures": False, "flags": [], "scenario": scenario}
        documents[name] = make_run(tmp_path / name, attacked, **changes)
    page, reader = page_of("one", "two", options=["--title", "Both & all"])
    assert "<h1>Both &amp; all</h1>" in page
    for name, document in documents.items():
        cases = document["routes"]["straight"]["surrogate"]
        shown = "no_object", "random", "attack"
        means = [cases[case]["cross_track_mean_m"] for case in shown]
        overview, row, *_ = [row for row in reader.rows if row[0] == name]
        assert overview[6:] == [f"{means[2]:.3f}", row[7], *["1/1"] * 2]
        assert [row[3], row[4], row[6]] == [f"{mean:.3f}" for mean in means]
        assert row[7] == f"{means[2] / means[1]:.1f}"
    plots = {i["alt"] for i in reader.images}
    assert "Damage against frames, straight" in plots
    # where textures had other limits
    assert "Damage against the texture's budget, linf" in plots
    assert "Damage against the texture's budget, l2" not in plots
    # what makes the pictures that are missing
    folder = tmp_path / "one"
    assert f"attack {folder / 'scenario.toml'} -o {folder}" in reader.text


def test_plots_of_a_page_are_vectors_next_to_it(tmp_path, page_of, monkeypatch):
    for name in ("one", "two"):
        make_run(tmp_path / name, pictures=False)
    page_of("one", "two")
    assert not (tmp_path / "page_plots").exists()
    monkeypatch.setenv("MI_NERFATTACK_PLOTS", "pdf")
    page_of("one", "two")
    assert [path.name for path in (tmp_path / "page_plots").iterdir()] == [
        "Damage_against_frames_straight.pdf"
    ]


def test_other_policies_and_vehicles_have_plots_of_their_own(tmp_path, page_of):
    attack = {"method": {"kind": "gradient"}, "freedom": {"kind": "texture"}}
    made = {"name": "x", "objects": [], "attack": attack, "vehicle": {"dt_s": 0.1}}
    for name, changes in (
        ("one", {"seed": 1}),
        (
            "two",
            {
                "seed": 2,
                "attack": {**attack, "freedom": {"kind": "texture", "linf": 0.1}},
            },
        ),
        ("other", {"policy": {"file": "another.pt2"}}),
        ("bicycle", {"vehicle": {"dt_s": 0.1, "kind": "bicycle"}}),
    ):
        make_run(tmp_path / name, pictures=False, flags=[], scenario=made | changes)
    _, reader = page_of("one", "two", "other", "bicycle")
    plots = [i["alt"] for i in reader.images if i["alt"].startswith("Damage")]
    assert plots == [
        "Damage against frames, straight: one, two",
        "Damage against the texture's budget, linf: one, two",
    ]
    lines = [row[:3] for row in reader.rows if row[0] in ("other", "bicycle")]
    assert lines[:2] == [["other", "another.pt2", "–"], ["bicycle", "–", "bicycle"]]


def test_objectives_stand_in_the_line_of_a_run(tmp_path, page_of):
    for name in ("one", "other"):
        make_run(tmp_path / name, pictures=False)
    path = tmp_path / "other" / "metrics.json"
    document = files.read_json(path)
    document["objective"] = {"name": "rail.py:slow", "missing": {"mitsuba": "why"}}
    for environment, cases in document["routes"]["straight"].items():
        for number, figures in enumerate(cases.values()):
            value = -1.5 * number if environment == "surrogate" else None
            figures["objective"] = value
            for run in figures["per_run"]:
                run["objective"] = value
    files.write_json(path, document)
    _, reader = page_of("one", "other")
    lines = [next(row for row in reader.rows if row[0] == k) for k in ("one", "other")]
    assert [line[-2:] for line in lines] == [["–", "–"], ["-1.5", "-4.5"]]
    assert "It has no value in mitsuba: why." in reader.text


def test_files_of_a_scenario_count_by_their_checksums():
    def run(label, digest, file, **object_keys):
        scenario = {"policy": {"file": file}, "name": label}
        scenario["objects"] = [{"field": f"{label}/o.safetensors", **object_keys}]
        digests = {f"policy.file: {file}": digest, "objects[0].field: o": "o"}
        contents = {"pictures": {}, "scrubbers": {}, "missing": {}, "repeat": ""}
        provenance = {"scenario": "", "made_with": {}, "digests": digests}
        return RunPart(label, {"scenario": scenario}, **provenance, **contents)

    runs = [run("x", "1", "a.pt2"), run("y", "2", "a.pt2"), run("z", "1", "b.pt2")]
    assert grouped(runs) == [["x", "z"], ["y"]]
    # Older runs do not say that an object is a file; its place counts
    older, newer, turned = (
        run("old", "1", "a.pt2"),
        run("here", "1", "a.pt2", kind="field"),
        run("there", "1", "a.pt2", kind="field", yaw_deg=9.0),
    )
    assert grouped([older, newer, turned]) == [["old", "here"], ["there"]]


def grouped(runs, deployed=True):
    groups = _settings(PageContents(runs=runs), deployed)
    return [[run.label for run in own] for own in groups.values()]


def test_deployments_part_what_was_measured_in_them():
    def run(label, kind):
        scenario = {"name": label, "deployment": [{"kind": kind}]}
        contents = {"pictures": {}, "scrubbers": {}, "missing": {}, "repeat": ""}
        provenance = {"scenario": "", "made_with": {}, "digests": {}}
        return RunPart(label, {"scenario": scenario}, **provenance, **contents)

    runs = [run("a", "mitsuba"), run("b", "mujoco")]
    assert grouped(runs) == [["a"], ["b"]]
    assert grouped(runs, deployed=False) == [["a", "b"]]


def test_a_title_says_no_word_twice(tmp_path, page_of):
    make_transfer(tmp_path / "transfer")
    page, _ = page_of("transfer")
    assert "<title>transfer</title>" in page


def test_transfers_and_retrainings_are_tables(tmp_path, page_of):
    make_transfer(tmp_path / "moved")
    make_retraining(tmp_path / "better-retrain.json")
    page, reader = page_of("moved", "better-retrain.json")
    assert "<title>transfer moved, retraining better</title>" in page
    assert ["environment", "case", "day", "<noon>"] in reader.rows
    # nothing was driven at noon in the surrogate; of attacks, how many are out
    assert ["surrogate", "no object", "0.05", ""] in reader.rows
    assert ["", "attack", "0.80 2/2", ""] in reader.rows
    assert ["", "attack", "0.40 1/2", "0.20 0/2"] in reader.rows
    largest, least = (
        re.search(rf'style="background: (#\w+); color: (#\w+)">{text}<', page).groups()
        for text in ("0.80", "0.20")
    )
    assert largest == ("#fcffa4", "#000") and least[1] == "#fff"  # the map's ends
    middle = "0.400 to 1.600", "0.50", "8/8", "2/2 25 to 75 %", "2/2 25 to 75 %"
    assert ["surrogate", "day", "0.050", "0.800", *middle] in reader.rows
    after = "0.060", "0.090", "0.045 to 0.180", "1.50", "0/8", "0/2 25 to 75 %"
    assert ["", "", "after", *after] in reader.rows
    assert "third: the expert leaves its lane" in reader.text


def unfinished(name):
    """Return what makes a run of which a file is missing."""

    def make(folder):
        make_run(folder, pictures=False)
        (folder / name).unlink()

    return make


@pytest.mark.parametrize(
    ("make", "where"),
    [
        (lambda it: make_transfer(it, complete=False), "it/transfer.json"),
        (lambda it: (it / "cells").mkdir(parents=True), "it"),
        (lambda it: it.write_text("{}"), "it"),
        (lambda it: it.mkdir(), "it"),
        (unfinished("metrics.json"), "it"),
        (unfinished("scenario.toml"), "it"),
    ],
)
def test_what_is_not_finished_is_refused(tmp_path, capsys, make, where):
    make(tmp_path / "it")
    page = tmp_path / "page.html"
    assert cli.main(["report", str(tmp_path / "it"), "-o", str(page)]) == 2
    assert f"error: {tmp_path / where}: " in capsys.readouterr().err
    assert not page.exists()


def test_wrong_words_are_refused(tmp_path, capsys):
    make_run(tmp_path / "run", pictures=False)
    (tmp_path / "x").mkdir()
    run, twice = str(tmp_path / "run"), str(tmp_path / "x" / ".." / "run")
    rows = ([run], "page.pdf", "-o"), ([run, twice], "page.html", "FOLDER")
    for folders, name, where in rows:
        assert cli.main(["report", *folders, "-o", str(tmp_path / name)]) == 2
        assert f"{where}: " in capsys.readouterr().err
