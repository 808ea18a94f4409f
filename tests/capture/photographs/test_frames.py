"""Frames of videos: chosen by motion and sharpness, and videos that cannot be used."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from helpers.corner import corner_photograph, corner_poses
from scipy import ndimage

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


def moved_by(steps: np.ndarray, sharpness: np.ndarray | None = None) -> Motion:
    """Return the motion of tiles that all move by steps (n,), in longer edges."""
    place = np.zeros((len(steps), 16, 2))
    place[..., 1] = np.cumsum(steps)[:, None]
    return Motion(np.ones(len(steps)) if sharpness is None else sharpness, place)


class TestChoice:
    def test_is_spaced_by_the_baseline(self):
        motion = moved_by(np.full(300, 0.01))
        found = np.array(choose_frames(motion, FrameOptions(baseline=0.1)))
        gaps = np.diff(found)
        assert gaps.min() >= 6 and gaps.max() <= 14 and found[-1] > 280

    def test_a_standing_camera_gives_few_and_a_fast_one_many(self):
        steps = np.concatenate([np.zeros(300), np.full(100, 0.02), np.full(100, 0.004)])
        found = np.array(choose_frames(moved_by(steps), FrameOptions(baseline=0.1)))
        still, fast, slow = np.histogram(found, [0, 300, 400, 500])[0]
        assert still == 1 and fast >= 4 * slow > 0

    def test_a_hand_that_shakes_does_not_move(self):
        steps = 0.02 * (-1.0) ** np.arange(200)
        assert len(choose_frames(moved_by(steps), FrameOptions(baseline=0.1))) == 1

    def test_takes_the_sharpest_of_neighbours(self):
        sharpness = np.ones(200)
        sharpness[::5] = 2.0
        motion = moved_by(np.full(200, 0.01), sharpness)
        found = choose_frames(motion, FrameOptions(baseline=0.1))
        assert len(found) > 10 and all(index % 5 == 0 for index in found)

    def test_a_short_walk_gives_some(self):
        motion = moved_by(np.full(100, 0.005))  # five baselines
        assert 18 <= len(choose_frames(motion, FrameOptions(baseline=0.1))) <= 25

    def test_a_quarter_of_the_picture_moves(self):
        motion = moved_by(np.full(300, 0.01))
        motion.place[:, 5:] = 0  # around a thing, its picture stands still
        assert len(choose_frames(motion, FrameOptions(baseline=0.1))) > 20

    def test_has_a_limit(self):
        motion = moved_by(np.full(500, 0.05))
        found = choose_frames(motion, FrameOptions(frames=20, baseline=0.05))
        assert 10 <= len(found) <= 20 and found[-1] > 400

    def test_a_long_film_is_looked_through_a_few_times(self, monkeypatch):
        """The choice is that of a search to the film's end, at a small part of it."""
        rng = np.random.default_rng(4)
        place = rng.normal(0.004, 0.01, (3000, 16, 2)).cumsum(0)
        motion = Motion(rng.uniform(size=len(place)), place)
        looked, percentile = [], np.percentile

        def counted(away: np.ndarray, *rest, **names):
            looked.append(len(away))
            return percentile(away, *rest, **names)

        monkeypatch.setattr(np, "percentile", counted)
        found = choose_frames(motion, FrameOptions(frames=1000, baseline=0.1))
        assert len(found) > 100 and sum(looked) < 8 * len(place)
        wanted, start, near = [], 0, 0.0
        while True:
            away = np.linalg.norm(place[start:] - place[start], axis=2)
            moved = percentile(away, 75, axis=1) / 0.1
            if not (moved > near + 0.8).any():
                break
            end = int(np.argmax(moved > near + 0.8))
            first = int(np.argmax(moved >= near))
            window = motion.sharpness[start + first : start + max(end, first + 1)]
            start += first + int(window.argmax())
            wanted.append(start)
            near = 0.6
        assert found == wanted

    @pytest.mark.parametrize("options", [{"frames": 0}, {"baseline": 0.0}])
    def test_options(self, options):
        with pytest.raises(InputError, match=next(iter(options))):
            FrameOptions(**options)


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
    found = -np.median(motion.place[..., 1], axis=1) * WIDTH
    np.testing.assert_allclose(found, pixels.astype(int), atol=1.5)
    sharp = np.setdiff1d(np.arange(len(pixels)), blurred)
    least = motion.sharpness[sharp].min()
    assert motion.sharpness[list(blurred)].max() < 0.5 * least


def test_sharp_frames_are_written_in_order(tmp_path):
    blurred = tuple(range(1, 80, 2))
    write_pan(tmp_path / "pan.mp4", 3 * np.arange(80), blurred)
    (tmp_path / "frames").mkdir()
    seen = []
    times = extract_frames(
        tmp_path / "pan.mp4",
        tmp_path / "frames",
        progress=lambda *call: seen.append(call),
    )
    names = list(times)
    assert sorted(p.name for p in (tmp_path / "frames").iterdir()) == names
    indices = [int(name[6:12]) for name in names]
    assert len(names) >= 10 and all(index % 2 == 0 for index in indices)
    np.testing.assert_allclose(list(times.values()), np.array(indices) / 30, atol=1e-3)
    shown = files.read_image(tmp_path / "frames" / names[0])
    assert shown.shape == (HEIGHT, WIDTH, 3)
    assert ("motion", 80, 80) in seen and seen[-1] == ("frames", *[len(names)] * 2)


def test_films_that_a_phone_turned_are_shown_upright():
    left = np.zeros((4, 6, 3), np.uint8)
    left[:, :3] = 255

    def to_ndarray(format: str) -> np.ndarray:
        return left

    for angle, bright in ((0, np.s_[:, 0]), (-90, np.s_[0]), (90, np.s_[-1])):
        shown = _upright(SimpleNamespace(rotation=angle, to_ndarray=to_ndarray))
        assert shown[bright].min() == 255 and shown.mean() == 127.5


class TestUnusable:
    def refused(self, path: Path, message: str) -> None:
        with pytest.raises(InputError, match=message):
            extract_frames(path, path.parent)

    def test_standing_camera(self, tmp_path):
        write_pan(tmp_path / "still.mp4", np.zeros(40))
        self.refused(tmp_path / "still.mp4", "40 frames, but .* 1 differ .*--baseline")

    def test_too_short(self, tmp_path):
        write_pan(tmp_path / "short.mp4", np.array([0, 9]))
        self.refused(tmp_path / "short.mp4", "short.mp4: 2 frames; at least 3")

    def test_no_video(self, tmp_path):
        (tmp_path / "text.mp4").write_text("not a film")
        self.refused(tmp_path / "text.mp4", "text.mp4: damaged or truncated")
        self.refused(tmp_path / "none.mp4", "none.mp4: does not exist")


class TestCommand:
    def told(self, capsys, *arguments: str) -> str:
        assert cli.main(["capture", *arguments]) == cli.EXIT_INPUT
        return capsys.readouterr().err

    def test_options_of_another_source(self, tmp_path, capsys):
        out = str(tmp_path / "out")
        told = self.told(capsys, "a.xml", "-o", out, "--long-edge", "800")
        assert "--long-edge: not for a.xml, which is a scene" in told
        told = self.told(capsys, "walk.mp4", "-o", out, "--views", "8")
        assert "--views: not for walk.mp4, which is no scene" in told
        assert "--routes: missing" in self.told(capsys, "a.xml", "-o", out)
        told = self.told(capsys, str(tmp_path), "-o", out, "--frames", "9")
        assert "--frames: not for" in told and "no video" in told
        told = self.told(capsys, "walk.mp4", "-o", out, "--marker-family", "4x4_50")
        assert "--marker-family: needs" in told
        assert not (tmp_path / "out").exists()

    def test_output_is_checked_before_the_film_is_read(self, tmp_path, capsys):
        (tmp_path / "walk.mp4").write_bytes(b"no film")
        (tmp_path / "file").write_text("")
        out = str(tmp_path / "file")
        told = self.told(capsys, str(tmp_path / "walk.mp4"), "-o", out)
        assert "file" in told and "walk.mp4" not in told

    @pytest.mark.parametrize("source", ["scene.xml", "photographs", "walk.mp4"])
    def test_no_folder_is_written_over(self, source, tmp_path, capsys):
        kept = tmp_path / "out/transforms.json"
        kept.parent.mkdir()
        kept.write_text("kept")
        told = self.told(capsys, source, "-o", str(kept.parent))
        assert f"-o: {kept.parent}; is not an empty folder" in told
        assert kept.read_text() == "kept" and len(list(kept.parent.iterdir())) == 1

    @pytest.mark.slow
    def test_a_film_is_placed(self, tmp_path, capsys):
        pytest.importorskip("pycolmap")
        frames = [corner_photograph(pose) for pose in corner_poses(60)]
        write_video(tmp_path / "walk.mp4", frames, 30.0)
        arguments = [str(tmp_path / "walk.mp4"), "-o", str(tmp_path / "out")]
        assert cli.main(["capture", *arguments, "--lens", "SIMPLE_PINHOLE"]) == 0
        table = json.loads((tmp_path / "out/transforms.json").read_text())
        assert len(table["frames"]) >= 6 and table["left_out"] == []
        assert "transforms.json" in capsys.readouterr().out
