"""Follow tutorials literally: run their blocks in order, in an empty folder.

    python docs/follow.py docs/tutorials/*.md [--long] [--keep FOLDER]

A block of `bash` or `python` is run, each in a process of its own; one that begins
with `# NAME.py`, `# NAME.toml` and so on is saved under that name. A block of `text`
after one that was run is what it printed; `...` stands for anything. Others are not
looked at.
`<!-- long: WHY -->` before a block leaves it to --long, `<!-- skip: WHY -->` to nobody.
The folder lies beside `scenes`, as one in a checkout does.
"""

from __future__ import annotations

import argparse
import doctest
import os
import re
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from markdown_it import MarkdownIt

ROOT = Path(__file__).resolve().parents[1]
RUN = {"bash": ["bash", "-euc"], "python": [sys.executable, "-c"]}
LOOSE = doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE


@dataclass(frozen=True)
class Block:
    """A fenced block of a page; `mark` is "long", "skip" or empty."""

    line: int
    language: str
    text: str
    mark: str
    why: str


class FailedError(Exception):
    """A block ended with an error, or printed something else."""


def blocks(page: Path) -> Iterator[Block]:
    """Find the blocks of a page."""
    mark, why = "", ""
    for token in MarkdownIt().parse(page.read_text("utf-8")):
        if token.type == "fence":
            assert token.map is not None
            language = token.info.split()[0] if token.info else ""
            yield Block(token.map[0] + 1, language, token.content, mark, why)
        match = re.fullmatch(r"<!-- (long|skip): (.*?) -->\s*", token.content, re.S)
        mark, why = match.groups() if match else ("", "")


def follow(page: Path, folder: Path, long: bool) -> Iterator[str]:
    """Run the blocks of a page, and tell of each.

    Raises:
        FailedError: a block failed; those behind it are not run.
    """
    printed: str | None = None
    for block in blocks(page):
        where = f"{page.name}:{block.line}"
        name = re.match(r"# (\S+\.\w+)\n", block.text)
        if block.mark == "skip" or block.mark == "long" and not long:
            printed = None
            yield f"{where}: {block.mark}: {block.why}"
        elif name:
            (folder / name[1]).write_text(block.text, "utf-8")
            yield f"{where}: saved {name[1]}"
        elif block.language in RUN:
            printed, seconds = run(block, folder, where)
            yield f"{where}: ran {block.language}, {seconds:.1f} s"
        elif block.language == "text" and printed is not None:
            if not doctest.OutputChecker().check_output(block.text, printed, LOOSE):
                raise FailedError(
                    f"{where}: printed\n{printed}\nin place of\n{block.text}"
                )
            yield f"{where}: as printed"
            printed = None


def run(block: Block, folder: Path, where: str) -> tuple[str, float]:
    """Run a block; return what it printed, and the seconds that it took."""
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    begin = time.perf_counter()
    done = subprocess.run(
        [*RUN[block.language], block.text],
        cwd=folder,
        env=os.environ | {"PATH": path},
        capture_output=True,
        text=True,
    )
    if done.returncode:
        raise FailedError(
            f"{where}: ended with {done.returncode}\n{done.stdout}{done.stderr}"
        )
    return done.stdout, time.perf_counter() - begin


def main() -> int:
    """Follow the pages that are named."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("pages", nargs="+", type=Path)
    parser.add_argument("--long", action="store_true", help="run what takes long, too")
    parser.add_argument("--keep", type=Path, help="work in this folder, and leave it")
    options = parser.parse_args()
    failed = False
    for page in options.pages:
        with tempfile.TemporaryDirectory() as scratch:
            above = options.keep or Path(scratch)
            folder = above / page.stem
            folder.mkdir(parents=True)
            if not (above / "scenes").exists():
                (above / "scenes").symlink_to(ROOT / "scenes")
            try:
                for line in follow(page, folder, options.long):
                    print(line, flush=True)
            except FailedError as error:
                print(error, flush=True)
                failed = True
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
