"""Try many damaged files: ``python -m fuzz.campaign`` with `tests` as a path.

Inputs are tried in pieces, and the table gets a row as a piece ends: its format, seed,
first number, count, the commit, and what failed. A piece of which nothing failed is not
tried again, so that a campaign continues after an interruption, also on another day or
machine.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor, as_completed
from pathlib import Path

import pandas as pd
from fuzz.formats import FORMATS

from mi_nerfattack.io import files

ROOT = Path(__file__).parents[2]
TABLE = Path(__file__).with_name("tried.csv")
COLUMNS = ["format", "seed", "first", "count", "commit", "failed"]
PIECE = 10_000
#: Format, seed, first number, count.
Piece = tuple[str, int, int, int]
MEMORY = Path("/dev/shm")  # files there are not written to a disk


def main() -> int:
    """Try what has no row, the formats in turns; return 1 if any input failed."""
    parser = argparse.ArgumentParser(prog="fuzz.campaign")
    parser.add_argument("formats", nargs="*", default=list(FORMATS))
    parser.add_argument("--count", type=int, default=100_000)
    parser.add_argument("--seeds", type=int, nargs="+", default=[20261128, 20261129])
    parser.add_argument("--workers", type=int, default=os.cpu_count())
    parser.add_argument("--table", type=Path, default=TABLE)
    options = parser.parse_args()
    rows = _read(options.table)
    waiting = [
        (name, seed, first, min(PIECE, options.count - first))
        for seed in options.seeds
        for first in range(0, options.count, PIECE)
        for name in options.formats
    ]
    waiting = [p for p in waiting if p not in rows or rows[p][1]]
    commit, failures = _commit(), 0
    pool = ThreadPoolExecutor(options.workers)
    try:
        running = {pool.submit(_tried, *piece): piece for piece in waiting}
        for ended in as_completed(running):
            piece, failed = running[ended], ended.result()
            rows[piece] = commit, failed
            failures += bool(failed)
            lines = [(*piece, *row) for piece, row in sorted(rows.items())]
            text = pd.DataFrame(lines, columns=COLUMNS).to_csv(index=False)
            files.write_text(options.table, text)
            print(*piece, failed or "all read or refused", flush=True)
    finally:
        pool.shutdown(cancel_futures=True)
    return int(failures > 0)


def _tried(name: str, seed: int, first: int, count: int) -> str:
    """Return what failed of one piece, a line a kind."""
    words = [name, *("--seed", seed), *("--first", first), *("--count", count)]
    result = subprocess.run(
        [sys.executable, "-m", "fuzz.run", *map(str, words)],
        env=os.environ | ({"TMPDIR": str(MEMORY)} if MEMORY.is_dir() else {}),
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
    )
    failed = result.stdout.strip()
    if result.returncode not in (0, 1) or bool(result.returncode) != bool(failed):
        raise SystemExit(f"{' '.join(map(str, words))}: ended by {result.returncode}")
    return failed


def _commit() -> str:
    command = ["git", "rev-parse", "--short", "HEAD"]
    return subprocess.check_output(command, cwd=ROOT, text=True).strip()


def _read(table: Path) -> dict[Piece, tuple[str, str]]:
    """Return commit and failures of each piece."""
    if not table.exists():
        return {}
    read = pd.read_csv(table, dtype={"commit": str}, keep_default_na=False)
    return {
        (str(name), int(seed), int(first), int(count)): (str(commit), str(failed))
        for name, seed, first, count, commit, failed in read.itertuples(index=False)
    }


if __name__ == "__main__":
    sys.exit(main())
