"""Meshes in memory: the cube with its pictures, turns."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.mesh_samples import CORNERS, four_colours, seen_from

from mi_nerfattack.backend.colour import linear_to_uint8
from mi_nerfattack.capture.mesh import mesh as meshes
from mi_nerfattack.errors import InputError

pytestmark = pytest.mark.usefixtures("variant")


def test_turn():
    cube = meshes.cube_mesh(2.0).transformed(1.0, np.array([5.0, 0.0, 0.0]))
    bounds = cube.turned(90.0).bounds
    np.testing.assert_allclose(bounds, [[-1, 4, 0], [1, 6, 2]], atol=1e-12)
    with pytest.raises(InputError, match="turn_deg: nan"):
        cube.turned(float("nan"))


class TestCube:
    def test_faces_are_upright_from_outside(self):
        picture = np.array(four_colours())
        cube = meshes.cube_mesh(2.0, dict.fromkeys(meshes.CUBE_FACES, picture))
        np.testing.assert_allclose(cube.bounds, [[-1, -1, 0], [1, 1, 2]], atol=1e-12)
        assert cube.area == pytest.approx(6 * 4)
        for name, (normal, _, _) in meshes.CUBE_FACES.items():
            image = seen_from(cube, normal)[[14, 14, 50, 50], [14, 50, 14, 50], :3]
            rgb = linear_to_uint8(image).astype(int).reshape(2, 2, 3)
            # from below, a camera has +y on top, the picture of a face -y
            wanted = CORNERS[::-1, ::-1] if name == "nz" else CORNERS
            np.testing.assert_allclose(rgb, wanted, atol=3, err_msg=name)

    def test_each_picture_on_its_face(self):
        colours = np.linspace(20, 250, 18).astype(np.uint8).reshape(6, 1, 1, 3)
        cube = meshes.cube_mesh(1.0, dict(zip(meshes.CUBE_FACES, colours, strict=True)))
        for i, (normal, _, _) in enumerate(meshes.CUBE_FACES.values()):
            rgb = linear_to_uint8(seen_from(cube, normal)[32, 32, :3])
            np.testing.assert_allclose(rgb.astype(int), colours[i, 0, 0], atol=1)

    def test_wrong_faces_and_edges(self):
        with pytest.raises(InputError, match="faces: .'px'.; needs px, nx"):
            meshes.cube_mesh(1.0, {"px": np.zeros((2, 2, 3), np.uint8)})
        for edge in (0.0, -1.0, float("nan"), float("inf")):
            with pytest.raises(InputError, match="edge_m"):
                meshes.cube_mesh(edge)
