"""Examples, scripts of the README and of a guide, and tutorials run unchanged."""

from __future__ import annotations

import re
import runpy
import subprocess
import sys
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
from safetensors.torch import load_file
from support.pages.blocks import fenced

from mi_nerfattack.experiment.sweep.table import read_table
from mi_nerfattack.fields import load_grid
from mi_nerfattack.io.files import read_image
from mi_nerfattack.scenes import bundled

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"
SCRIPTS = sorted((DOCS / "examples").glob("*_user.py"))


def blocks(language: str, page: str = "README.md") -> list[str]:
    return fenced(ROOT / page, language)


def run(folder: Path, *words: object) -> list[str]:
    """Run Python in a folder beside the scenes, and return the lines that it prints."""
    (folder / "scenes").symlink_to(ROOT / "scenes")
    command = [sys.executable, *map(str, words)]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return done.stdout.splitlines()


def printed(name: str, folder: Path) -> list[float]:
    """Run an example in a folder; return the last number of each line printed."""
    lines = run(folder, DOCS / f"examples/{name}.py")
    numbers = [re.findall(r"-?\d+\.\d+", line) for line in lines]
    return [float(matches[-1]) for matches in numbers if matches]


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda script: script.stem)
def test_examples_are_short(script):
    assert len(script.read_text("utf-8").splitlines()) <= 60


def test_the_bundled_weights_fit_the_network_of_two_cameras():
    network = runpy.run_path(str(DOCS / "examples/two_cameras.py"))["Net"]()
    network.load_state_dict(load_file(bundled("country/two_cameras.safetensors")))


def test_tables_user(tmp_path):
    *means, worst = printed("tables_user", tmp_path)
    page = (DOCS / "results/table2/README.md").read_text("utf-8")
    _, _, page = page.partition("## mitsuba")
    header = next(x for x in page.splitlines() if x.startswith("| route |"))
    column = [name.strip() for name in header.split("|")].index("attack")
    for route, mean in zip(("straight", "right", "left"), means, strict=True):
        line = next(x for x in page.splitlines() if x.startswith(f"| {route} |"))
        assert line.split("|")[column].split()[0] == f"{mean:.3f}"
    assert worst > max(means)


#: What the printed numbers show.
HOLDS = {
    "mitsuba_user": lambda first, *others: others[-1] < first / 2,
    "pytorch_user": lambda *x: len(x) == 7 and x[4] > x[0],  # errors after iterations
    "robotics_user": lambda *errors: len(errors) == 3 and max(errors) < 0.3,
    "renderer_user": lambda *others: others[-1] > 20,  # dB
    "training_user": lambda before, after: after < before / 4,  # metres
    "gymnasium_user": lambda *x: x[-1] == max(x[:-1]) > min(x[:-1]),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", HOLDS)
def test_scripts_run(name, tmp_path):
    assert HOLDS[name](*printed(name, tmp_path))


SENSOR = """
<sensor type="perspective">
    <float name="fov" value="40"/>
    <transform name="to_world">
        <lookat origin="2.2, -1.4, 0.8" target="0, 0, 0.37" up="0, 0, 1"/></transform>
    <film type="hdrfilm"><rfilter type="box"/>
        <integer name="width" value="30"/><integer name="height" value="20"/></film>
</sensor>
"""


def test_the_script_writes_an_image_and_prints_the_gradients_shape(tmp_path):
    (script,) = blocks("python")
    assert len([line for line in script.splitlines() if line]) <= 15
    total = "print(dr.sum(dr.abs(dr.grad(params[key]).array))[0])"
    fewer = script.replace("spp=8", "spp=1")
    shape, total = run(tmp_path, "-c", fewer + total)
    assert re.fullmatch(r"\(\d{6,}, 3\)", shape)
    assert float(total) > 0
    image = np.array(mi.Bitmap(str(tmp_path / "frame.exr")))
    assert image.shape == (240, 640, 3)
    middle = image[110:170, 300:340]  # of the hydrant, which is red
    assert (middle[..., 0] > 2 * middle[..., 2]).mean() > 0.5


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
    table = read_table(ROOT / "docs/results/table2/results.csv")
    driven = table[table["environment"] == "mitsuba"]
    cases = driven.groupby(["route", "seed", "case"])
    means = cases["cross_track_mean_m"].mean().unstack("case")
    worst = cases["cross_track_mean_m"].max().unstack("case")
    assert len(means) == 15
    assert (means["attack"] > worst["random"]).all()
    assert (means["attack"] > means["best_random"]).all()
    out_s = cases["wheel_out_s"].mean().unstack("case")["attack"]
    long = out_s[out_s >= 1].reset_index()
    assert len(long) == 4 and set(long["route"]) == {"left"}


PAGES = [p for p in sorted((DOCS / "tutorials").glob("*.md")) if p.stem != "index"]


def follow(*words: object) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, DOCS / "follow.py", *map(str, words)]
    return subprocess.run(command, capture_output=True, text=True)


@pytest.mark.slow
@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_tutorial_works_as_it_stands(page):
    done = follow(page)
    print(done.stdout)
    assert done.returncode == 0, done.stdout + done.stderr
    assert ": ran " in done.stdout


PAGE = """\
```toml
# sizes.toml
width = 3
```

```bash
cat sizes.toml
```

```text
...
width = 3
```

<!-- long: hours -->
```bash
touch long
```

<!-- skip: takes a car -->
```bash
touch skipped
```

```python
print(3, "m")
```

```text
3 m
```
"""


def test_blocks_are_saved_run_and_left_out(tmp_path):
    (tmp_path / "page.md").write_text(PAGE)
    done = follow(tmp_path / "page.md", "--keep", tmp_path / "kept")
    assert done.returncode == 0, done.stdout + done.stderr
    reports = [line.split(": ", 1)[1].split()[0] for line in done.stdout.splitlines()]
    assert reports == "saved ran as long: skip: ran as".split()
    assert [path.name for path in (tmp_path / "kept/page").iterdir()] == ["sizes.toml"]
    follow(tmp_path / "page.md", "--long", "--keep", tmp_path / "all")
    assert (tmp_path / "all/page/long").exists()
    assert not (tmp_path / "all/page/skipped").exists()


@pytest.mark.parametrize(
    ("old", "new", "end"),
    [
        ("3 m\n", "4 m\n", ":29: printed\n3 m\n\nin place of\n4 m\n"),
        ("cat sizes", "cat others", ":6: ended with 1"),
        ("print", "prin", ":25: ended with 1"),
    ],
)
def test_mistakes_are_told(tmp_path, old, new, end):
    (tmp_path / "page.md").write_text(PAGE.replace(old, new))
    done = follow(tmp_path / "page.md")
    assert done.returncode == 1 and end in done.stdout


@pytest.mark.usefixtures("variant")
@pytest.mark.parametrize("page", ["plugins", "glass", "light", "media"])
def test_scenes_of_the_guides_show_something(page):
    """Each one, in light and before a camera where the page has none."""
    for xml in blocks("xml", f"docs/howto/{page}.md"):
        if "<scene" not in xml:
            if "<integrator" not in xml:
                kind = "volpath" if page == "media" else "path"
                if xml.startswith("<volume"):
                    xml = f'<integrator type="field_integrator">{xml}</integrator>'
                else:
                    xml += f'<integrator type="{kind}"/>'
            light = '<emitter type="constant"/>'
            xml = f'<scene version="3.0.0">{xml}{SENSOR}{light}</scene>'
        scene = mi.load_string(xml, parallel=False)
        image = np.array(mi.render(scene, spp=2))
        assert np.isfinite(image).all() and image.std() > 0.02


@pytest.mark.slow
def test_blocks_of_the_guide_to_the_loop_run(tmp_path):
    scripts = blocks("python", "docs/howto/loop.md")
    lines = run(tmp_path, "-c", "\n".join(scripts))
    assert len(scripts) == 4 and len(lines) == 2


@pytest.mark.slow
@pytest.mark.usefixtures("variant")
def test_scene_is_attacked_from_xml(monkeypatch, capsys):
    """Both textures move, and the script says whether that transfers."""
    monkeypatch.setattr(sys, "argv", ["attack_from_xml.py", "3", "1"])
    names = runpy.run_path(str(DOCS / "examples/attack_from_xml.py"))
    before = load_grid(bundled("hydrant/field.safetensors")).texture.numpy()
    near, far = (texture.numpy() for texture in names["sensor"].textures())
    assert (near != before).any() and (far != before).any() and (near != far).any()
    *rows, traced, last = capsys.readouterr().out.splitlines()
    assert len(rows) == 2 and traced.startswith("path-traced") and "failure" in last


@pytest.mark.slow
@pytest.mark.usefixtures("variant")
def test_a_bitmap_is_attacked_through_prb(monkeypatch, tmp_path):
    """The policy sees the board: its colours change, and are written."""
    monkeypatch.setattr(sys, "argv", ["attack_billboard.py", "3", "1"])
    monkeypatch.chdir(tmp_path)
    names = runpy.run_path(str(DOCS / "examples/attack_billboard.py"))
    scene, key = mi.load_file(str(names["file"]), parallel=False), names["key"]
    before, after = (mi.traverse(s)[key].numpy() for s in (scene, names["scene"]))
    changed = np.abs(after - before).max(-1) > 0.05
    assert changed.mean() > 0.01
    assert read_image(tmp_path / "billboard.png").shape[:2] == after.shape[:2]
