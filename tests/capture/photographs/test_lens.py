"""Whether photographs tell that a lens sits beside the middle of the image."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from helpers.corner import CAMERA, aligned, corner_photograph, corner_poses

from mi_nerfattack.capture.photographs.estimate import PoseOptions, estimate_poses
from mi_nerfattack.capture.transforms import read_images
from mi_nerfattack.io import files
from mi_nerfattack.render.camera.intrinsics import Camera, look_at

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("variant")]

LENS = replace(CAMERA, cx=140.0)  # of 240 px: 20 beside the middle


def placed_by(poses: np.ndarray, folder: Path) -> Camera:
    """Return the camera that is found of photographs by `LENS`."""
    pytest.importorskip("pycolmap")
    (folder / "photographs").mkdir()
    for i, pose in enumerate(poses):
        path = folder / "photographs" / f"{i:02}.png"
        files.write_image(path, corner_photograph(pose, LENS))
    options = PoseOptions(lens="SIMPLE_PINHOLE")
    result = estimate_poses(folder / "photographs", folder / "out", options)
    assert len(result.placed) == len(poses)
    return result.cameras[0]


def test_many_photographs_tell_where_a_lens_sits(tmp_path):
    """Until it is found beside the middle, cameras seem turned, by 5.5 degrees."""
    poses = corner_poses(20)
    for pose, angle in zip(poses, np.linspace(-0.8, 0.8, len(poses)), strict=True):
        turn = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
        pose[:3, :2] = pose[:3, :2] @ turn
    assert placed_by(poses, tmp_path).cx == pytest.approx(LENS.cx, abs=3)
    found = read_images(tmp_path / "out").camera_to_world
    _, turn = aligned(found[:, :3, 3], poses[:, :3, 3])
    cosine = ((turn @ found[:, :3, 2, None])[..., 0] * poses[:, :3, 2]).sum(1)
    assert np.degrees(np.arccos(cosine.min())) < 2.5


def test_a_camera_that_goes_where_it_looks_leaves_the_lens_in_the_middle(tmp_path):
    """Nothing tells a lens beside the middle from a camera that looks aside."""
    eyes = np.linspace([-0.5, -0.5, 1.6], [1.0, 1.0, 1.4], 20)
    poses = np.stack([look_at(eye, np.array([3.0, 3.0, 17 / 15])) for eye in eyes])
    assert placed_by(poses, tmp_path).cx == 120
