"""The pages keep the plain voice, and docs/voice.py finds what breaks it."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from docs.voice import (
    docstrings,
    findings,
    findings_in,
    modules,
    pages,
    prose_words,
    sentences,
)

ROOT = Path(__file__).parents[2]
PAGES = pages()


@pytest.mark.parametrize("name", [*PAGES, *modules()])
def test_text_keeps_the_voice(name):
    faults = findings_in(name, ROOT / name)
    assert not faults, "".join(f"\n{name}:{x.line}: {x.kind}: {x.text}" for x in faults)


# How-to pages are short; a page of reference may be as long as its tables need.
LONGEST = {
    "docs/howto/": 600,
    "docs/reference/": None,
    "docs/index.md": None,  # the list of all pages
    "paper/": None,
    "": 1500,
}


def longest(page: str) -> int | None:
    return next(size for folder, size in LONGEST.items() if page.startswith(folder))


@pytest.mark.parametrize("page", [p for p in PAGES if longest(p)])
def test_page_is_short(page):
    words = prose_words((ROOT / page).read_text("utf-8"))
    assert words <= longest(page), f"{words} words; split the page"


def test_docstrings_of_public_names_and_attributes_are_read():
    source = '''"""One."""
def _hidden():
    """None."""
class Shown:
    """Two."""
    size: int
    """Three."""
    def method(self):
        """Four."""
        def inner():
            """None."""
'''
    passages = {(passage.line, passage.text) for passage in docstrings(source)}
    assert passages == {(1, "One."), (5, "Two."), (7, "Three."), (9, "Four.")}


def test_names_of_arguments_are_code_and_simple_tables_are_tables():
    word = "word " * 6
    rows = f"{word}  {word}\n" * 4
    source = f'''"""One.

====  ====
name  told
====  ====
{rows}====  ====

Args:
    told: a number.
    size: told.
"""'''
    (passage,) = docstrings(source)
    kinds = [(finding.line, finding.kind) for finding in findings(passage.text)]
    assert kinds == [(4, "phrase"), (14, "phrase")]


def kinds(markdown: str, results: bool = False) -> list[tuple[int, str]]:
    return [(one.line, one.kind) for one in findings(markdown, results)]


@pytest.mark.parametrize(
    ("text", "number"),
    [
        ("One. Two! Three?", 3),
        ("Open a file, e.g. a mesh, i.e. one of 0.5 m in scene.xml.", 1),
        ("See Smith et al. and Fig. 3. It shows more.", 2),
        ("It drives (in a loop.) Then it stops.", 2),
        ("It waits ... and goes on.", 1),
    ],
)
def test_sentences_are_split(text, number):
    split = list(sentences(text))
    assert len(split) == number
    assert all(text[offset:].startswith(sentence) for offset, sentence in split)


LONG = "\n".join(["word"] * 36)


@pytest.mark.parametrize(
    ("markdown", "lines"),
    [
        (LONG.removesuffix("\nword"), []),
        (LONG, [1]),
        ("Short.\n\n- item\n- " + LONG.replace("\n", "\n  "), [4]),
        (f"One sentence.\nThen\n{LONG}.", [2]),
        ("`{}` word".format("word " * 20) + "\nword" * 33, []),
        ("[{}](page.md)".format("word " * 20) + "\nword" * 16, [1]),
        ("$a + b + c + d$" + "\nword" * 34, []),
        ("- - -" + "\nword - word" * 17, []),
        (f"```\n{LONG}\n```", []),
        ("| a |\n|---|\n| {} |".format(LONG.replace("\n", " ")), []),
        (f"<!--\n{LONG}\n-->", []),
        (f"<p>\n{LONG}</p>", [1]),
        ("![{}](a.png)".format("word " * 36), [1]),
    ],
)
def test_long_sentences_are_found(markdown, lines):
    assert [line for line, kind in kinds(markdown) if kind == "sentence"] == lines


@pytest.mark.parametrize(
    ("bad", "good"),
    [
        ("You are told the size.", "We retold it."),
        ("B in\nplace of A.", "Put A in its place."),
        ("The error beside random textures.", "Besides, it is slow."),
        ("A pass back costs more.", "Pass it backwards."),
        ("No GPU was at hand.", "Print it by hand."),
        ("Likewise for the other.", "It is likely."),
        ("It begins anew.", "A new run begins."),
        ("It counts whatever it gives.", "It counts, whatever its value."),
        ("The table has a row a drive.", "A road between two walls."),
        ("One ray a pixel.", "A ray hits a pixel."),
        ("The error past the object.", "The policy drives past it."),
        ("It drives past it; the mean past it.", "It drives past it and past her."),
        ("Random looks cost as much.", "It looks at a picture."),
        ("With their own textures.", "Each has its own texture."),
        ("The cube stands for yours.", "The cube stands on the road."),
        ("Limits stand at the end.", "It stands still at the end."),
        ("Run it as it stands.", "Run it as it is."),
    ],
)
def test_phrases_are_found(bad, good):
    assert kinds(f"# Title\n\n{bad}")[0][1] == "phrase"
    assert kinds(good) == []


@pytest.mark.parametrize(
    ("markdown", "expected"),
    [
        ("It is `told`.\n\n```\ntold\n```\n\n| told |\n|---|", [(7, "phrase")]),
        ("x" * 100, []),
        ("x" * 101, [(1, "line")]),
        ("a share of 5\n% is lost", [(2, "line")]),
        ("https://example.org/" + "x" * 100, []),
        ("see https://example.org/" + "x" * 100, [(1, "line")]),
        ("- [name](page.md#" + "x" * 100 + ").", []),
        ("[![" + "x" * 100 + "](a.png)](b.md)", []),
        ("```\n{0}\n```\n\n| a |\n|---|\n| {0} |".format("x" * 101), [(2, "line")]),
        ("On Linux, an NVIDIA GPU or AMD64.", []),
        ("| 2 cores (AMD EPYC) |\n|---|", [(1, "machine")]),
    ],
)
def test_phrases_lines_and_machines_are_found_where_they_count(markdown, expected):
    assert kinds(markdown) == expected
    assert kinds(markdown, results=True) == [x for x in expected if x[1] != "machine"]


def test_findings_are_listed_with_page_and_line(tmp_path):
    (tmp_path / "good.md").write_text("Drive `told` past it.")
    (tmp_path / "bad.md").write_text("A new page\nis told.")
    command = [sys.executable, ROOT / "docs/voice.py", "good.md"]
    for names, code, start in (([], 0, "no"), (["bad.md"], 1, "bad.md:2: phrase: ")):
        done = subprocess.run([*command, *names], cwd=tmp_path, stdout=-1, text=True)
        assert done.returncode == code and done.stdout.startswith(start)
