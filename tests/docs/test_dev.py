"""Pages name files, functions and tests that are there, and the contents every page."""

from __future__ import annotations

import ast
import re
from functools import cache
from pathlib import Path
from xml.etree import ElementTree

import pytest

from docs.generate import MARK

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
            match = re.search(rf"{within}def {name}\b", source, re.M | re.S)
            assert match, f"{owner}.{name}: not in {files}"
        for name in {*re.findall(CLASS_OR_CONSTANT, item)} - NO_CODE:
            assert re.search(rf"\b{name}\b", source), f"{name}: not in {files}"


def test_the_picture_shows_the_folders_in_their_order():
    root = ElementTree.parse(PICTURE).getroot()
    shown = [node.text for node in root.iter() if node.get("class") == "name"]
    source = (ROOT / "tests/test_imports.py").read_text("utf-8")
    order = re.search(r"^ORDER = (\(.*?\n\))\.split\(\)", source, re.M | re.S)
    assert order is not None and shown == ast.literal_eval(order[1]).split()


def test_every_page_is_in_the_contents():
    docs = ROOT / "docs"
    names = (
        "index.md",
        "car/index.md",
        "notebooks/index.md",
        "tutorials/index.md",
        "results/findings/index.md",
        "dev/extend/index.md",
    )
    contents = [docs / name for name in names]
    listed = {
        (page.parent / name).resolve()
        for page in contents
        for name in re.findall(
            r"^- \[[^]]*\]\(([\w/.]+)\)", page.read_text("utf-8"), re.M
        )
    }
    pages = {*docs.glob("**/*.md"), docs / "api/index.rst"}
    hidden = ("index.md", "pictures/README.md", "examples/package_template/README.md")
    assert pages - {docs / name for name in hidden} == listed


def test_every_package_with_public_names_is_in_the_reference():
    pages = (ROOT / "docs/api").glob("*.rst")
    text = "".join(page.read_text("utf-8") for page in pages)
    documented = set(re.findall(r"automodule:: (\S+)", text))
    stubs = (ROOT / "mi_nerfattack").glob("**/__init__.pyi")
    names = {".".join(stub.parent.relative_to(ROOT).parts) for stub in stubs}
    assert documented == names | {"mi_nerfattack"}


NAMED = re.findall(
    r"`(tests/[^`]*)`", (ROOT / "docs/reference/faults.md").read_text("utf-8")
)
TESTS = sorted({name for name in NAMED if "::" in name})


@cache
def collected(path: Path) -> set[str]:
    names = set()
    for node in ast.parse(path.read_text("utf-8")).body:
        if isinstance(node, ast.ClassDef) and node.name.startswith("Test"):
            methods = (item for item in node.body if isinstance(item, ast.FunctionDef))
            names |= {f"{node.name}::{item.name}" for item in methods}
        elif isinstance(node, ast.FunctionDef):
            names.add(node.name)
    return {name for name in names if name.rpartition("::")[2].startswith("test_")}


@pytest.mark.parametrize("name", TESTS)
def test_a_named_test_is_there(name):
    file, _, test = name.partition("::")
    assert Path(file).name.startswith("test_")
    assert test in collected(ROOT / file)


def test_every_row_names_a_test():
    page = (ROOT / "docs/reference/faults.md").read_text("utf-8").partition(MARK)[0]
    rows = re.findall(r"^\|(.*)\|$", page, re.M)
    promises = [row for row in rows if not re.fullmatch(r"[-|]+|.* shown by ", row)]
    assert len(promises) > 30
    assert all(any(name in row for name in TESTS) for row in promises)
