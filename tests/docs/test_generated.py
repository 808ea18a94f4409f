"""Pages that repeat other files are equal to them, and show every script and plugin."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from docs import generate
from mi_nerfattack import plugins

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
    sections = re.split(r"^## ", PAGES[DOCS / "plugin_reference.md"], flags=re.M)
    (section,) = (text for text in sections if f"(`{name}`)\n" in text)
    assert f"](pictures/plugin_{name}.jpg)" in section
    assert "| Parameter | Type | Description | Flags |" in section
    assert f'type="{name}"' in section and f'"type": "{name}"' in section


DOCSTRING = '''
class First:
    r"""
    .. _volume-first:

    A * first (:monosp:`first`)
    ---------------------------

    .. pluginparameters::
     :extra-rows: 1

     * - size
       - |int|, :paramtype:`int[]`
       - Pixels of ``a|b``,
         each

     * - data
       - |tensor|
       - Values
       - |exposed|, |discontinuous|

    Text with :math:`x_1 < y`:

    .. math::

        x \\cdot y

    .. tabs::
        .. code-tab:: xml

            <volume type="first">
                <integer name="size"/>
            </volume>

        .. code-tab:: python

            {"type": "first"}

    - one
      line
    - two

    """
'''
SECTION = r"""- [A \* first (`first`)](#a--first-first)

## A \* first (`first`)

![Picture of first](pictures/plugin_first.jpg)

| Parameter | Type | Description | Flags |
|---|---|---|---|
| size | `int`, `int[]` | Pixels of `a\|b`, each |  |
| **State parameters** | | | |
| data | `tensor` | Values | P, D |

Text with $x_1 < y$:

```math
x \cdot y
```

In XML:

```xml
<volume type="first">
    <integer name="size"/>
</volume>
```

In Python:

```python
{"type": "first"}
```

- one
  line
- two
"""


def test_docstrings_become_markdown(tmp_path, monkeypatch):
    monkeypatch.setattr(generate, "PLUGINS", tmp_path)
    (tmp_path / "first.py").write_text(DOCSTRING)
    (tmp_path / "without.py").write_text('class Base:\n    """No plugin."""\n')
    assert generate.plugin_reference() == SECTION


@pytest.mark.parametrize("body", ["a link_\n\n.. _link: a.md", "|unknown|", "1. one"])
def test_what_has_no_markdown_is_refused(tmp_path, monkeypatch, body):
    monkeypatch.setattr(generate, "PLUGINS", tmp_path)
    text = DOCSTRING.replace("Text with", body.replace("\n", "\n    ") + "\n\n    Text")
    (tmp_path / "first.py").write_text(text)
    with pytest.raises(Exception, match="no Markdown|unknown"):
        generate.plugin_reference()


def test_files_replace_the_blocks_below_their_links():
    page = (
        "# Title\n\n[examples/wall.xml](examples/wall.xml):\n\n"
        "```xml\nold\n```\n\n```xml\nkept\n```\n"
    )
    wall = (DOCS / "examples/wall.xml").read_text("utf-8")
    assert generate.with_files(page) == page.replace("old\n", wall)
