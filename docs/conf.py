"""Settings of the documentation's site: `make docs`."""

from __future__ import annotations

import re
import sys
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path

from sphinx.application import Sphinx

from mi_nerfattack import ranges

sys.path.append(str(Path(__file__).parent / "extensions"))

project = "mi-nerfattack"
copyright = "The mi-nerfattack authors"

extensions = [
    "myst_nb",  # brings myst_parser
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "mathml",
    "signatures",
]
exclude_patterns = ["extensions", "examples", "pictures"]
# Nothing is fetched, neither while the site is built nor while it is read.
html_math_renderer = "mathml"

# Notebooks are pages of text; only those with a kernel are run, at each build.
nb_execution_mode = "force"
nb_execution_timeout = 600
nb_execution_raise_on_error = True
nb_execution_show_tb = True

myst_heading_anchors = 4
myst_enable_extensions = ["dollarmath"]
myst_fence_as_directive = ["math"]  # ```math, which GitHub shows too

autodoc_member_order = "bysource"
_ranges = [
    name for name, type_ in vars(ranges).items() if hasattr(type_, "__metadata__")
]
autodoc_type_aliases = {name: name for name in (*_ranges, "ArrayLike")}
napoleon_numpy_docstring = False
napoleon_use_ivar = True
napoleon_use_rtype = False

html_theme = "furo"
html_title = "mi-nerfattack"
html_copy_source = False
# A font for equations: few systems bring one.
_font = find_spec("ziamath").submodule_search_locations[0] + "/fonts"
html_static_path = ["style", f"{_font}/STIXTwoMath-Regular.ttf"]
html_css_files = ["site.css"]
# Fences without a language are commands with their output, or equations.
highlight_language = "none"


# Pages whose lists of links are the table of contents.
CONTENTS = (
    "index",
    "car/index",
    "notebooks/index",
    "tutorials/index",
    "results/findings/index",
    "dev/extend/index",
)
# The site shows these files as pages; in the repository a page links to each.
CARDS = {
    "results/pilotnet": "scenes/policy/pilotnet.md",
    "results/room_policy": "scenes/room/policy.md",
}


def _for_the_site(app: Sphinx, page: str, text: list[str]) -> None:
    """Turn a page that reads well in the repository into a page of the site."""
    del app
    if page in CARDS:
        text[0] = f"```{{include}} ../../{CARDS[page]}\n:relative-images:\n```\n"
    for name, card in CARDS.items():
        text[0] = re.sub(rf"\((?:\.\./)+{card}\)", f"(/{name}.md)", text[0])
    if page in CONTENTS:
        text[0] += "".join(_toctrees(text[0]))


def _toctrees(text: str) -> Iterator[str]:
    """Make a hidden toctree of each section's list of links to pages."""
    for section in re.split(r"^##+ ", text, flags=re.MULTILINE)[1:]:
        caption = section.partition("\n")[0]
        names = re.findall(r"^- \[[^]]*\]\(([\w/]+)\.\w+\)", section, re.MULTILINE)
        if names:
            options = f":caption: {caption}\n:hidden:\n\n"
            yield f"\n```{{toctree}}\n{options}" + "\n".join(names) + "\n```\n"


def setup(app: Sphinx) -> None:
    """Connect what the settings cannot say."""
    app.connect("source-read", _for_the_site)
