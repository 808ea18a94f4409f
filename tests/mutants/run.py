"""Change the code and run its tests: ``python -m mutants.run`` with `tests` as a path.

One run of all tests says by coverage which of them execute which line, and how long
each takes. Every change is then made in a copy of the tree, and tests of its line run
there, the quickest first, until one fails or `SECONDS` are over. The table gets a row
as a change is judged. What has a row is not done again. With ``--again``, a drawn
change that no test noticed is, once, by tests of all lines of its module: coverage
counts what is cached for one test alone.
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
import xml.etree.ElementTree as ElementTree
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from itertools import chain
from pathlib import Path
from queue import SimpleQueue
from typing import Any

import pandas as pd
from coverage import CoverageData
from mutants.changes import Change, draw

from mi_nerfattack.io import files

ROOT = Path(__file__).parents[2]
WORK = ROOT / "build" / "mutants"
PACKAGE = "mi_nerfattack"
PARTS = "rollout render evaluation drives attack car/drive/safety car/vesc".split()
#: Of tests of one change, as they were measured, and of one run beside others.
SECONDS, LIMIT_S = 60.0, 600.0


def main() -> int:
    """Measure once, judge the drawn changes, and print those that no test noticed."""
    parser = argparse.ArgumentParser(prog="mutants")
    parser.add_argument("--count", type=int, default=400)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--workers", type=int, default=os.cpu_count())
    parser.add_argument("--parts", nargs="*", default=PARTS)
    parser.add_argument("--again", action="store_true")
    parser.add_argument("--table", type=Path, default=WORK / "changes.csv")
    given = parser.parse_args()
    measured = Measured()
    drawn = draw(ROOT / PACKAGE, given.parts, given.count, given.seed)
    rows = _read(given.table)
    keys = {(change.path, str(change.line), change.after) for change in drawn}
    if given.again:
        rows = [
            row
            for row in rows
            if row["outcome"] == "noticed" or row["wide"] or _key(row) not in keys
        ]
    done = set(map(_key, rows))
    waiting = [c for c in drawn if (c.path, str(c.line), c.after) not in done]
    trees: SimpleQueue[Path] = SimpleQueue()
    for number in range(given.workers):
        trees.put(_copied(WORK / f"tree_{number}"))
    with ThreadPoolExecutor(given.workers) as pool:
        wide = given.again
        judged = pool.map(lambda c: _judge(c, measured.tests(c, wide), trees), waiting)
        for change, (outcome, test) in zip(waiting, judged, strict=True):
            row = {"seed": str(given.seed), "outcome": outcome, "test": test}
            row["wide"] = "wide" * wide
            columns = ("path", "line", "kind", "before", "after")
            rows.append(row | {name: str(getattr(change, name)) for name in columns})
            files.write_text(given.table, pd.DataFrame(rows).to_csv(index=False))
            print(f"{len(rows)}: {outcome} {change.path}:{change.line}", flush=True)
    _print(rows)
    return 0


class Measured:
    """Which tests execute which line of the package, and how long each takes.

    Measured once for each state of the package.
    """

    def __init__(self) -> None:
        command = ["git", "rev-parse", "--short", f"HEAD:{PACKAGE}"]
        code = subprocess.check_output(command, cwd=ROOT, text=True).strip()
        data, times = WORK / code / "coverage", WORK / code / "times.xml"
        if not times.exists():
            times.parent.mkdir(parents=True, exist_ok=True)
            words = [
                *("-n", str(os.cpu_count()), "-m", "not slow", "--dist", "worksteal"),
                *(f"--cov={PACKAGE}", "--cov-context=test", "--cov-report="),
                f"--junitxml={times}",
            ]
            environment = os.environ | {"COVERAGE_FILE": str(data)}
            subprocess.run(
                [sys.executable, "-m", "pytest", *words], cwd=ROOT, env=environment
            )
        self._data = CoverageData(str(data))
        self._data.read()
        self._contexts: dict[str, dict[int, list[str]]] = {}
        self._seconds = {
            _identity(case): float(case.attrib["time"])
            for case in ElementTree.parse(times).iter("testcase")
        }

    def tests(self, change: Change, wide: bool) -> list[str]:
        """Return tests that execute a line, the quickest first, `SECONDS` in all.

        Args:
            change: of the line.
            wide: take those that execute any line of its module.
        """
        path = str(ROOT / PACKAGE / change.path)
        if path not in self._contexts:
            self._contexts[path] = self._data.contexts_by_lineno(path)
        lines = self._contexts[path]
        # what an import executes, as constants are, all tests of the module may notice
        own = lines.get(change.line, [])
        contexts = chain(*lines.values()) if wide or "" in own else own
        names = {context.split("|")[0] for context in contexts if context}
        # what mirrors the folder comes first: these tests are meant for it
        folder = f"tests/{change.path.rsplit('/', 1)[0]}/"
        order = sorted(
            names & self._seconds.keys(),
            key=lambda n: (not n.startswith(folder), self._seconds[n]),
        )
        chosen: list[str] = []
        left = SECONDS
        for name in order:
            if not chosen or self._seconds[name] <= left:
                chosen.append(name)
                left -= self._seconds[name]
        return chosen


def _identity(case: ElementTree.Element) -> str:
    names = case.attrib["classname"].split(".")
    count = len(names)
    while count and not (ROOT / "/".join(names[:count])).with_suffix(".py").exists():
        count -= 1
    path = "/".join(names[:count]) + ".py"
    return "::".join((path, *names[count:], case.attrib["name"]))


def _copied(tree: Path) -> Path:
    shutil.rmtree(tree, ignore_errors=True)
    listed = subprocess.run(
        ["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, check=True, text=True
    )
    for name in listed.stdout.split("\0")[:-1]:
        (tree / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(ROOT / name, tree / name, follow_symlinks=False)
    for name in ("plugins", "scenes"):
        (tree / PACKAGE / name).symlink_to(tree / name)
    return tree


def _judge(
    change: Change, tests: list[str], trees: SimpleQueue[Path]
) -> tuple[str, str]:
    """Return whether a change was noticed, lived or has no test, and the test."""
    if not tests:
        return "no test", ""
    tree = trees.get()
    path = tree / PACKAGE / change.path
    source = path.read_text()
    try:
        path.write_text(change.applied(source))
        return _outcome(tree, tests)
    finally:
        path.write_text(source)
        trees.put(tree)


def _outcome(tree: Path, tests: list[str]) -> tuple[str, str]:
    command = [sys.executable, "-m", "pytest", "-x", "-q", "-p", "no:cacheprovider"]
    environment = os.environ | {"PYTHONPATH": str(tree), "PYTHONDONTWRITEBYTECODE": "1"}
    try:
        result = subprocess.run(
            [*command, "--no-header", "--tb=no", *tests],
            cwd=tree,
            env=environment,
            capture_output=True,
            text=True,
            timeout=LIMIT_S,
        )
    except subprocess.TimeoutExpired:
        return "noticed", "hangs"
    if result.returncode == 0:
        return "lived", f"{len(tests)} tests"
    failed = [
        line.split(" ")[1]
        for line in result.stdout.splitlines()
        if line.startswith(("FAILED ", "ERROR "))
    ]
    return "noticed", failed[0] if failed else f"ends with {result.returncode}"


def _key(row: dict[Any, Any]) -> tuple[str, str, str]:
    return row["path"], row["line"], row["after"]


def _read(table: Path) -> list[dict[Any, Any]]:
    if not table.exists():
        return []
    rows = pd.read_csv(table, dtype=str, na_filter=False).to_dict("records")
    return [{"wide": "", **row} for row in rows]


def _print(rows: list[dict[Any, Any]]) -> None:
    for row in rows:
        if row["outcome"] != "noticed":
            print(f"{row['path']}:{row['line']} {row['outcome']}")
            print(f"    {row['before']}\n    {row['after']}")
    for part in PARTS:
        own = [row for row in rows if row["path"].startswith(part)]
        counts = Counter(row["outcome"] for row in own)
        print(f"{part}: {counts['noticed']} of {len(own)} noticed")


if __name__ == "__main__":
    sys.exit(main())
