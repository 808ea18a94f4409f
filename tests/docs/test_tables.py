"""Tables of single measurements on pages equal the files of their rows."""

from __future__ import annotations

import json
import re
from pathlib import Path

from support.pages.measured import page, results

ROOT = Path(__file__).parents[2]
BENCH = ROOT / "bench"


def read(name: str) -> dict:
    return json.loads((BENCH / name).read_text("utf-8"))


def test_steps_and_composites_equal_their_file():
    text, rows = page("accuracy"), results("accuracy")
    for view, row in rows["steps"].items():
        cells = (
            f"{row[f'psnr_db_{n}']:.1f} dB, {1e3 * row[f'cpu_seconds_{n}']:.0f} ms"
            for n in (1, 2, 4, 8)
        )
        assert f"| {view} | {' | '.join(cells)} |" in text
    gains = [row["psnr_db_2"] - row["psnr_db_1"] for row in rows["steps"].values()]
    costs = [
        row["cpu_seconds_2"] / row["cpu_seconds_1"] for row in rows["steps"].values()
    ]
    assert f"{min(gains):.0f} to {max(gains):.0f} dB nearer" in text
    assert f"{min(costs):.1f} to {max(costs):.1f} times as long" in text
    feet = {
        "0.8": "0.8 m above the road",
        "0.1": "0.1 m above",
        "0": "on the road",
        "-0.1": "0.1 m below",
        "-0.75": "0.75 m below: half in the road",
        "-1.2": "1.2 m below",
    }
    assert rows["composite"].keys() == feet.keys() and len(rows["steps"]) == 4
    for foot, row in rows["composite"].items():
        mean, largest = row["mean_255"], row["largest_255"]
        share = f"{100 * row['pixels_above_1']:.1f} %"
        cells = f"{mean:.2g} | {largest:.1f} | {share}"
        assert f"| {feet[foot]} | {cells} |" in text
    half = rows["composite"]["-0.75"]["mean_255"]
    assert f"differs by {half:.1f} of 255 on average" in text


def test_objects_as_one_level_equal_their_file():
    text, rows = page("accuracy"), results("accuracy")["one_level"]
    assert len(rows) == 3
    for name, row in rows.items():
        own, views = row["psnr_db"], row["psnr_db_of_views"]
        assert f"| `{name}` | {own:.1f} dB | {views:.1f} dB |" in text


def test_splats_equal_their_file():
    text, ratios = page("rendering"), []
    sizes = results("splats")["sizes"]
    assert sizes.keys() == {"200x66", "366x188"}
    for size, row in sizes.items():
        for task, words in (("frame", "frame"), ("gradient", "frame and gradient")):
            ours, peer = (
                row[f"{side}_{task}"] for side in ("ours", "volprim_rf_basic")
            )
            cells = f"{ours:.3f} | {peer:.3f} | {peer / ours:.1f}"
            assert f"| {size} | {words} | {cells} |" in text
        ratios.append(row["frame_ratio"])
    assert f"{min(ratios):.1f} to {max(ratios):.1f} times as fast" in page("bench")


def test_the_bundled_field_equals_its_file():
    text, routes = page("fields"), read("fields/compare/metrics.json")["routes"]
    assert routes.keys() == {"straight", "right", "left"}
    for route, row in routes.items():
        psnr = f"{row['psnr_mean_db']:.1f} / {row['psnr_min_db']:.1f} dB"
        ssim = f"{row['ssim_mean']:.2f} / {row['ssim_min']:.2f}"
        metres = f"{row['depth_median_m']:.2f} / {row['depth_p90_m']:.2f} m"
        shares = (row[f"depth_{key}_relative"] for key in ("median", "p90"))
        relative = "({:.1f} / {:.1f} %)".format(*(100 * share for share in shares))
        wrong, holes = (f"{100 * row[k]:.2f} %" for k in ("wrong_opacity", "holes"))
        pictures = f"{row['frames']} | {psnr} | {ssim}"
        depths = f"{metres} {relative} | {wrong} | {holes}"
        assert f"| {route} | {pictures} | {depths} |" in text


def test_bricks_equal_their_file():
    text = " ".join(page("fields").split())
    row = read("fields/bricks.report/metrics.json")
    assert f"have {row['vertices_mb']:.0f} MB" in text
    assert f"in {len(row['per_view'])} views" in text
    assert f"is {row['psnr_db']:.1f} dB on average" in text
    assert f"{row['psnr_least_db']:.1f} dB at worst" in text
    assert f"the SSIM is {row['ssim']:.3f}" in text
    assert f"differ by {100 * row['depth_m']:.1f} cm" in text


def test_photographs_placed_again_equal_their_file():
    text, row = page("photographs"), read("photographs/poses/figures.json")
    assert f"| placed | {row['placed']} |" in text
    turns = row["rotation_deg"], row["rotation_most_deg"]
    shares = row["position_share"], row["position_most_share"]
    assert "median and most | {:.2f} and {:.2f} degrees |".format(*turns) in text
    percents = (100 * share for share in shares)
    assert "median and most | {:.2f} and {:.2f} % |".format(*percents) in text
    assert f"| focal length, most | {100 * row['focal_most_share']:.2f} % |" in text
    assert f"| reprojection error | {row['reprojection_error_px']:.2f} px |" in text


def test_fewer_photographs_equal_their_file():
    text, rows = page("photographs"), read("photographs/gaps/figures.json")["rows"]
    assert len(rows) == 4
    for row in rows:
        own = f"{row['fitted']} | {row['psnr_fitted_db']:.1f} dB"
        others = f"{row['gap_deg']:.1f} degrees | {row['psnr_db']:.1f} dB"
        assert f"| {own} | {others} |" in text


def test_a_policy_of_minutes_equals_its_file():
    text, card = page("training"), read("training/card.json")
    drives = []
    for route in ("straight", "right", "left"):
        cases = [
            card[where][route][case]
            for where in ("surrogate", "mitsuba")
            for case in ("no_object", "random")
        ]
        drives += cases
        cells = " | ".join(f"{case['cross_track_mean_m']:.3f}" for case in cases)
        assert f"| {route} | {cells} |" in text
    count = sum(case["n"] for case in drives)
    assert not any(case["drives_departed"] for case in drives)
    assert f"None of {count} drives left its lane" in " ".join(text.split())
    largest = max(case["cross_track_max_m"] for case in drives)
    assert f"distance was {largest:.2f} m" in " ".join(text.split())


def test_rows_made_again_equal_their_file():
    row = read("quick/check.json")
    cells = f"{row['rows']} of {row['of']} | {row['largest_m']:g} m"
    assert f"| `quick` | {cells} |" in page("pages")
    assert f"{row['rows']} of the {row['of']} rows" in page("pages")


def test_what_a_variation_costs_equals_its_file():
    text, rows = page("attack_speed"), results("vary")["parts"]
    assert len(rows) == 8
    for part, row in rows.items():
        (line,) = re.findall(rf"^\| {part} \| .*$", text, re.M)
        cells = f"{row['iteration_cpu_s']:.2f} | {row['ratio']:.2f}"
        assert line.endswith(f" | {cells} |")
