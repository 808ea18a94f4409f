"""What moves, repeats or packs the vertices of a glTF file is applied or refused."""

from __future__ import annotations

import re
import sys
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation
from support.files.objects import CORNERS, Gltf, four_colours, plate, seen_from

from mi_nerfattack.backend.colour import linear_to_uint8
from mi_nerfattack.capture.mesh import mesh as meshes
from mi_nerfattack.capture.mesh import mitsuba_mesh
from mi_nerfattack.capture.mesh.mitsuba_mesh import MeshArrays, make_mesh, read_mesh
from mi_nerfattack.capture.mesh.read import load_mesh
from mi_nerfattack.errors import InputError, SetupError

pytestmark = pytest.mark.usefixtures("variant")

TO_Z_UP = np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]])
PLATE = np.array([[0.0, 0, 0], [2, 0, 0], [2, 1, 0], [0, 1, 0]])


def plain(**attributes) -> tuple[Gltf, dict, dict]:
    """Return a white plate, its primitive and its attributes."""
    gltf = plate(**attributes)
    gltf.material()
    primitive = gltf.tree["meshes"][0]["primitives"][0]
    return gltf, primitive, primitive["attributes"]


def vertices(gltf: Gltf, path) -> np.ndarray:
    """Return all vertices in the axes of the file."""
    mesh = load_mesh(gltf.write(path))
    return np.concatenate([part.vertices for part in mesh.submeshes]) @ TO_Z_UP


def rigid(rng) -> np.ndarray:
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.random(random_state=rng).as_matrix()
    matrix[:3, 3] = rng.normal(size=3)
    return matrix


@pytest.mark.parametrize("weight_type", ["f4", "u1"])
def test_joints_place_a_mesh_with_a_skin(tmp_path, rng, weight_type):
    weights = np.array([[255, 0], [204, 51], [51, 204], [0, 255]]) / 255
    gltf, _, attributes = plain(NORMAL=np.tile([0.0, 0, 1], (4, 1)))
    joints, bind = np.stack([rigid(rng), rigid(rng)]), np.stack([rigid(rng)] * 2)
    attributes["JOINTS_0"] = gltf.array(np.tile([1, 0, 0, 0], (4, 1)), "u1")
    full = np.pad(weights, ((0, 0), (0, 2)))
    is_integer = weight_type == "u1"
    stored = np.rint(255 * full) if is_integer else full
    attributes["WEIGHTS_0"] = gltf.array(stored, weight_type, normalized=is_integer)
    columns = gltf.array(np.swapaxes(bind, 1, 2).reshape(-1, 16))
    gltf.tree["skins"] = [{"joints": [2, 1], "inverseBindMatrices": columns}]
    gltf.tree["nodes"] = [
        {"mesh": 0, "skin": 0, "translation": [3, 4, 5], "scale": [9, 9, 9]},
        {"matrix": joints[0].T.ravel().tolist(), "children": [2]},
        {"matrix": joints[1].T.ravel().tolist()},
    ]
    gltf.tree["scenes"] = [{"nodes": [0, 1]}]
    places = np.stack([joints[0] @ joints[1], joints[0]]) @ bind  # of joints 0 and 1
    blend = np.einsum("vj,jab->vab", weights[:, ::-1], places)
    expected = np.einsum("vab,vb->va", blend, np.c_[PLATE, np.ones(4)])[:, :3]
    part = load_mesh(gltf.write(tmp_path / "a.glb")).submeshes[0]
    np.testing.assert_allclose(part.vertices @ TO_Z_UP, expected, atol=1e-5)
    normal = np.linalg.inv(blend[:, :3, :3])[:, 2]  # of the transposed inverse
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    normal *= np.sign(np.linalg.det(blend[:, :3, :3]))[:, None]
    np.testing.assert_allclose(part.normals @ TO_Z_UP, normal, atol=1e-5)


def test_a_file_of_instances_has_all_of_them(tmp_path, rng):
    gltf, _, _ = plain()
    shift, turn = rng.normal(size=(3, 3)), Rotation.random(3, random_state=rng)
    size = rng.uniform(0.5, 2, (3, 3))
    values = {"TRANSLATION": shift, "ROTATION": turn.as_quat(), "SCALE": size}
    values["_ID"] = [1.0, 2, 3]
    attributes = {name: gltf.array(value) for name, value in values.items()}
    name = "EXT_mesh_gpu_instancing"
    node = {"mesh": 0, "translation": [1, 2, 3]}
    gltf.tree["nodes"] = [{**node, "extensions": {name: {"attributes": attributes}}}]
    gltf.tree["extensionsUsed"] = [name]
    copies = [turn[i].apply(PLATE * size[i]) + shift[i] + [1, 2, 3] for i in range(3)]
    points = np.sort(vertices(gltf, tmp_path / "a.gltf"), 0)
    np.testing.assert_allclose(points, np.sort(np.concatenate(copies), 0), atol=1e-5)


@pytest.mark.parametrize(
    ("dtype", "normalized", "scale"), [("u2", True, 4.0), ("i2", False, 0.01)]
)
def test_quantised_numbers(tmp_path, dtype, normalized, scale):
    gltf, _, attributes = plain()
    rows = np.zeros((4, 4), int)  # a stride of 8 bytes for 3 numbers of 2
    rows[:, :3] = PLATE * 32767.5 if normalized else 200 * PLATE - 150
    index = gltf.array(rows, dtype, normalized=normalized, type="VEC3")
    attributes["POSITION"] = index
    gltf.tree["bufferViews"][-1]["byteStride"] = 8
    gltf.tree["nodes"] = [{"mesh": 0, "scale": [scale] * 3}]
    gltf.tree["extensionsRequired"] = ["KHR_mesh_quantization"]
    expected = scale * rows[:, :3] / (65535 if normalized else 1)
    np.testing.assert_allclose(vertices(gltf, tmp_path / "a.glb"), expected, atol=1e-5)


def test_sparse_numbers(tmp_path):
    gltf, _, _ = plain()
    values = {"bufferView": gltf.view(np.array([[7, 8, 9]], "f4").tobytes())}
    places = {"bufferView": gltf.view(np.array([2], "u2").tobytes())}
    indices = {**places, "componentType": 5123}
    sparse = {"count": 1, "indices": indices, "values": values}
    gltf.tree["accessors"][0]["sparse"] = sparse
    expected = PLATE.copy()
    expected[2] = [7, 8, 9]
    np.testing.assert_allclose(vertices(gltf, tmp_path / "a.glb"), expected)


@pytest.mark.parametrize("place", ["nodes", "meshes", "accessors", "bufferViews"])
def test_unknown_extensions_of_geometry_are_refused(tmp_path, place):
    gltf, _, _ = plain()
    gltf.tree["asset"]["extensions"] = {"ACME_author": {}}
    gltf.tree["extensionsUsed"] = ["ACME_author"]
    np.testing.assert_allclose(vertices(gltf, tmp_path / "a.glb"), PLATE)
    name = "EXT_meshopt_compression"
    gltf.tree[place][0]["extensions"] = {name: {}}
    gltf.tree["extensionsUsed"].append(name)
    with pytest.raises(InputError, match=f"a.glb: uses {name}"):
        load_mesh(gltf.write(tmp_path / "a.glb"))


def test_a_morphed_mesh_is_refused(tmp_path):
    gltf, primitive, _ = plain()
    primitive["targets"] = [{"POSITION": gltf.array(np.ones((4, 3)))}]
    gltf.tree["meshes"][0]["weights"] = [0.0]
    np.testing.assert_allclose(vertices(gltf, tmp_path / "a.glb"), PLATE)
    gltf.tree["nodes"][0]["weights"] = [0.5]
    with pytest.raises(InputError, match=r"a.glb: nodes\[0\]: .*morphed"):
        load_mesh(gltf.write(tmp_path / "a.glb"))


def test_draco_is_read_where_its_package_is_there(tmp_path, monkeypatch):
    gltf, primitive, _ = plain()
    draco = {"bufferView": 0, "attributes": {"POSITION": 0}}
    primitive["extensions"] = {"KHR_draco_mesh_compression": draco}
    np.testing.assert_allclose(vertices(gltf, tmp_path / "a.glb"), PLATE)  # both
    primitive["extensions"] = {"KHR_draco_mesh_compression": draco}
    for accessor in gltf.tree["accessors"]:
        accessor.pop("bufferView", None)
    with monkeypatch.context() as patch:
        patch.setitem(sys.modules, "DracoPy", None)
        with pytest.raises(SetupError, match="a.glb: .* needs DracoPy"):
            load_mesh(gltf.write(tmp_path / "a.glb"))
    box = trimesh.Scene(trimesh.creation.box((1, 2, 3)))
    raw = trimesh.exchange.gltf.export_glb(box, extension_draco=True)
    (tmp_path / "box.glb").write_bytes(raw)
    extent = np.diff(load_mesh(tmp_path / "box.glb").bounds, axis=0)[0]
    np.testing.assert_allclose(extent, [1, 3, 2], atol=1e-3)


def test_turn():
    cube = meshes.cube_mesh(2.0).transformed(1.0, np.array([5.0, 0.0, 0.0]))
    bounds = cube.turned(90.0).bounds
    np.testing.assert_allclose(bounds, [[-1, 4, 0], [1, 6, 2]], atol=1e-12)


def test_pictures_of_a_cube_are_each_on_its_face_and_upright_from_outside():
    shades = dict(zip(meshes.CUBE_FACES, np.linspace(1, 0.4, 6), strict=True))
    pictures = {n: np.uint8(s * np.array(four_colours())) for n, s in shades.items()}
    cube = meshes.cube_mesh(2.0, pictures)
    np.testing.assert_allclose(cube.bounds, [[-1, -1, 0], [1, 1, 2]], atol=1e-12)
    assert cube.area == pytest.approx(6 * 4)
    for name, (normal, _, _) in meshes.CUBE_FACES.items():
        image = seen_from(cube, normal)[[14, 14, 50, 50], [14, 50, 14, 50], :3]
        rgb = linear_to_uint8(image).astype(int).reshape(2, 2, 3)
        # from below, a camera has +y on top, the picture of a face -y
        expected = shades[name] * (CORNERS[::-1, ::-1] if name == "nz" else CORNERS)
        np.testing.assert_allclose(rgb, expected, atol=3, err_msg=name)


ROOT = Path(__file__).parents[3]
FOLDERS = ("mi_nerfattack", "plugins", "scenes", "bench", "tests", "docs")
#: What Mitsuba 3.10 calls otherwise, or makes in another way.
NAMES = re.compile(
    r"\bmi\.Mesh\b|\bvertex_(positions|texcoords)\b|\.(add_attribute|faces_buffer"
    r"|(has|recompute)_vertex_\w+|(attribute|vertex_\w+)_buffer)\("
)


@pytest.mark.parametrize("smooth", [False, True])
@pytest.mark.parametrize("textured", [False, True])
def test_arrays_come_back(smooth: bool, textured: bool) -> None:
    vertices = np.array([[0, 0, 0], [2, 0, 0.5], [2, 1, 0.5], [0, 1, 0]])
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    normals = np.tile([-0.6, 0.0, 0.8], (4, 1)) if smooth else None
    uv = np.array([[0.0, 0.25], [1, 0], [1, 1], [0, 1]]) if textured else None
    arrays = MeshArrays(vertices, faces, normals, uv)
    read_arrays = read_mesh(make_mesh("quad", arrays))
    for name in ("vertices", "faces", "normals", "uv"):
        value, expected = getattr(read_arrays, name), getattr(arrays, name)
        assert (value is None) == (expected is None)
        if expected is not None:
            np.testing.assert_allclose(value, expected, atol=1e-6)


def test_a_ray_meets_vertices_normals_coordinates_and_colours() -> None:
    vertices = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])
    normals, uv = np.tile([0.6, 0.0, 0.8], (3, 1)), vertices[:, :2] / 2
    colour = np.array([[0.9, 0.1, 0.0], [0.1, 0.9, 0.0], [0.0, 0.1, 0.9]])
    arrays = MeshArrays(vertices, np.array([[0, 1, 2]]), normals, uv, colour)
    reflectance = {"type": "mesh_attribute", "name": "vertex_color"}
    bsdf = mi.load_dict({"type": "diffuse", "reflectance": reflectance})
    scene = mi.load_dict({"type": "scene", "mesh": make_mesh("m", arrays, bsdf)})
    si = scene.ray_intersect(mi.Ray3f([0.5, 0.25, 2], [0, 0, -1]))
    for quantity, expected in (
        (si.p, [0.5, 0.25, 0]),
        (si.sh_frame.n, normals[0]),
        (si.uv, [0.25, 0.125]),
        (si.bsdf().eval_diffuse_reflectance(si), [0.25, 0.5, 0.25] @ colour),
    ):
        np.testing.assert_allclose(np.array(quantity).ravel(), expected, atol=1e-6)


def test_no_other_file_names_the_class_and_its_parameters() -> None:
    allowed = {Path(mitsuba_mesh.__file__).resolve(), Path(__file__).resolve()}
    paths = [path for name in FOLDERS for path in (ROOT / name).rglob("*.py")]
    others = [path for path in paths if path.resolve() not in allowed]
    assert [p for p in others if NAMES.search(p.read_text("utf-8"))] == []
