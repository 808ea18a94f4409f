"""The pages keep the plain voice, and docs/voice.py finds what breaks it."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from docs.voice import findings, findings_in, pages, sentences

ROOT = Path(__file__).parents[2]
FOUND = {name: findings_in(name, path) for name, path in pages().items()}
# Pages that do not pass yet, with their number of findings; it may only fall.
PENDING = {
    "docs/attack.md": 82,
    "docs/bench.md": 173,
    "docs/environments.md": 36,
    "docs/faults.md": 15,
    "docs/fields.md": 76,
    "docs/formats.md": 2,
    "docs/loop.md": 13,
    "docs/matrix/README.md": 6,
    "docs/method.md": 26,
    "docs/methods/README.md": 52,
    "docs/place.md": 13,
    "docs/plugins.md": 9,
    "docs/policy.md": 27,
    "docs/refine.md": 16,
    "docs/report.md": 10,
    "docs/retrain.md": 53,
    "docs/robot.md": 184,
    "docs/room.md": 13,
    "docs/sweep.md": 52,
    "docs/table2/README.md": 29,
    "docs/training.md": 40,
    "docs/transfer.md": 32,
    "docs/view.md": 18,
}


@pytest.mark.parametrize("page", FOUND)
def test_page_keeps_the_voice(page):
    found, allowed = FOUND[page], PENDING.get(page, 0)
    listed = "".join(f"\n{page}:{x.line}: {x.kind}: {x.text}" for x in found)
    assert len(found) <= allowed, f"{len(found)} findings, {allowed} allowed{listed}"
    lower = f"lower the count to {len(found)}" if found else "take the page out"
    assert len(found) == allowed, f"PENDING, {page}: {lower}"


def test_pending_pages_exist_and_have_findings():
    assert set(PENDING) <= set(FOUND)
    assert all(PENDING.values())


def kinds(markdown: str) -> list[tuple[int, str]]:
    return [(one.line, one.kind) for one in findings(markdown)]


@pytest.mark.parametrize(
    ("text", "number"),
    [
        ("One. Two! Three?", 3),
        ("Open a file, e.g. a mesh, i.e. one of 0.5 m in scene.xml.", 1),
        ("See Smith et al. and Fig. 3. It shows more.", 2),
        ("It drives (in a loop.) Then it stops.", 2),
        ("`x` reads it. `x` writes it.", 2),
        ("It waits ... and goes on.", 1),
        ("It is in mi_nerfattack.policy and Dr.Jit 1.5.", 1),
    ],
)
def test_sentences_are_split(text, number):
    split = list(sentences(text))
    assert len(split) == number
    assert all(text[offset:].startswith(sentence) for offset, sentence in split)


LONG = " ".join(["word"] * 36)
FITS = " ".join(["word"] * 35)


@pytest.mark.parametrize(
    ("markdown", "lines"),
    [
        (f"{FITS[:89]}\n{FITS[90:]}.", []),
        (LONG.replace(" ", "\n"), [1]),
        (
            f"Short.\n\n- item\n- {LONG}".replace(
                "word word word", "word\n  word word"
            ),
            [4],
        ),
        (f"One sentence.\nThen\n{LONG}.".replace("word word", "word\nword"), [2]),
        (f"# {LONG[:90]}\n\n{LONG[90:]}", []),
        ("`{}` word".format("word " * 20) + "\nword" * 33, []),
        ("[{}](page.md)".format("word " * 20) + "\nword" * 16, [1]),
        ("$a + b + c + d$" + "\nword" * 34, []),
        ("$$\na + b + c\n$$" + "\nword" * 34, []),
        ("- - -" + "\nword - word" * 17, []),
        (f"```\n{LONG}\n```".replace("word word", "word\nword"), []),
        (f"| a |\n|---|\n| {LONG} |", []),
        ("<!--\n" + "word\n" * 40 + "-->", []),
        ("<p>\n" + "word\n" * 40 + "</p>", [1]),
        ("![" + "word " * 36 + "](a.png)", [1]),
    ],
)
def test_long_sentences_are_found(markdown, lines):
    assert [line for line, kind in kinds(markdown) if kind == "sentence"] == lines


@pytest.mark.parametrize(
    ("bad", "good"),
    [
        ("You are told the size.", "We retold it."),
        ("Its name tells the size.", "Photographs do not tell it."),
        ("B in\nplace of A.", "Put A in its place."),
        ("The error beside random textures.", "Besides, it is slow."),
        ("A pass back costs more.", "Pass it backwards."),
        ("No GPU was at hand.", "Print it by hand."),
        ("Likewise for the other.", "It is likely."),
        ("It counts whatever it gives.", "It counts, whatever its value."),
        ("It begins anew.", "A new run begins."),
        ("The table has a row a drive.", "A road between two walls."),
        ("One page a workflow.", "One page for each workflow."),
        ("One ray a pixel.", "A ray hits a pixel."),
        ("Past the attack the error is 2 m.", "It was so in the past."),
        ("The error past the object.", "The policy drives past it."),
        ("It drives past it; the mean past it.", "It drives past it and past her."),
        ("Two drives, error past it.", "It drives a car past it, past the end."),
        ("Random looks cost as much.", "It looks at a picture."),
        ("Two of the looks win.", "One looks at the road."),
        ("With their own textures.", "Each has its own texture."),
        ("Past its own colours.", "Give your own colours."),
        ("The cube stands for yours.", "The cube stands on the road."),
        ("The key stands in `scene`.", "The car stands in the lane."),
        ("Limits stand at the end.", "It stands still at the end."),
        ("Run it as it stands.", "Run it as it is."),
    ],
)
def test_phrases_are_found(bad, good):
    assert kinds(f"# Title\n\n{bad}")[0][1] == "phrase"
    assert kinds(good) == []


def test_phrases_count_in_text_and_tables_not_in_code():
    code = "It is `told`.\n\n```\ntold\n```\n\n"
    assert kinds(f"{code}| told |\n|---|\n| x |\n\nFine,\nand **told**.") == [
        (7, "phrase"),
        (12, "phrase"),
    ]


@pytest.mark.parametrize(
    ("line", "found"),
    [
        ("x" * 100, False),
        ("x" * 101, True),
        ("    " + "x" * 97, True),
        ("https://example.org/" + "x" * 100, False),
        ("see https://example.org/" + "x" * 100, True),
        ("[name]: https://example.org/" + "x" * 100, False),
        ("- [name](page.md#" + "x" * 100 + ").", False),
        ("![picture](" + "x" * 100 + ".png)", False),
        ("[![" + "x" * 100 + "](a.png)](b.md)", False),
        ('<img src="' + "x" * 100 + '">', False),
    ],
)
def test_long_lines_are_found(line, found):
    assert ((1, "line") in kinds(line)) == found


def test_long_lines_count_in_code_and_not_in_tables():
    table = f"| a |\n|---|\n| {'x' * 101} |"
    assert kinds(f"```\n{'x' * 101}\n```\n\n{table}") == [(2, "line")]


@pytest.mark.parametrize("name", ["AMD EPYC", "Xeon", "a Ryzen 9", "H100", "RTX 4090"])
def test_machines_are_named_in_results_alone(name):
    page = f"On Linux, an NVIDIA GPU or AMD64.\n\n| 2 cores ({name}) |\n|---|\n"
    assert kinds(page) == [(3, "machine")]
    assert not findings(page, results=True)


def test_findings_are_listed_with_page_and_line(tmp_path):
    (tmp_path / "good.md").write_text("Drive `told` past it.")
    (tmp_path / "bad.md").write_text("A new page\nis told.")
    command = [sys.executable, ROOT / "docs/voice.py"]
    for names, code in ((["good.md"], 0), (["good.md", "bad.md"], 1)):
        done = subprocess.run(
            [*command, *names], cwd=tmp_path, capture_output=True, text=True
        )
        assert done.returncode == code, done.stderr
        assert done.stdout.startswith("bad.md:2: phrase: " if code else "no findings")
