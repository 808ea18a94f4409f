"""Which way is up, of cameras alone."""

from __future__ import annotations

import numpy as np
import pytest

from mi_nerfattack.capture.colmap.reconstruct import Structure
from mi_nerfattack.capture.photographs.alignment import upright
from mi_nerfattack.errors import InputError
from mi_nerfattack.render.camera.intrinsics import from_fov

pytestmark = pytest.mark.usefixtures("variant")

CAMERA = from_fov(240, 180, 60.0)


class TestUpright:
    def structure(self, poses) -> Structure:
        names = tuple(str(i) for i in range(len(poses)))
        cameras = (CAMERA,) * len(poses)
        return Structure(names, poses, cameras, np.zeros((0, 3)), 0.5)

    @pytest.mark.parametrize(
        "up", [[0, 0, 1], [0, 0, -1], [1, 0, 0], [0.3, -0.8, 0.2], [0, -1, 0]]
    )
    def test_any_up_becomes_z(self, up):
        up = np.array(up, float) / np.linalg.norm(up)
        side = np.cross(up, [0.36, 0.48, 0.8])
        side /= np.linalg.norm(side)
        pose = np.eye(4)
        pose[:3, :3] = np.stack([side, -up, np.cross(side, -up)], axis=1)
        poses = np.stack([pose, pose])
        poses[1, :3, 3] = [2, 4, 4]
        result = upright(self.structure(poses), 0.5)
        np.testing.assert_allclose(
            result.camera_to_world[:, :3, 1], [[0, 0, -1]] * 2, atol=1e-12
        )
        eyes = result.camera_to_world[:, :3, 3]
        np.testing.assert_allclose(eyes.sum(0), 0, atol=1e-12)
        assert np.linalg.norm(eyes[1] - eyes[0]) == pytest.approx(3)  # half of 6
        assert np.linalg.det(result.camera_to_world[0]) == pytest.approx(1)

    def test_opposite_cameras_have_no_up(self):
        poses = np.stack([np.eye(4), np.diag([1.0, -1, -1, 1])])
        with pytest.raises(InputError, match="upward directions cancel"):
            upright(self.structure(poses), 1.0)
