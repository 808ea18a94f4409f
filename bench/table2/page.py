"""Table 2 of the paper beside a sweep's figures: a page in Markdown."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Sequence

from bench.table2.rows import (
    COLUMNS,
    FLOOR,
    METHOD_HEADER,
    NAMES,
    PAPER,
    STEPS,
    TITLES,
    Figures,
    Table,
    against_rows,
    aim_rows,
    cell,
    detail_rows,
    make_table,
    method_rows,
    own_rows,
    paper_rows,
)
from mi_nerfattack.experiment.retrain.compare import AFTER, BEFORE
from mi_nerfattack.rollout.drive import ATTACK, NO_OBJECT

_INTRODUCTION = """\
# Table 2 of the paper, on the bundled intersection

Three cars and three hydrants at natural size, attacked at once on three routes. Places,
seeds and budget are those of [`scenes/table2.toml`](../../scenes/table2.toml), settled
before the first result. Beside this page lie `results.parquet`, a row a drive, and
`summary.json`, of which the page is made ([what they hold](../sweep.md#the-table)).

Figures are mean distances from the lane's centre, metres: mean ± standard deviation
over attacks [95 % interval, BCa] (attacks); then how many of them have a wheel out of
the lane for 1 s, in the mean over their drives [95 % interval, Wilson, per cent]. An
attack is a seed with a place of its own."""
_UNIT = f"""\
The paper sums the distance over {STEPS} steps of 0.01 s, from a line 2 m beside the
lane's centre: a drive along the centre has {FLOOR:,} metre-steps, one that strays away
from the line more, one that strays towards it less. In brackets: (total - {FLOOR:,}) /
{STEPS}, its mean deviation to one side, metres. Ours are distances to whichever side:
{FLOOR:,} + {STEPS} x mean is what that count would come to if all of it led away from
the line, the most that it could be; in brackets the mean. Scenes, policies and control
periods differ: compare within a row, not between the rows."""
_RETRAIN = (
    "mi-nerfattack retrain FOLDER/cells/* -o retrained.safetensors --data DATA "
    "--more FRAMES  # which: docs/retrain.md"
)
_WHY = (
    "Why some of it is missed: [what the policy does](../bench.md#why-aims-are-missed)."
)
_REPLAY = "mi-nerfattack reproduce docs/table2 --rows 10  # any row comes back"
_BUDGETS = """\
The same places and unseen starts, [budgets](../../scenes/budgets.toml) of four times as
much: `gradient` as above, 24 iterations from one start; 96 from one; 24 from four each.
The ratio is that of the mean error to the first's, paired."""
_AGAINST = [
    *("environment", "route", "ratio", "difference (m)", "spread over seeds (m)"),
    *("random out", "gradient out", "p (McNemar)"),
]
_DETAILS = [
    *("environment", "route", "case", "attacks", "drives", "mean (m)", "± sd"),
    *("95 % interval", "own metre-steps", "drives departed", "attacks out"),
]


def page(
    summary: Figures,
    rows: Sequence[Figures],
    retrained: Table,
    made: Figures,
    budgets: Figures | None = None,
) -> str:
    """Return the page.

    Args:
        summary: ``summary.json`` of the sweep of ``scenes/table2.toml``.
        rows: of its table.
        retrained: of `rows.read_retrained`; may be empty.
        made: date, machine and command, as of `bench.results.stamp`.
        budgets: ``summary.json`` of ``scenes/budgets.toml``.

    Raises:
        InputError: the sweep has no such attacks, or several budgets.
    """
    table, cases = make_table(summary, retrained), list(COLUMNS.values())
    parts = [_INTRODUCTION, flags(summary)]
    for environment, title in TITLES.items():
        own = own_rows(table, environment)
        parts.append(section(title, "", ["route", *cases], own))
    theirs = paper_rows(table)
    against = against_rows(summary["comparisons"])
    aims = list(aim_rows(summary, rows, table, retrained))
    why = _WHY if any("not met" in aim[-1] for aim in aims) else ""
    parts += [
        section("In the paper's unit", _UNIT, ["route", "", *cases], theirs),
        section("Against random textures", "", _AGAINST, against),
        section("What was aimed at", why, ["aim", "found", ""], aims),
    ]
    if budgets is not None:
        parts += list(_budgets(budgets))
    if retrained:
        parts.append(_retraining(retrained))
    parts.append(section("All figures", "", _DETAILS, detail_rows(table)))
    commands = ["mi-nerfattack sweep scenes/table2.toml -o FOLDER"]
    if budgets is not None:
        commands.append("mi-nerfattack sweep scenes/budgets.toml -o BUDGETS")
    commands += [_RETRAIN] if retrained else []
    commands += [made["command"], _REPLAY]
    parts.append(provenance(commands, summary["attacks"], rows, made))
    return "\n\n".join(parts) + "\n"


def section(
    title: str, text: str, header: Sequence[str], rows: Iterable[Sequence[str]]
) -> str:
    """Return a section of a page: title, text and table."""
    lines = [header, ["---"] * len(header), *rows]
    table = "\n".join(f"| {' | '.join(cells)} |" for cells in lines)
    return "\n\n".join(filter(None, (f"## {title}", text, table)))


def flags(summary: Figures, total: int | None = None) -> str:
    """Return the section that tells a sweep's flags and failed cells.

    Args:
        summary: ``summary.json``.
        total: cells of the grid, where the table may have fewer.
    """
    told = [f"- **{flag}".replace(": ", ":** ", 1) for flag in summary["flags"]]
    told += [f"- **failed:** {r['cell']}: {r['error']}" for r in summary["failed"]]
    total = summary["cells"] if total is None else total
    cells = f"{summary['complete']} of {total} attacks are complete."
    if not told:
        return f"## Flags\n\n{cells} No flag was raised."
    return "\n".join([f"## Flags\n\n{cells}\n", *told])


def _budgets(summary: Figures) -> Iterator[str]:
    methods = dict.fromkeys(group["method"] for group in summary["groups"])
    text = (
        f"{_BUDGETS} {summary['complete']} of {summary['cells']} attacks are complete."
    )
    for environment in TITLES:
        rows = method_rows(summary, environment, list(methods))
        title = f"With more budget: {environment}"
        yield section(title, text, METHOD_HEADER, rows)
        text = ""


def _retraining(retrained: Table) -> str:
    clean, attacked = (
        [f"{stage} {case}" for stage in (BEFORE, AFTER)] for case in (NO_OBJECT, ATTACK)
    )
    stages = clean + attacked
    rows = (
        (
            *(name, route or "all"),
            *(
                f"{retrained[route, name, case]['cross_track_mean_m']:.3f}"
                for case in clean
            ),
            *(cell(retrained[route, name, case]) for case in attacked),
        )
        for name in NAMES.values()
        for route in (*PAPER, None)
        if (route, name, stages[0]) in retrained
    )
    text = (
        "Drives of both policies from the same starts, which no run has seen. Those "
        "without\nobjects are the same for all attacks of a route: the mean alone.\n"
        "How it was retrained, how a first retraining missed the aim, and what became "
        "of attacks\nheld out: [retraining](../retrain.md#what-it-came-to)."
    )
    header = ["environment", "route", *(stage.replace("_", " ") for stage in stages)]
    return section("Before and after retraining", text, header, rows)


def provenance(
    commands: Sequence[str],
    attacks: Sequence[Figures],
    rows: Iterable[Figures],
    made: Figures,
) -> str:
    """Return the section that tells how a page was made.

    Args:
        commands: in their order.
        attacks: of the ``summary.json``.
        rows: of the table.
        made: date, machine and command, as of `bench.results.stamp`.
    """
    versions, contents = {}, {}
    for row in rows:
        if row["versions"] is not None:
            versions[row["versions"]] = None
        for key, digest in json.loads(row["digests"]).items():
            if key != "scenario":
                contents[digest] = contents.get(digest, key)
    done = sum(attack["converged"] for attack in attacks)
    told = [", ".join(f"{k} {v}" for k, v in json.loads(v).items()) for v in versions]
    machine = ", ".join(f"{key}: {value}" for key, value in made["machine"].items())
    lines = [
        "## How it was made\n",
        "```",
        *commands,
        "```\n",
        f"- page written on {made['date']}; {machine}",
        *(f"- attacked with: {text}" for text in told),
        f"- {done} of {len(attacks)} attacks converged",
        *(f"- {key}: SHA-256 {digest}" for digest, key in contents.items()),
    ]
    return "\n".join(lines)
