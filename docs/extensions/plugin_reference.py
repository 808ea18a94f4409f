"""Docstrings of the plugins, in the format of Mitsuba's plugin reference, as sections.

``.. mitsuba-plugin:: NAME`` takes the class docstring of ``plugins/NAME.py`` as it
stands, without importing it, and the picture that ``docs/pictures.py`` rendered.
"""

from __future__ import annotations

import ast
import inspect
import os
from pathlib import Path

from docutils import nodes
from docutils.parsers.rst import directives
from docutils.parsers.rst.directives.tables import ListTable
from sphinx.application import Sphinx
from sphinx.errors import ExtensionError
from sphinx.util.docutils import SphinxDirective

ROOT = Path(__file__).parents[2]
PICTURES = ROOT / "build/pictures"
HEADINGS = ("Parameter", "Type", "Description", "Flags")
WIDTHS = [20, 12, 60, 8]
TYPES = (
    "bool film float int integrator medium sampler spectrum string tensor transform "
    "volume"
).split()
FLAGS = {
    "exposed": ("P", "shown by mi.traverse"),
    "differentiable": ("∂", "differentiable"),
    "discontinuous": ("D", "moves edges of the image"),
}
PROLOG = "\n".join(
    [
        ".. role:: paramtype(literal)",
        ".. role:: monosp(literal)",
        ".. |false| replace:: :monosp:`false`",
        *(f".. |{name}| replace:: :paramtype:`{name}`" for name in TYPES),
        *(f".. |{k}| replace:: :abbr:`{s} ({v})`" for k, (s, v) in FLAGS.items()),
    ]
)


class PluginParameters(ListTable):
    """Rows of three or four cells: name, type, description, flags.

    `:extra-rows:` tells how many rows at the head are parameters; the others are what
    only ``mi.traverse`` shows.
    """

    option_spec = {"extra-rows": directives.nonnegative_int}

    def run(self) -> list[nodes.Node]:
        """Build the table."""
        content = nodes.Element()
        self.state.nested_parse(self.content, self.content_offset, content)
        rows = [[cell.children for cell in item[0]] for item in content[0]]
        rows = [row + [[]] * (len(WIDTHS) - len(row)) for row in rows]
        count = self.options.get("extra-rows", len(rows))
        if count < len(rows):
            rows.insert(count, _texts("State parameters", "", "", ""))
        rows.insert(0, _texts(*HEADINGS))
        return [self.build_table_from_list(rows, WIDTHS, 1, 0)]


def _texts(*words: str) -> list[list[nodes.Node]]:
    return [[nodes.paragraph("", "", nodes.strong(word, word))] for word in words]


class MitsubaPlugin(SphinxDirective):
    """Section of one plugin."""

    required_arguments = 1

    def run(self) -> list[nodes.Node]:
        """Parse the docstring, and put the picture below its title."""
        name = self.arguments[0]
        source = ROOT / "plugins" / f"{name}.py"
        self.env.note_dependency(str(source))
        found = self.parse_text_to_nodes(
            _docstring(source), offset=0, allow_section_headings=True
        )
        picture = PICTURES / f"{name}.png"
        if not picture.exists():
            raise ExtensionError(f"{picture}: no picture; run docs/pictures.py")
        uri = os.path.relpath(picture, Path(self.env.doc2path(self.env.docname)).parent)
        section = next(node for node in found if isinstance(node, nodes.section))
        section.insert(1, nodes.image(uri=uri, alt=f"What {name} shows"))
        return found


def _docstring(source: Path) -> str:
    """Read the docstring of the one documented class of a file."""
    tree = ast.parse(source.read_text("utf-8"))
    classes = [node for node in tree.body if isinstance(node, ast.ClassDef)]
    (text,) = [ast.get_docstring(node, clean=False) for node in classes]
    assert text is not None, source
    return inspect.cleandoc(text)


def setup(app: Sphinx) -> dict[str, bool]:
    """Register both directives."""
    app.add_directive("pluginparameters", PluginParameters)
    app.add_directive("mitsuba-plugin", MitsubaPlugin)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
