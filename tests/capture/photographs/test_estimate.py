"""Poses from photographs: an analytic scene, a real one, and what cannot be used."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from helpers.corner import CAMERA, aligned, corner_photograph, corner_poses
from PIL import ExifTags, Image

from mi_nerfattack import cli
from mi_nerfattack.capture.photographs.estimate import (
    PoseOptions,
    estimate_poses,
)
from mi_nerfattack.capture.photographs.staging import (
    copy_upright,
    list_photographs,
    stage,
)
from mi_nerfattack.capture.transforms import read_images
from mi_nerfattack.errors import InputError, SetupError
from mi_nerfattack.io import files
from mi_nerfattack.render.camera.intrinsics import Camera, from_fov

pytestmark = pytest.mark.usefixtures("variant")

COUNT = 8
LEFT_HALF = np.zeros((180, 240), np.uint8)
LEFT_HALF[:, 120:] = 255


@pytest.fixture(scope="module")
def corner(tmp_path_factory):
    """A folder of photographs of the corner, and the poses found for them."""
    pytest.importorskip("pycolmap")
    root = tmp_path_factory.mktemp("corner")
    (root / "photographs").mkdir()
    for i, pose in enumerate(corner_poses()):
        files.write_image(root / "photographs" / f"{i}.png", corner_photograph(pose))
    (root / "masks").mkdir()
    files.write_image(root / "masks" / "0.png.png", LEFT_HALF)
    flat = np.full((180, 240, 3), 90, np.uint8)
    files.write_image(root / "photographs" / "flat.png", flat)
    stages = []
    options = PoseOptions(
        lens="SIMPLE_PINHOLE", metres_per_unit=2.0, masks=root / "masks"
    )
    result = estimate_poses(
        root / "photographs", root / "out", options, lambda *call: stages.append(call)
    )
    return root, result, stages


class TestCorner:
    def test_cameras_stand_where_they_stood(self, corner):
        root, result, _ = corner
        assert result.left_out == ("flat.png",) and len(result.placed) == COUNT
        given = corner_poses()[:, :3, 3]
        posed = read_images(root / "out")
        found, _ = aligned(posed.camera_to_world[:, :3, 3], given)
        np.testing.assert_allclose(found, given, atol=0.05)
        assert result.error_px < 1
        assert result.cameras[0].fx == pytest.approx(CAMERA.fx, rel=0.05)

    def test_z_points_up(self, corner):
        posed = read_images(corner[0] / "out")
        given = corner_poses()
        _, turn = aligned(posed.camera_to_world[:, :3, 3], given[:, :3, 3])
        tilt = turn.T @ [0, 0, 1]  # of the true vertical, in the estimate's world
        mean_up = -given[:, :3, 1].mean(0)
        expected = mean_up[2] / np.linalg.norm(mean_up)
        assert tilt[2] == pytest.approx(expected, abs=5e-3)
        np.testing.assert_allclose(
            posed.camera_to_world[:, :3, 3].mean(0), 0, atol=1e-9
        )

    def test_a_mask_takes_features_away_and_is_written(self, corner):
        root, result, _ = corner
        features = result.found.features
        assert 0 < features["0.png"] < 0.75 * features["1.png"]
        masks = read_images(root / "out").masks
        np.testing.assert_array_equal(masks[0], LEFT_HALF > 0)
        assert masks[1:].all()

    def test_points_lie_on_the_corner(self, corner):
        posed = read_images(corner[0] / "out")
        given = corner_poses()[:, :3, 3]
        eyes = posed.camera_to_world[:, :3, 3]
        together = np.concatenate([eyes, posed.points])
        # carry the points along with the similarity of the cameras
        centre, target = eyes.mean(0), given.mean(0)
        fitted, turn = aligned(eyes, given)
        scale = np.linalg.norm(fitted - target) / np.linalg.norm(eyes - centre)
        world = scale * (together - centre) @ turn.T + target
        off = np.abs(world[COUNT:] - [3.0, 3.0, 0.0]).min(1)
        assert np.median(off) < 0.03

    def test_file_says_the_unit_and_what_is_left_out(self, corner):
        root, result, _ = corner
        table = json.loads((root / "out/transforms.json").read_text())
        assert read_images(root / "out").unit == table["units"] == "metre"
        assert table["left_out"] == ["flat.png"]
        assert sorted(p.name for p in (root / "out/images").iterdir()) == list(
            result.placed
        )
        copied = (root / "out/images/0.png").read_bytes()
        assert copied == (root / "photographs/0.png").read_bytes()

    def test_report_says_what_each_gave(self, corner):
        table = json.loads((corner[0] / "out/capture.json").read_text())
        assert (table["placed"], table["photographs"]) == (COUNT, COUNT + 1)
        assert table["scale"]["metres_per_unit"] == 2.0
        assert table["retake"]["flat.png"].startswith("not placed")
        *placed, flat = table["frames"]
        assert flat["features"] < 10 and flat["points"] == 0
        for frame in placed:
            assert 20 < frame["points"] < frame["features"]
            assert 0 < frame["error_px"] < 1

    def test_progress_ends_every_stage(self, corner):
        _, _, stages = corner
        ends = {stage: (done, total) for stage, done, total in stages}
        n = COUNT + 1
        assert ends == {
            "photographs": (n, n),
            "features": (n, n),
            "matches": (n * (n - 1) // 2, n * (n - 1) // 2),
            "poses": (n, n),
        }

    def test_command(self, corner, tmp_path, capsys):
        arguments = ["--matching", "sequential", "--lens", "SIMPLE_PINHOLE"]
        code = cli.main(
            ["capture", str(corner[0] / "photographs"), "-o", str(tmp_path), *arguments]
        )
        out = capsys.readouterr().out
        assert code == 0 and f"Placed {COUNT} of {COUNT + 1} photographs" in out
        assert "Take again: flat.png, not placed" in out and "--metres-per-unit" in out
        assert files.read_image(tmp_path / "cameras.png").shape[2] >= 3
        table = json.loads((tmp_path / "transforms.json").read_text())
        assert table["units"] == "arbitrary"
        output = str(tmp_path / "again")
        arguments += ["-o", output, "--json"]
        assert cli.main(["capture", str(corner[0] / "photographs"), *arguments]) == 0
        told = json.loads(capsys.readouterr().out)
        written = json.loads((tmp_path / "again" / "capture.json").read_text())
        assert written.items() <= told.items() and told["placed"] == COUNT
        assert told["transforms"] == f"{output}/transforms.json"
        assert len(told["farthest"]) == 2 and told["distance"] > 0


class TestUnusable:
    def photographs(self, folder: Path, count: int) -> Path:
        folder.mkdir()
        for i in range(count):
            image = np.full((60, 80, 3), 40 * i, np.uint8)
            files.write_image(folder / f"{i}.jpg", image)
        return folder

    def refused(self, folder: Path, message: str, options=None) -> None:
        out = folder.parent / "out"
        with pytest.raises(InputError, match=message):
            estimate_poses(folder, out, options)
        assert not out.exists()

    def test_too_few(self, tmp_path):
        folder = self.photographs(tmp_path / "p", 2)
        self.refused(folder, "p: 2 photographs .*at least 3")
        self.refused(tmp_path / "none", "none: is not a folder")

    def test_unreadable(self, tmp_path):
        folder = self.photographs(tmp_path / "p", 3)
        raw = (folder / "1.jpg").read_bytes()
        (folder / "1.jpg").write_bytes(raw[: len(raw) // 2])
        self.refused(folder, "1.jpg: damaged image")

    def test_mixed_sizes(self, tmp_path):
        folder = self.photographs(tmp_path / "p", 3)
        for name in "34":
            files.write_image(folder / f"{name}.jpg", np.zeros((80, 60, 3), np.uint8))
        message = "p: only 3.jpg, 4.jpg of 60 x 80 px; .* at least 3 .* 2 such groups"
        self.refused(folder, message)

    def test_nothing_placed(self, tmp_path, monkeypatch):
        pytest.importorskip("pycolmap")
        temporary = tmp_path / "temporary"
        temporary.mkdir()
        monkeypatch.setenv("TMPDIR", str(temporary))
        self.refused(self.photographs(tmp_path / "p", 3), "0 of 3 could be placed")
        assert not list(temporary.iterdir())  # nor the log of COLMAP

    def test_without_pycolmap(self, tmp_path, monkeypatch):
        (tmp_path / "pycolmap.py").write_text("raise ImportError('gone')")
        monkeypatch.syspath_prepend(str(tmp_path))
        folder = self.photographs(tmp_path / "p", 3)
        with pytest.raises(SetupError, match="pycolmap: gone; .*pip install pycolmap"):
            estimate_poses(folder, tmp_path / "out")
        assert not (tmp_path / "out").exists()

    @pytest.mark.parametrize("scale", [0.0, -1.0, float("nan"), float("inf")])
    def test_scale(self, scale):
        with pytest.raises(InputError, match="metres_per_unit: .*above 0"):
            PoseOptions(metres_per_unit=scale)

    @pytest.mark.parametrize("seed", [-1, 1 << 31])
    def test_seed(self, seed):
        with pytest.raises(InputError, match=f"seed: {seed}; must be .* in .0, 21"):
            PoseOptions(seed=seed)

    def test_output_that_is_a_file(self, tmp_path):
        folder = self.photographs(tmp_path / "p", 3)
        (tmp_path / "file").write_text("x")
        with pytest.raises(InputError, match="file"):
            estimate_poses(folder, tmp_path / "file" / "out")

    def test_turned_photographs_are_not_replaced(self, tmp_path):
        folder = self.photographs(tmp_path / "images", 3)
        for i in range(3):
            write_turned(folder / f"{i}.jpg", np.zeros((60, 80, 3), np.uint8))
        before = (folder / "0.jpg").read_bytes()
        with pytest.raises(InputError, match="0.jpg: its EXIF data turn it"):
            estimate_poses(folder, tmp_path)
        assert (folder / "0.jpg").read_bytes() == before


def write_turned(path: Path, image: np.ndarray) -> None:
    exif = Image.Exif()
    exif[0x0112] = 6  # the camera was held upright: turn clockwise to show
    Image.fromarray(image).save(path, exif=exif, quality=95)


def test_turned_photographs_are_stored_upright(tmp_path):
    image = np.zeros((60, 80, 3), np.uint8)
    image[:, :40] = 255  # left, so on top when turned clockwise
    write_turned(tmp_path / "a.jpg", image)
    held = copy_upright(tmp_path / "a.jpg", tmp_path / "b.jpg")
    assert held[-3:] == (6, 60, 80)
    shown = files.read_image(tmp_path / "b.jpg")
    assert shown.shape == (80, 60, 3)
    assert shown[:36].min() > 240 and shown[44:].max() < 15
    with Image.open(tmp_path / "b.jpg") as stored:
        assert stored.getexif().get(0x0112, 1) == 1


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
        wide, tele, tall = (
            CAMERA,
            from_fov(240, 180, 45.0),
            Camera(180, 240, CAMERA.fx, CAMERA.fy, 90, 120),
        )
        return [(wide, 4.0, 0), (tall, 4.0, 1), (tele, 6.5, 0), (tall, 4.0, 3)][i % 4]

    def photographs(self, folder: Path, count: int) -> np.ndarray:
        folder.mkdir()
        poses = corner_poses(count)
        for i, pose in enumerate(poses):
            camera, focal, turn = self.taken(i)
            image = corner_photograph(pose, camera)
            photograph_with(folder / f"{i:02d}.jpg", image, focal, turn)
        return poses

    def test_groups(self, tmp_path):
        self.photographs(tmp_path / "p", 12)
        (tmp_path / "staged").mkdir()
        names = list_photographs(tmp_path / "p")
        groups = stage(tmp_path / "p", names, tmp_path / "staged", lambda *_: None)
        found = {(held.focal_mm, held.orientation): held for held in groups}
        sizes = {key: (held.width, held.height) for key, held in found.items()}
        assert sizes == {
            ("4.0", 1): (240, 180),
            ("4.0", 6): (180, 240),
            ("6.5", 1): (240, 180),
            ("4.0", 8): (180, 240),
        }
        assert [len(group) for group in groups.values()] == [3, 3, 3, 3]
        assert str(found["4.0", 6]) == (
            "Analytic, 4.0 mm, 180 x 240 px, turned by EXIF data (6)"
        )
        upright_one = files.read_image(tmp_path / "staged/01.jpg").astype(float)
        wanted = corner_photograph(corner_poses(12)[1], self.taken(1)[0])
        assert np.abs(upright_one - wanted).mean() < 8

    def test_too_few_held_one_way(self, tmp_path):
        self.photographs(tmp_path / "p", 10)
        message = "only 02.jpg, 06.jpg of Analytic, 6.5 mm, .* at least 3"
        with pytest.raises(InputError, match=message):
            estimate_poses(tmp_path / "p", tmp_path / "out")
        assert not (tmp_path / "out").exists()

    @pytest.mark.slow
    def test_is_placed_whole(self, tmp_path):
        pytest.importorskip("pycolmap")
        given = self.photographs(tmp_path / "p", 16)
        options = PoseOptions(lens="SIMPLE_PINHOLE")
        result = estimate_poses(tmp_path / "p", tmp_path / "out", options)
        assert result.left_out == ()
        for i, camera in enumerate(result.cameras):
            wanted = self.taken(i)[0]
            assert (camera.width, camera.height) == (wanted.width, wanted.height)
            assert camera.fx == pytest.approx(wanted.fx, rel=0.05)
        posed = read_images(tmp_path / "out")
        found, _ = aligned(posed.camera_to_world[:, :3, 3], given[:, :3, 3])
        np.testing.assert_allclose(found, given[:, :3, 3], atol=0.05)
        assert posed.cameras == result.cameras and not posed.has_one_size


@pytest.mark.slow
def test_fox_stands_where_it_stood(data_folder, tmp_path):
    """Twelve photographs of 480 px against the poses that come with them."""
    pytest.importorskip("pycolmap")
    given = read_images(data_folder / "fox", 480, skip_missing=True)
    (tmp_path / "p").mkdir()
    chosen = list(range(0, 24, 2))
    for i in chosen:
        name = Path(given.names[i]).stem
        files.write_image(tmp_path / "p" / f"{name}.png", given.images[i])
    result = estimate_poses(tmp_path / "p", tmp_path / "out")
    assert len(result.placed) == len(chosen)
    stems = [Path(name).stem for name in given.names]
    index = [stems.index(Path(name).stem) for name in result.placed]
    eyes = given.camera_to_world[index, :3, 3]
    posed = read_images(result.path)
    found, _ = aligned(posed.camera_to_world[:, :3, 3], eyes)
    error = np.linalg.norm(found - eyes, axis=1)
    extent = np.linalg.norm(eyes - eyes.mean(0), axis=1).max()
    assert np.median(error) < 0.01 * extent
    assert isinstance(posed.camera, Camera) and posed.images.shape[1:3] == (480, 270)
    assert posed.camera.fx == pytest.approx(given.camera.fx, rel=0.02)
