"""Posed images and renders of scenes and meshes against analytic scenes."""

from __future__ import annotations

import json
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from support.faults.refusals import refusals
from support.files.folders import (
    HEIGHT,
    WIDTH,
    blender,
    instant_ngp,
    nerfstudio,
    picture,
    poses,
)
from support.worlds.views import write_transforms

from mi_nerfattack.capture.inputs import read_depth
from mi_nerfattack.capture.masks import stage_masks
from mi_nerfattack.capture.posed_images import (
    PosedImages,
    held_out,
    resize_area,
    stacked,
)
from mi_nerfattack.capture.transforms import begin_posed, read_images, read_transforms
from mi_nerfattack.errors import InputError
from mi_nerfattack.io import files
from mi_nerfattack.render.camera.conventions import opencv_to_opengl
from mi_nerfattack.render.camera.intrinsics import Camera, look_at

pytestmark = pytest.mark.usefixtures("variant")

CAMERA = Camera(12, 8, 10.0, 10.5, 6.5, 3.75, k1=0.01, k2=-0.002, p1=1e-3, p2=2e-3)


def some_frames(n: int = 3, channels: int = 3):
    rng = np.random.default_rng(0)
    images = rng.integers(0, 256, (n, 8, 12, channels), dtype=np.uint8)
    eyes = rng.normal(size=(n, 3)) + [0, 0, 4]
    return images, np.stack([look_at(eye, np.zeros(3)) for eye in eyes])


def edited(folder: Path, edit) -> Path:
    path = folder / "transforms.json"
    table = files.read_json(path)
    edit(table)
    files.write_json(path, table)
    return path


@pytest.fixture
def folder(tmp_path):
    images, poses = some_frames()
    write_transforms(tmp_path, images, CAMERA, poses)
    return tmp_path


MATRIX = "transform_matrix"


class TestTransforms:
    @pytest.mark.parametrize("channels", [3, 4])
    def test_round_trip(self, tmp_path, channels):
        images, poses = some_frames(channels=channels)
        images[..., 3:] = np.maximum(images[..., 3:], 1)
        write_transforms(tmp_path, images, CAMERA, poses, {"seed": 7})
        back = read_transforms(tmp_path)
        np.testing.assert_array_equal(back.images, images)
        np.testing.assert_allclose(back.camera_to_world, poses, atol=1e-12)
        assert back.camera == CAMERA
        assert json.loads((tmp_path / "transforms.json").read_text())["seed"] == 7

    def test_alpha_without_transparency_is_left_out(self, tmp_path):
        images, poses = some_frames(channels=4)
        images[..., 3] = 255
        write_transforms(tmp_path, images, CAMERA, poses)
        np.testing.assert_array_equal(read_transforms(tmp_path).images, images[..., :3])
        images[0, 0, 0, 3] = 254
        write_transforms(tmp_path, images, CAMERA, poses)
        assert read_transforms(tmp_path).channels == 4

    def test_rounded_matrices_become_rotations_again(self, folder):
        exact = read_transforms(folder).camera_to_world

        def rounded(table, decimals):
            for frame, matrix in zip(table["frames"], exact, strict=True):
                values = np.round(opencv_to_opengl(matrix), decimals)
                frame["transform_matrix"] = values.tolist()

        source = edited(folder, partial(rounded, decimals=3))
        back = read_transforms(source).camera_to_world
        product = back[:, :3, :3].swapaxes(1, 2) @ back[:, :3, :3]
        np.testing.assert_allclose(product, np.tile(np.eye(3), (3, 1, 1)), atol=1e-12)
        np.testing.assert_allclose(back, exact, atol=1e-3)
        with pytest.raises(InputError, match=r"frames\[0\].*not a rigid pose"):
            read_transforms(edited(folder, partial(rounded, decimals=1)))

    def test_an_unfinished_folder_has_no_poses(self, folder):
        assert begin_posed(folder) == folder / "transforms.json"
        assert not (folder / "transforms.json").exists()

    def test_resize(self, folder):
        read = read_transforms(folder, long_edge_px=6)
        assert read.images.shape == (3, 4, 6, 3)
        assert read.camera == Camera(6, 4, 5.0, 5.25, 3.25, 1.875, *CAMERA.distortion)
        assert read_transforms(folder, long_edge_px=100).images.shape == (3, 8, 12, 3)
        halves = np.repeat(np.uint8([[[255] * 3], [[0] * 3]]), 2, 1)
        assert resize_area(halves, 1, 1).tolist() == [[[188] * 3]]  # half the light
        clear = np.array([[[255, 0, 0, 255], [0, 255, 0, 0]]], np.uint8)
        assert resize_area(clear, 1, 1).tolist() == [[[255, 0, 0, 128]]]
        files.write_image(folder / "images/0001.png", np.full((8, 12, 4), 9, np.uint8))
        assert read_transforms(folder).images.shape == (3, 8, 12, 4)  # all with alpha

    def test_missing_image(self, folder):
        (folder / "images" / "0001.png").unlink()
        with pytest.raises(InputError, match="1 of 3 .*0001.png.*--skip-missing"):
            read_transforms(folder)
        read = read_transforms(folder, skip_missing=True)
        assert len(read) == 2 and read.missing == ("images/0001.png",)
        edited(folder, lambda t: t["frames"][2].update(h=8.5))  # its index in the file
        with pytest.raises(InputError, match=r"frames\[2\]: h: 8.5"):
            read_transforms(folder, skip_missing=True)

    def test_mixed_sizes(self, folder):
        small = np.full((6, 10, 3), 7, np.uint8)
        files.write_image(folder / "images/0002.png", small)
        with pytest.raises(InputError, match="0002.png: 10 x 6 px, .* 12 x 8 px"):
            read_transforms(folder)
        edited(folder, lambda t: t["frames"][2].update(w=10, h=6, cx=5.0, cy=3.0))
        read = read_transforms(folder)
        assert [image.shape for image in read.images] == [(8, 12, 3)] * 2 + [(6, 10, 3)]
        assert read.camera_of(2).cx == 5 and read.camera_of(1) == CAMERA
        np.testing.assert_array_equal(read.images[2], small)
        reduced = read_transforms(folder, long_edge_px=5)
        assert [image.shape for image in reduced.images] == [(3, 5, 3)] * 3
        assert reduced.camera_of(2).cx == 2.5

    @pytest.mark.parametrize(
        ("frame", "key", "value", "message"),
        [
            (None, "w", 1080, "w, h: 1080 x 8"),
            (None, "fl_x", -3.0, "fl_x, fl_y"),
            (None, "k1", -50.0, "k1"),
            (None, "k3", 0.1, "k3"),
            (None, "camera_model", "FULL_OPENCV", "camera_model"),
            (None, "distortion_params", [0, 0, 0.1, 0, 0, 0], "k3"),
            (None, "frames", [], "frames"),
            (2, "k1", -50.0, ".*k1"),
            (1, "fl_x", 0.0, "fl_x, fl_y: 0.0"),
            (2, MATRIX, np.diag([2.0, 2, 2, 1]), "not a rigid pose"),
            (2, MATRIX, np.zeros((4, 4)), "last row"),
            (2, MATRIX, np.diag([1.0, 1, -1, 1]), "reflection"),
            (2, MATRIX, np.eye(3), "shape"),
        ],
    )
    def test_unusable_fields(self, folder, frame, key, value, message):
        def edit(table):
            entry = table if frame is None else table["frames"][frame]
            entry[key] = value.tolist() if isinstance(value, np.ndarray) else value

        where = "" if frame is None else rf"frames\[{frame}\].*"
        with pytest.raises(InputError, match=f"transforms.json: .*{where}{message}"):
            read_transforms(edited(folder, edit))


def posed(*channels: int, place: float = 0.0, **options) -> PosedImages:
    """Make images of so many channels each, the first at a place."""
    images, poses = some_frames(2)
    images = [np.resize(images[0], (8, 12, c)) for c in channels]
    images = stacked(images) if images else np.zeros((0, 8, 12, 3), np.uint8)
    poses[0, 1, 3] = place
    count = len(channels)
    return PosedImages(images, poses[:count], CAMERA, ("a", "b")[:count], **options)


OTHER = CAMERA, Camera(9, 8, 9.0, 9.0, 4.5, 4.0)
test_refused = refusals(
    (lambda: posed(3, 3, place=np.nan), "a: .*NaN"),
    (lambda: posed(3, 4), "images: b .*height, width, 3"),
    (lambda: posed(4, 3), "images: b .*height, width, 3"),
    (lambda: posed(2, 2), "images: a .*height, width, 3"),
    (lambda: posed(), "images: none"),
    (lambda: posed(3, 3, cameras=(CAMERA,)), "cameras: 1; .* 2 images"),
    (lambda: posed(3, 3, cameras=OTHER), "b: its camera has 9 x 8 px"),
)


def test_every_eighth_image_is_held_out():
    assert held_out(17).tolist() == [0, 8, 16]


class TestFolders:
    def test_nerfstudio(self, tmp_path):
        read = read_images(nerfstudio(tmp_path))
        assert len(read.cameras) == 3
        for i, camera in enumerate(read.cameras):
            numbers = 10.0 + i, 11.0 + i, 6.25, 3.75, 0.01 * i
            assert camera == Camera(WIDTH, HEIGHT, *numbers)
        half = read_images(tmp_path, long_edge_px=6)
        assert half.camera_of(2).fx == 6.0 and half.camera_of(2).k1 == 0.02
        assert half.images.shape == (3, 4, 6, 3)
        depth = read_depth(tmp_path, half)
        # the optical axis passes (3.125, 1.875); half a pixel beside it, next to 1.5 m
        assert depth[0, 1, 3] == pytest.approx(1.5, abs=0.02)
        assert (depth >= 1.5).all() and depth[0, 0, 0] > 1.55

    def test_numbers_of_frames(self, tmp_path):
        source = nerfstudio(tmp_path)
        usual = {"fl_x": 10.0, "fl_y": 11.0, "k1": 0.0}
        edited(source, lambda t: [frame.update(usual) for frame in t["frames"]])
        read = read_images(tmp_path)
        assert read.cameras == () and read.camera_of(2) == read.camera
        lens = [0.03, 0.01, 0, 0, 1e-3, 2e-3]
        edited(source, lambda t: t["frames"][1].update(distortion_params=lens))
        assert read_images(tmp_path).camera_of(1).distortion == (0.03, 0.01, 1e-3, 2e-3)

    def test_instant_ngp(self, tmp_path):
        read = read_images(instant_ngp(tmp_path))
        lens = (0.01, 0.002, 0.001, 0.002)
        assert read.cameras == () and read.unit == "unknown"
        assert read.camera == Camera(WIDTH, HEIGHT, 10.0, 11.0, 6.5, 3.75, *lens)
        np.testing.assert_allclose(
            read.camera_to_world, np.array(poses(3)) * [1, -1, -1, 1], atol=1e-12
        )

    def test_blender(self, tmp_path):
        read = read_images(blender(tmp_path))
        assert read.images.shape == (3, HEIGHT, WIDTH, 4)
        np.testing.assert_array_equal(read.images[1], picture(1, 4))
        focal = 0.5 * WIDTH / np.tan(0.5 * 0.6911112070083618)
        assert read.camera.fx == read.camera.fy == pytest.approx(focal)
        assert (read.camera.cx, read.camera.cy) == (WIDTH / 2, HEIGHT / 2)
        assert read_depth(tmp_path, read) is None


MASK = np.full((8, 12), 255, np.uint8)
MASK[6:, :5] = MASK[5, 8] = 0


@pytest.fixture
def masked(tmp_path):
    """Three posed images, of which the second has a mask."""
    images = np.zeros((3, 8, 12, 3), np.uint8)
    poses = np.stack([look_at([4, y, 0], [0, 0, 0]) for y in (0, 1, 2)])
    path = write_transforms(tmp_path, images, CAMERA, poses)
    table = files.read_json(path)
    table["frames"][1]["mask_path"] = "masks/1.png"
    files.write_json(path, table)
    files.write_image(files.make_folder(tmp_path / "masks") / "1.png", MASK)
    return tmp_path


def test_read_with_the_images(masked):
    masks = read_transforms(masked).masks
    np.testing.assert_array_equal(masks[1], MASK > 0)
    assert masks[[0, 2]].all()
    for mask, message in ((MASK[:, :6], "6 x 8 px; .* 12 x 8 px"), (0 * MASK, "black")):
        files.write_image(masked / "masks/1.png", mask)
        with pytest.raises(InputError, match=f"1.png: {message}"):
            read_transforms(masked)
    (masked / "masks/1.png").unlink()
    with pytest.raises(InputError, match="1.png: does not exist"):
        read_transforms(masked)


def test_a_reduced_pixel_counts_if_all_that_it_is_made_of_does(masked):
    masks = read_transforms(masked, long_edge_px=6).masks
    assert masks.shape == (3, 4, 6)
    # of the columns 0 to 4, the last shares its pixel with one that counts
    assert np.argwhere(~masks[1]).tolist() == [[2, 4], [3, 0], [3, 1], [3, 2]]


def test_masks_of_photographs(tmp_path):
    names = ["a.jpg", "b.jpg"]
    for name in ("photographs", "masks", "out"):
        (tmp_path / name).mkdir()
    for name in names:
        files.write_image(tmp_path / "photographs" / name, np.stack([0 * MASK] * 3, -1))

    def stage(masks: str) -> list[np.ndarray]:
        out = tmp_path / "out"
        stage_masks(tmp_path / masks, tmp_path / "photographs", names, out)
        return [files.read_image(out / f"{name}.png")[..., 0] for name in names]

    files.write_image(tmp_path / "bonnet.png", MASK // 3)
    np.testing.assert_array_equal(stage("bonnet.png"), [MASK, MASK])
    for masks, named in (("masks", "a.jpg.png"), ("none", "does not exist")):
        with pytest.raises(InputError, match=f"{masks}: .*{named}"):
            stage(masks)
    files.write_image(tmp_path / "masks/b.jpg.png", MASK)
    np.testing.assert_array_equal(stage("masks"), [0 * MASK + 255, MASK])
    files.write_image(tmp_path / "masks/b.png", MASK)
    with pytest.raises(InputError, match="masks: b.png"):
        stage("masks")
