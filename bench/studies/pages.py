"""Write the pages of docs/results/findings."""

from __future__ import annotations

import io
import re
import textwrap
from collections.abc import Sequence
from os.path import relpath
from pathlib import Path

from PIL import Image

from bench.studies.findings import Finding, finding
from bench.studies.plan import ROOT, UNKNOWN, State, Study, choose, read_plan, state
from bench.tables import markdown
from mi_nerfattack.io import files
from mi_nerfattack.report.plots.charts import blank, png

MARK = "<!-- python -m bench results --pages writes this page from the table. -->"
FOLDER = ROOT / "docs/results/findings"
_SIZE_IN, _DPI = (6.0, 3.4), 130


def write_pages(
    studies: Sequence[Study] = (),
    folder: Path = FOLDER,
    pictures: Path = ROOT / "docs/pictures",
) -> list[Path]:
    """Write a page, a chart and a line of the index for each study with a finding.

    Args:
        studies: by default all of the plan.
        folder: of the pages.
        pictures: folder of the charts.

    Returns:
        Paths of the pages.
    """
    written = []
    for study in studies or read_plan().studies:
        if (made := finding(study)) is not None:
            chart = files.make_folder(pictures) / f"finding_{study.finding}.png"
            with blank(_SIZE_IN, _DPI) as figure:
                made.draw(figure)
                files.write_bytes(chart, _smaller(png(figure)))
            page = files.make_folder(folder) / f"{study.finding}.md"
            one = state(study, compare=False)
            files.write_text(
                page, page_text(study, made, one, picture=relpath(chart, folder))
            )
            written.append(page)
            index = folder / "index.md"
            if index.exists():
                text = with_answer(index.read_text("utf-8"), page.name, made.title)
                files.write_text(index, text)
    return written


def with_answer(index: str, page: str, title: str) -> str:
    """Return the text of the index, in which the question of a page has its answer.

    Args:
        index: Markdown with one item for each page: its question as a link.
        page: the page's file name.
        title: the finding.
    """
    item = re.compile(rf"^(- \[[^]]*\]\({re.escape(page)}\)).*(?:\n  .*)*", re.M)
    return item.sub(lambda match: _wrapped(f"{match[1]} {title}.", "  "), index)


def _smaller(image: bytes) -> bytes:
    """Return a PNG file with 64 colours, which charts need at most."""
    buffer = io.BytesIO()
    with Image.open(io.BytesIO(image)) as chart:
        few = chart.convert("RGB").quantize(64, dither=Image.Dither.NONE)
    few.save(buffer, "PNG", optimize=True)
    return buffer.getvalue()


def page_text(study: Study, made: Finding, one: State, picture: str) -> str:
    """Return a page as Markdown.

    Args:
        study: whose page it is.
        made: what it shows.
        one: how far the study is.
        picture: address of the chart.
    """
    data, names = f"{study.table}/{study.rows}", [*study.reads, study.name]
    rules = [one.grid for one in choose(tuple(names)) if one.grid is not None]
    listed = " and ".join(
        f"[`{Path(rule).name}`]({relpath(ROOT / rule, FOLDER)})"
        for rule in rules or ["bench/results.toml"]
    )
    what = "places, seeds and budgets" if rules else "commands"
    only = names[0] if len(names) == 1 else f'"{" ".join(names)}"'
    threats = [f"The table has {one.done} of {one.wanted} {study.units}."]
    if UNKNOWN in one.sources:
        threats.append(
            "Nobody recorded which commit of the source made these rows. Today's "
            f"program may give other figures (`make results LIST=1 ONLY={study.name}`)."
        )
    if len(one.sources) > 1:
        threats.append(f"{len(one.sources)} versions of the program made these rows.")
    threats += [*made.threats, *study.threats]
    description = (
        f"[`{data}`]({relpath(ROOT / data, FOLDER)}) has the rows. "
        f"{listed} {'has' if len(rules) < 2 else 'have'} the {what}. "
        f"`make results ONLY={only}` makes missing rows. "
        f"{study.note} [How to read this page](index.md)."
    )
    code = f'import pandas as pd\n\ndrives = pd.read_csv("{data}")\n{made.pandas}'
    sections = [
        f"# {made.title}",
        MARK,
        f"![{made.title}.]({picture})",
        _wrapped(" ".join(made.sentences)),
        markdown(made.head, made.rows),
        "## Threats to validity",
        "\n".join(_wrapped(f"- {threat}", "  ") for threat in threats),
        "## Data",
        _wrapped(" ".join(description.split())),
        f"```python\n{code}\n```",
    ]
    return "\n\n".join(sections) + "\n"


def _wrapped(text: str, indent: str = "") -> str:
    """Break lines at 100 characters; links and percentages stay whole.

    A line that begins with ``%`` is a comment in the site's Markdown.
    """
    return textwrap.fill(
        text.replace(" %", "\0%"),
        100,
        subsequent_indent=indent,
        break_long_words=False,
        break_on_hyphens=False,
    ).replace("\0%", " %")
