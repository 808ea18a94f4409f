"""Frames of videos: chosen by motion and sharpness, and videos that cannot be used."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from scipy import ndimage
from support.faults.refusals import refusals
from support.worlds.views import corner_photograph, corner_poses

from mi_nerfattack import cli
from mi_nerfattack.capture.photographs.frames import (
    FrameOptions,
    Motion,
    _upright,
    choose_frames,
    extract_frames,
    measure_motion,
)
from mi_nerfattack.errors import InputError
from mi_nerfattack.io import files
from mi_nerfattack.io.video import write_video

WIDTH, HEIGHT = 192, 128


class TestChoice:
    def test_has_a_limit(self):
        place = np.full((500, 16, 2), 0.05).cumsum(0) * [0, 1]
        motion = Motion(np.ones(500), place)
        indices = choose_frames(motion, FrameOptions(frames=20, baseline=0.05))
        assert 10 <= len(indices) <= 20 and indices[-1] > 400

    def test_a_long_film_is_looked_through_a_few_times(self, monkeypatch):
        """The choice is that of a search to the film's end, at a small part of it."""
        rng = np.random.default_rng(4)
        place = rng.normal(0.004, 0.01, (3000, 16, 2)).cumsum(0)
        motion = Motion(rng.uniform(size=len(place)), place)
        looked, percentile = [], np.percentile

        def counted(away: np.ndarray, *arguments, **names):
            looked.append(len(away))
            return percentile(away, *arguments, **names)

        monkeypatch.setattr(np, "percentile", counted)
        indices = choose_frames(motion, FrameOptions(frames=1000, baseline=0.1))
        assert len(indices) > 100 and sum(looked) < 8 * len(place)
        start, near = 0, 0.0
        for chosen in [*indices, None]:
            away = np.linalg.norm(place[start:] - place[start], axis=2)
            moved = percentile(away, 75, axis=1) / 0.1
            if chosen is None:
                assert not (moved > near + 0.8).any()
                break
            end = int(np.argmax(moved > near + 0.8))
            first = int(np.argmax(moved >= near))
            window = motion.sharpness[start + first : start + max(end, first + 1)]
            start += first + int(window.argmax())
            assert chosen == start
            near = 0.6


def write_pan(path: Path, pixels: np.ndarray, blurred: tuple[int, ...] = ()) -> None:
    """Film a picture that moves to the left, to a place (pixels) in each frame."""
    rng = np.random.default_rng(2)
    width = WIDTH + int(np.max(pixels)) + 1
    texture = ndimage.gaussian_filter(rng.normal(size=(HEIGHT, width)), 1.5)
    grey = np.clip(128 + 55 * texture / texture.std(), 0, 255)
    frames = []
    for i, left in enumerate(np.asarray(pixels).astype(int)):
        frame = grey[:, left : left + WIDTH]
        frame = ndimage.gaussian_filter(frame, 3.0) if i in blurred else frame
        frames.append(np.repeat(frame.astype(np.uint8)[..., None], 3, axis=2))
    write_video(path, frames, 30.0)


def test_motion_and_blur_of_a_film(tmp_path):
    pixels = np.concatenate([np.zeros(10), 0.5 * np.arange(50)])
    blurred = (5, 30, 31)
    write_pan(tmp_path / "pan.mp4", pixels, blurred)
    path = tmp_path / "pan.mp4"
    motion = measure_motion(path, path.read_bytes())
    shift_px = -np.median(motion.place[..., 1], axis=1) * WIDTH
    np.testing.assert_allclose(shift_px, pixels.astype(int), atol=1.5)
    sharp = np.setdiff1d(np.arange(len(pixels)), blurred)
    least = motion.sharpness[sharp].min()
    assert motion.sharpness[list(blurred)].max() < 0.5 * least


def test_sharp_frames_are_written_in_order(tmp_path):
    film, folder, calls = tmp_path / "pan.mp4", tmp_path / "frames", []
    write_pan(film, 3 * np.arange(80), blurred=tuple(range(1, 80, 2)))
    folder.mkdir()
    times = extract_frames(film, folder, progress=lambda *call: calls.append(call))
    names = list(times)
    assert sorted(path.name for path in folder.iterdir()) == names
    indices = [int(name[6:12]) for name in names]
    assert len(names) >= 10 and all(index % 2 == 0 for index in indices)
    np.testing.assert_allclose(list(times.values()), np.array(indices) / 30, atol=1e-3)
    assert files.read_image(folder / names[0]).shape == (HEIGHT, WIDTH, 3)
    assert ("motion", 80, 80) in calls and calls[-1] == ("frames", *[len(names)] * 2)


def test_films_that_a_phone_turned_are_shown_upright():
    left = np.zeros((4, 6, 3), np.uint8)
    left[:, :3] = 255
    for angle, bright in ((0, np.s_[:, 0]), (-90, np.s_[0]), (90, np.s_[-1])):
        frame = SimpleNamespace(rotation=angle, to_ndarray=lambda format: left)
        shown = _upright(Path("film.mp4"), frame)
        assert shown[bright].min() == 255 and shown.mean() == 127.5


@pytest.mark.parametrize(
    ("places", "remedy"), [(np.zeros(40), "--baseline"), (np.array([0, 9]), "at least")]
)
def test_unusable_films(tmp_path, places, remedy):
    path = tmp_path / "a.mp4"
    write_pan(path, places)
    with pytest.raises(InputError, match=rf"{path}: {len(places)} frames.*{remedy}"):
        extract_frames(path, tmp_path)


test_refused = refusals(
    (lambda: FrameOptions(frames=0), "frames: 0"),
    (lambda: FrameOptions(baseline=0.0), "baseline: 0.0"),
)


def test_the_output_is_checked_before_the_source_is_read(tmp_path, capsys):
    (tmp_path / "walk.mp4").write_bytes(b"no film")
    (tmp_path / "file").write_text("")
    (tmp_path / "full").mkdir()
    (tmp_path / "full/kept").write_text("kept")
    film = f"video {tmp_path}/walk.mp4"
    for words, out, where in (
        (film, "file", f"{tmp_path}/file"),
        (f"{film} --masks {tmp_path}", "out", "masks"),
        (film, "full", f"-o: {tmp_path}/full"),
        ("photographs a", "full", f"-o: {tmp_path}/full"),
        ("scene a --routes-file b", "full", "full"),
    ):
        words = ["capture", *words.split(), "-o", f"{tmp_path}/{out}"]
        assert cli.main(words) == cli.EXIT_INPUT
        error = capsys.readouterr().err
        assert where in error and "damaged" not in error
    assert (tmp_path / "full/kept").read_text() == "kept"
    assert len(list(tmp_path.rglob("*"))) == 4


@pytest.mark.slow
def test_a_film_is_placed(tmp_path):
    pytest.importorskip("pycolmap")
    frames = [corner_photograph(pose) for pose in corner_poses(60)]
    write_video(tmp_path / "walk.mp4", frames, 30.0)
    words = ["capture", "video", str(tmp_path / "walk.mp4"), "-o", str(tmp_path / "a")]
    assert cli.main([*words, "--lens", "SIMPLE_PINHOLE"]) == 0
    table = files.read_json(tmp_path / "a/transforms.json")
    assert len(table["frames"]) >= 6 and table["left_out"] == []
