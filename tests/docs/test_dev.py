"""Pages for contributors name folders, files and functions that are there."""

from __future__ import annotations

import ast
import re
from pathlib import Path
from xml.etree import ElementTree

import pytest

ROOT = Path(__file__).parents[2]
PAGES = [ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs/dev").glob("*.md"))]
PICTURE = ROOT / "docs/pictures/architecture.svg"
# A file or a folder with at least one slash, or a file of the root.
PATH = r"`((?:[\w.]+/)+[\w.]*|\w+\.(?:md|toml))`"
FUNCTION = r"`(?:(\w+)\.)?(\w+)\(\)`"
CLASS_OR_CONSTANT = r"`(_?[A-Z]\w+)`"
NO_CODE = {"NAME", "NERFATTACK_DATA"}
by_page = pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)


def items(text: str) -> list[str]:
    """Split a page into paragraphs, items of lists and rows of tables."""
    text = re.sub(r"^\s*```.*?^\s*```$", "", text, flags=re.M | re.S)
    return re.split(r"\n\s*\n|\n(?=\s*- |\d+\. |\|)", text)


@by_page
def test_paths_lead_to_files(page):
    named = re.findall(PATH, page.read_text("utf-8"))
    assert named
    for name in named:
        path = ROOT / name
        is_new = "NAME" in path.name
        assert (path.parent if is_new else path).exists(), name


@by_page
def test_names_are_in_one_of_the_files_that_an_item_names(page):
    for item in items(page.read_text("utf-8")):
        files = [ROOT / n for n in re.findall(PATH, item) if n.endswith((".py", "pyi"))]
        files = [path for path in files if path.exists()]
        if not files:
            continue
        source = "\n".join(path.read_text("utf-8") for path in files)
        for owner, name in re.findall(FUNCTION, item):
            within = rf"^class {owner}\b(?:(?!^class ).)*?^    " if owner else r"^\s*"
            found = re.search(rf"{within}def {name}\b", source, re.M | re.S)
            assert found, f"{owner}.{name}: not in {files}"
        for name in {*re.findall(CLASS_OR_CONSTANT, item)} - NO_CODE:
            assert re.search(rf"\b{name}\b", source), f"{name}: not in {files}"


def test_the_picture_shows_the_folders_in_their_order():
    root = ElementTree.parse(PICTURE).getroot()
    shown = [node.text for node in root.iter() if node.get("class") == "name"]
    source = (ROOT / "tests/test_imports.py").read_text("utf-8")
    order = re.search(r"^ORDER = (\(.*?\n\))\.split\(\)", source, re.M | re.S)
    assert order is not None and shown == ast.literal_eval(order[1]).split()


def test_the_picture_is_readable_on_a_dark_page():
    root = ElementTree.parse(PICTURE).getroot()
    ground = next(node for node in root if node.tag.endswith("rect"))
    size = root.get("width"), root.get("height"), "#ffffff"
    assert (ground.get("width"), ground.get("height"), ground.get("fill")) == size
