"""The figures of a sweep or a transfer in a page of Markdown."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import pandas as pd
from scipy.stats import gmean

from mi_nerfattack.drives.table import MAX_BYTES, read_csv, records, write_csv
from mi_nerfattack.errors import InputError
from mi_nerfattack.evaluation.summary import summary
from mi_nerfattack.experiment.sweep.cell import CELLS
from mi_nerfattack.experiment.sweep.summary import (
    GRADIENT,
    SUMMARY,
    read_attacks,
    summarise,
)
from mi_nerfattack.experiment.sweep.table import (
    MADE_OF,
    RESULTS,
    read_made,
    read_table,
)
from mi_nerfattack.experiment.transfer.columns import ENVIRONMENTS
from mi_nerfattack.experiment.transfer.figures import (
    DOCUMENT,
    TABLE,
    column_figures,
    compare_rows,
    drives_of,
    read_document,
)
from mi_nerfattack.io import files
from mi_nerfattack.report.pages.sections import escaped, markdown_table
from mi_nerfattack.rollout.drive import ATTACK, NO_OBJECT, RANDOM
from mi_nerfattack.scenario.deployment import SURROGATE

#: Lines of a page between which the figures are; what is around them stays.
BEGIN, END = "<!-- figures, by mi-nerfattack report -->", "<!-- end of the figures -->"
#: Table of a transfer's drives, of which its page can be written again.
DRIVES = "drives.csv"
CASES = {
    NO_OBJECT: "without objects",
    RANDOM: "random textures",
    ATTACK: "attack",
}
Figures = Mapping[str, Any]
_SEED = 1  # of intervals


def write_markdown(path: Path, folder: Path, tuning: Path | None = None) -> None:
    """Write the figures of a sweep or a transfer between two marks of a page.

    What is around them stays. The tables of which the figures are made are copied to
    the page, which can be written again of them.

    Args:
        path: of the page; it is made, if it is not there.
        folder: of a sweep, which need not be finished, or of a transfer; or that of a
            page.
        tuning: folder of the sweep by which settings of the methods were chosen.

    Raises:
        InputError: it is of another kind, or the page has no marks.
    """
    before, after = _around(path)
    if (folder / RESULTS).is_file():
        blocks = _of_sweep(folder, path.parent, tuning)
    elif (folder / DOCUMENT).is_file() or (folder / DRIVES).is_file():
        blocks = _of_transfer(folder, path.parent)
    else:
        raise InputError(
            f"{folder}: has neither {RESULTS} of a sweep nor {DOCUMENT} of a transfer, "
            "of which pages of Markdown are made; others are written as .html"
        )
    files.write_text(path, "\n\n".join([before, *blocks, after]))


def _around(path: Path) -> tuple[str, str]:
    """Return what stands before and after the figures, with the marks."""
    text = files.read_text(path) if path.exists() else f"# Figures\n\n{BEGIN}\n{END}\n"
    before, begin, tail = text.partition(BEGIN)
    _, end, after = tail.partition(END)
    if not (begin and end):
        raise InputError(f"{path}: has no lines {BEGIN!r} and {END!r}; write them")
    return before + begin, end + after


def _of_sweep(folder: Path, output: Path, tuning: Path | None) -> list[str]:
    figures, made = summary_of(folder), read_made(folder)
    blocks = list(sections(figures, made))
    copy_table(folder, output)
    if tuning is not None:
        blocks.insert(-1, settings(summary_of(tuning), methods_of(figures)))
        copy_table(tuning, output / "tuning")
    files.write_json(output / SUMMARY, figures)
    return blocks


def _of_transfer(folder: Path, output: Path) -> list[str]:
    table = files.make_folder(output) / DRIVES
    if (folder / DOCUMENT).is_file():
        write_csv(table, drives_of(read_document(folder)))
    elif folder.resolve() != output.resolve():
        files.write_bytes(table, files.read_bytes(folder / DRIVES, MAX_BYTES))
    return list(transfer_sections(read_csv(table, TABLE)))


def summary_of(sweep: Path) -> dict[str, Any]:
    """Return what a sweep, finished or not, or a copy of its table came to."""
    if (sweep / SUMMARY).is_file() and not (sweep / CELLS).is_dir():
        return files.read_json(sweep / SUMMARY)
    table = read_table(sweep / RESULTS)
    return summarise(table, read_attacks(sweep, table))


def copy_table(folder: Path, output: Path) -> None:
    """Copy a sweep's table, unless it is there already."""
    if files.make_folder(output).resolve() != folder.resolve():
        for name in (RESULTS, MADE_OF):
            raw = files.read_bytes(folder / name, MAX_BYTES)
            files.write_bytes(output / name, raw)


def methods_of(summary: Figures) -> list[str]:
    """Return the names of a sweep's methods in their order."""
    return list(dict.fromkeys(group["method"] for group in summary["groups"]))


def sections(summary: Figures, made: Figures) -> Iterator[str]:
    """Yield a table for each environment, the flags, and what made the sweep."""
    compared = len(methods_of(summary)) > 1
    header = ["route", "method", "frames", *CASES.values(), "out of the lane"]
    header += ["attack to random", *["to the gradient"] * compared]
    for environment in dict.fromkeys(g["environment"] for g in summary["groups"]):
        rows = list(_rows(summary, environment, compared))
        yield f"## {environment}\n\n{markdown_table(header, rows)}"
    yield "\n\n".join(_flags(summary))
    yield _provenance(summary, made)


def _flags(summary: Figures) -> Iterator[str]:
    """Yield a heading, how many attacks are complete, and one row per kind of flag."""
    yield "## Flags"
    yield f"{summary['complete']} of {summary['cells']} attacks are complete."
    kinds: dict[str, list[str]] = {}
    for flag in summary["flags"]:
        kind, _, text = flag.partition(": ")
        kinds.setdefault(kind, []).append(text)
    for failed in summary["failed"]:
        kinds.setdefault("failed", []).append(f"{failed['cell']}: {failed['error']}")
    if kinds:
        rows = [
            (kind, *map(escaped, _how_often(texts))) for kind, texts in kinds.items()
        ]
        yield markdown_table(["flag", "how often", "the first one"], rows)


def _how_often(texts: Sequence[str]) -> tuple[str, str]:
    """Return how often a flag is, and what its first one says."""
    counted = re.match(r"in (\d+ of \d+ attacks); (.*)", texts[0])
    return (counted[1], counted[2]) if counted else (str(len(texts)), texts[0])


def _rows(
    summary: Figures, environment: str, compared: bool
) -> Iterator[Sequence[str]]:
    """Yield a row for each method and budget on each route, then on all routes."""
    groups = {
        (group["route"], group["method"], group["budget"], group["case"]): group
        for group in summary["groups"]
        if group["environment"] == environment
    }
    names = "route", "method", "budget", "other_method", "other_case"
    effects = {
        tuple(row[name] for name in names): row
        for row in summary["comparisons"]
        if row["environment"] == environment
    }
    for (route, method, budget, case), attack in groups.items():
        if case != ATTACK:
            continue
        labels = route, method, budget
        others = [(method, RANDOM), *[(GRADIENT, ATTACK)] * compared]
        yield (
            route or "all",
            method,
            f"{attack['frames']:.0f}",
            *(cell(groups.get((*labels, name)), name) for name in CASES),
            out(attack),
            *(ratio(effects.get((*labels, *other))) for other in others),
        )


def cell(figures: Figures | None, case: str = ATTACK) -> str:
    """Return the mean error, and with the attack its interval."""
    if figures is None:
        return ""
    ends = interval(figures["cross_track_mean_ci95_m"]) if case == ATTACK else ""
    return f"{figures['cross_track_mean_m']:.3f}{ends}"


def out(figures: Figures) -> str:
    """Return how many of the attacks put a wheel out of the lane for 1 s."""
    return f"{figures['attacks_out']} of {figures['attacks']}"


def interval(ends: Sequence[float] | None) -> str:
    """Return an interval after a space, or nothing."""
    return "" if ends is None else f" [{ends[0]:.3f}, {ends[1]:.3f}]"


def percent(ends: Sequence[float] | None) -> str:
    """Return the interval of a share in percent after a space, or nothing."""
    return "" if ends is None else f" {[round(100 * end) for end in ends]}"


def ratio(row: Figures | None) -> str:
    """Return the ratio of a comparison with its interval."""
    effect = {"ratio": None} if row is None else row["effect"]
    if effect["ratio"] is None:
        return ""
    return f"{effect['ratio']:.2f}{interval(effect['ratio_ci95'])}"


def settings(tuning: Figures, methods: Sequence[str]) -> str:
    """Return the mean error of each setting by route, the best of a method marked.

    The name of a setting begins with its method's.
    """
    errors: dict[str, dict[str, float]] = {}
    for group in tuning["groups"]:
        labels = group["environment"], group["case"]
        if labels == (SURROGATE, ATTACK) and group["route"] is not None:
            own = errors.setdefault(group["method"], {})
            own[group["route"]] = group["cross_track_mean_m"]
    routes = list(dict.fromkeys(route for own in errors.values() for route in own))
    means = {
        name: float(gmean(list(own.values())))
        for name, own in errors.items()
        if len(own) == len(routes)
    }
    rows = []
    for method in methods:
        own = [name for name in errors if _method_of(name, methods) == method]
        for name in own:
            best = all(means.get(name, 0) >= means.get(n, 9e9) for n in own)
            cells = [*(errors[name].get(r) for r in routes), means.get(name)]
            texts = ("" if value is None else f"{value:.3f}" for value in cells)
            rows.append((method, name, *texts, "chosen" if best else ""))
    header = ("method", "setting", *routes, "geometric mean", "")
    return f"## Settings\n\n{markdown_table(header, rows)}"


def _method_of(setting: str, methods: Sequence[str]) -> str:
    """Return the longest name of a method that the name of a setting begins with."""
    own = [method for method in methods if setting.startswith(f"{method}_")]
    return max(own, key=len, default="")


def _provenance(summary: Figures, made: Figures) -> str:
    """Return versions of programs, and digests of the files that the sweep used."""
    versions, contents = {}, {}
    for record in made.values():
        if record["versions"] is not None:
            line = ", ".join(f"{k} {v}" for k, v in record["versions"].items())
            versions[line] = None
        for key, digest in record["digests"].items():
            if key != "scenario":
                contents.setdefault(digest, key)
    attacks = summary["attacks"]
    done = sum(attack["converged"] for attack in attacks)
    rows = [
        *(("attacked with", text) for text in versions),
        ("converged", f"{done} of {len(attacks)} attacks"),
        *((key, f"SHA-256 {digest}") for digest, key in contents.items()),
    ]
    return f"## What it was made of\n\n{markdown_table(['what', 'which'], rows)}"


def transfer_sections(drives: pd.DataFrame) -> Iterator[str]:
    """Yield a table for each environment, and one of the attacks by day.

    Args:
        drives: with `TABLE`'s columns.
    """
    by = ["attack", "environment", "condition", "case"]
    cells: dict[tuple[str, ...], dict[str, Any]] = {}
    for figures in records(summary(drives, by, ["attack"])):
        identity = {name: figures[name] for name in by[:3]}
        row = cells.setdefault(tuple(identity.values()), identity | {"cases": {}})
        row["cases"][figures["case"]] = figures
    rows = list(cells.values())
    compare_rows(rows)
    columns = column_figures(rows, drives, _SEED)
    header = ["condition", "no object", "attack", "out of the lane", "ratio", "kept"]
    others = {column["environment"] for column in columns} - set(ENVIRONMENTS)
    for environment in (*ENVIRONMENTS, *sorted(others)):
        own = [_column(c) for c in columns if c["environment"] == environment]
        if own:
            yield f"## {environment}\n\n{markdown_table(header, own)}"
    day = {(r["attack"], r["environment"]): r for r in rows if r["condition"] == "day"}
    there = list(dict.fromkeys(name for _, name in day))
    labels = drives["attack"].unique()
    lines = (
        (label, *(_error(day.get((label, name))) for name in there)) for label in labels
    )
    text = "Mean error with each attack by day, metres; bold where it succeeds."
    yield f"## Attacks\n\n{text}\n\n{markdown_table(['attack', *there], lines)}"


def _column(column: Mapping[str, Any]) -> Sequence[str]:
    cases, transfer, transferred = column["cases"], column["transfer"], ""
    if transfer is not None:
        ends = percent(transfer["rate_ci95"])
        transferred = f"{transfer['kept']}/{transfer['of']}{ends}"
    ratio = column["ratio_to_surrogate"]
    return (
        column["condition"],
        cell(cases.get(NO_OBJECT), NO_OBJECT),
        cell(cases.get(ATTACK)),
        out(cases[ATTACK]) if ATTACK in cases else "",
        "" if ratio is None else f"{ratio:.2f}",
        transferred,
    )


def _error(row: Mapping[str, Any] | None) -> str:
    if row is None or ATTACK not in row["cases"]:
        return ""
    error = f"{row['cases'][ATTACK]['cross_track_mean_m']:.3f}"
    return f"**{error}**" if row["succeeds"] else error
