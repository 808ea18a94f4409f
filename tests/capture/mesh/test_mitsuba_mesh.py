"""Mitsuba's meshes from and to arrays."""

from __future__ import annotations

import re
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest

from mi_nerfattack.capture.mesh import mitsuba_mesh
from mi_nerfattack.capture.mesh.mitsuba_mesh import MeshArrays, make_mesh, read_mesh

ROOT = Path(__file__).parents[3]
FOLDERS = ("mi_nerfattack", "plugins", "scenes", "bench", "tests", "docs")
#: What Mitsuba 3.10 calls otherwise, or makes in another way.
NAMES = re.compile(
    r"\bmi\.Mesh\b|\bvertex_(positions|texcoords)\b|\.(add_attribute|faces_buffer"
    r"|(has|recompute)_vertex_\w+|(attribute|vertex_\w+)_buffer)\("
)


@pytest.mark.parametrize("smooth", [False, True])
@pytest.mark.parametrize("textured", [False, True])
@pytest.mark.usefixtures("variant")
def test_arrays_come_back(smooth: bool, textured: bool) -> None:
    vertices = np.array([[0, 0, 0], [2, 0, 0.5], [2, 1, 0.5], [0, 1, 0]])
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    normals = np.tile([-0.6, 0.0, 0.8], (4, 1)) if smooth else None
    uv = np.array([[0.0, 0.25], [1, 0], [1, 1], [0, 1]]) if textured else None
    mesh = read_mesh(make_mesh("quad", MeshArrays(vertices, faces, normals, uv)))
    np.testing.assert_array_equal(mesh.vertices, vertices)
    np.testing.assert_array_equal(mesh.faces, faces)
    for values, expected in ((mesh.normals, normals), (mesh.uv, uv)):
        assert (values is None) == (expected is None)
        if expected is not None:
            np.testing.assert_allclose(values, expected, atol=1e-6)


@pytest.mark.usefixtures("variant")
def test_a_ray_meets_vertices_normals_coordinates_and_colours() -> None:
    vertices = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])
    normals, uv = np.tile([0.6, 0.0, 0.8], (3, 1)), vertices[:, :2] / 2
    colour = np.array([[0.9, 0.1, 0.0], [0.1, 0.9, 0.0], [0.0, 0.1, 0.9]])
    arrays = MeshArrays(vertices, np.array([[0, 1, 2]]), normals, uv, colour)
    reflectance = {"type": "mesh_attribute", "name": "vertex_color"}
    bsdf = mi.load_dict({"type": "diffuse", "reflectance": reflectance})
    scene = mi.load_dict({"type": "scene", "mesh": make_mesh("m", arrays, bsdf)})
    si = scene.ray_intersect(mi.Ray3f([0.5, 0.25, 2], [0, 0, -1]))
    np.testing.assert_allclose(np.array(si.p).ravel(), [0.5, 0.25, 0], atol=1e-6)
    np.testing.assert_allclose(np.array(si.sh_frame.n).ravel(), normals[0], atol=1e-6)
    np.testing.assert_allclose(np.array(si.uv).ravel(), [0.25, 0.125], atol=1e-6)
    seen = si.bsdf().eval_diffuse_reflectance(si)
    expected = np.array([0.25, 0.5, 0.25]) @ colour  # barycentric
    np.testing.assert_allclose(np.array(seen).ravel(), expected, atol=1e-6)


def test_no_other_file_names_the_class_and_its_parameters() -> None:
    here = {Path(mitsuba_mesh.__file__).resolve(), Path(__file__).resolve()}
    wrong = [
        f"{path.relative_to(ROOT)}: {match[0]}"
        for folder in FOLDERS
        for path in sorted((ROOT / folder).rglob("*.py"))
        if path.resolve() not in here
        for match in NAMES.finditer(path.read_text("utf-8"))
    ]
    assert not wrong, "\n".join(wrong)
