"""Poses from photographs: an analytic scene, a real one, and what cannot be used."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from textwrap import indent
from typing import Any

import numpy as np
import pytest
from PIL import ExifTags, Image
from support.faults.refusals import refusals
from support.worlds.views import CAMERA, aligned, corner_photograph, corner_poses

from mi_nerfattack import cli
from mi_nerfattack.capture.colmap.follow import Stages
from mi_nerfattack.capture.colmap.process import MARK
from mi_nerfattack.capture.photographs.estimate import PoseOptions, estimate_poses
from mi_nerfattack.capture.photographs.staging import (
    list_photographs,
    stage,
)
from mi_nerfattack.capture.transforms import read_images
from mi_nerfattack.errors import InputError, SetupError
from mi_nerfattack.io import files
from mi_nerfattack.render.camera.intrinsics import Camera, from_fov, look_at

pytestmark = pytest.mark.usefixtures("variant")

COUNT = 8
LEFT_HALF = np.zeros((180, 240), np.uint8)
LEFT_HALF[:, 120:] = 255


@pytest.fixture(scope="module")
def corner(tmp_path_factory):
    """A folder of photographs of the corner, and the poses found for them."""
    pytest.importorskip("pycolmap")
    root = tmp_path_factory.mktemp("corner")
    for name in ("photographs", "masks"):
        (root / name).mkdir()
    for i, pose in enumerate(corner_poses()):
        files.write_image(root / f"photographs/{i}.png", corner_photograph(pose))
    files.write_image(root / "masks/0.png.png", LEFT_HALF)
    flat = np.full((180, 240, 3), 90, np.uint8)
    files.write_image(root / "photographs/flat.png", flat)
    scale = {"metres_per_unit": 2.0, "masks": root / "masks"}
    options = PoseOptions(lens="SIMPLE_PINHOLE", **scale)
    return root, estimate_poses(root / "photographs", root / "out", options)


class TestCorner:
    def test_cameras_and_points_are_where_they_were(self, corner):
        root, result = corner
        assert result.left_out == ("flat.png",) and len(result.placed) == COUNT
        poses, posed = corner_poses(), read_images(root / "out")
        true_eyes, eyes = poses[:, :3, 3], posed.camera_to_world[:, :3, 3]
        aligned_eyes, turn = aligned(eyes, true_eyes)
        np.testing.assert_allclose(aligned_eyes, true_eyes, atol=0.05)
        assert result.error_px < 1
        assert result.cameras[0].fx == pytest.approx(CAMERA.fx, rel=0.05)
        # z points up, and the cameras are around the origin
        mean_up = -poses[:, :3, 1].mean(0)
        expected = mean_up[2] / np.linalg.norm(mean_up)
        assert turn[2, 2] == pytest.approx(expected, abs=5e-3)
        np.testing.assert_allclose(eyes.mean(0), 0, atol=1e-9)
        # the similarity of the cameras carries the points to the corner's planes
        centre = true_eyes.mean(0)
        scale = np.linalg.norm(aligned_eyes - centre) / np.linalg.norm(eyes)
        world = scale * posed.points @ turn.T + centre
        assert np.median(np.abs(world - [3.0, 3.0, 0.0]).min(1)) < 0.03

    def test_a_mask_takes_features_away_and_is_written(self, corner):
        root, result = corner
        features = result.structure.features
        assert 0 < features["0.png"] < 0.75 * features["1.png"]
        masks = read_images(root / "out").masks
        np.testing.assert_array_equal(masks[0], LEFT_HALF > 0)
        assert masks[1:].all()

    def test_what_the_files_say(self, corner):
        root, result = corner
        table = files.read_json(root / "out/transforms.json")
        assert read_images(root / "out").unit == table["units"] == "metre"
        assert table["left_out"] == ["flat.png"]
        copied = sorted(path.name for path in (root / "out/images").iterdir())
        assert copied == list(result.placed)
        raw = (root / "photographs/0.png").read_bytes()
        assert (root / "out/images/0.png").read_bytes() == raw
        report = files.read_json(root / "out/capture.json")
        assert (report["placed"], report["photographs"]) == (COUNT, COUNT + 1)
        assert report["scale"]["metres_per_unit"] == 2.0
        assert list(report["retake"]) == ["flat.png"]
        *placed, flat = report["frames"]
        assert flat["features"] < 10 and flat["points"] == 0
        for frame in placed:
            assert 20 < frame["points"] < frame["features"]
            assert 0 < frame["error_px"] < 1

    def test_command(self, corner, tmp_path, capsys):
        words = ["capture", "photographs", str(corner[0] / "photographs"), "--json"]
        words += ["--matching", "sequential", "--lens", "SIMPLE_PINHOLE"]
        assert cli.main([*words, "-o", str(tmp_path)]) == 0
        printed = json.loads(capsys.readouterr().out)
        written = files.read_json(tmp_path / "capture.json")
        assert written.items() <= printed.items() and printed["placed"] == COUNT
        assert files.read_json(tmp_path / "transforms.json")["units"] == "arbitrary"
        assert len(printed["farthest"]) == 2 and printed["distance"] > 0


def flat(folder: Path, *sizes: tuple[int, int]) -> None:
    """Write pictures without features, of these heights and widths."""
    for i, size in enumerate(sizes):
        image = np.full((*size, 3), 30 * i, np.uint8)
        files.write_image(folder / f"{i}.jpg", image)


WIDE, TALL = (60, 80), (80, 60)


@pytest.mark.parametrize(
    ("sizes", "message"),
    [
        ([WIDE] * 2, "p: 2 photographs .*at least 3"),
        ([WIDE] * 3 + [TALL] * 2, "p: only 3.jpg, 4.jpg of 60 x 80 px; .* at least 3"),
        ([WIDE] * 3, "photographs: 0 of 3"),
    ],
)
def test_unusable_photographs(tmp_path, sizes, message, monkeypatch):
    pytest.importorskip("pycolmap")
    for name in ("p", "temporary"):
        (tmp_path / name).mkdir()
    monkeypatch.setenv("TMPDIR", str(tmp_path / "temporary"))
    flat(tmp_path / "p", *sizes)
    with pytest.raises(InputError, match=message):
        estimate_poses(tmp_path / "p", tmp_path / "out")
    assert not (tmp_path / "out").is_dir()
    assert not list((tmp_path / "temporary").iterdir())  # nor the log of COLMAP


test_refused = refusals(
    (lambda: PoseOptions(metres_per_unit=0.0), "metres_per_unit: 0.0"),
    (lambda: PoseOptions(seed=1 << 31), "seed: 2147483648"),
    (lambda at: list_photographs(at / "none"), "none: is not a folder"),
)


def photograph_with(path: Path, image: np.ndarray, focal_mm: float, turn: int) -> None:
    """Store a picture as a phone does, turned, and with EXIF data that turn it back."""
    exif = Image.Exif()
    exif[ExifTags.Base.Model] = "Analytic"
    exif[ExifTags.Base.Orientation] = {0: 1, 1: 6, 3: 8}[turn]
    exif.get_ifd(ExifTags.IFD.Exif)[ExifTags.Base.FocalLength] = focal_mm
    Image.fromarray(np.rot90(image, turn)).save(path, exif=exif, quality=95)


class TestMixedSet:
    """One camera held three ways and zoomed; EXIF data tell the groups apart."""

    def taken(self, i: int) -> tuple[Camera, float, int]:
        """Return lens, focal length and turn of the i-th photograph."""
        wide, tele = CAMERA, from_fov(240, 180, 45.0)
        tall = Camera(180, 240, CAMERA.fx, CAMERA.fy, 90, 120)
        return [(wide, 4.0, 0), (tall, 4.0, 1), (tele, 6.5, 0), (tall, 4.0, 3)][i % 4]

    def photographs(self, folder: Path, count: int) -> np.ndarray:
        folder.mkdir()
        poses = corner_poses(count)
        for i, pose in enumerate(poses):
            camera, focal, turn = self.taken(i)
            image = corner_photograph(pose, camera)
            photograph_with(folder / f"{i:02d}.jpg", image, focal, turn)
        return poses

    def test_groups_of_upright_copies(self, tmp_path):
        poses = self.photographs(tmp_path / "p", 12)
        staged = files.make_folder(tmp_path / "staged")
        names = list_photographs(tmp_path / "p")
        groups = stage(tmp_path / "p", names, staged, lambda *_: None)
        sizes = {(h.focal_mm, h.orientation): (h.width, h.height) for h in groups}
        wide, tall = (240, 180), (180, 240)
        expected = {("4.0", 1): wide, ("4.0", 6): tall, ("6.5", 1): wide}
        assert sizes == {**expected, ("4.0", 8): tall}
        assert [len(group) for group in groups.values()] == [3, 3, 3, 3]
        for i in (1, 3):
            with Image.open(staged / f"{i:02d}.jpg") as copy:
                assert copy.getexif().get(ExifTags.Base.Orientation, 1) == 1
            shown = files.read_image(staged / f"{i:02d}.jpg").astype(float)
            reference = corner_photograph(poses[i], self.taken(i)[0])
            assert np.abs(shown - reference).mean() < 8

    def test_is_not_replaced_by_upright_copies(self, tmp_path):
        self.photographs(tmp_path / "images", 12)
        before = (tmp_path / "images/01.jpg").read_bytes()
        with pytest.raises(InputError, match="images/01.jpg: its EXIF"):
            estimate_poses(tmp_path / "images", tmp_path)
        assert (tmp_path / "images/01.jpg").read_bytes() == before

    @pytest.mark.slow
    def test_is_placed_whole(self, tmp_path):
        pytest.importorskip("pycolmap")
        true_poses = self.photographs(tmp_path / "p", 16)
        options = PoseOptions(lens="SIMPLE_PINHOLE")
        result = estimate_poses(tmp_path / "p", tmp_path / "out", options)
        assert result.left_out == ()
        for i, camera in enumerate(result.cameras):
            true_camera = self.taken(i)[0]
            assert (camera.width, camera.height) == (
                true_camera.width,
                true_camera.height,
            )
            assert camera.fx == pytest.approx(true_camera.fx, rel=0.05)
        posed = read_images(tmp_path / "out")
        aligned_eyes, _ = aligned(posed.camera_to_world[:, :3, 3], true_poses[:, :3, 3])
        np.testing.assert_allclose(aligned_eyes, true_poses[:, :3, 3], atol=0.05)
        assert posed.cameras == result.cameras and not posed.has_one_size


LENS = replace(CAMERA, cx=140.0)  # of 240 px: 20 beside the middle


def placed_by(
    poses: np.ndarray, folder: Path, camera: Camera = LENS, lens: Any = "SIMPLE_PINHOLE"
) -> Camera:
    """Return the camera that is found of photographs by `camera`."""
    pytest.importorskip("pycolmap")
    photographs = files.make_folder(folder / "photographs")
    for i, pose in enumerate(poses):
        files.write_image(photographs / f"{i:02}.png", corner_photograph(pose, camera))
    result = estimate_poses(photographs, folder / "out", PoseOptions(lens=lens))
    assert len(result.placed) == len(poses)
    return result.cameras[0]


@pytest.mark.slow
def test_many_photographs_tell_where_a_lens_sits(tmp_path):
    """Until it is found beside the middle, cameras seem turned, by 5.5 degrees."""
    poses = corner_poses(20)
    for pose, angle in zip(poses, np.linspace(-0.8, 0.8, len(poses)), strict=True):
        turn = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
        pose[:3, :2] = pose[:3, :2] @ turn
    assert placed_by(poses, tmp_path).cx == pytest.approx(LENS.cx, abs=3)
    estimated_poses = read_images(tmp_path / "out").camera_to_world
    _, turn = aligned(estimated_poses[:, :3, 3], poses[:, :3, 3])
    cosine = ((turn @ estimated_poses[:, :3, 2, None])[..., 0] * poses[:, :3, 2]).sum(1)
    assert np.degrees(np.arccos(cosine.min())) < 2.5


@pytest.mark.slow
def test_a_camera_that_goes_where_it_looks_leaves_the_lens_in_the_middle(tmp_path):
    """Nothing tells a lens beside the middle from a camera that looks aside."""
    eyes = np.linspace([-0.5, -0.5, 1.6], [1.0, 1.0, 1.4], 20)
    poses = np.stack([look_at(eye, np.array([3.0, 3.0, 17 / 15])) for eye in eyes])
    assert placed_by(poses, tmp_path).cx == 120


@pytest.mark.slow
@pytest.mark.parametrize("focal_px", [120.0, 220.0])
def test_fisheyes_of_150_and_80_degrees_are_placed(tmp_path, focal_px):
    """EXIF data say no focal length here, which COLMAP does not find of a fisheye."""
    lens = Camera(320, 240, focal_px, focal_px, 160.0, 120.0, 0.05, is_fisheye=True)
    poses = corner_poses(10)
    camera = placed_by(poses, tmp_path, lens, "OPENCV_FISHEYE")
    assert camera.is_fisheye and camera.fx == pytest.approx(focal_px, rel=0.03)
    eyes = read_images(tmp_path / "out").camera_to_world[:, :3, 3]
    np.testing.assert_allclose(
        aligned(eyes, poses[:, :3, 3])[0], poses[:, :3, 3], atol=0.05
    )


def test_without_the_package_the_message_names_it(tmp_path, monkeypatch):
    path = tmp_path / "a.heic"
    path.write_bytes(b"\0\0\0\x18ftypheic" + bytes(40))
    monkeypatch.setitem(sys.modules, "pillow_heif", None)
    with pytest.raises(SetupError, match=f"{path}: .*pillow_heif"):
        files.read_image(path)


def test_photographs_are_read_and_staged_as_jpeg(tmp_path):
    pytest.importorskip("pillow_heif").register_heif_opener()
    taken, staged = (files.make_folder(tmp_path / name) for name in ("taken", "staged"))
    ramp = np.linspace(0, 255, 64 * 48 * 3).reshape(48, 64, 3).astype(np.uint8)
    exif = Image.Exif()
    exif[0x010F] = "Maker"
    for i in range(3):
        image = Image.fromarray(ramp)
        image.save(taken / f"{i}.HEIC", "HEIF", quality=100, exif=exif)
    groups = stage(taken, list_photographs(taken), staged, lambda *_: None)
    (held,) = groups
    assert held.make == "Maker" and (held.width, held.height) == (64, 48)
    assert groups[held] == [f"{i}.HEIC.jpg" for i in range(3)]
    for path in (taken / "0.HEIC", staged / "0.HEIC.jpg"):
        assert abs(files.read_image(path).astype(int) - ramp).max() < 12
    with Image.open(staged / "0.HEIC.jpg") as copy:
        assert copy.format == "JPEG"


PYCOLMAP = """
import os, pathlib, signal, sys, time
class CameraMode: SINGLE = 0
class logging: logtostderr = False
def set_random_seed(seed): pass
def ImageReaderOptions(**_): pass
def FeatureExtractionOptions(**_): pass
def extract_features(database, *_):
"""


class TestProcess:
    """pycolmap's process, with modules of its name that fail on purpose."""

    @pytest.fixture
    def poses(self, tmp_path, monkeypatch):
        """Estimate poses with a pycolmap whose extract_features is the given code."""
        folder = files.make_folder(tmp_path / "p")
        for i in range(3):
            files.write_image(folder / f"{i}.jpg", np.full((60, 80, 3), i, np.uint8))

        def call(code: str, progress=lambda *_: None) -> None:
            (tmp_path / "pycolmap.py").write_text(PYCOLMAP + indent(code, "    "))
            monkeypatch.syspath_prepend(str(tmp_path))
            estimate_poses(folder, tmp_path / "out", progress=progress)

        return call

    @pytest.mark.parametrize(
        ("code", "message"),
        [
            ("os.kill(os.getpid(), signal.SIGBUS)", "SIGBUS at the stage 'features'"),
            ("os.kill(os.getpid(), signal.SIGKILL)", "SIGKILL .*E full.*--long-edge"),
            ("raise ZeroDivisionError('why')", "code 1 .*ZeroDivisionError: why"),
        ],
    )
    def test_crash_is_a_message(self, poses, tmp_path, code, message):
        with pytest.raises(SetupError, match=message):
            poses(f"print('E full', flush=True)\n{code}")
        assert not (tmp_path / "out").exists()

    def test_interrupt_ends_the_process(self, poses, tmp_path):
        pid, calls = tmp_path / "pid", []
        code = (
            f"pathlib.Path({str(pid)!r}).write_text(str(os.getpid()))\n"
            "print('I Processed file [2/3]', flush=True)\ntime.sleep(100)\n"
        )

        def interrupt(*call) -> None:
            calls.append(call)
            if call == ("features", 2, 3):
                raise KeyboardInterrupt

        with pytest.raises(KeyboardInterrupt):
            poses(code, interrupt)
        with pytest.raises(ProcessLookupError):
            os.kill(int(pid.read_text()), 0)
        assert ("features", 0, 3) in calls

    def test_process_ends_with_its_parent(self, tmp_path):
        (tmp_path / "pycolmap.py").write_text("import time\ntime.sleep(100)\n")
        command = [sys.executable, "-m", "mi_nerfattack.capture.colmap.process"]
        task = json.dumps({"work": "", "folder": "", "groups": []})
        environment = {**os.environ, "PYTHONPATH": str(tmp_path)}
        result = subprocess.run(command, input=task + "\n", text=True, env=environment)
        assert result.returncode == 1

    def test_progress_of_a_log_line(self):
        for line, done in (
            ("Processed file [3/4]", 45),
            ("Processing image [3/4]", 30),
            ("Processing block [1/3, 3/3]", 13),
            ("Processing block [3/3, 1/3]", 40),
        ):
            calls = []
            stages = Stages(lambda *call, calls=calls: calls.append(call))
            begun = MARK + json.dumps({"stage": "s", "total": 60})
            stages.follow([begun, f"I2026 7 pairing.cc:2] {line}\n"])
            assert calls == [("s", 0, 60), ("s", done, 60)]
