"""Write the parts of pages that repeat other files.

    python docs/generate.py

docs/examples.md shows files of docs/examples/. docs/reference/faults.md shows the
tables of the suite in tests/faults. docs/reference/plugins.md shows the class
docstrings of plugins/*.py, which are reStructuredText in the format of Mitsuba's plugin
reference. No plugin is imported. tests/docs/test_generated.py compares the pages with
the files.
"""

from __future__ import annotations

import ast
import inspect
import re
import runpy
from collections.abc import Iterator
from pathlib import Path

from docutils import nodes
from docutils.core import publish_doctree
from docutils.parsers.rst import Directive, directives

DOCS = Path(__file__).resolve().parent
PLUGINS = DOCS.parent / "plugins"
MARK = "<!-- docs/generate.py writes everything below this line. -->\n"
LIMITS = "[Limits of all plugins](plugin_limits.md)"
LANGUAGES = {"xml": "XML", "python": "Python"}
# What the docstrings use of Mitsuba's own documentation.
TYPES = (
    "bool film float int integrator medium sampler spectrum string tensor transform "
    "volume"
).split()
FLAGS = {"exposed": "P", "differentiable": "∂", "discontinuous": "D"}
PROLOG = "\n".join(
    [
        ".. role:: paramtype(literal)",
        ".. role:: monosp(literal)",
        ".. |false| replace:: ``false``",
        *(f".. |{name}| replace:: ``{name}``" for name in TYPES),
        *(f".. |{name}| replace:: {sign}" for name, sign in FLAGS.items()),
        "\n",
    ]
)


def pages() -> dict[Path, str]:
    """Return the text that each of the pages should have."""
    examples, reference = DOCS / "examples.md", DOCS / "reference/plugins.md"
    faults = DOCS / "reference/faults.md"
    head = reference.read_text("utf-8").partition(MARK)[0]
    return {
        examples: with_files(examples.read_text("utf-8")),
        faults: faults.read_text("utf-8").partition(MARK)[0] + MARK + fault_tables(),
        reference: head + MARK + "\n" + plugin_reference(),
    }


def fault_tables() -> str:
    """Write the tables of the conformance suite: events, commands, and their files."""
    path = DOCS.parent / "tests/faults/jobs.py"
    suite = runpy.run_path(str(path), run_name="jobs")
    rows = ["", "| event | exit code | the message holds |", "|---|---|---|"]
    for name, event in suite["EVENTS"].items():
        code = "–" if event.code is None else event.code
        rows.append(f"| {name} | {code} | {event.message or '–'} |")
    columns = (
        "command",
        "files that are written once",
        "files that end equal to the bit",
    )
    rows += ["", f"| {' | '.join(columns)} |", "|---|---|---|"]
    for name, job in suite["JOBS"].items():
        once = f"`{job.keeps}`" if job.keeps else "–"
        equal = " ".join(f"`{pattern}`" for pattern in job.equal)
        rows.append(f"| `{name}` | {once} | {equal} |")
    rows += [
        "",
        "Commands that write only at their ends, as the suite starts them:",
        "",
    ]
    return "\n".join([*rows, *(f"- `{words}`" for words in suite["WRITERS"]), ""])


def with_files(page: str) -> str:
    """Replace each block of code below a link `[examples/NAME](...):` by the file.

    Below `[examples/NAME](...), lines 3 to 9:`, the block has these lines of the file.
    """

    def show(match: re.Match[str]) -> str:
        lines = (DOCS / match["file"]).read_text("utf-8").splitlines(keepends=True)
        if match["first"]:
            lines = lines[int(match["first"]) - 1 : int(match["last"])]
        return f"{match['head']}{''.join(lines)}```\n"

    part = r"(?:, lines (?P<first>\d+) to (?P<last>\d+))?"
    link = rf"^(?P<head>\[(?P<file>examples/[\w.]+)\]\((?P=file)\){part}:\n\n```\w+\n)"
    return re.sub(rf"{link}.*?^```\n", show, page, flags=re.M | re.S)


def plugin_reference() -> str:
    """Write a list of the plugins, then a section for each."""
    sections, contents = [], []
    for source in sorted(PLUGINS.glob("*.py")):
        if (text := class_docstring(source)) and ".. pluginparameters::" in text:
            document = publish_doctree(
                PROLOG + text,
                settings_overrides={"doctitle_xform": False, "halt_level": 2},
            )
            (section,) = document.findall(nodes.section)
            title, *body = section.children
            heading = inline(title)
            anchor = re.sub(r"[^\w -]", "", heading.lower()).replace(" ", "-")
            picture = (
                f"![Picture of {source.stem}](../pictures/plugin_{source.stem}.jpg)"
            )
            contents.append(f"- [{heading}](#{anchor})")
            paragraphs = [paragraph for node in body for paragraph in block(node)]
            sections += [f"## {heading}", picture, *paragraphs, LIMITS]
    return "\n".join(contents) + "\n\n" + "\n\n".join(sections) + "\n"


def class_docstring(source: Path) -> str | None:
    """Read the docstring of the first class of a file."""
    tree = ast.parse(source.read_text("utf-8"))
    classes = [node for node in tree.body if isinstance(node, ast.ClassDef)]
    text = ast.get_docstring(classes[0], clean=False) if classes else None
    return text and inspect.cleandoc(text)


def block(node: nodes.Node) -> Iterator[str]:
    """Translate an element of a section into blocks of Markdown."""
    match node:
        case nodes.paragraph():
            yield inline(node)
        case nodes.math_block():
            yield f"```math\n{node.astext()}\n```"
        case nodes.literal_block():
            language = node["language"]
            yield f"In {LANGUAGES[language]}:"
            yield f"```{language}\n{node.astext()}\n```"
        case nodes.bullet_list() if "parameters" in node:
            yield "\n".join(table(node))
        case nodes.bullet_list():
            texts = ["\n\n".join(b for n in item for b in block(n)) for item in node]
            yield "\n".join("- " + text.replace("\n", "\n  ") for text in texts)
        case _:
            raise NotImplementedError(f"no Markdown for {node}")


def table(rows: nodes.bullet_list) -> Iterator[str]:
    """Translate rows of parameters; rows of state alone follow a title."""
    yield "| Parameter | Type | Description | Flags |"
    yield "|---|---|---|---|"
    for k, item in enumerate(rows):
        if k == rows["parameters"]:
            yield "| **State parameters** | | | |"
        cells = [" ".join(map(inline, cell)) for cell in item[0]]
        cells += [""] * (4 - len(cells))
        escaped = [re.sub(r"\s*\n\s*", " ", c).replace("|", r"\|") for c in cells]
        yield "| " + " | ".join(escaped) + " |"


def inline(node: nodes.Node) -> str:
    """Translate text."""
    match node:
        case nodes.Text():
            return re.sub(r"([\\*<`])", r"\\\1", node.astext())
        case nodes.literal():
            return f"`{node.astext()}`"
        case nodes.math():
            return f"${node.astext()}$"
        case nodes.title() | nodes.paragraph():
            return "".join(map(inline, node.children))
    raise NotImplementedError(f"no Markdown for {node}")


class Parameters(Directive):
    """Rows of cells: name, type, description and, where there are some, flags.

    `:extra-rows:` counts the rows that the plugin reads. Only `mi.traverse` shows the
    rows after them.
    """

    has_content = True
    option_spec = {"extra-rows": directives.nonnegative_int}

    def run(self) -> list[nodes.Node]:
        """Parse the rows."""
        content = nodes.Element()
        self.state.nested_parse(self.content, self.content_offset, content)
        (rows,) = content
        rows["parameters"] = self.options.get("extra-rows", len(rows))
        return [rows]


class Tabs(Directive):
    """Examples in several languages."""

    has_content = True

    def run(self) -> list[nodes.Node]:
        """Parse the examples."""
        content = nodes.Element()
        self.state.nested_parse(self.content, self.content_offset, content)
        return content.children


class Tab(Directive):
    """Example in one language."""

    has_content = True
    required_arguments = 1

    def run(self) -> list[nodes.Node]:
        """Keep the text."""
        text = "\n".join(self.content)
        return [nodes.literal_block(text, text, language=self.arguments[0])]


directives.register_directive("pluginparameters", Parameters)
directives.register_directive("tabs", Tabs)
directives.register_directive("code-tab", Tab)


if __name__ == "__main__":
    for path, text in pages().items():
        path.write_text(text, "utf-8")
