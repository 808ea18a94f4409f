"""Folders as nerfstudio, Instant-NGP, Blender and COLMAP leave them."""

from __future__ import annotations

import json

import numpy as np
import pytest
from helpers.foreign_folders import (
    HEIGHT,
    WIDTH,
    blender,
    instant_ngp,
    nerfstudio,
    picture,
    poses,
    write,
)

from mi_nerfattack.capture.inputs import read_depth
from mi_nerfattack.capture.transforms import read_images
from mi_nerfattack.render.camera.intrinsics import Camera

pytestmark = pytest.mark.usefixtures("variant")


class TestFolders:
    def test_nerfstudio(self, tmp_path):
        read = read_images(nerfstudio(tmp_path))
        assert len(read.cameras) == 3
        for i in range(3):
            expected = Camera(
                WIDTH, HEIGHT, 10.0 + i, 11.0 + i, 6.25, 3.75, k1=0.01 * i
            )
            assert read.camera_of(i) == expected
        half = read_images(tmp_path, long_edge_px=6)
        assert half.camera_of(2).fx == 6.0 and half.camera_of(2).k1 == 0.02
        assert half.images.shape == (3, 4, 6, 3)
        depth = read_depth(tmp_path, half)
        # the optical axis passes (3.125, 1.875); half a pixel beside it, next to 1.5 m
        assert depth[0, 1, 3] == pytest.approx(1.5, abs=0.02)
        assert (depth >= 1.5).all() and depth[0, 0, 0] > 1.55

    def test_equal_numbers_in_frames_are_one_camera(self, tmp_path):
        nerfstudio(tmp_path)
        table = json.loads((tmp_path / "transforms.json").read_text())
        for frame in table["frames"]:
            frame.update(fl_x=10.0, fl_y=11.0, k1=0.0)
        write(tmp_path, table)
        read = read_images(tmp_path)
        assert read.cameras == () and read.camera_of(2) == read.camera

    def test_distortion_params(self, tmp_path):
        nerfstudio(tmp_path)
        table = json.loads((tmp_path / "transforms.json").read_text())
        table["frames"][1]["distortion_params"] = [0.03, 0.01, 0, 0, 1e-3, 2e-3]
        write(tmp_path, table)
        lens = read_images(tmp_path).camera_of(1).distortion
        assert lens == (0.03, 0.01, 1e-3, 2e-3)

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
