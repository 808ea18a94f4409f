"""Pages from the templates of this folder; HTML needs no network and no other file."""

from __future__ import annotations

import base64
import io
from pathlib import Path
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup
from PIL import Image

from mi_nerfattack.io import files

# What ends a cell of a table or begins an element, and how Markdown shows it.
_IN_MARKDOWN = str.maketrans({"&": "&amp;", "<": "&lt;", "|": "\\|", "\n": " "})


def render(template: str, **values: Any) -> str:
    """Fill in a template; every value is escaped for its format.

    Args:
        template: ``NAME.html.j2`` or ``NAME.md.j2`` in the folder `templates`.
        values: all that it names.
    """
    environment = _MARKDOWN if template.endswith(".md.j2") else _HTML
    return environment.get_template(template).render(values)


def _embedded(path: str | Path) -> Markup:
    """Return the address of an image file as PNG that holds its pixels."""
    buffer = io.BytesIO()
    Image.fromarray(files.read_image(path)).save(buffer, "PNG")
    data = base64.b64encode(buffer.getvalue()).decode("ascii")
    return Markup(f"data:image/png;base64,{data}")


def _in_markdown(value: Any) -> Markup:
    """Escape a value; what a macro returns is escaped already."""
    if isinstance(value, Markup):
        return value
    return Markup(str(value).translate(_IN_MARKDOWN))


def _code(value: str) -> Markup:
    """Return text as Markdown's code, in which only its own mark and `|` count."""
    return Markup("`" + value.replace("`", "'").replace("|", "\\|") + "`")


_HTML = Environment(
    loader=PackageLoader("mi_nerfattack.report.pages"),
    autoescape=True,
    undefined=StrictUndefined,
    trim_blocks=True,
    lstrip_blocks=True,
    keep_trailing_newline=True,
)
_HTML.filters |= {"embedded": _embedded, "code": _code}
_MARKDOWN = _HTML.overlay(finalize=_in_markdown)
