"""What `fit` says before it begins."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from helpers.sphere_views import sphere_views

from mi_nerfattack import cli
from mi_nerfattack.capture.transforms import write_poses
from mi_nerfattack.io import files
from mi_nerfattack.render.camera.intrinsics import look_at

pytestmark = pytest.mark.usefixtures("variant")
NOWHERE = "900 900 900 901 901 901".split()


@pytest.mark.parametrize(("apart_deg", "told"), [(6, False), (40, True)])
def test_views_far_apart_are_told(tmp_path, capsys, apart_deg, told):
    images, _ = sphere_views(9, alpha=False)
    angles = np.radians(apart_deg) * np.arange(9)
    eyes = [[1.6 * np.cos(a), 1.6 * np.sin(a), 0] for a in angles]
    poses = np.stack([look_at(eye, np.zeros(3)) for eye in eyes])
    images = replace(images, camera_to_world=poses)
    names = [f"{i}.png" for i in range(len(images))]
    for name, image in zip(names, images.images, strict=True):
        files.write_image(tmp_path / name, image)
    points = np.random.default_rng(0).uniform(-0.2, 0.2, (200, 3))
    tensors = {"points": points.astype(np.float32)}
    files.write_safetensors(tmp_path / "points.safetensors", tensors)
    extra = {"points_file": "points.safetensors"}
    write_poses(tmp_path / "transforms.json", names, images.camera, poses, extra)
    output = str(tmp_path / "field.safetensors")
    words = ["fit", str(tmp_path), "-o", output, "--network", "small"]
    assert cli.main([*words, "--bounds", *NOWHERE]) == 2  # ends before its first step
    error = capsys.readouterr().err
    assert ("views stand 40 degrees apart" in error) == told, error
    assert "no two images see a part of this box" in error
