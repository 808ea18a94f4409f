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

_EXACT_BYTES = 200_000  # on a page, of an image whose pixels are kept as they are
_QUALITY = 85  # of larger ones
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


def address(image: Image.Image, kind: str = "WEBP", **options: Any) -> Markup:
    """Return the address of an image that holds it, a `data:` URI.

    Args:
        image: sRGB.
        kind: of Pillow's formats.
        options: of its writer.
    """
    buffer = io.BytesIO()
    image.save(buffer, kind, **options)
    data = base64.b64encode(buffer.getvalue()).decode("ascii")
    return Markup(f"data:image/{kind.lower()};base64,{data}")


def _embedded(path: str | Path) -> Markup:
    """Return the attributes of `img` that show a file.

    Its pixels are exact, unless that takes too much room.
    """
    image = Image.fromarray(files.read_image(path))
    source = address(image, lossless=True, quality=60, method=3)
    if len(source) > _EXACT_BYTES:
        source = address(image, quality=_QUALITY)
    size = 'width="{0}" height="{1}" style="--w: {0}" src="{2}"'
    return Markup(size).format(*image.size, source)


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
