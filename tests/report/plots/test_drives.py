"""Plots of drives hold what they show."""

from __future__ import annotations

import numpy as np
from helpers.made_drives import RUN_ENVIRONMENTS, make_drive

from mi_nerfattack.io import files
from mi_nerfattack.report.plots import drives as plots


def plot_drives():
    drives = []
    for environment in RUN_ENVIRONMENTS:
        drives.append(make_drive(np.full(40, 0.02), environment, "own"))
        for run in range(3):
            drives.append(
                make_drive(np.full(30 + run, 0.1 * run), environment, run=run)
            )
        drives.append(make_drive(np.linspace(0, 1.5, 40), environment, "attack"))
    return drives


def count(image, colour, tolerance=12):
    distance = np.abs(image[..., :3].astype(int) - np.array(colour)).max(axis=-1)
    return int((distance <= tolerance).sum())


BLUE, RED, YELLOW = (0x00, 0x72, 0xB2), (0xD5, 0x5E, 0x00), (0xF0, 0xC0, 0x00)
SQUARE = np.array([[9, -3], [10, -3], [10, -2], [9, -2]])
ROUTE = np.array([[0.0, 0.0], [10.0, 0.0], [30.0, 0.0]])


def test_overhead_shows_drives_and_object(tmp_path):
    path = tmp_path / "overhead.png"
    plots.overhead(path, plot_drives(), ROUTE, 3.5, [SQUARE], 0.85)
    image = files.read_image(path)
    assert image.shape[1] == plots.WIDTH_PX
    assert count(image, BLUE) > 1500
    assert count(image, RED) > 1500
    assert count(image, YELLOW) > 500
    # The blue lines are 20 m long, 2.2 points wide and level: equal axes make the
    # square of one metre as wide as it is high, and the scales agree.
    upper = image[: image.shape[0] // 2]
    rows, columns = np.nonzero(
        np.abs(upper[..., :3].astype(int) - YELLOW).max(axis=-1) <= 12
    )
    assert abs(np.ptp(rows) - np.ptp(columns)) <= 2
    rows, columns = np.nonzero(
        np.abs(upper[..., :3].astype(int) - BLUE).max(axis=-1) <= 12
    )
    side = np.ptp(columns) / 20
    assert np.ptp(rows) < 8
    assert 20 < side < 60


def test_overhead_has_a_panel_for_an_environment_of_your_own(tmp_path):
    drives = [make_drive([0.1, 0.2], name, "own") for name in ("a", "b")]
    plots.overhead(tmp_path / "one.png", drives[:1], ROUTE, 3.5, [], 0.85)
    plots.overhead(tmp_path / "two.png", drives, ROUTE, 3.5, [], 0.85)
    one, two = (files.read_image(tmp_path / f"{name}.png") for name in ("one", "two"))
    assert count(two, BLUE) > 0 < count(one, BLUE)
    assert one.shape != two.shape


def test_errors(tmp_path):
    plots.errors(tmp_path / "errors.png", plot_drives(), 0.85)
    image = files.read_image(tmp_path / "errors.png")
    assert image.shape[1] == plots.WIDTH_PX
    assert min(count(image, BLUE), count(image, RED)) > 500
