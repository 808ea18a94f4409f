"""Small versions of the pictures can be made, and the committed ones are not blank."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
from PIL import Image

from mi_nerfattack import cli, plugins
from mi_nerfattack.experiment.sweep.table import read_table
from mi_nerfattack.scenes import bundled

DOCS = Path(__file__).parents[2] / "docs"
sys.path.append(str(DOCS / "pictures"))
import diagrams  # noqa: E402  lies in the folder above

# A drive of 15 periods through the right turn of the demo, and two iterations.
SETTINGS = (
    "drive.start_m=14 drive.length_m=7.5 drive.runs=1 attack.method.max_iterations=2 "
    "baseline.textures=1 deployment.spp=1"
).split()
NAMES = [name for names in plugins._REGISTERED.values() for name in names]
KINDS = (".jpg", ".png", ".svg", ".webp")
PLUGINS = {f"plugin_{name}.jpg" for name in NAMES}
# The gallery's first picture is one of the README's.
GALLERY = set(
    re.findall(r"\]\(pictures/(\w+\.jpg)\)", (DOCS / "gallery.md").read_text("utf-8"))
)
WORLDS = {"environments.jpg", "cameras.jpg", "room.jpg", "overlay.jpg", "net.jpg"}


def read(path: Path) -> np.ndarray:
    with Image.open(path) as image:
        return np.asarray(image.convert("RGB")) / 255.0


def thumbnail(path: Path) -> np.ndarray:
    with Image.open(path) as image:
        small = image.convert("RGB").resize((16, 12), Image.Resampling.BOX)
    return np.asarray(small) / 255.0


def assert_shows_something(image: np.ndarray) -> None:
    """Some parts are dark and some bright, and the middle is not of one colour."""
    low, high = np.quantile(image.mean(-1), [0.02, 0.98])
    assert high - low > 0.2
    rows, columns = (slice(n // 4, -n // 4) for n in image.shape[:2])
    assert image[rows, columns].std() > 0.05


def make(name: str, folder: Path, *words: object) -> None:
    command = [sys.executable, DOCS / "pictures/make.py", name, *map(str, words)]
    words = ["--small", "--output", str(folder)]
    done = subprocess.run([*command, *words], capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr


def assert_made(names: set[str], folder: Path) -> None:
    assert {path.name for path in folder.iterdir()} == names
    for name in names:
        assert_shows_something(read(folder / name))
        difference = thumbnail(folder / name) - thumbnail(DOCS / "pictures" / name)
        assert np.abs(difference).mean() < 0.05, f"{name}: another picture"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "pictures"),
    [
        ("plugins", PLUGINS),
        ("country", {"country.jpg"}),
        ("glass", {"glass.jpg"}),
        ("light_maps", {"light_maps.jpg"}),
        ("gallery", GALLERY),
        ("worlds", WORLDS),
    ],
)
def test_pictures_are_made(name, pictures, tmp_path):
    make(name, tmp_path)
    assert_made(pictures, tmp_path)


@pytest.mark.slow
def test_banner_and_animation_are_made_of_a_run(tmp_path):
    """Of an attack at the place of the demo, with a frame for every fifth period."""
    mi.set_variant("llvm_ad_rgb")
    words = ["attack", str(bundled("base.toml")), "-o", str(tmp_path / "run")]
    words += ["--pictures", "none", *(x for key in SETTINGS for x in ("--set", key))]
    assert cli.main(words) == 0
    for name in ("banner", "drive"):
        make(name, tmp_path, "--run", tmp_path / "run")
    image = read(tmp_path / "banner.jpg")
    half = image.shape[1] // 2 - 4
    assert_shows_something(image[:, :half])
    assert_shows_something(image[:, -half:])
    assert np.abs(image[:, :half] - image[:, -half:]).max() > 0.1  # two drives
    with Image.open(tmp_path / "drive.webp") as animation:
        assert animation.n_frames == 1 + 15 // 5


def test_the_loop_names_its_parts(tmp_path):
    diagrams.draw_loop(tmp_path, small=True)
    made, committed = (
        re.findall(r"<text[^>]*>([^<]+)</text>", path.read_text("utf-8"))
        for path in (tmp_path / "loop.svg", DOCS / "pictures/loop.svg")
    )
    assert made == committed
    assert {"object", "render", "policy", "vehicle", "image", "steering"} <= set(made)


def test_the_chart_has_a_mark_for_each_drive():
    table = read_table(diagrams.TABLE)
    (axis,) = diagrams.places_chart(table).axes
    assert axis.get_yscale() == "log"
    assert [line.get_ydata()[0] for line in axis.lines][0] == diagrams.LIMIT_M
    for marks, case in zip(axis.collections, diagrams.CASES, strict=True):
        x, y = np.array(marks.get_offsets()).T
        own = (table["environment"] == "mitsuba") & (table["case"] == case)
        assert y.tolist() == table.loc[own, "cross_track_mean_m"].tolist()
        assert len(y) >= 30
        assert set(x.astype(int)) == set(range(15))


@pytest.mark.parametrize(
    "name",
    sorted(PLUGINS | GALLERY | WORLDS | {"banner.jpg", "chart.png", "country.jpg"}),
)
def test_committed_pictures_show_something(name):
    assert_shows_something(read(DOCS / "pictures" / name))


def test_the_committed_animation_shows_the_whole_drive():
    with Image.open(DOCS / "pictures/drive.webp") as animation:
        assert animation.n_frames > 20
        animation.seek(animation.n_frames - 1)
        assert_shows_something(np.asarray(animation.convert("RGB")) / 255.0)


def test_pictures_are_small():
    pictures = [p for p in (DOCS / "pictures").iterdir() if p.suffix in KINDS]
    assert sum(path.stat().st_size for path in pictures) < 1.5e6
