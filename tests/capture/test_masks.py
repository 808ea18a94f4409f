"""Masks: which pixels of images count, where they lie, and what does not fit."""

from __future__ import annotations

import json

import numpy as np
import pytest
from helpers.posed_folders import write_transforms

from mi_nerfattack import cli
from mi_nerfattack.capture.masks import stage_masks
from mi_nerfattack.capture.transforms import read_transforms
from mi_nerfattack.errors import InputError
from mi_nerfattack.io import files
from mi_nerfattack.render.camera.intrinsics import from_fov, look_at

CAMERA = from_fov(12, 8, 60.0)
MASK = np.full((8, 12), 255, np.uint8)
MASK[6:, :5] = 0


@pytest.fixture
def folder(tmp_path):
    """Three posed images, of which the second has a mask."""
    images = np.zeros((3, 8, 12, 3), np.uint8)
    poses = np.stack([look_at([4, y, 0], [0, 0, 0]) for y in (0, 1, 2)])
    path = write_transforms(tmp_path, images, CAMERA, poses)
    table = json.loads(path.read_text())
    table["frames"][1]["mask_path"] = "masks/1.png"
    path.write_text(json.dumps(table))
    files.make_folder(tmp_path / "masks")
    files.write_image(tmp_path / "masks" / "1.png", MASK)
    return tmp_path


def test_read_with_the_images(folder):
    masks = read_transforms(folder).masks
    np.testing.assert_array_equal(masks[1], MASK > 0)
    assert masks[[0, 2]].all()


def test_a_reduced_pixel_counts_if_all_that_it_is_made_of_does(folder):
    masks = read_transforms(folder, long_edge_px=6).masks
    assert masks.shape == (3, 4, 6)
    # of the columns 0 to 4, the last shares its pixel with one that counts
    assert np.argwhere(~masks[1]).tolist() == [[3, 0], [3, 1], [3, 2]]


@pytest.mark.parametrize(
    ("mask", "message"),
    [
        (MASK[:, :6], "1.png: 6 x 8 px; the mask of .* 12 x 8 px"),
        (0 * MASK, "1.png: black everywhere"),
    ],
)
def test_does_not_fit(folder, mask, message):
    files.write_image(folder / "masks" / "1.png", mask)
    with pytest.raises(InputError, match=message):
        read_transforms(folder)
    (folder / "masks" / "1.png").unlink()
    with pytest.raises(InputError, match="1.png: does not exist"):
        read_transforms(folder)


class TestStaging:
    @pytest.fixture
    def stage(self, tmp_path):
        for name in ("photographs", "masks", "out"):
            (tmp_path / name).mkdir()
        for name in ("a.jpg", "b.jpg"):
            image = np.zeros((8, 12, 3), np.uint8)
            files.write_image(tmp_path / "photographs" / name, image)

        def call(masks: str = "masks") -> dict[str, np.ndarray]:
            photographs, out = tmp_path / "photographs", tmp_path / "out"
            stage_masks(tmp_path / masks, photographs, ["a.jpg", "b.jpg"], out)
            return {p.name: files.read_image(p)[..., 0] for p in out.iterdir()}

        return call

    def test_one_for_all(self, stage, tmp_path):
        files.write_image(tmp_path / "bonnet.png", MASK // 3)
        found = stage("bonnet.png")
        assert sorted(found) == ["a.jpg.png", "b.jpg.png"]
        np.testing.assert_array_equal(found["a.jpg.png"], MASK)

    def test_some_by_name(self, stage, tmp_path):
        files.write_image(tmp_path / "masks" / "b.jpg.png", MASK)
        found = stage()
        np.testing.assert_array_equal(found["b.jpg.png"], MASK)
        assert found["a.jpg.png"].min() == 255

    def test_refused(self, stage, tmp_path):
        with pytest.raises(InputError, match="masks: has no mask; .* a.jpg.png"):
            stage()
        files.write_image(tmp_path / "masks" / "b.png", MASK)
        with pytest.raises(InputError, match="b.png belongs to no photograph"):
            stage()
        with pytest.raises(InputError, match="none: does not exist"):
            stage("none")


def test_a_folder_is_not_for_a_video(tmp_path, capsys):
    (tmp_path / "walk.mp4").write_bytes(b"no film")
    arguments = [str(tmp_path / "walk.mp4"), "-o", str(tmp_path / "out")]
    assert cli.main(["capture", *arguments, "--masks", str(tmp_path)]) == cli.EXIT_INPUT
    assert "is a folder; give one PNG" in capsys.readouterr().err
