"""Settings of the documentation's site: `make docs`."""

from __future__ import annotations

import sys
from importlib.util import find_spec
from pathlib import Path

from sphinx.application import Sphinx

from mi_nerfattack import ranges

sys.path.append(str(Path(__file__).parent / "extensions"))
import plugin_reference  # noqa: E402  lies in the folder above

project = "mi-nerfattack"
copyright = "The mi-nerfattack authors"

extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "sphinx_tabs.tabs",
    "mathml",
    "plugin_reference",
    "signatures",
]
rst_prolog = plugin_reference.PROLOG
exclude_patterns = ["extensions", "examples"]
# Nothing is fetched, neither while the site is built nor while it is read.
html_math_renderer = "mathml"

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


def _name_pages_of_the_site(app: Sphinx, page: str, text: list[str]) -> None:
    """Point links at files beside what they describe to the site's page of them."""
    del app, page
    text[0] = text[0].replace("(../scenes/policy/pilotnet.md)", "(pilotnet.md)")


def setup(app: Sphinx) -> None:
    """Connect what the settings cannot say."""
    app.connect("source-read", _name_pages_of_the_site)
