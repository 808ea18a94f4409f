"""Change the code and run its tests: ``python -m mutants.run`` with `tests` as a path.

One run of all tests says by coverage which of them execute which line, and how long
each takes. Every change is then made in a copy of the tree, and tests of its line run
there, the quickest first, until one fails or `SECONDS` are over. The table gets a row
as a change is judged. What has a row is not done again. With ``--again``, changes of
the table that no test noticed are made in the code of today and judged by tests of all
lines of their module: coverage counts what is cached for one test alone. The column
`reason` says, written by hand, why a change may live.
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
from mutants.changes import Change, changes, draw

from mi_nerfattack.io import files

ROOT = Path(__file__).parents[2]
WORK = ROOT / "build" / "mutants"
PACKAGE = "mi_nerfattack"
FOLDERS = "rollout render evaluation drives attack car/drive/safety car/vesc".split()
#: Of tests of one change, as they were measured, and of one run beside others.
SECONDS, LIMIT_S = 60.0, 600.0
#: A change and its row of the table.
_Judged = tuple[Change, dict[Any, Any]]


def main() -> int:
    """Measure once, judge the drawn changes, and print those that no test noticed."""
    parser = argparse.ArgumentParser(prog="mutants")
    parser.add_argument("--count", type=int, default=400)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--workers", type=int, default=os.cpu_count())
    parser.add_argument("--parts", nargs="*", default=FOLDERS)
    parser.add_argument("--again", action="store_true")
    parser.add_argument("--tests", nargs="*", help="judge by these, without measuring")
    parser.add_argument("--table", type=Path, default=WORK / "changes.csv")
    arguments = parser.parse_args()
    rows = _read(arguments.table)
    code = _hash("")
    if arguments.again:
        waiting = _again(rows, None if arguments.tests else code)
    else:
        drawn = draw(ROOT / PACKAGE, arguments.parts, arguments.count, arguments.seed)
        done = {(*_key(row), row["line"]) for row in rows}
        waiting = [
            (change, {"seed": str(arguments.seed)})
            for change in drawn
            if (*_key(vars(change)), str(change.line)) not in done
        ]
    measured = None if arguments.tests else Measured()
    trees: SimpleQueue[Path] = SimpleQueue()
    for number in range(arguments.workers):
        trees.put(_copied(WORK / f"tree_{number}"))

    def judged(change: Change) -> tuple[str, str]:
        tests = measured.tests(change, arguments.again) if measured else arguments.tests
        return _judge(change, tests, trees)

    with ThreadPoolExecutor(arguments.workers) as pool:
        outcomes = pool.map(judged, [change for change, _ in waiting])
        for (change, row), (outcome, test) in zip(waiting, outcomes, strict=True):
            if not arguments.again:
                rows.append(row)
            columns = ("path", "line", "kind", "before", "after")
            row |= {"outcome": outcome, "test": test, "code": code}
            row["reason"] = row.get("reason", "") * (outcome != "noticed")
            row |= {name: str(getattr(change, name)) for name in columns}
            files.write_text(arguments.table, pd.DataFrame(rows).to_csv(index=False))
            print(f"{outcome} {change.path}:{change.line}", flush=True)
    _print(rows)
    return 0


def _again(rows: list[dict[Any, Any]], code: str | None) -> list[_Judged]:
    """Find in the code of today the changes of a table that no test noticed.

    Args:
        rows: of the table.
        code: whose rows need not be judged again, if any.
    """
    waiting: list[_Judged] = []
    for row in rows:
        path = ROOT / PACKAGE / row["path"]
        if row["outcome"] == "noticed" or row["code"] == code or not path.exists():
            continue
        same = [c for c in changes(row["path"], path.read_text()) if _same(c, row)]
        if same:
            line = int(row["line"])
            waiting.append((min(same, key=lambda c: abs(c.line - line)), row))
    return waiting


def _same(change: Change, row: dict[Any, Any]) -> bool:
    return _key(vars(change)) == _key(row)


def _hash(folder: str) -> str:
    command = ["git", "rev-parse", "--short", f"HEAD:{folder}"]
    return subprocess.check_output(command, cwd=ROOT, text=True).strip()


class Measured:
    """Which tests execute which line of the package, and how long each takes.

    Measured once for each state of the package and its tests.
    """

    def __init__(self) -> None:
        measured = WORK / f"{_hash(PACKAGE)}_{_hash('tests')}"
        data, times = measured / "coverage", measured / "times.xml"
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


def _key(row: dict[Any, Any]) -> tuple[str, str, str, str]:
    return row["path"], row["kind"], row["before"], row["after"]


def _read(table: Path) -> list[dict[Any, Any]]:
    if not table.exists():
        return []
    rows = pd.read_csv(table, dtype=str, na_filter=False).to_dict("records")
    return [{"code": "", "reason": "", **row} for row in rows]


def _print(rows: list[dict[Any, Any]]) -> None:
    for row in rows:
        if row["outcome"] != "noticed":
            print(f"{row['path']}:{row['line']} {row['outcome']} {row['reason']}")
            print(f"    {row['before']}\n    {row['after']}")
    for folder in FOLDERS:
        own = [row for row in rows if row["path"].startswith(folder)]
        counts = Counter(row["outcome"] for row in own)
        print(f"{folder}: {counts['noticed']} of {len(own)} noticed")


if __name__ == "__main__":
    sys.exit(main())
