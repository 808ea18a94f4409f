"""The findings: their pages, and what is computed from the rows."""

from __future__ import annotations

import math

import numpy as np
import pandas as pd
import pytest
from matplotlib.figure import Figure
from support.pages.studies import drives, table

from bench.studies.attack import is_farther, is_majority
from bench.studies.charts import draw_heat, draw_ratios
from bench.studies.findings import FINDINGS, finding
from bench.studies.fit_quality import fit_quality
from bench.studies.pages import FOLDER, page_text, with_answer
from bench.studies.plan import ROOT, read_plan, state

STUDIES = read_plan().studies
PAGES = {s.finding: s for s in STUDIES if s.finding and s.read() is not None}


@pytest.mark.parametrize("name", PAGES)
def test_a_page_is_what_its_table_gives(name):
    study = PAGES[name]
    made, picture = finding(study), f"../../pictures/finding_{name}.png"
    assert made is not None
    text = page_text(study, made, state(study, compare=False), picture)
    page = (FOLDER / f"{name}.md").read_text("utf-8")
    assert page == text, "run python -m bench results --pages"
    assert 0 < (ROOT / f"docs/pictures/finding_{name}.png").stat().st_size < 100_000
    assert len(made.sentences) == 3 and len(made.pandas.splitlines()) == 2


@pytest.mark.parametrize("name", PAGES)
def test_the_index_has_the_answer_beside_the_question(name):
    made = finding(PAGES[name])
    assert made is not None
    index = (FOLDER / "index.md").read_text("utf-8")
    assert with_answer(index, f"{name}.md", made.title) == index
    assert f"]({name}.md) {made.title}." in " ".join(index.split())


def test_only_findings_with_rows_have_a_page():
    assert {path.stem for path in FOLDER.glob("*.md")} == {*PAGES, "index"}


@pytest.mark.parametrize("name", PAGES)
def test_the_lines_of_pandas_run(name, capsys, monkeypatch):
    monkeypatch.chdir(ROOT)
    page = (FOLDER / f"{name}.md").read_text("utf-8")
    exec(page.partition("```python\n")[2].removesuffix("```\n"), {})
    assert len(capsys.readouterr().out.splitlines()) > 2


def made(name: str, rows: pd.DataFrame):
    return FINDINGS[name][1](rows)


def test_a_side_is_farther_if_wilsons_interval_lies_above_one_half():
    """All of 6 places: low end 6 / (6 + 1.96²) = 0.61; 5 of 6: 0.44; of 4: unknown."""
    for errors, expected in (
        ([0.2] * 6, (6, True)),
        ([0.2] * 5 + [0.05], (5, False)),
        ([0.2] * 4, (4, False)),
    ):
        other = drives(table({"attack": [0.1] * len(errors)}))
        assert is_farther(drives(table({"attack": errors})), other) == expected


def test_equal_sides_are_seldom_farther_by_chance():
    """By the binomial distribution, as the page of findings says: 4 % at most."""
    for places in range(5, 41):
        majorities = [k for k in range(places + 1) if is_majority(k, places)]
        ways = sum(math.comb(places, k) for k in majorities)
        assert 0 < ways / 2**places < 0.04


def test_the_attack_is_compared_with_the_worst_random_texture():
    cases = ("no_object", "random", "best_random", "attack")
    errors = {case: [0.1 + 0.1 * k] * 6 for k, case in enumerate(cases)}
    rows = drives(table(errors), table(errors).assign(environment="mitsuba"))
    answer = made("attack", rows)
    assert answer.title.endswith("at 6 of 6 places")
    assert "0.400 m" in answer.sentences[0] and "ratio 1.3" in answer.sentences[0]
    rows.loc[rows["case"] == "attack", "cross_track_mean_m"] = 0.25
    assert "not shown" in made("attack", rows).title


def test_the_gradient_is_compared_with_each_search():
    rows = drives(
        table({"attack": [0.4] * 6}),
        table({"attack": [0.2] * 6}, method="random"),
        table({"attack": [0.5] * 6}, method="blocks"),
        table({"attack": [0.1] * 6}, method="single_frame"),
    )
    cheap = rows["method"] == "single_frame"
    rows.loc[cheap, "frames"] = 7  # of 9
    answer = made("gradient", rows)
    assert "farther than 1 of 2 searches without a gradient" in answer.title
    assert "0 of 0 other searches" in answer.sentences[0]
    assert "`single_frame`" in answer.threats[0]
    assert len(answer.threats) == 1 + 6  # places where `blocks` is better
    assert [row[4] for row in answer.rows] == ["–", "2.00", "0.80", "4.00"]
    assert [row[7] for row in answer.rows] == ["–", "0.20 m", "-0.10 m", "0.30 m"]
    assert "`blocks`" in answer.sentences[1] and "0 to 6 of 6" in answer.sentences[2]


def test_transfer_counts_places_not_attacks():
    """The ratios of all places are almost equal, so their intervals are points."""
    rows = [
        {"attack": f"left-{name}-{seed}-0", "environment": where, "condition": "day"}
        | {"route": "left", "case": case, "cross_track_mean_m": error * (1 + seed)}
        | {"departed": where == "kept"}
        for where, factor in (("surrogate", 1.0), ("kept", 0.8), ("lost", 0.2))
        for seed in range(6)
        for name, change in (("one", 2), ("two", 0.5))
        for case, error in (
            ("attack", factor * (change + seed / 1e4 if factor < 1 else 1)),
            ("no_object", 0.1),
        )
    ]
    answer = made("transfer", pd.DataFrame(rows))
    assert answer.title.endswith("keep 0.20 to 0.80 (pasted) of their error")
    assert "6 places with 12 attacks" in answer.sentences[0]
    assert "in 1 of 2 environments, below one half in 1," in answer.sentences[1]
    assert "In `lost`, it is 0.25." in answer.sentences[2]
    assert "0 of 12 drives leave the lane there" in answer.threats[1]
    assert len(answer.threats) == 2
    assert answer.rows == [
        ["kept", "0.80", "0.80 to 0.80", "0.10", "1.00", "12 of 12"],
        ["lost", "0.20", "0.20 to 0.20", "0.10", "0.25", "0 of 12"],
    ]

    # without one of six places, which lost all, the others would count
    table = pd.DataFrame(rows)
    lost = table["attack"].str.endswith("-4-0") & (table["environment"] == "kept")
    table.loc[lost, "cross_track_mean_m"] = 1e-9
    answer = made("transfer", table)
    assert "in 0 of 2 environments" in answer.sentences[1]
    (threat,) = answer.threats[2:]
    assert "without left 4, the 95 % interval lies above one half in 1 of 2" in threat
    five = table[~table["attack"].str.contains("-5-")]  # four have no interval
    assert not made("transfer", five).threats[2:]


def light_rows(methods, where):
    """Return drives at five places: an environment's share of the surrogate's error."""
    return pd.DataFrame(
        {"attack": f"left-cars-{method}-{seed}-0", "route": "left", "case": case}
        | {"environment": environment, "condition": condition}
        | {"cross_track_mean_m": error * size * share * (1 + seed / 1e3 * (size > 1))}
        | {"departed": share > 0.8 and seed > 2}
        for method, size in methods.items()
        for (environment, condition), share in where.items()
        for seed in range(5)
        for case, error in (("attack", 0.1 + seed), ("no_object", (0.1 + seed) / 4))
    )


def test_light_counts_aims_and_where_varying_helps():
    where = {("surrogate", "day"): 1.0, ("mitsuba", "day"): 0.88}
    where |= {("mujoco_built_in", "day"): 0.72, ("mitsuba", "evening"): 0.59}
    rows = light_rows({"plain": 1.0, "vary": 2.0}, where)
    answer = made("light", rows)
    assert "keep 0.59 to 0.88 of their error" in answer.title
    assert answer.title.endswith("it helps in 3")
    assert "It lies below 1 in 0, and" in answer.sentences[2]
    assert "`plain` reaches the aim in 1 rows." in answer.sentences[1]
    assert "in 1 rows with `vary` and in 1 with" in answer.sentences[1]
    assert (
        "`vary` moves the car farther in `surrogate` day (5 of 5" in answer.threats[3]
    )
    assert "5 attacks with `vary` and 5 attacks with `plain`" in answer.sentences[0]
    missed = "misses it in `mitsuba` day, `mitsuba` evening."
    assert missed in answer.sentences[1] and "in 1 of 3 rows" in answer.sentences[1]
    by_place = {tuple(row[:2]): row[2:] for row in answer.rows}
    # aim, what `vary` keeps, floor, what `plain` keeps, both compared
    assert {x: [*row[:2], *row[3:5], row[6]] for x, row in by_place.items()} == {
        ("mitsuba", "day"): ["0.90", "0.88", "0.22", "0.88", "2.00"],
        ("mujoco_built_in", "day"): ["0.70", "0.72", "0.18", "0.72", "2.00"],
        ("mitsuba", "evening"): ["0.60", "0.59", "0.15", "0.59", "2.00"],
    }
    for _, share, *others in by_place.values():
        expected = f"{share} to {share}", f"{share} to {float(share) + 0.01:.2f}"
        assert others[0] in expected
        assert others[3] in (*expected, "–")  # where rounding alone differs
    assert {row[-1] for row in answer.rows} == {"2.00 to 2.01"}
    threat = answer.threats[-1]
    assert "leaves the lane at 2 places" in threat and "at all 2 of them" in threat
    assert "The attacks at the other 3 places keep 0.72 there" in threat
    alone = made("light", rows[rows["attack"].str.contains("vary")])
    assert alone.title.endswith("it helps in 0")
    assert "0 attacks with `plain`" in alone.sentences[0]
    assert {cell for row in alone.rows for cell in row[-4:]} == {"–"}


def test_the_second_place_has_the_rule_of_the_first():
    cases = ("no_object", "random", "best_random", "attack")
    errors = {case: [0.1 + 0.1 * k] * 6 for k, case in enumerate(cases)}
    rows = drives(table(errors), table(errors).assign(environment="mitsuba"))
    road = "On a country road, the attack moves the car farther at 6 of 6 places, "
    assert made("country", rows).title == f"{road}but never out of its lane"
    rows.loc[rows["case"] == "attack", "departed"] = True
    left = made("country", rows)
    assert left.title == f"{road}and out of its lane in 6 of 6 drives"
    assert "at 6 of 6 places (share: 95 % interval 0.61" in left.sentences[1]


def test_the_parts_of_varying_are_compared_with_nothing():
    sizes = {"none": 1.0, "light": 0.5, "camera": 2.0, "vehicle": 1.0, "all": 2.5}
    rows = pd.DataFrame(
        {"attack": f"{route}-cars-{method}-101-0", "route": route, "case": "attack"}
        | {"environment": environment, "condition": "day"}
        | {"cross_track_mean_m": size * share * error}
        for method, size in sizes.items()
        for route, error in (("left", 0.1), ("right", 0.4))
        for environment, share in (("surrogate", 1.0), ("mitsuba", 0.5))
    )
    answer = made("parts", rows)
    assert answer.title.startswith("2 places") and "`camera`" in answer.title
    assert answer.title.endswith("ratio, 2.00")
    factors = ["0.50", "2.00", "1.00", "2.50"]
    assert answer.head[3] == "light (ratio)" and len(answer.head) == 7
    assert answer.rows == [
        ["surrogate", "day", "0.200", *factors],
        ["mitsuba", "day", "0.100", *factors],
    ]
    assert "by 0.50 (`light`)" in answer.sentences[0]
    assert "2 (`camera`), 0 (`vehicle`)" in answer.sentences[1]
    # at one place, the camera's attack is three times as far as in the other rows
    far = rows["attack"].str.startswith("right-cars-camera")
    rows.loc[far, "cross_track_mean_m"] *= 3
    factors = "by a factor of 12.0, and on the other routes by at most 5.0. Without"
    sentence = made("parts", rows).sentences[2]
    assert "On `right`" in sentence and factors in sentence
    assert sentence.endswith(
        "2.00 (`camera`), 1.00 (`vehicle`) and 2.50 (`all parts`)."
    )


def test_a_field_is_too_poor_if_the_interval_of_its_ratio_lies_below_one():
    psnr = {"steps_300": 20.0, "steps_3000": 28.0, "steps_12000": 30.0}
    places, spread = np.linspace(0.2, 0.4, 6), np.geomspace(0.9, 1 / 0.9, 6)
    shares = {"steps_300": spread / 2, "steps_3000": spread, "steps_12000": 1.0}
    sides = [
        table({"attack": list(share * places * scale), "own": [0.1] * 6}, **labels)
        for method, share in shares.items()
        for environment, scale in (("surrogate", 2.0), ("mitsuba", 1.0))
        for labels in [{"method": method, "environment": environment}]
    ]
    rows = drives(*(side.assign(cell="one") for side in sides))
    rows["environment"] = np.repeat(["surrogate", "mitsuba"] * 3, 12)
    answer = fit_quality(rows, psnr)
    assert (
        "1 of 2 poorer fields" in answer.title and "0.50 times at 20.0" in answer.title
    )
    assert "This holds for `steps_300`." in answer.sentences[2]
    assert answer.rows[0][:3] == ["`steps_300`", "20.0", "0.100"]
    assert answer.rows[0][5:8] == ["0.50", "0.50 to 0.50", "0.50"]
    assert answer.rows[2][-3:] == ["1", "–", "0 of 6"]
    assert len(answer.threats) == 2
    few = fit_quality(rows[rows["seed"].isin(rows["seed"].unique()[:2])], psnr)
    assert "lies below 1. None has one yet." in few.sentences[2]
    left = (rows["method"] == "steps_300") & (rows["environment"] == "mitsuba")
    rows.loc[left & (rows["seed"] == rows["seed"].max()), "departed"] = True
    threat, *_ = fit_quality(rows, psnr).threats
    assert "(`steps_300`)" in threat and "not from `steps_12000`" in threat
    failed = (rows["case"] == "own") & (rows["method"] == "steps_300")
    rows["departed"] = rows["departed"].to_numpy() | failed.to_numpy()
    assert (
        "In the field of `steps_300`, the policy" in fit_quality(rows, psnr).threats[0]
    )
    better = psnr | {"steps_300": 29.0}
    assert "1.00 times" in fit_quality(rows, better).title
    level = rows[rows["method"] != "steps_300"]
    assert fit_quality(level, psnr).title.startswith("Not shown that a poorer field")


def retrained(departed: bool) -> pd.DataFrame:
    """Return drives with attacks at five places, before and after a retraining.

    Args:
        departed: whether adaptive attacks make the new policy leave its lane.
    """
    after = {"old": 0.25, "held_out": 0.5, "adaptive": 0.75}
    return pd.DataFrame(
        {"group": group, "policy": policy, "environment": environment}
        | {"attack": f"left-cars-gradient-{seed}-{policy * (group == 'adaptive')}"}
        | {"route": "left", "case": case, "condition": "day"}
        | {"cross_track_mean_m": (1 + seed) * (error if policy == "after" else 1.0)}
        | {"departed": policy == "before" or (departed and group == "adaptive")}
        for group, share in after.items()
        for policy in ("before", "after")
        for environment in ("surrogate", "mitsuba")
        for seed in range(5)
        for case, error in (("attack", share), ("no_object", 1.1))
    )


def test_a_policy_is_repaired_where_no_drive_leaves_the_lane():
    answer = made("repaired", retrained(departed=True))
    words = "in its lane near old and held-out attacks, not near adaptive ones"
    assert answer.title.endswith(words)
    left = "0 of 10 (old), 0 of 10 (held-out), 10 of 10 (adaptive)."
    assert answer.sentences[0].endswith(left)
    _, errors, aims = answer.sentences
    assert "For old attacks, it is 0.25" in errors
    assert "For adaptive attacks, it is 0.75" in errors
    assert "below 1 at 5 of 5 places" in errors
    assert "it has 0.25, and reaches the aim. " in aims
    assert "it has 1.10, and reaches the aim. " in aims
    assert answer.rows[5] == [
        *("adaptive (5)", "`mitsuba`", "3.000", "2.250", "0.75", "0.75 to 0.75"),
        *("5/5", "5/5"),
    ]
    old, held_out, adaptive, _, routes = answer.threats
    assert "leaves the lane at 5 of 5 places with the old policy" in old
    assert "With the new one, it does so at 0 places (share: 95 %" in held_out
    assert "With the new one, it does so at 5 places" in adaptive
    assert routes.endswith("new attacks on the new one: left 5 and 5.")
    some = retrained(departed=True).query("group != 'adaptive'")
    assert made("repaired", some).title.endswith("near old and held-out attacks")
    good = made("repaired", retrained(departed=False))
    assert good.title.endswith("near old, held-out and adaptive attacks")


def test_limits_counts_places_beyond_the_lane():
    rows = [
        {
            "place": f"{route}-{kind}-{seed}",
            "pixels": 10,
            "moved": 0.1003 * number - 0.0004,
        }
        | {"original_m": 0.1, "up_m": up, "down_m": 0.2, "limit_m": 0.85}
        | {"in_view": 20}
        for number, (route, kind, up) in enumerate(
            [("left", "patch", 0.9), ("left", "billboard", 0.8)], 1
        )
        for seed in (1, 2)
    ]
    answer = made("limits", pd.DataFrame(rows))
    assert answer.title.endswith(
        "a billboard would take the car out of its lane at 0 of 2 places"
    )
    assert [row[:3] for row in answer.rows] == [
        ["a billboard", "`left`", "0 of 2"],
        ["a patch", "`left`", "2 of 2"],
    ]
    assert "With a patch, 2 of 2 places count." in answer.sentences[1]
    assert "medians of 0.20 to 0.20 rad/s" in answer.sentences[2]
    assert "where the reach is over 0.201 rad/s" in answer.sentences[2]
    assert "where the reach is under 0.099 rad/s" in answer.sentences[2]
    alone = made("limits", pd.DataFrame(rows[2:]))
    assert "nan" not in " ".join(alone.sentences)

    answer.draw(figure := Figure())
    billboards, patches = figure.axes[0].lines
    assert list(billboards.get_xdata()) == pytest.approx([0.2002] * 2)
    assert (billboards.get_fillstyle(), patches.get_fillstyle()) == ("none", "full")


def test_charts_draw_ratios_intervals_and_heat():
    draw_ratios(figure := Figure(), {"a": (2.0, [1.5, 3.0]), "b": (0.5, None)})
    lines = [line.get_xdata() for line in figure.axes[0].lines]
    assert [list(x) for x in lines[:4]] == [[1.5, 3.0], [2.0], [0.5, 0.5], [0.5]]
    heat = pd.DataFrame([[1.0, np.nan]], ["surrogate"], ["day", "noon"])
    draw_heat(figure := Figure(), heat)
    (image,) = figure.axes[0].images
    assert image.get_array().filled(-1).tolist() == [[1.0, -1.0]]
    assert [text.get_text() for text in figure.axes[0].texts] == ["1.0"]
