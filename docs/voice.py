"""List the sentences, phrases and lines of a page that break the plain voice.

    python docs/voice.py docs/start/install.md README.md mi_nerfattack/cli.py

Of Python files, the docstrings of public names and the help texts of options are read.
Each finding is printed with its page and line. The rules: a sentence has at most 35
words, a line at most 100 characters, no phrase is one of PHRASES, and only pages of
results name a machine. Tables may have long lines and sentences; code may have the
phrases.
"""

from __future__ import annotations

import argparse
import ast
import inspect
import re
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from markdown_it import MarkdownIt
from markdown_it.token import Token

ROOT = Path(__file__).resolve().parents[1]
MAX_WORDS = 35
MAX_CHARACTERS = 100
CODE = "`x`"  # one word instead of a code span or of mathematics

# Pattern -> what to write. A space matches a line break too. A pattern with a group
# finds only the matches of the group: its other branch is the good use.
_MOVES = r"driv(?:es?|en|ing)|drove|go(?:es|ing)?|went|mov(?:es?|ed|ing)|steer(?:s|ed)?"
PHRASES = {
    r"\b(?:told|tells)\b": "report, print, say, show; or name who learns it and how",
    r"\bin place of\b": "instead of",
    r"\bbeside\b": "next to (a place), compared with (a number)",
    r"\bpass(?:es|ed|ing)? back\b": "backward pass",
    r"\bat hand\b": "available",
    r"\blikewise\b": "also, in the same way; in a table: repeat the cell",
    r"\bwhatever (?:it|they|that|this) gives?\b": "say which values it may give",
    r"\banew\b": "again",
    # "one row per drive"; not "a road between two walls"
    r"\b(?:a|one) (?:row|column|page|plot|number|bit|cost) an? \w+": "one ... per ...",
    r"\bone (?:drive|frame|ray|tick|process|concept|image) an? \w+": "one ... per ...",
    # "drives past one car and past another" is plain; "the error past a car" is not
    rf"\b(?:{_MOVES})(?:[:,]|(?: [^\s,:]+){{0,3}}?) past\b"
    r"(?:[^.;]*? (?:and|or) past\b)*"
    r"|\bin the past\b|\bpast (?:the|an|its) end\b|\b(past)\b": (
        "after, with; or say what drives past"
    ),
    # The noun: "random looks". The verb is plain: "each looks at the road".
    r"\b(?:random|these|those|the|of|over|own|best|each|every|no|a|one|new|starts,)"
    r" looks?\b(?! (?:at|like|for|from|up|down|through|across|along|into)\b)": (
        "texture, appearance"
    ),
    # "each object has its own texture" is plain; "with their own textures" is not
    r"\b(?:has|have|gets?|keeps?|needs?|gives?) \w+ own\b|\byour own\b"
    r"|\b(own (?:textures?|colou?rs?|looks?))\b": "original texture",
    # An object stands on the pavement; a word does not stand for another.
    r"\bst(?:ands?|anding|ood) (?:for|in for|there|here|first|above|below)\b"
    r"|\bst(?:ands?|anding|ood) in `x`": "mean, represent, replace, be",
    r"\bst(?:ands?|anding|ood) (?:at the (?:top|end|bottom|start|beginning)"
    r"|in the (?:list|table|file|page|scenario|section|glossary|report))\b": "be, find",
    r"\bas (?:it|they) stands?\b": "unchanged, exactly as written",
}
_PHRASES = {re.compile(p.replace(" ", r"\s+"), re.I): new for p, new in PHRASES.items()}

_MACHINES = re.compile(
    r"\b(?:AMD|EPYC|Xeon|Ryzen|Threadripper|Intel Core|Core i\d|Graviton|Apple M\d"
    r"|[AHV][12]00|RTX \w+|GTX \w+|Tesla [A-Z]\d+)\b"
)
# Pages of results may name machines.
_PAGES = "bench car fields gpu retrain training".split()
_TABLES = "table2 methods matrix".split()
_RESULTS = (
    *(f"docs/results/{page}.md" for page in _PAGES),
    *(f"docs/results/{table}/" for table in _TABLES),
)

_SENTENCE_END = re.compile(r"(?<!\.\.)[.!?][)\]\"'”’*]*\s+")
_ABBREVIATION = re.compile(r"\b(?:e\.g|i\.e|cf|vs|approx|et al|Fig|Eq|Sec)\.\s+$")
_MATHEMATICS = re.compile(r"\$\$.+?\$\$|\$[^$\n]+\$", re.S)
_ADDRESS = r"https?://\S+|<https?://\S+>|\[[^\]]+\]:\s+\S+"
_ONLY_A_LINK = re.compile(
    rf"\s*(?:[-*] )?(?:{_ADDRESS}|!?\[[^\]]*\]\(\S+\)|\[!\[.*\]\(\S+\)"
    r"|<(?:img|a|source) [^>]*>)[.,;:]?\s*$"
)
# In docstrings: a name that a description follows, and a line of a simple table.
_ARGUMENT = re.compile(r"(?<=^    )\w+(?=: )", re.M)
_BORDER = re.compile(r"=+(?: +=+)+")


@dataclass(frozen=True, order=True)
class Finding:
    """What breaks the voice: kind is "sentence", "phrase", "line" or "machine"."""

    line: int
    kind: str
    text: str


@dataclass(frozen=True)
class Passage:
    """A paragraph, heading, item or cell as plain text, and the line that it begins."""

    line: int
    text: str
    in_table: bool


def findings(markdown: str, results: bool = False) -> list[Finding]:
    """Find all that breaks the voice in a page; results may name machines."""
    tokens = MarkdownIt().enable("table").parse(markdown)
    faults: list[Finding] = []
    for passage in passages(tokens):
        faults += _phrases(passage)
        if not passage.in_table:
            faults += _long_sentences(passage)
    faults += _long_lines(markdown, tokens)
    if not results:
        faults += _machines(markdown)
    return sorted(faults)


def passages(tokens: Sequence[Token]) -> Iterator[Passage]:
    """Take the text out of parsed Markdown: no code, one word for each formula."""
    in_table = False
    for token in tokens:
        if token.type in ("table_open", "table_close"):
            in_table = token.type == "table_open"
        if token.map is None:
            continue
        line = token.map[0] + 1
        if token.type == "inline":
            children = token.children or []
            text = "".join(map(_plain, children))
            yield Passage(line, _MATHEMATICS.sub(CODE, text), in_table)
            for image in children:
                if image.type == "image":
                    yield Passage(line, image.content, in_table)
        elif token.type == "html_block":
            text = re.sub(r"<!--.*?-->|<[^>]+>", _blank, token.content, flags=re.S)
            yield Passage(line, text, in_table or "<td" in token.content)


def sentences(text: str) -> Iterator[tuple[int, str]]:
    """Split a passage into sentences, each with its offset."""
    begin = 0
    for end in _SENTENCE_END.finditer(text):
        if not _ABBREVIATION.search(text[begin : end.end()]):
            yield begin, text[begin : end.end()].strip()
            begin = end.end()
    if text[begin:].strip():
        yield begin, text[begin:].strip()


def _plain(token: Token) -> str:
    if token.type in ("softbreak", "hardbreak"):
        return "\n"
    if token.type == "code_inline":
        return CODE
    return (
        token.content if token.type == "text" else " " * (token.type == "html_inline")
    )


def _blank(match: re.Match[str]) -> str:
    return "\n" * match[0].count("\n")


def _line(passage: Passage, offset: int) -> int:
    return passage.line + passage.text.count("\n", 0, offset)


def _long_sentences(passage: Passage) -> Iterator[Finding]:
    for offset, sentence in sentences(passage.text):
        words = [word for word in sentence.split() if re.search(r"\w", word)]
        if len(words) > MAX_WORDS:
            text = f"{len(words)} words: {' '.join(words[:8])} ..."
            yield Finding(_line(passage, offset), "sentence", text)


def _phrases(passage: Passage) -> Iterator[Finding]:
    for pattern, instead in _PHRASES.items():
        for match in pattern.finditer(passage.text):
            group = pattern.groups  # 0, the whole match, where there is no group
            if match[group] is not None:
                words = " ".join(match[group].split())
                line = _line(passage, match.start(group))
                yield Finding(line, "phrase", f'"{words}": {instead}')


def _long_lines(markdown: str, tokens: Sequence[Token]) -> Iterator[Finding]:
    tables: set[int] = set()
    for token in tokens:
        if token.type == "table_open" and token.map is not None:
            tables.update(range(*token.map))
    for index, line in enumerate(markdown.split("\n")):
        exempt = index in tables or _ONLY_A_LINK.match(line)
        if len(line) > MAX_CHARACTERS and not exempt:
            yield Finding(index + 1, "line", f"{len(line)} characters")
        if line.lstrip().startswith("% "):
            yield Finding(index + 1, "line", "begins with %: a comment of the site")


def _machines(markdown: str) -> Iterator[Finding]:
    for number, line in enumerate(markdown.split("\n"), 1):
        if match := _MACHINES.search(line):
            yield Finding(number, "machine", f'"{match[0]}": a rounded number, a link')


def pages() -> dict[str, Path]:
    """Find the pages of the repository, by their names in it."""
    alone = [ROOT / name for name in ("README.md", "CONTRIBUTING.md", "paper/paper.md")]
    paths = [*alone, *ROOT.glob("docs/**/*.md")]
    return {path.relative_to(ROOT).as_posix(): path for path in sorted(paths)}


def prose_words(markdown: str) -> int:
    """Count the words of a page without its code and tables."""
    tokens = MarkdownIt().enable("table").parse(markdown)
    return sum(len(x.text.split()) for x in passages(tokens) if not x.in_table)


def modules() -> dict[str, Path]:
    """Find the Python files of package and plugins, by their names."""
    paths = [*ROOT.glob("mi_nerfattack/**/*.py"), *ROOT.glob("plugins/*.py")]
    return {path.relative_to(ROOT).as_posix(): path for path in sorted(paths)}


def docstrings(source: str) -> Iterator[Passage]:
    """Find the docstrings of public names, and those of attributes: help texts."""
    for node in _public(ast.parse(source)):
        for expression in node.body:
            value = expression.value if isinstance(expression, ast.Expr) else None
            if isinstance(value, ast.Constant) and isinstance(value.value, str):
                text = _as_markdown(inspect.cleandoc(value.value))
                yield Passage(value.lineno, text, False)


def _as_markdown(docstring: str) -> str:
    """Mark names of arguments as code, and simple tables as tables; keep the lines."""
    lines, borders = _ARGUMENT.sub(r"`\g<0>`", docstring).split("\n"), 0
    for index, line in enumerate(lines):
        if _BORDER.fullmatch(line):
            borders = (borders + 1) % 3
            lines[index] = "|---|" if borders == 2 else ""
        elif borders:
            lines[index] = f"| {line} |"
    return "\n".join(lines)


def _public(
    node: ast.Module | ast.ClassDef | ast.FunctionDef,
) -> Iterator[ast.Module | ast.ClassDef | ast.FunctionDef]:
    yield node
    if isinstance(node, ast.FunctionDef):
        return
    for child in node.body:
        if isinstance(child, ast.ClassDef | ast.FunctionDef):
            if not child.name.startswith("_"):
                yield from _public(child)


def findings_in(name: str, path: Path) -> list[Finding]:
    """Find what breaks the voice in a file; its name decides if it shows results."""
    text = path.read_text("utf-8")
    if path.suffix != ".py":
        return findings(text, results=name.startswith(_RESULTS))
    return [
        replace(finding, line=passage.line + finding.line - 1)
        for passage in docstrings(text)
        for finding in findings(passage.text)
    ]


def main() -> int:
    """List the findings of the pages that are named, of all without a name."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("pages", nargs="*", help="all without one")
    named = {name: Path(name) for name in parser.parse_args().pages}
    lines = [
        f"{name}:{finding.line}: {finding.kind}: {finding.text}"
        for name, path in (named or {**pages(), **modules()}).items()
        for finding in findings_in(name, path)
    ]
    print("\n".join(lines) or "no findings")
    return int(bool(lines))


if __name__ == "__main__":
    sys.exit(main())
