"""Try many damaged files: ``python -m fuzz.campaign`` with `tests` as a path.

Inputs are tried in pieces, and the table gets a row as a piece ends: its format, seed,
first number, count, the commit, and what failed. What has a row is not tried again, so
that a campaign goes on after an interruption, also on another day or machine.
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

ROOT = Path(__file__).parents[2]
TABLE = Path(__file__).with_name("tried.csv")
COLUMNS = ["format", "seed", "first", "count", "commit", "failed"]
PIECE = 10_000
MEMORY = Path("/dev/shm")  # files there are not written to a disk


def main() -> int:
    """Try what has no row, the formats in turns; return 1 if any input failed."""
    parser = argparse.ArgumentParser(prog="fuzz.campaign")
    parser.add_argument("formats", nargs="*", default=list(FORMATS))
    parser.add_argument("--count", type=int, default=100_000)
    parser.add_argument("--seeds", type=int, nargs="+", default=[20261128, 20261129])
    parser.add_argument("--workers", type=int, default=os.cpu_count())
    parser.add_argument("--table", type=Path, default=TABLE)
    given = parser.parse_args()
    done = _read(given.table)
    keys = set(map(tuple, done[COLUMNS[:4]].to_numpy()))
    count = min(PIECE, given.count)
    waiting = [
        (name, seed, first, count)
        for seed in given.seeds
        for first in range(0, given.count, PIECE)
        for name in given.formats
        if (name, seed, first, count) not in keys
    ]
    commit = _output("git", "rev-parse", "--short", "HEAD").strip()
    with ThreadPoolExecutor(given.workers) as pool:
        running = {pool.submit(_tried, *piece): piece for piece in waiting}
        for ended in as_completed(running):
            piece, failed = running[ended], ended.result()
            done.loc[len(done)] = [*piece, commit, failed]
            done.sort_values(COLUMNS[:4]).to_csv(given.table, index=False)
            print(*piece, failed or "all read or refused", flush=True)
    return int((done["failed"] != "").any())


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
    return result.stdout.strip() if result.returncode else ""


def _output(*command: str) -> str:
    return subprocess.run(command, cwd=ROOT, stdout=subprocess.PIPE, text=True).stdout


def _read(table: Path) -> pd.DataFrame:
    if not table.exists():
        return pd.DataFrame(columns=COLUMNS)
    return pd.read_csv(table, dtype={"commit": str}, keep_default_na=False)


if __name__ == "__main__":
    sys.exit(main())
