"""Posed images and renders of scenes and meshes against analytic scenes."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
from helpers.kernels import nothing_compiled
from helpers.posed_folders import render_views, write_transforms

from mi_nerfattack.capture.posed_images import (
    PosedImages,
    held_out,
    resize_area,
    stacked,
)
from mi_nerfattack.capture.transforms import (
    begin_posed,
    read_transforms,
    write_poses,
)
from mi_nerfattack.errors import InputError
from mi_nerfattack.io import files
from mi_nerfattack.render.camera.intrinsics import (
    Camera,
    from_fov,
    look_at,
)
from mi_nerfattack.render.pathtrace.views import ViewRenderer

pytestmark = pytest.mark.usefixtures("variant")

CAMERA = Camera(12, 8, 10.0, 10.5, 6.5, 3.75, k1=0.01, k2=-0.002, p1=1e-3, p2=2e-3)


def some_frames(n: int = 3, channels: int = 3):
    rng = np.random.default_rng(0)
    images = rng.integers(0, 256, (n, 8, 12, channels), dtype=np.uint8)
    eyes = rng.normal(size=(n, 3)) + [0, 0, 4]
    return images, np.stack([look_at(eye, np.zeros(3)) for eye in eyes])


def edited(folder: Path, edit) -> Path:
    path = folder / "transforms.json"
    table = json.loads(path.read_text())
    edit(table)
    path.write_text(json.dumps(table))
    return path


@pytest.fixture
def folder(tmp_path):
    images, poses = some_frames()
    write_transforms(tmp_path, images, CAMERA, poses)
    return tmp_path


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

    def test_an_unfinished_folder_has_no_poses(self, folder, monkeypatch):
        images, poses = some_frames()
        monkeypatch.setattr(files, "write_image", lambda path, image: 1 / 0)
        with pytest.raises(ZeroDivisionError):
            write_transforms(folder, images, CAMERA, poses)
        assert not (folder / "transforms.json").exists()

    def test_file_is_opengl(self, tmp_path):
        images, _ = some_frames(1)
        write_transforms(tmp_path, images, CAMERA, look_at([4, 0, 0], [0, 0, 0])[None])
        table = json.loads((tmp_path / "transforms.json").read_text())
        matrix = np.array(table["frames"][0]["transform_matrix"])
        # seen from +x towards the origin: back is +x, up is +z, right is +y
        np.testing.assert_allclose(matrix[:3, :3].T, [[0, 1, 0], [0, 0, 1], [1, 0, 0]])

    def test_resize_scales_the_intrinsics(self, folder):
        read = read_transforms(folder, long_edge_px=6)
        assert read.images.shape == (3, 4, 6, 3)
        assert read.camera == Camera(6, 4, 5.0, 5.25, 3.25, 1.875, *CAMERA.distortion)
        assert read_transforms(folder, long_edge_px=100).images.shape == (3, 8, 12, 3)

    def test_resize_averages_light(self):
        image = np.zeros((2, 2, 3), np.uint8)
        image[0] = 255
        assert resize_area(image, 1, 1).tolist() == [
            [[188, 188, 188]]
        ]  # half the light

    def test_resize_ignores_the_colour_of_nothing(self):
        image = np.array([[[255, 0, 0, 255], [0, 255, 0, 0]]], np.uint8)
        assert resize_area(image, 1, 1).tolist() == [[[255, 0, 0, 128]]]

    def test_held_out(self):
        assert held_out(17).tolist() == [0, 8, 16]

    def test_missing_image(self, folder):
        (folder / "images" / "0001.png").unlink()
        with pytest.raises(
            InputError, match=r"1 of 3 frames.*0001.png.*--skip-missing"
        ):
            read_transforms(folder)
        read = read_transforms(folder, skip_missing=True)
        assert len(read) == 2 and read.missing == ("images/0001.png",)
        edited(folder, lambda t: t["frames"][2].update(h=8.5))  # its index in the file
        with pytest.raises(InputError, match=r"frames\[2\]: h: 8.5"):
            read_transforms(folder, skip_missing=True)

    def test_damaged_image(self, folder):
        (folder / "images" / "0001.png").write_bytes(b"\x89PNG\r\n\x1a\n garbage")
        with pytest.raises(InputError, match="0001.png"):
            read_transforms(folder)

    def test_mixed_sizes(self, folder):
        small = np.full((6, 10, 3), 7, np.uint8)
        files.write_image(folder / "images/0002.png", small)
        message = "0002.png: 10 x 6 px, but the intrinsics .* are for 12 x 8 px"
        with pytest.raises(InputError, match=message):
            read_transforms(folder)
        edited(folder, lambda t: t["frames"][2].update(w=10, h=6, cx=5.0, cy=3.0))
        read = read_transforms(folder)
        assert [image.shape for image in read.images] == [(8, 12, 3)] * 2 + [(6, 10, 3)]
        assert read.camera_of(2).cx == 5 and read.camera_of(1) == CAMERA
        np.testing.assert_array_equal(read.images[2], small)
        reduced = read_transforms(folder, long_edge_px=5)
        assert [image.shape for image in reduced.images] == [(3, 5, 3)] * 3
        assert reduced.camera_of(2).cx == 2.5

    def test_intrinsics_of_each_frame(self, tmp_path):
        images, poses = some_frames()
        own = [CAMERA, replace(CAMERA, fx=20.0), CAMERA]
        path = begin_posed(tmp_path)
        names = [f"images/{i}.png" for i in range(3)]
        for name, image in zip(names, images, strict=True):
            files.write_image(tmp_path / name, image)
        write_poses(path, names, own, poses)
        assert "fl_x" not in json.loads(path.read_text())
        assert list(read_transforms(tmp_path).cameras) == own

    @pytest.mark.parametrize(
        ("edit", "message"),
        [
            (lambda t: t.update(w=1080), "w, h: 1080 x 8"),
            (lambda t: t.update(fl_x="wide"), "fl_x: 'wide'"),
            (lambda t: t.update(fl_x=-3.0), "fl_x, fl_y"),
            (lambda t: t.update(k3=0.1), "k3"),
            (lambda t: t.update(camera_model="OPENCV_FISHEYE"), "camera_model"),
            (lambda t: t.update(camera_model=[]), r"camera_model: \[\]"),
            (
                lambda t: t["frames"][1].update(camera_model={}),
                r"frames\[1\]: camera_model: \{\}",
            ),
            (lambda t: t["frames"][2].update(k1=-50.0), r"frames\[2\]: .*k1"),
            (lambda t: t["frames"][1].update(cx="a"), r"frames\[1\]: cx: 'a'"),
            (lambda t: t.update(k1=-50.0), "k1"),
            (
                lambda t: t["frames"][1].update(fl_x=0.0),
                r"frames\[1\]: fl_x, fl_y: 0.0",
            ),
            (lambda t: t["frames"][1].update(h=8.5), r"frames\[1\]: h: 8.5"),
            (lambda t: t.update(distortion_params=[0.1]), "distortion_params"),
            (lambda t: t.update(distortion_params=[0, 0, 0.1, 0, 0, 0]), "k3"),
            (lambda t: t.update(frames=[]), "frames"),
            (lambda t: t["frames"][1].pop("file_path"), r"frames\[1\].file_path"),
            (lambda t: t["frames"][1].pop("transform_matrix"), r"\[1\].transform_m"),
        ],
    )
    def test_unusable_fields(self, folder, edit, message):
        with pytest.raises(InputError, match=f"transforms.json: .*{message}"):
            read_transforms(edited(folder, edit))

    @pytest.mark.parametrize(
        ("matrix", "message"),
        [
            (np.diag([2.0, 2, 2, 1]), "not a rigid pose"),
            (np.zeros((4, 4)), "last row"),
            (np.diag([0.0, 0, 0, 1]), "not a rigid pose"),
            (np.diag([1.0, 1, -1, 1]), "reflection"),
            (np.eye(3), "shape"),
            ("unity", "not a matrix"),
        ],
    )
    def test_unusable_poses(self, folder, matrix, message):
        value = matrix if isinstance(matrix, str) else matrix.tolist()
        path = edited(folder, lambda t: t["frames"][2].update(transform_matrix=value))
        with pytest.raises(InputError, match=rf"frames\[2\].transform_m.*{message}"):
            read_transforms(path)

    def test_nan_pose(self):
        images, poses = some_frames(1)
        poses[0, 1, 3] = np.nan
        with pytest.raises(InputError, match="first: .*NaN"):
            PosedImages(images, poses, CAMERA, ("first",))

    @pytest.mark.parametrize("channels", [(3, 4), (4, 3), (2, 2)])
    def test_channels_are_the_same(self, channels):
        images, poses = some_frames(2)
        images = stacked(
            [np.resize(images[0], (*images[0].shape[:2], c)) for c in channels]
        )
        with pytest.raises(InputError, match="must be .height, width, 3. in all, or"):
            PosedImages(images, poses, CAMERA, ("a", "b"))

    def test_none(self):
        with pytest.raises(InputError, match="at least one"):
            PosedImages(
                np.zeros((0, 8, 8, 3), np.uint8), np.zeros((0, 4, 4)), CAMERA, ()
            )

    def test_real_photographs(self, data_folder):
        read = read_transforms(data_folder / "fox", long_edge_px=96, skip_missing=True)
        assert read.images.shape == (50, 96, 54, 3) and len(read.missing) == 17
        assert read.camera.fx == pytest.approx(1375.52 * 54 / 1080)
        # the cameras look inwards at one thing: their axes meet near one point
        eyes, axes = read.camera_to_world[:, :3, 3], read.camera_to_world[:, :3, 2]
        off = np.eye(3) - axes[:, :, None] * axes[:, None, :]
        centre = np.linalg.solve(off.sum(0), (off @ eyes[..., None]).sum(0))[:, 0]
        assert np.all(((centre - eyes) * axes).sum(1) > 0)


def wall_scene():
    """A glowing red square on the left, green on the right, 4 m ahead along +x."""

    def square(colour, y):
        place = mi.ScalarTransform4f().translate([4, y, 1]).rotate([0, 1, 0], -90)
        return {
            "type": "rectangle",
            "to_world": place @ mi.ScalarTransform4f().scale(0.5),
            "emitter": {"type": "area", "radiance": {"type": "rgb", "value": colour}},
        }

    return mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "path"},
            "red": square([1, 0, 0], 1.0),
            "green": square([0, 1, 0], -1.0),
        }
    )


class TestViews:
    def test_orientation_and_depth(self):
        camera = from_fov(40, 20, 90.0)
        poses = np.stack(
            [look_at([0, 0, 1.0], [1, 0, 1.0]), look_at([0, 0, 1.0], [0, 1.0, 1.0])]
        )
        rgb, alpha, depth = render_views(wall_scene(), camera, poses, 4, 0)
        assert rgb.shape == (2, 20, 40, 3) and rgb.dtype == np.float32
        # y = 1 at x = 4 is a quarter of the half width to the left of the middle
        np.testing.assert_allclose(rgb[0, 10, 15], [1, 0, 0], atol=1e-6)
        np.testing.assert_allclose(rgb[0, 10, 25], [0, 1, 0], atol=1e-6)
        assert alpha[0, 10, 15] == 1 and alpha[0, 10, 20] == 0
        assert np.isinf(depth[0, 10, 20]) and not rgb[1].any() and not alpha[1].any()
        slope = np.array([1, (20 - 15.5) / 20, (10 - 10.5) / 20])
        assert depth[0, 10, 15] == pytest.approx(4 * np.linalg.norm(slope), rel=1e-5)

    def test_lens_bends_colour_and_depth_alike(self):
        lens = Camera(40, 20, 20.0, 23.0, 18.0, 11.0, k1=-0.06, p1=0.01)
        straight = Camera(40, 20, 20.0, 23.0, 18.0, 11.0)
        pose = look_at([2.2, 0.2, 1.0], [4, 0.2, 1.1])[None]
        scene = wall_scene()
        _, alpha, depth = render_views(scene, lens, pose, 16, 0)
        sure = (alpha == 0) | (alpha == 1)
        assert 20 < alpha.sum() < 0.5 * alpha.size and sure.mean() > 0.8
        np.testing.assert_array_equal(np.isfinite(depth)[sure], alpha[sure] == 1)
        other = render_views(scene, straight, pose, 16, 0)[1]
        assert np.abs(other - alpha).sum() > 5

    def test_no_kernel_after_the_first_view(self):
        camera = from_fov(13, 7, 70.0)
        renderer = ViewRenderer(wall_scene(), camera)
        renderer.render(look_at([0, 0, 1.0], [1, 0, 1.0]), 2, 0)
        with nothing_compiled():
            for i in range(1, 4):
                renderer.render(look_at([0, i, 1.0], [1, 0.1 * i, 2.0]), 2, i)

    def test_spp_must_be_positive(self):
        with pytest.raises(InputError, match="spp: 0"):
            render_views(wall_scene(), from_fov(2, 2, 9.0), np.eye(4)[None], 0, 0)


class TestCameras:
    @pytest.mark.parametrize(
        ("cameras", "message"),
        [
            ((CAMERA,), "cameras: 1; must be one for each of 2"),
            ((CAMERA, Camera(9, 8, 9.0, 9.0, 4.5, 4.0)), "b: its camera has 9 x 8 px"),
        ],
    )
    def test_that_do_not_fit(self, cameras, message):
        images, poses = some_frames(2)
        with pytest.raises(InputError, match=message):
            PosedImages(images, poses, CAMERA, ("a", "b"), cameras=cameras)
