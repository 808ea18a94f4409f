"""The page of results says what its folders hold, and needs nothing else."""

from __future__ import annotations

import base64
import io
import re
import shutil

import numpy as np
import pytest
from helpers.made_runs import PICTURES, make_retraining, make_run, make_transfer
from helpers.page_reader import PageReader
from PIL import Image

from mi_nerfattack import cli
from mi_nerfattack.experiment.page.run import read_run
from mi_nerfattack.experiment.page.write import write_page
from mi_nerfattack.io import files
from mi_nerfattack.report.pages.parts import Parts

pytestmark = pytest.mark.usefixtures("variant")


def report(*words):
    return cli.main(["report", *map(str, words)])


def page_of_run(folder):
    parts = Parts(runs=[read_run(folder / "run", "run")])
    write_page(folder / "page.html", parts, folder)


def decoded(address):
    kind, _, data = address.partition(",")
    assert kind == "data:image/webp;base64"
    return np.asarray(Image.open(io.BytesIO(base64.b64decode(data))).convert("RGB"))


def test_a_run_is_on_one_page(tmp_path):
    document = make_run(tmp_path / "run")
    page_of_run(tmp_path)
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
    assert sizes.count((4 * 4, 8, 3)) == 3  # frames
    assert len(sizes) == len(PICTURES) + 3 + 1  # and a turntable


def test_frames_are_scrubbed_beside_each_other(tmp_path):
    make_run(tmp_path / "run", frames=4)
    shutil.rmtree(tmp_path / "run" / "frames" / "surrogate_random")
    page_of_run(tmp_path)
    page = files.read_text(tmp_path / "page.html")
    sheets = [i for i in PageReader(page).images if "frame by frame" in i["alt"]]
    assert [i["alt"].split(", ")[1] for i in sheets] == ["no object", "attack"]
    # farthest out after 2 periods of 0.1 s, where the slider begins
    assert "0.2 s, -1.20 m</span>" in page and 'value="2"' in page
    for number, sheet in zip((0, 2), sheets, strict=True):
        pixels = decoded(sheet["src"])
        assert pixels.shape == (4 * 4, 8, 3)
        means = pixels.reshape(4, -1).mean(axis=1)
        np.testing.assert_allclose(means, 60 * number + 10 * np.arange(4), atol=3)


def test_several_runs_stand_side_by_side(tmp_path, capsys):
    documents = {
        name: make_run(tmp_path / name, attacked, pictures=False, flags=[])
        for name, attacked in (("one", 1.2), ("two", 2.4))
    }
    folders = [tmp_path / name for name in documents]
    assert report(*folders, "-o", tmp_path / "page.html", "--title", "Both & all") == 0
    assert "page.html" in capsys.readouterr().out
    page = files.read_text(tmp_path / "page.html")
    reader = PageReader(page)
    reader.check_alone()
    assert "<h1>Both &amp; all</h1>" in page
    for name, document in documents.items():
        cases = document["routes"]["straight"]["surrogate"]
        means = [
            cases[case]["cross_track_mean_m"]
            for case in ("no_object", "random", "attack")
        ]
        row = next(row for row in reader.rows if row[0] == name)
        assert [row[3], row[4], row[6]] == [f"{mean:.3f}" for mean in means]
        assert row[7] == f"{means[2] / means[1]:.1f}"
    assert "Damage against frames, straight" in {i["alt"] for i in reader.images}
    # what is missing, and what makes it
    resume = re.escape(f"{folders[0] / 'scenario.toml'} -o {folders[0]}")
    assert re.search(f"without pictures; this writes them: .*{resume}", page)


def test_transfers_and_retrainings_are_tables(tmp_path):
    make_transfer(tmp_path / "moved")
    make_retraining(tmp_path / "better-retrain.json")
    words = tmp_path / "moved", tmp_path / "better-retrain.json"
    assert report(*words, "-o", tmp_path / "page.html") == 0
    page = files.read_text(tmp_path / "page.html")
    reader = PageReader(page)
    reader.check_alone()
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
    assert "Left out: third: the expert leaves its lane" in reader.text


def test_damage_is_laid_against_what_textures_may_change(tmp_path):
    for name, linf in (("free", None), ("little", 0.1)):
        scenario = {
            "name": name,
            "vehicle": {"dt_s": 0.1},
            "objects": [],
            "attack": {"method": "gradient", "parameters": "texture", "linf": linf},
        }
        make_run(tmp_path / name, pictures=False, scenario=scenario)
    words = tmp_path / "free", tmp_path / "little"
    assert report(*words, "-o", tmp_path / "page.html") == 0
    shown = {
        i["alt"]
        for i in PageReader(files.read_text(words[0].parent / "page.html")).images
    }
    assert "Damage against the texture's budget, linf" in shown
    assert "Damage against the texture's budget, l2" not in shown


@pytest.mark.parametrize(
    ("make", "told"),
    [
        (lambda place: make_transfer(place, complete=False), "rows are missing"),
        (lambda place: (place / "cells").mkdir(parents=True), "no cell is done"),
        (lambda place: place.write_text("{}"), "is not of 'mi-nerfattack retrain'"),
    ],
)
def test_what_is_not_finished_is_refused(tmp_path, capsys, make, told):
    make(tmp_path / "it")
    assert report(tmp_path / "it", "-o", tmp_path / "page.html") == 2
    assert told in capsys.readouterr().err
    assert not (tmp_path / "page.html").exists()


@pytest.mark.parametrize(
    ("damage", "told"),
    [
        (lambda run: (run / "metrics.json").unlink(), "goes on with an unfinished one"),
        (lambda run: (run / "scenario.toml").unlink(), "holds no results; give run"),
        (lambda run: (run / "metrics.json").write_text("{}"), "metrics.schema"),
        (lambda run: shutil.rmtree(run), "holds no results; give run"),
    ],
)
def test_what_is_no_finished_run_is_refused(tmp_path, capsys, damage, told):
    make_run(tmp_path / "run", pictures=False)
    damage(tmp_path / "run")
    assert report(tmp_path / "run", "-o", tmp_path / "page.html") == 2
    assert told in capsys.readouterr().err
    assert not (tmp_path / "page.html").exists()


def test_wrong_words_are_refused(tmp_path, capsys):
    make_run(tmp_path / "run", pictures=False)
    assert report(tmp_path / "run", "-o", tmp_path / "page.pdf") == 2
    assert "name an .html file" in capsys.readouterr().err
    twice = tmp_path / "run", tmp_path / "x" / ".." / "run"
    assert report(*twice, "-o", tmp_path / "page.html") == 2
    assert "each once" in capsys.readouterr().err
