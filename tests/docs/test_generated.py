"""Pages that repeat other files are equal to them, and show every script and plugin."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from docs import generate
from mi_nerfattack import plugins
from mi_nerfattack.car.drive.config import DriveConfig
from mi_nerfattack.car.drive.log import TOPICS
from mi_nerfattack.car.drive.safety.judge import Cause
from mi_nerfattack.car.vesc.calibration import Calibration

DOCS = Path(__file__).parents[2] / "docs"
PAGES = generate.pages()
NAMES = [name for names in plugins._REGISTERED.values() for name in names]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_page_is_equal_to_its_sources(page):
    assert page.read_text("utf-8") == PAGES[page], "run python docs/generate.py"


def test_every_script_and_its_scene_are_shown():
    shown = re.findall(r"^\[examples/([\w.]+)\]", PAGES[DOCS / "examples.md"], re.M)
    scripts = {path.name for path in (DOCS / "examples").glob("*_user.py")}
    assert set(shown) == scripts | {"hydrant.xml"} and len(shown) == len(set(shown))


@pytest.mark.parametrize("name", NAMES)
def test_every_plugin_has_a_section_with_its_parts(name):
    sections = re.split(r"^## ", PAGES[DOCS / "reference/plugins.md"], flags=re.M)
    (section,) = (text for text in sections if f"(`{name}`)\n" in text)
    assert f"](../pictures/plugin_{name}.jpg)" in section
    assert "| Parameter | Type | Description | Flags |" in section
    assert f'type="{name}"' in section and f'"type": "{name}"' in section


def cells(section: str) -> dict[str, str]:
    """Find the second cell of each row by the code spans of the first one."""
    text = (DOCS / "car/reference.md").read_text("utf-8")
    (body,) = re.findall(rf"^## {section}\n(.*?)(?=^##+ |\Z)", text, re.M | re.S)
    rows = re.findall(r"^\| (.*?) \| (.*?) \|", body, re.M)
    split = ((re.findall("`([^`]+)`", first), second) for first, second in rows)
    return {name: second for names, second in split for name in names}


@pytest.mark.parametrize(
    ("section", "model"),
    [("The drive file", DriveConfig), ("The calibration file", Calibration)],
)
def test_keys_of_the_car_are_listed_with_their_defaults(section, model):
    listed = cells(section)
    assert set(listed) == set(model.model_fields)
    for name, field in model.model_fields.items():
        if isinstance(field.default, float | int) and field.default is not False:
            assert str(field.default).removesuffix(".0") in listed[name]


def test_topics_and_causes_of_the_car_are_listed():
    assert set(cells("Topics of the log")) == set(TOPICS)
    rows = (DOCS / "car/safety.md").read_text("utf-8").partition("## What ends")[2]
    listed = re.findall("`([^`]+)`", "".join(re.findall(r"^\|(.*?)\|", rows, re.M)))
    assert sorted(listed) == sorted(cause.value for cause in Cause)


@pytest.mark.parametrize("text", ["a link_\n\n.. _link: a.md", "|unknown|", "1. one"])
def test_what_has_no_markdown_is_refused(tmp_path, monkeypatch, text):
    monkeypatch.setattr(generate, "PLUGINS", tmp_path)
    head = (
        "First\n-----\n\n.. pluginparameters::\n\n * - size\n   - |int|\n   - Pixels\n"
    )
    (tmp_path / "first.py").write_text(f'class A:\n    """{head}\n{text}\n"""\n')
    with pytest.raises(Exception, match="no Markdown|unknown"):
        generate.plugin_reference()


def test_files_replace_the_blocks_below_their_links():
    link, tail = (
        "[examples/wall.xml](examples/wall.xml):\n\n",
        "```\n\n```xml\nkept\n```\n",
    )
    wall = (DOCS / "examples/wall.xml").read_text("utf-8")
    assert (
        generate.with_files(f"{link}```xml\nold\n{tail}")
        == f"{link}```xml\n{wall}{tail}"
    )
    part = link.replace(":\n\n", ", lines 2 to 3:\n\n")
    second_and_third = "".join(wall.splitlines(keepends=True)[1:3])
    assert (
        generate.with_files(f"{part}```xml\nold\n{tail}")
        == f"{part}```xml\n{second_and_third}{tail}"
    )
