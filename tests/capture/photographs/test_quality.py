"""Which photographs a report tells to take again."""

from __future__ import annotations

import json

import numpy as np
import pytest
from scipy import ndimage

from mi_nerfattack.capture.colmap.reconstruct import Structure
from mi_nerfattack.capture.photographs.quality import (
    assess,
    median_gap,
    quality_table,
    retake,
)
from mi_nerfattack.io import files
from mi_nerfattack.render.camera.intrinsics import from_fov, look_at
from mi_nerfattack.report.plots.fit import write_cameras_above

CAMERA = from_fov(120, 90, 60.0)
COUNT, BLURRED, LOST, BARE, ALONE = 12, 4, 7, 9, 11


@pytest.fixture
def taken(tmp_path):
    """Twelve photographs: one blurred, one that was not placed, one of few features."""
    rng = np.random.default_rng(1)
    names = [f"{i:02d}.png" for i in range(COUNT)]
    for i, name in enumerate(names):
        grey = rng.integers(0, 256, (90, 120)).astype(float)
        grey = ndimage.gaussian_filter(grey, 3.0) if i == BLURRED else grey
        image = np.repeat(grey.astype(np.uint8)[..., None], 3, axis=2)
        files.write_image(tmp_path / name, image)
    placed = [i for i in range(COUNT) if i != LOST]
    angles = [i / 12 + 0.6 * (i == ALONE) for i in placed]
    poses = [look_at([np.cos(a), np.sin(a), 1.0], [0, 0, 0]) for a in angles]
    found = Structure(
        tuple(names[i] for i in placed),
        np.stack(poses),
        (CAMERA,) * len(placed),
        rng.normal(size=(50, 3)),
        0.6,
        tuple(40 if i == BARE else 900 for i in placed),
        tuple(0.1 * i for i in placed),
        {name: 120 if i == BARE else 2000 for i, name in enumerate(names)},
    )
    return tmp_path, names, found


def test_what_to_take_again(taken):
    folder, names, found = taken
    qualities = assess(folder, names, found)
    again = retake(qualities)
    assert list(again) == [names[i] for i in (BLURRED, LOST, BARE, ALONE)]
    assert again[names[BLURRED]].startswith("blurred (0.0")
    assert again[names[LOST]] == "not placed"
    assert again[names[BARE]] == "few features (120), few points (40)"
    assert again[names[ALONE]].startswith("alone, ")
    assert qualities[ALONE].gap_deg == max(q.gap_deg or 0 for q in qualities)
    assert qualities[LOST].gap_deg is None
    assert qualities[3].error_px == pytest.approx(0.3)
    assert qualities[LOST].error_px is None and qualities[LOST].features == 2000


def test_table_and_picture(taken):
    folder, names, found = taken
    qualities = assess(folder, names, found)
    table = quality_table(found, qualities, {"metres_per_unit": None})
    files.write_json(folder / "capture.json", table)
    read = json.loads((folder / "capture.json").read_text())
    assert (read["photographs"], read["placed"]) == (COUNT, COUNT - 1)
    assert read["placed_share"] == pytest.approx((COUNT - 1) / COUNT)
    assert (
        read["frames"][BARE]["points"] == 40
        and len(read["retake"]) == 4
        and read["gap_deg"] == median_gap(qualities)
    )
    write_cameras_above(folder / "all.png", found, set())
    write_cameras_above(folder / "flagged.png", found, {names[0]})
    pictures = [files.read_image(folder / f"{n}.png") for n in ("all", "flagged")]
    assert pictures[0].shape == pictures[1].shape
    assert (pictures[0] != pictures[1]).any()
