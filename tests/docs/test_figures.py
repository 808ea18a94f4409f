"""Measured figures of the pages: each has rows, or is counted, and equals its rows."""

from __future__ import annotations

import json
import math
import re
from pathlib import Path

import pandas as pd
import pytest
from support.pages.measured import page, results

from bench import end_to_end
from bench.attack.drive import SECONDS
from bench.loop.bench import POLICIES, WAYS
from bench.studies.findings import finding
from bench.studies.plan import read_plan
from bench.studies.vary import light
from mi_nerfattack.experiment.sweep.table import read_table
from mi_nerfattack.io import files

ROOT = Path(__file__).parents[2]
FIGURES = files.read_toml(ROOT / "bench/figures.toml")


@pytest.mark.parametrize("page", FIGURES)
def test_the_words_are_on_the_page_and_their_rows_exist(page):
    text = " ".join((ROOT / page).read_text("utf-8").split())
    for words, rows in FIGURES[page].items():
        assert words in text, f"bench/figures.toml: {words!r} is not on {page}"
        assert (ROOT / rows).is_file(), f"bench/figures.toml: {words!r} has no rows"


def test_the_table_of_rendering_equals_its_file():
    text = page("rendering")
    for size, row in results("render")["sizes"].items():
        for name, key in (
            ("forward", "forward"),
            ("backward", "backward"),
            ("both", "forward_and_backward"),
        ):
            ours, peer = (row[f"{p}{key}_samples_per_s"] for p in ("", "torch_"))
            figures = f"{ours / 1e6:.3f} | {peer / 1e6:.3f} | {ours / peer:.1f}"
            assert f"| {size} {name} | {figures} |" in text


def test_the_figures_of_the_country_road_equal_their_files():
    text = " ".join((ROOT / "docs/reference/places.md").read_text("utf-8").split())
    place = ROOT / "bench/country_place"
    card = files.read_json(place / "policy/card.json")
    cases = [one.values() for routes in card.values() for one in routes.values()]
    drives = [case for some in cases for case in some]
    count = sum(case["n"] for case in drives)
    departed = sum(case["drives_departed"] for case in drives)
    mean = sum(case["n"] * case["cross_track_mean_m"] for case in drives) / count
    words = f"in {departed} of {count} drives, and is {mean:.2f} m from the lane centre"
    assert words in text
    routes = files.read_json(place / "field/metrics.json")["routes"].values()
    psnr = sum(route["psnr_mean_db"] for route in routes) / len(routes)
    assert f"along both routes is about {psnr:.0f} dB" in text


def test_the_readme_says_what_the_rows_of_the_country_road_say():
    (study,) = (one for one in read_plan().studies if one.name == "country")
    made = finding(study)
    assert made is not None
    assert "at 16 of 16 places, but never out of its lane" in made.title
    readme = " ".join((ROOT / "README.md").read_text("utf-8").split())
    assert "too, at 16 of 16 places, but never out of its lane" in readme


def test_the_results_of_the_readme_equal_their_rows():
    readme = " ".join((ROOT / "README.md").read_text("utf-8").split())
    rows = read_table(ROOT / "docs/results/table2/results.csv")
    rows = rows[rows["environment"] == "mitsuba"]
    attack = rows[rows["case"] == "attack"]
    assert set(attack[attack["departed"]]["route"]) == {"left"}
    words = "With the attack, {} of {} drives left the lane, all on the left turn."
    assert words.format(attack["departed"].sum(), len(attack)) in readme
    departed = rows[rows["case"].isin(["random", "best_random"])]["departed"]
    assert f"random textures, {departed.sum()} of {len(departed)} did" in readme
    places = rows.groupby(["case", "route", "seed"])["cross_track_mean_m"].mean()
    medians = (f"{places[case].median():.2f} m" for case in ("attack", "best_random"))
    assert f"worst random texture: {' against '.join(medians)}" in readme

    page = (ROOT / "docs/results/findings/transfer.md").read_text("utf-8")
    assert "0.21 to 0.35 (built-in)" in " ".join(page.split())
    assert "[0.21 to 0.35 of the error](docs/results/findings/transfer.md)" in readme
    drives = pd.read_csv(ROOT / "docs/results/matrix/drives.csv")
    lit = drives[drives["environment"].str.endswith("_built_in")]
    lit = lit[(lit["case"] == "attack") & (lit["condition"] == "day")]
    counts = lit.groupby("environment")["departed"].agg(["sum", "size"])
    assert set(counts["size"]) == {24} and counts["sum"].max() == 1
    assert "at most 1 of 24 drives leaves the lane" in readme

    rows = pd.read_csv(ROOT / "bench/retrain/better-retrain.csv")
    rows = rows[(rows["environment"] == "mitsuba") & (rows["case"] == "attack")]
    out = rows.groupby(["group", "policy"])["departed"].agg(["sum", "size"])
    assert out.loc["old", "after"]["sum"] == out.loc["held_out", "after"]["sum"] == 0
    new, old = out.loc["adaptive", "after"], out.loc["old", "before"]
    words = (
        f"took {new['sum']} of {new['size']} drives out of the lane. The old policy "
    )
    assert f"{words}with the old attacks had {old['sum']} such drives" in readme


def test_the_table_of_the_demo_equals_its_rows():
    rows = read_table(ROOT / "bench/demo/results.csv")
    shown = {
        "its original colours": ("surrogate", "own"),
        "random textures": ("surrogate", "random"),
        "the attack": ("surrogate", "attack"),
        "the attack, pasted into path-traced images that the search never saw": (
            "mitsuba",
            "attack",
        ),
    }
    text = (ROOT / "README.md").read_text("utf-8")
    for words, (environment, case) in shown.items():
        own = rows[(rows["environment"] == environment) & (rows["case"] == case)]
        mean, out = own["cross_track_mean_m"].mean(), own["departed"].sum()
        metres = f"{mean:.1f}" if mean > 1 else f"{mean:.2f}"
        assert f"| {words} | {metres} m | {out} of {len(own)} |" in text
    text = (ROOT / "docs/start/first_attack.md").read_text("utf-8")
    means = rows.groupby(["case", "environment"])["cross_track_mean_m"].mean()
    for case, digits in (("own", 2), ("random", 2), ("attack", 1)):
        surrogate, mitsuba = (f"{x:.{digits}f}" for x in means[case][::-1])
        assert f"| `{case}` | {surrogate} m | {mitsuba} m |" in text


@pytest.mark.parametrize("driver", ["expert", "policy"])
def test_the_table_of_simulated_drives_equals_its_files(driver):
    page = (ROOT / "docs/results/car.md").read_text("utf-8")
    drive = json.loads((ROOT / f"docs/results/car/{driver}.json").read_text("utf-8"))
    row = drive["figures"]
    period = (row[f"{x}_s"] for x in ("period_jitter", "longest_period"))
    late = (row[f"latency_{x}_s"] for x in ("median", "99"))
    cells = (
        f"{row['laps']:.2f}",
        f"{row['largest_error_m']:.3f} m",
        f"{row['mean_error_m']:.3f} m",
        f"{1e3 * row['period_s']:.1f}, "
        + "{:.1f}, {:.0f} ms".format(*(1e3 * x for x in period)),
        "{:.0f}, {:.0f} ms".format(*(1e3 * x for x in late)),
    )
    assert f"| {driver} | {' | '.join(cells)} |" in page
    counts = {name: f"{count:,}" for name, count in drive["messages"].items()}
    frames, poses = counts["/camera/image"], counts["/vehicle/pose"]
    assert (
        f"All {frames} frames, {row['commands']:,} commands and {poses} poses" in page
    )


@pytest.mark.parametrize(("name", "pixels"), [("flat", "32"), ("flat_coarse", "8")])
def test_patches_of_two_resolutions_equal_their_rows(name, pixels):
    text = (ROOT / "docs/howto/flat_objects.md").read_text("utf-8")
    words = " ".join(text.split())
    shown = re.findall(r"^\| (\d) \| (\d+) \| ([\d.]+) \| ([\d.]+) \|$", text, re.M)
    own = {int(row[0]): row[2:] for row in shown if row[1] == pixels}
    rows = read_table(ROOT / "bench" / name / "results.csv")
    rows = rows[(rows["route"] == "straight") & (rows["objects"] == "patch")]
    rows = rows[rows["seed"].isin(own)]
    means = rows.groupby(["seed", "environment", "case"])["cross_track_mean_m"].mean()
    assert len(own) >= 2
    for seed, figures in own.items():
        errors = [means[seed, where, "attack"] for where in ("surrogate", "built_in")]
        assert tuple(f"{mean:.3f}" for mean in errors) == figures
    if name == "flat_coarse":
        lit = rows[rows["environment"] == "built_in"]
        left, count = lit[lit["case"] == "attack"]["departed"].agg(["sum", "count"])
        assert f"the scene lights, {left} of {count} drives left the lane" in words
        assert not rows[rows["case"] == "random"]["departed"].any()


def test_what_varied_attacks_keep_equals_their_rows():
    rows = light(pd.read_csv(ROOT / "bench/light_transfer/drives.csv")).rows
    by_day = {row[0]: row for row in rows if row[1] == "day"}
    text = " ".join((ROOT / "docs/howto/robust.md").read_text("utf-8").split())
    for column, words in (
        (
            6,
            "such attacks kept {} of their error when the path-traced scene lit the "
            "objects, and {} with MuJoCo's car there",
        ),
        (
            3,
            "attacks kept {} of their error when the path-traced scene lit the "
            "objects, but only {} with MuJoCo's car there",
        ),
    ):
        cells = (by_day[f"{name}_built_in"][column] for name in ("mitsuba", "mujoco"))
        assert words.format(*cells) in text
    assert len(rows) == 16 and all(float(row[9].split()[0]) <= 1 for row in rows)
    assert "In none of 16 environments and lights is the difference shown" in text


def test_the_table_of_coarse_colours_equals_its_rows():
    text = (ROOT / "docs/howto/robust.md").read_text("utf-8")
    pattern = r"^\| (\w+) \| ([\d and]+) \| ([\d.]+) \| ([\d.]+) \|$"
    shown = re.findall(pattern, text, re.M)
    rows = read_table(ROOT / "bench/resolution/results.csv")
    rows = rows[rows["case"] == "attack"]
    methods = {"64 and 129": "fine", "32": "coarse_32", "16": "coarse_16"}
    assert len(shown) == rows.groupby(["route", "method"]).ngroups == 9
    by = ["route", "method", "environment"]
    means = rows.groupby(by)["cross_track_mean_m"].mean()
    for route, vertices, *figures in shown:
        method = methods[vertices]
        errors = [means[route, method, where] for where in ("surrogate", "built_in")]
        assert [f"{mean:.3f}" for mean in errors] == figures
    shares = means.xs("built_in", level=2) / means.xs("surrogate", level=2)
    ratios = shares.map(math.log).groupby("method").mean().map(math.exp)
    sentence = f"{ratios['fine']:.2f} to {ratios['coarse_16']:.2f} only"
    assert sentence in " ".join(text.split())


def test_the_table_of_fits_equals_its_file():
    text = page("rendering")
    for row in results("fit")["steps"]:
        ours, peer = (row[f"{p}seconds_per_step"] for p in ("", "torch_"))
        figures = f"{1e3 * ours:.0f} | {1e3 * peer:.0f} | {peer / ours:.1f}"
        assert f"| {row['network']}, {row['stage']} | {figures} |" in text


def span(values: list[float], digits: int) -> str:
    """Return the least and the largest value as words; one number if they agree."""
    ends = (f"{value:.{digits}f}" for value in (min(values), max(values)))
    return " to ".join(dict.fromkeys(ends))


def test_the_table_of_attacks_equals_its_file():
    text = page("attack_speed")
    rows = [results("attack")["sizes"][size] for size in ("200x66", "366x188")]

    def table_cells(key: str, to: str, unit: str) -> str:
        pairs = [(row[f"{key}_seconds"], row[f"{to}_seconds"]) for row in rows]
        if unit == "times":
            cells = (f"{1e3 * x:.0f}, {x / y:.1f} times" for x, y in pairs)
        else:
            cells = (f"{1e3 * x:.0f}, {x / y:.2f} drives" for x, y in pairs)
        return " | ".join(cells)

    adjoint, flat = "kept_backgrounds", "the same, objects as one level"
    for name, key, to in (
        (f"iteration, `{adjoint}`", adjoint, "rollout"),
        (flat, "one_level", "rollout"),
        ("iteration, `replay`", "replay", "rollout"),
        (f"iteration in bricks, `{adjoint}`", f"bricks_{adjoint}", "bricks_rollout"),
        (flat, "bricks_one_level", "bricks_rollout"),
    ):
        assert f"| {name} | {table_cells(key, to, 'drives')} |" in text
    assert f"| PyTorch | {table_cells('torch', adjoint, 'times')} |" in text
    drives = [row[f"{adjoint}_seconds"] / row["rollout_seconds"] for row in rows]
    again = [row["replay_seconds"] / row["rollout_seconds"] for row in rows]
    faster = [row["torch_seconds"] / row[f"{adjoint}_seconds"] for row in rows]
    words = " ".join(text.split())
    assert f"as long as {span(drives, 1)} drives" in words
    assert f"{span(faster, 0)} times as fast" in words
    assert f"`replay` needs {span(again, 1)} drives" in words
    slower = [row["torch_seconds"] / row["replay_seconds"] for row in rows]
    main = " ".join(page("bench").split())
    for some in (faster, slower):
        assert f"{span(some, 0)} times as fast" in main
    shares = [row["settings"]["ours"] for row in rows]
    cells = " | ".join(
        f"{100 * x['object_share_mean']:.1f} %, {100 * x['object_share_max']:.1f} %"
        for x in shares
    )
    assert f"| object in the frame, mean and largest | {cells} |" in text
    assert not any(row["kernels_compiled_after_warmup"] for row in rows)
    for name, key in (
        ("a drive alone", "rollout"),
        ("a drive alone, in bricks", "bricks_rollout"),
    ):
        cells = " | ".join(f"{1e3 * row[f'{key}_seconds']:.0f}" for row in rows)
        assert f"| {name} | {cells} |" in text
        ratios = " and ".join(f"{SECONDS / row[f'{key}_seconds']:.1f}" for row in rows)
        assert f"{ratios} times" in words


def test_the_table_of_the_loop_equals_its_file():
    text, document = page("attack_speed"), results("loop")
    seconds = {"plain": [], "rollout": []}
    for row in document["rows"]:
        cells = f"{row['seconds']:.1f} s | {row['cpu_seconds']:.1f} s"
        policy, way = POLICIES[row["policy"]], WAYS[row["way"]]
        memory = f"{row['peak_memory_mb']:.0f} MB"
        assert f"| {way} | {policy} | {cells} | {memory} |" in text
        seconds["plain" if row["way"] == "plain" else "rollout"].append(row["seconds"])
    words = " ".join(text.split())
    for verb, some in (("in", seconds["rollout"]), ("needs", seconds["plain"])):
        assert f"{verb} {span(some, 1)} s" in words
    for kind in ("gradient", "loss"):
        most = f"{document[f'{kind}_difference']:.1e}".replace("e-0", "e-")
        assert f"at most {most}" in words


def test_the_table_of_scaling_equals_its_file():
    text, rows = page("attack_size"), results("scaling")["rows"]
    keys = (
        "iteration_ms",
        "iteration_mb",
        "replay_iteration_ms",
        "replay_iteration_mb",
    )
    for row in rows:
        assert f"| {' | '.join(f'{row[key]:.0f}' for key in keys)} |" in text
    # width, height, vehicles, periods, objects
    horizon = {row["job"][3]: row for row in rows if row["job"][:3] == [200, 66, 1]}
    growth = horizon[400]["replay_iteration_mb"] / horizon[100]["replay_iteration_mb"]
    words = " ".join(text.split())
    assert f"by {100 * (growth - 1):.1f} % from 100 to 400 periods" in words
    assert f"grows by {100 * (growth - 1):.1f} %" in page("bench")


def fit_psnr(name: str) -> float:
    """Return the PSNR (dB) of the held-out views of a fit of the study `fits`."""
    metrics = files.read_json(ROOT / f"bench/fits/{name}.report/metrics.json")
    return metrics["psnr_heldout_db"]


def test_the_table_of_marching_steps_equals_its_rows():
    text, short = page("photographs"), fit_psnr("short")
    for name, step in (("step_4", "250"), ("step_8", "125")):
        assert f"| edge / {step} | {fit_psnr(name):.1f} dB |" in text
    assert f"| edge / 1000, the default | {short:.1f} dB |" in text
    assert f"up to {fit_psnr('step_8') - short:.1f} dB more" in " ".join(text.split())


def test_the_tables_of_fits_equal_their_rows():
    text = page("fields")
    for name, words in (
        ("fox", "of the sample"),
        ("placed", "of `capture`, with its sparse points"),
    ):
        row = files.read_json(ROOT / f"bench/fits/{name}.report/metrics.json")
        views = [view["psnr_db"] for view in row["per_view"] if view["index"] % 8 == 0]
        assert len(views) == 7
        assert f"| {words} | {fit_psnr(name):.1f} dB | {min(views):.1f} dB |" in text
        gave = f"gave {fit_psnr(name):.1f} dB and SSIM {row['ssim_heldout']:.2f}"
        assert gave in " ".join(text.split())
    for name, mesh in (("duck", "Duck"), ("truck", "CesiumMilkTruck")):
        row = files.read_json(ROOT / f"bench/fits/{name}.report/metrics.json")
        (line,) = (x for x in text.splitlines() if x.startswith(f"| `{mesh}.glb`"))
        assert line.endswith(f"| {fit_psnr(name):.1f} dB | {row['wall_s']:.0f} s |")


def test_the_table_of_whole_commands_equals_its_rows():
    text = page("bench")
    rows = pd.read_csv(ROOT / "bench/end_to_end/end_to_end.csv")
    assert set(rows["command"]) == set(end_to_end.COMMANDS)
    assert end_to_end.table(rows) in text
    turns = {2: "two", 3: "three"}[rows["round"].nunique()]
    assert f"medians of {turns} turns" in " ".join(text.split())


def test_the_memory_of_six_objects_equals_its_row():
    row = files.read_json(ROOT / "bench/six_objects/run/metrics.json")
    words = f"took {row['cost']['peak_memory_mb'] / 1e3:.1f} GB at most, over"
    length = f"{row['scenario']['drive']['length_m']:g} m of the route"
    assert f"{words} {length}" in " ".join(page("attack_size").split())


def test_the_tables_of_a_gpu_equal_their_file():
    text, steps = page("gpu"), results("nvidia-h200-gpu")["steps"]
    frames = steps["frames"]["result"]
    attack = steps["attack"]["result"]["200x66"]
    render = steps["render"]["result"]["sizes"]["366x188"]
    for row in frames["batches"]:
        figures = f"{row['frames_per_s']:,.0f} | {row['drjit_peak_memory_mb']:,.0f}"
        assert f"| {row['frames']} | {figures} |" in text
    assert f"| {frames['latency_ms']:.1f} ms |" in text
    assert f"| {attack['rollout_ms']:.0f} ms |" in text
    drives = f"{attack['iteration_over_rollout']:.1f} drives"
    peer = f"{attack['torch_tuned_iteration_ms']:.0f} ms"
    assert f"| {attack['iteration_ms']:.0f} ms, {drives} | {peer} |" in text
    for key in ("frame_ms", "backward_ms"):
        ours, peer = render[key], render[f"torch_tuned_{key}"]
        assert f"| {ours:.1f} ms | {peer:.1f} ms |" in text


def test_the_rows_of_reach_equal_their_file():
    text = page("reach")
    table = pd.read_csv(ROOT / "bench/reach/reach.csv")
    shown = [row for row in table.itertuples() if f"| {row.place} |" in text]
    assert len(shown) >= 3
    for row in shown:
        pixels = f"{row.pixels:.0f} | {row.most_pixels}"
        reach = f"{row.moved:.2f} | {row.most_moved:.2f}"
        errors = f"{row.original_m:.2f} | {row.up_m:.2f} | {row.down_m:.2f}"
        cells = f"{row.place} | {row.in_view} of {row.frames} | {pixels} | {reach}"
        assert f"| {cells} | {errors} |" in text
