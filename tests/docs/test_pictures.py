"""Small versions of the pictures can be made, and the committed ones are not blank."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from mi_nerfattack import plugins

DOCS = Path(__file__).parents[2] / "docs"
NAMES = [name for names in plugins._REGISTERED.values() for name in names]
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


def make(name: str, folder: Path) -> None:
    command = [sys.executable, DOCS / "pictures/make.py", name]
    words = ["--small", "--output", folder]
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
def test_pictures_of_the_gallery_are_made(tmp_path):
    make("gallery", tmp_path)
    assert_made(GALLERY, tmp_path)
    before, after = (read(tmp_path / f"{name}.jpg") for name in ("before", "after"))
    assert red(before).mean() > 0.02 > red(after).mean()


@pytest.mark.parametrize("name", sorted(PLUGINS | GALLERY))
def test_committed_pictures_show_something(name):
    assert_shows_something(read(DOCS / "pictures" / name))


def test_pictures_are_small():
    sizes = [path.stat().st_size for path in (DOCS / "pictures").glob("*.jpg")]
    assert sum(sizes) < 1.5e6
