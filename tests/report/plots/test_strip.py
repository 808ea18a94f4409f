"""The strip of first-person frames shows exactly the pixels that it was given."""

from __future__ import annotations

import numpy as np

from mi_nerfattack.io import files
from mi_nerfattack.report.plots import strip
from mi_nerfattack.rollout.drive import Drive
from mi_nerfattack.vehicle.route.route import Route


def test_strip_doubles_frames_exactly(tmp_path):
    rng = np.random.default_rng(3)
    frames = [rng.integers(0, 256, (66, 200, 3), dtype=np.uint8) for _ in range(2)]
    path = tmp_path / "strip.png"
    strip.first_person_strip(
        path, {"a": frames, "longer\nlabel": frames[:1]}, ["0 m", "7.5 m"]
    )
    image = files.read_image(path)
    doubled = np.kron(frames[1], np.ones((2, 2, 1), dtype=np.uint8))
    left = image.shape[1] - strip.GAP_PX - 400
    top = strip.FONT_PX + 2 * strip.GAP_PX
    np.testing.assert_array_equal(image[top : top + 132, left : left + 400], doubled)
    below = image[top + 138 : top + 270, left : left + 400]
    assert (below == 225).all()
    # Nothing is written outside the label column, the header and the frames.
    assert (image[top:, left - strip.GAP_PX : left] == 255).all()


def drive_at(x, y=0.0):
    """Return a drive through positions (n,) along x."""
    states = np.stack([x, np.full(len(x), y), np.zeros(len(x))], axis=1)
    nothing, times = np.zeros(len(x) - 1), np.arange(1.0, len(x))
    return Drive("surrogate", "line", "own", 0, 0, states, nothing, nothing, times)


def test_rows_show_the_same_places():
    """One drives at half the speed, from 2 m farther on, and one ends early."""
    line = Route("line", 0, np.array([[0.0, 0.0], [60.0, 0.0]]))
    fast, slow = drive_at(1.0 * np.arange(42)), drive_at(2 + 0.5 * np.arange(78), 1.0)
    ended = drive_at(1.0 * np.arange(22))
    places, steps = strip.aligned_steps(line, [fast, slow, ended], 5)
    np.testing.assert_allclose(places, [0, 10, 20, 30, 40])
    assert steps == [[0, 10, 20, 30, 40], [0, 16, 36, 56, 76], [0, 10, 20]]


def test_laps_are_places_of_their_own():
    corners = np.array([[0.0, 0.0], [10.0, 0.0], [10.0, 10.0], [0.0, 10.0]])
    square = Route("square", 0, corners, closed=True)
    states, times = square.pose_at(np.arange(62.0)), np.arange(1.0, 62)
    nothing = np.zeros(61)
    lap = Drive("a", "square", "own", 0, 0, states, nothing, nothing, times)
    places, (steps,) = strip.aligned_steps(square, [lap], 4)
    np.testing.assert_allclose(places, [0, 20, 40, 60])
    assert steps == [0, 20, 40, 60]


def test_tiles_stand_row_by_row_under_their_titles():
    colours = {"one": 10, "two": 90, "three": 170}
    images = {n: np.full((5, 100, 3), v, np.uint8) for n, v in colours.items()}
    sheet = strip.tiles(images)
    scale = strip.TILE_PX // 100
    assert scale == 4 and sheet.shape[1] == 2 * (400 + strip.GAP_PX) + strip.GAP_PX
    found = [int(v) for v in sheet[:, strip.GAP_PX + 399, 0] if v in colours.values()]
    assert found == [10] * 20 + [170] * 20
    right = sheet[:, 2 * strip.GAP_PX + 400 :, 0]
    assert (right == 90).sum() >= 20 * 400
    large = strip.tiles({"one": np.zeros((5, 900, 3), np.uint8)}, 1)
    assert large.shape[1] == 900 + 2 * strip.GAP_PX
