"""The README's script and XML run, and its statement about the chart is true."""

from __future__ import annotations

import re
import subprocess
import sys
from collections import defaultdict
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest

from mi_nerfattack.experiment.sweep.table import read_table

ROOT = Path(__file__).parents[2]
SENSOR = """
<sensor type="perspective">
    <float name="fov" value="40"/>
    <transform name="to_world">
        <lookat origin="2.2, -1.4, 0.8" target="0, 0, 0.37" up="0, 0, 1"/>
    </transform>
    <film type="hdrfilm">
        <integer name="width" value="30"/>
        <integer name="height" value="20"/>
        <rfilter type="box"/>
    </film>
</sensor>
"""


def blocks(language: str) -> list[str]:
    """The README's blocks of a language."""
    text = (ROOT / "README.md").read_text("utf-8")
    return re.findall(rf"^```{language}\n(.*?)^```$", text, re.M | re.S)


def run(script: str, folder: Path) -> list[str]:
    """Run a script beside the scenes, and return the lines that it prints."""
    (folder / "scenes").symlink_to(ROOT / "scenes")
    words = [sys.executable, "-c", script]
    done = subprocess.run(words, cwd=folder, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return done.stdout.splitlines()


def test_the_script_writes_an_image_and_prints_the_gradients_shape(tmp_path):
    script, _ = blocks("python")
    assert len([line for line in script.splitlines() if line]) <= 15
    total = "print(dr.sum(dr.abs(dr.grad(params[key]).array))[0])"
    fewer = script.replace("spp=8", "spp=1")
    shape, total = run(fewer + total, tmp_path)
    assert re.fullmatch(r"\(\d{6,}, 3\)", shape)
    assert float(total) > 0
    image = np.array(mi.Bitmap(str(tmp_path / "frame.exr")))
    assert image.shape == (240, 640, 3)
    middle = image[110:170, 300:340]  # of the hydrant, which is red
    assert (middle[..., 0] > 2 * middle[..., 2]).mean() > 0.5


def test_the_script_of_a_drive_changes_the_colours(tmp_path):
    _, script = blocks("python")
    assert len([line for line in script.splitlines() if line]) <= 25
    short = script.replace("horizon=20", "horizon=4").replace("range(5)", "range(2)")
    assert short.count("horizon=4") == short.count("range(2)") == 1
    before = "before = params[key].numpy().copy()\nadam ="
    after = "print(abs(adam[key].numpy() - before).max())\nprint(-value[0])"
    *_, change, error = run(short.replace("adam =", before, 1) + after, tmp_path)
    assert 0.05 <= float(change) <= 0.15  # two steps
    assert float(error) >= 0


@pytest.mark.usefixtures("variant")
def test_the_xml_shows_both_fields(monkeypatch):
    monkeypatch.chdir(ROOT)
    (xml,) = blocks("xml")
    assert len(xml.splitlines()) == 8
    text = f'<scene version="3.0.0">{xml}{SENSOR}</scene>'
    aovs = '<boolean name="aovs" value="true"/>'
    text = text.replace("</integrator>", f"{aovs}</integrator>")
    scene = mi.load_string(text, parallel=False)
    image = np.array(mi.render(scene, spp=4))
    names = ["R", "G", "B", *scene.integrator().aov_names()]
    assert {name.partition(".")[0] for name in names} >= {"scene", "hydrant"}
    centre = image[10, 15]
    assert centre[names.index("hydrant.A")] > 0.9


def test_attacks_beat_every_random_texture_on_average():
    """At each place, in deployment; only on the left turn a wheel is out for 1 s."""
    means, out = defaultdict(list), defaultdict(list)
    for row in read_table(ROOT / "docs/table2/results.parquet"):
        if row["environment"] == "deployment":
            key = (row["route"], row["seed"]), row["case"]
            means[key].append(row["cross_track_mean_m"])
            out[key].append(row["wheel_out_s"])
    places = {place for place, _ in means}
    assert len(places) == 15
    for place in places:
        attack = np.mean(means[place, "attack"])
        assert attack > max(means[place, "random"])
        assert attack > np.mean(means[place, "best_random"])
    long = {place for place in places if np.mean(out[place, "attack"]) >= 1}
    assert len(long) == 4 and {route for route, _ in long} == {"left"}
