"""Pages read well where only GitHub-flavoured Markdown is known, and links lead on."""

from __future__ import annotations

import re
import subprocess
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest
from markdown_it import MarkdownIt
from markdown_it.token import Token

ROOT = Path(__file__).parents[2]
# Those of ROOT, paper/ and scenes/ are not on the site: no other check of their links.
PAGES = [
    path
    for pattern in ("*.md", "docs/**/*.md", "paper/*.md", "scenes/**/*.md")
    for path in sorted(ROOT.glob(pattern))
]
NAMES = [path.relative_to(ROOT).as_posix() for path in PAGES]
DIRECTIVE = re.compile(r":::|^\.\. [\w:-]+::|^\([\w-]+\)=$|^\{[\w-]+\}", re.M)
ROLE = re.compile(r"(\{[\w:-]+\}|:[\w:-]+:)$")


def parse(text: str) -> list[Token]:
    return MarkdownIt().enable(["table", "strikethrough"]).parse(text)


def directives(text: str) -> Iterator[str]:
    """Find what a reader would see as code of another program."""
    for token in parse(text):
        language = r"\w*|\{code-cell\} python"  # the latter of a notebook
        if token.type == "fence" and not re.fullmatch(language, token.info.strip()):
            yield token.info
        if token.type != "inline":
            continue
        children = token.children or []
        words = "".join("`" if c.type == "code_inline" else c.content for c in children)
        yield from DIRECTIVE.findall(token.content if "`" not in words else words)
        for before, after in zip(children, children[1:], strict=False):
            role = ROLE.search(before.content)
            if before.type == "text" and after.type == "code_inline" and role:
                yield role[0]


def targets(text: str) -> Iterator[str]:
    for token in parse(text):
        for part in (token, *(token.children or [])):
            for name in ("href", "src"):
                if name in part.attrs:
                    yield str(part.attrs[name])
            if part.type in ("html_block", "html_inline"):
                yield from re.findall(r'\b(?:href|src|srcset)="([^"]+)"', part.content)


def anchors(text: str) -> set[str]:
    tokens = parse(text)
    headings = (
        "".join(child.content for child in tokens[k + 1].children or [])
        for k, token in enumerate(tokens)
        if token.type == "heading_open"
    )
    words = (re.sub(r"[^\w\- ]", "", heading.lower()) for heading in headings)
    return {word.strip().replace(" ", "-") for word in words}


@cache
def files() -> frozenset[Path]:
    command = ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True)
    paths = {ROOT / name for name in done.stdout.split("\0") if name}
    there = {path for path in paths if path.exists()}
    return frozenset(there.union(*(path.parents for path in there)))


@pytest.mark.parametrize("page", PAGES, ids=NAMES)
def test_page_has_no_directives(page):
    assert not list(directives(page.read_text("utf-8")))


@pytest.mark.parametrize("page", PAGES, ids=NAMES)
def test_links_lead_to_files_and_headings(page):
    text = page.read_text("utf-8")
    for link in targets(text):
        if re.match(r"https?://|mailto:", link):
            continue
        name, _, heading = link.partition("#")
        target = (page.parent / name).resolve() if name else page
        assert target in files(), f"{link}: no file that git has"
        if heading:
            assert heading in anchors(target.read_text("utf-8")), f"{link}: no heading"


@pytest.mark.parametrize(
    ("text", "count"),
    [
        ("```{toctree}\nindex\n```", 1),
        ("~~~ {note}\nWords\n~~~", 1),
        (":::{note}\nWords\n:::", 2),
        (".. image:: a.png", 1),
        ("See {ref}`the page <page>`.", 1),
        ("See :doc:`page`.", 1),
        ("(label)=\n# Title", 1),
        ("```math\nx\n```", 0),
        ("```\n.. note:: words\n```", 0),
        ("Write `{ref}` or `:doc:` or `:::`.", 0),
        ("A range: `x`, {a, b} or 3:`4`.", 0),
        ("The rates (left)= 3.", 0),
    ],
)
def test_directives_are_found(text, count):
    assert len(list(directives(text))) == count


def test_targets_and_anchors_are_found():
    text = '# A `b` of [c](d.md), e\n\n[![f](g.png)](h.md#i)\n\n<img src="j.jpg">'
    assert sorted(targets(text)) == ["d.md", "g.png", "h.md#i", "j.jpg"]
    assert anchors("# A `b` of C, e's d\n\n```\n# none\n```") == {"a-b-of-c-es-d"}
