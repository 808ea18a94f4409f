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
from mi_nerfattack.render.camera.intrinsics import from_fov, look_at
from mi_nerfattack.render.camera.outside import seen_at

DOCS = Path(__file__).parents[2] / "docs"
sys.path.append(str(DOCS / "pictures"))
import diagrams  # noqa: E402  lies in the folder above

# A drive of 15 periods through the right turn of the demo, and two iterations.
SCENARIO = """
name = "small"

[scene]
field = "bundled:intersection/field.safetensors"
deployment = "bundled:intersection/scene.xml"
routes = "bundled:intersection/routes.json"
route = "right"

[[objects]]
id = "hydrant"
field = "bundled:hydrant/field.safetensors"
position_m = [4.4, -10.5, 0.12]
scale = 3.3

[policy]
file = "bundled:policy/pilotnet.safetensors"

[drive]
start_m = 14
horizon = 15
runs = 1

[attack]
max_iterations = 2
adjoint = "kept_backgrounds"

[baseline]
textures = 1

[deployment]
spp = 1
"""
NAMES = [name for names in plugins._REGISTERED.values() for name in names]
KINDS = (".jpg", ".png", ".svg", ".webp")
PLUGINS = {f"plugin_{name}.jpg" for name in NAMES}
# The gallery's first picture is one of the README's.
GALLERY = set(
    re.findall(r"\]\(pictures/(\w+\.jpg)\)", (DOCS / "gallery.md").read_text("utf-8"))
)


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


def red(image: np.ndarray) -> np.ndarray:
    return (image[..., 0] > 0.4) & (image[..., 0] > 2 * image[..., 2])


@pytest.mark.slow
def test_pictures_of_plugins_are_made(tmp_path):
    make("plugins", tmp_path)
    assert_made(PLUGINS, tmp_path)
    for name in ("grid_field", "field_integrator", "field_emitter"):
        assert red(read(tmp_path / f"plugin_{name}.jpg")).mean() > 0.01, "the hydrant"


@pytest.mark.slow
def test_the_picture_with_glass_is_made(tmp_path):
    make("glass", tmp_path)
    assert_made({"glass.jpg"}, tmp_path)
    assert red(read(tmp_path / "glass.jpg"))[:, 80:].mean() > 0.01, "the hydrant"


@pytest.mark.slow
def test_pictures_of_the_gallery_are_made(tmp_path):
    make("gallery", tmp_path)
    assert_made(GALLERY, tmp_path)
    before, after = (read(tmp_path / f"{name}.jpg") for name in ("before", "after"))
    assert red(before).mean() > 0.02 > red(after).mean()


@pytest.fixture(scope="module")
def run(tmp_path_factory) -> Path:
    """A finished attack at the place of the demo."""
    mi.set_variant("llvm_ad_rgb")
    folder = tmp_path_factory.mktemp("run")
    (folder / "scenario.toml").write_text(SCENARIO)
    words = ["attack", folder / "scenario.toml", "-o", folder / "run", "--no-pictures"]
    assert cli.main([str(word) for word in words]) == 0
    return folder / "run"


def colour_at(image: np.ndarray, point: np.ndarray) -> np.ndarray:
    """The mean colour of 3 x 3 pixels."""
    column, row = np.round(point).astype(int)
    return image[row - 1 : row + 2, column - 1 : column + 2].mean((0, 1))


@pytest.mark.slow
def test_the_banner_shows_both_drives_and_the_object(run, tmp_path):
    import run_pictures as pictures

    make("banner", tmp_path, "--run", run)
    image = read(tmp_path / "banner.jpg")
    height, width = image.shape[:2]
    panels = image[:, : (width - 8) // 2], image[:, (width + 8) // 2 :]
    camera = from_fov(panels[0].shape[1], height, pictures.FOV_DEG)
    pose = look_at(pictures.EYE_M, pictures.TARGET_M)
    viewed = pictures.read_viewed(run)
    for panel, case in zip(panels, pictures.TITLES, strict=True):
        drive = pictures.drive_of(viewed, "deployment", case)
        places = np.pad(drive.states[[3, 10], :2], ((0, 0), (0, 1)))
        path, car = (colour_at(panel, p) for p in seen_at(camera, pose, places))
        sign = np.sign(pictures.COLOURS[case][0] - pictures.COLOURS[case][2])
        assert sign * (path[0] - path[2]) > 0.05, f"{case}: the path"
        assert car[2] > 1.5 * car[0], f"{case}: the car is blue"
    (hydrant,) = seen_at(camera, pose, np.array([[4.4, -10.5, 1.3]]))
    original, attacked = (colour_at(panel, hydrant) for panel in panels)
    assert original[0] > 1.5 * original[2], "the hydrant is red"
    assert np.abs(original - attacked).max() > 0.1, "both have the same colours"


@pytest.mark.slow
def test_the_animation_shows_both_drives(run, tmp_path):
    import run_pictures as pictures

    make("drive", tmp_path, "--run", run)
    with Image.open(tmp_path / "drive.webp") as animation:
        assert animation.n_frames == 1 + 15 // 5
        animation.seek(3)
        image = np.asarray(animation.convert("RGB")).astype(float)
    half = (image.shape[1] - 8) // 2
    columns = image[:, :half], image[:, half + 8 :]
    seen = [column[12:40] / 255 for column in columns]  # below the title
    assert all(part.std() > 0.1 for part in seen), "the images of the policy"
    for column, case in zip(columns, pictures.TITLES, strict=True):
        below = column[half * 66 // 200 :]  # the place from above
        away = np.abs(below - pictures.COLOURS[case]).max(-1)
        assert (away < 40).mean() > 0.01, f"{case}: path and car"


def test_the_loop_names_its_parts(tmp_path):
    diagrams.draw_loop(tmp_path, small=True)
    made, committed = (
        re.findall(r"<text[^>]*>([^<]+)</text>", path.read_text("utf-8"))
        for path in (tmp_path / "loop.svg", DOCS / "pictures/loop.svg")
    )
    assert made == committed
    assert {"object", "render", "policy", "vehicle", "image", "steering"} <= set(made)


def test_the_chart_has_a_mark_for_each_drive():
    rows = read_table(diagrams.TABLE)
    (axis,) = diagrams.places_chart(rows).axes
    assert axis.get_yscale() == "log"
    assert [line.get_ydata()[0] for line in axis.lines][0] == diagrams.LIMIT_M
    for marks, case in zip(axis.collections, diagrams.CASES, strict=True):
        x, y = np.array(marks.get_offsets()).T
        expected = [
            row["cross_track_mean_m"]
            for row in rows
            if (row["environment"], row["case"]) == ("deployment", case)
        ]
        assert y.tolist() == expected and len(y) >= 30
        assert set(x.astype(int)) == set(range(15))


@pytest.mark.parametrize(
    "name", sorted(PLUGINS | GALLERY | {"banner.jpg", "chart.png"})
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
