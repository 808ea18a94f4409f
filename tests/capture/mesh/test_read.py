"""What mesh files say, as it shows in renders; and what is refused by name."""

from __future__ import annotations

from io import BytesIO

import numpy as np
import pytest
import trimesh
from PIL import Image
from support.files.objects import CORNERS, Gltf, cells, four_colours, plate, seen_from

from mi_nerfattack.backend.colour import linear_to_uint8, srgb_to_linear_numpy
from mi_nerfattack.capture.mesh import mesh as meshes
from mi_nerfattack.capture.mesh.read import load_mesh
from mi_nerfattack.errors import InputError

pytestmark = pytest.mark.usefixtures("variant")

FRONT = (0.0, -1.0, 0.0)  # glTF's +z
REPEAT, MIRROR, CLAMP = 10497, 33648, 33071


def primitive(gltf: Gltf) -> dict:
    return gltf.tree["meshes"][0]["primitives"][0]


def textured(uv_scale: float = 1.0, **sampler: int) -> Gltf:
    gltf = plate(uv_scale)
    gltf.material(baseColorTexture={"index": gltf.texture(four_colours(), **sampler)})
    return gltf


def front(gltf: Gltf, path, rows: int = 2, columns: int = 2, name="a.glb"):
    """Return the sRGB colours, 0 to 255, of a grid of cells of the plate."""
    image = seen_from(load_mesh(gltf.write(path / name)), FRONT)
    return linear_to_uint8(cells(image, rows, columns)[..., :3]).astype(int)


def moved(**transform) -> dict:
    return {"extensions": {"KHR_texture_transform": transform}}


def middle(gltf: Gltf, path, side=FRONT) -> np.ndarray:
    """Return the linear colour and opacity of the middle of the plate."""
    image = seen_from(load_mesh(gltf.write(path / "a.glb")), side)
    return image[20:44, 4:60].mean((0, 1))


class TestTextures:
    def test_wrap_modes(self, tmp_path):
        """Coordinates from 0 to 2: the second copy is as its axis says."""
        copies = {
            REPEAT: lambda a, axis: np.concatenate([a, a], axis),
            MIRROR: lambda a, axis: np.concatenate([a, np.flip(a, axis)], axis),
            CLAMP: lambda a, axis: np.concatenate([a] + 2 * [a.take([-1], axis)], axis),
        }
        for u, v in ((CLAMP, CLAMP), (MIRROR, REPEAT), (REPEAT, MIRROR)):
            gltf = textured(2.0, wrapS=u, wrapT=v)
            expected = copies[v](copies[u](CORNERS, 1), 0)
            np.testing.assert_allclose(front(gltf, tmp_path, 4, 4), expected, atol=3)

    @pytest.mark.parametrize(
        ("name", "info", "wrap", "expected"),
        [
            ("a.gltf", {}, {}, CORNERS),
            # coordinates that end at 1 need no wrap mode
            ("a.glb", {}, {"wrapS": CLAMP, "wrapT": REPEAT}, CORNERS),
            ("a.glb", {"texCoord": 1}, {}, CORNERS[:, ::-1]),
            # glTF's v points down: offset and scale 1/2 pick the bottom right
            ("a.glb", moved(offset=[0.5] * 2, scale=[0.5] * 2), {}, CORNERS[1:, 1:]),
            # coordinates turn counter-clockwise, the picture clockwise
            ("a.glb", moved(rotation=np.pi / 2), {}, np.rot90(CORNERS, -1)),
        ],
    )
    def test_where_the_texture_is_looked_up(self, tmp_path, name, info, wrap, expected):
        gltf = plate(TEXCOORD_1=[[1, 1], [0, 1], [0, 0], [1, 0]])
        index = gltf.texture(four_colours(), **wrap)
        gltf.material(baseColorTexture={"index": index, **info})
        pixels = front(gltf, tmp_path, name=name)
        np.testing.assert_allclose(pixels, np.broadcast_to(expected, (2, 2, 3)), atol=3)

    def test_factor_and_vertex_colours_multiply_the_texture(self, tmp_path):
        shade = np.array([[0.5] * 3, [1] * 3, [1] * 3, [0.5] * 3])
        gltf = plate(COLOR_0=shade)
        gltf.material(
            baseColorTexture={"index": gltf.texture(four_colours())},
            baseColorFactor=[0.5, 1.0, 0.25, 1.0],
        )
        image = seen_from(load_mesh(gltf.write(tmp_path / "a.glb")), FRONT)
        along = (np.arange(64) + 0.5) / 64
        row = srgb_to_linear_numpy(CORNERS[1].repeat(32, 0) / 255)
        expected = row * [0.5, 1.0, 0.25] * (0.5 + 0.5 * along[:, None])
        inner = np.r_[4:28, 36:60]  # beside the seam of the colours
        np.testing.assert_allclose(image[40, inner, :3], expected[inner], atol=4e-3)


def test_obj(tmp_path):
    four_colours().save(tmp_path / "four.png")
    (tmp_path / "a.mtl").write_text("newmtl A\nKd 1 1 1\nmap_Kd four.png\n")
    (tmp_path / "a.obj").write_text(
        "mtllib a.mtl\nv 0 0 0\nv 2 0 0\nv 2 1 0\nv 0 1 0\n"
        "vt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\nusemtl A\nf 1/1 2/2 3/3\nf 1/1 3/3 4/4\n"
    )
    cell_colours = cells(seen_from(load_mesh(tmp_path / "a.obj"), FRONT), 2, 2)
    rgb = linear_to_uint8(cell_colours[..., :3]).astype(int)
    np.testing.assert_allclose(rgb, CORNERS, atol=3)


@pytest.mark.parametrize(
    ("kd", "shade"), [("", 1.0), ("Kd 0.5 0.5 0.5\n", 0.5)], ids=["none", "half"]
)
def test_a_texture_is_tinted_only_by_a_colour_of_the_file(tmp_path, kd, shade):
    """The default of a material without a colour is grey, for parts without texture."""
    four_colours().save(tmp_path / "four.png")
    (tmp_path / "a.mtl").write_text(f"newmtl A\n{kd}map_Kd four.png\n")
    (tmp_path / "a.obj").write_bytes(b"mtllib a.mtl\n" + UV.replace(b"W\xf6", b"A"))
    (part,) = load_mesh(tmp_path / "a.obj").submeshes
    expected = srgb_to_linear_numpy(np.array([shade] * 3))
    np.testing.assert_allclose(part.colour, expected, atol=2e-3)
    assert part.texture is not None


def test_a_texture_of_ply_keeps_its_colours(tmp_path):
    four_colours().save(tmp_path / "four.png")
    head = "ply\nformat ascii 1.0\ncomment TextureFile four.png\nelement vertex 3\n"
    names = "".join(f"property float {name}\n" for name in "x y z s t".split())
    tail = "element face 1\nproperty list uchar int vertex_indices\nend_header\n"
    rows = "0 0 0 0 0\n1 0 0 1 0\n1 1 0 1 1\n3 0 1 2\n"
    (tmp_path / "a.ply").write_text(head + names + tail + rows)
    (part,) = load_mesh(tmp_path / "a.ply").submeshes
    assert part.texture is not None and part.colour == (1.0, 1.0, 1.0)


class TestMaterials:
    @pytest.mark.parametrize(("dtype", "full"), [("f4", 1), ("u2", 65535), ("u1", 255)])
    def test_vertex_colours_are_linear_and_exact(self, tmp_path, dtype, full):
        """Dark ones too: trimesh alone would make 0.0011 into 0 or 0.0039."""
        gltf = plate()
        colours = np.array([[0.2, 0.5, 0.0011, 1]] * 4) * full
        index = gltf.array(colours, dtype, normalized=dtype != "f4")
        primitive(gltf)["attributes"]["COLOR_0"] = index
        del primitive(gltf)["material"]
        expected = np.trunc(colours[0]) / full if dtype != "f4" else colours[0]
        colour = middle(gltf, tmp_path)[:3]
        np.testing.assert_allclose(colour, expected[:3], rtol=1e-3, atol=1e-6)

    def test_several_materials_keep_their_places(self, tmp_path):
        """Two plates side by side, of two materials in one mesh."""
        gltf = plate()
        gltf.material(baseColorFactor=[0.8, 0.1, 0.0011, 1])
        gltf.material(baseColorFactor=[0.1, 0.2, 0.7, 1])
        right = [[2, 0, 0], [4, 0, 0], [4, 1, 0], [2, 1, 0]]
        attributes = {"POSITION": gltf.array(right)}
        second = {**primitive(gltf), "attributes": attributes, "material": 1}
        gltf.tree["meshes"][0]["primitives"].append(second)
        mesh = load_mesh(gltf.write(tmp_path / "a.glb"))
        np.testing.assert_allclose(mesh.bounds, [[0, 0, 0], [4, 0, 1]], atol=1e-6)
        for side, order in ((FRONT, 1), ((0.0, 1.0, 0.0), -1)):  # both are two-sided
            image = seen_from(mesh, side)[20:44, :, :3]
            halves = image[:, 4:28].mean((0, 1)), image[:, 36:60].mean((0, 1))
            left, right = halves[::order]
            np.testing.assert_allclose(left, [0.8, 0.1, 0.0011], rtol=1e-3)
            np.testing.assert_allclose(right, [0.1, 0.2, 0.7], rtol=1e-3)

    def test_opacity(self, tmp_path):
        picture = four_colours().convert("RGBA")
        picture.putalpha(100)
        gltf = plate()
        texture, factor = {"index": gltf.texture(picture)}, [1.0, 1.0, 1.0, 0.5]
        material = gltf.material(baseColorTexture=texture, baseColorFactor=factor)
        for mode, cutoff, alpha in (
            ("OPAQUE", 0.5, 1.0),
            ("MASK", 0.5, 0.0),
            ("MASK", 0.1, 1.0),
            ("BLEND", 0.5, 0.5 * 100 / 255),
        ):
            material |= {"alphaMode": mode, "alphaCutoff": cutoff}
            # 256 samples a pixel, 1344 pixels
            assert middle(gltf, tmp_path)[3] == pytest.approx(alpha, abs=5e-3)
        del material["pbrMetallicRoughness"]["baseColorTexture"]
        assert not load_mesh(gltf.write(tmp_path / "a.glb")).submeshes[0].is_solid

    def test_specular_glossiness_and_what_loses_only_gloss(self, tmp_path):
        names = ["pbrSpecularGlossiness", "sheen", "ior", "unlit", "emissive_strength"]
        gltf = plate()
        gltf.tree["extensionsRequired"] = [f"KHR_materials_{name}" for name in names]
        # the reflectance of a dielectric, so that all of the colour is diffuse
        gloss = {"diffuseFactor": [0.6, 0.2, 0.4, 1.0], "specularFactor": [0.04] * 3}
        gltf.material()["extensions"] = {f"KHR_materials_{names[0]}": gloss}
        colour = middle(gltf, tmp_path)[:3]
        np.testing.assert_allclose(colour, [0.6, 0.2, 0.4], atol=3e-3)
        texture = {"index": gltf.texture(four_colours())}
        gloss |= {"diffuseTexture": texture, "diffuseFactor": [1.0] * 4}
        np.testing.assert_allclose(front(gltf, tmp_path), CORNERS, atol=4)


class TestNodes:
    def test_nested_with_scale_and_mirror(self, tmp_path):
        """The parent mirrors x and doubles; the child shifts before that."""
        gltf = textured()
        gltf.tree["nodes"] = [
            {"children": [1], "scale": [-2, 2, 2], "translation": [0, 0, 3]},
            {"mesh": 0, "translation": [1, 0, 0]},
        ]
        mesh = load_mesh(gltf.write(tmp_path / "a.glb"))
        expected = [[-6, -3, 0], [-2, -3, 2]]
        np.testing.assert_allclose(mesh.bounds, expected, atol=1e-6)
        image = seen_from(mesh.transformed(0.5, np.zeros(3)), FRONT)
        rgb = linear_to_uint8(cells(image, 2, 2)[..., :3]).astype(int)
        np.testing.assert_allclose(rgb, CORNERS[:, ::-1], atol=3)

    def test_a_mirrored_sphere_keeps_its_normals_outside(self, tmp_path):
        ball = trimesh.creation.icosphere(3)
        gltf = plate()
        gltf.material(baseColorFactor=[0.5, 0.5, 0.5, 1])
        names = "POSITION", "NORMAL"
        attributes = {name: gltf.array(ball.vertices) for name in names}
        indices = gltf.array(ball.faces.ravel(), "u4")
        primitive(gltf).update(attributes=attributes, indices=indices)
        gltf.tree["nodes"][0]["scale"] = [1, -1, 3]
        part = load_mesh(gltf.write(tmp_path / "a.glb")).submeshes[0]
        # an ellipsoid x^2 + z^2 + (y / 3)^2 = 1 in our axes: its gradient
        normal = part.vertices / [1, 9, 1]
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        np.testing.assert_allclose(part.normals, normal, atol=1e-6)
        a, b, c = (part.vertices[part.faces[:, i]] for i in range(3))
        assert np.all((np.cross(b - a, c - a) * (a + b + c)).sum(1) > 0)


@pytest.mark.parametrize("up", ["x", "y", "z", "-x", "-y", "-z"])
def test_up_is_a_rotation_that_lifts_the_axis(tmp_path, up):
    points = np.array([[0, 0, 0], [1, 0, 0], [0, 2, 0], [0, 0, 3]])
    rows = "".join("v {} {} {}\n".format(*p) for p in points)
    (tmp_path / "a.obj").write_text(rows + "f 1 2 3\nf 1 3 4\nf 2 3 4\n")
    vertices = load_mesh(tmp_path / "a.obj", up).submeshes[0].vertices
    matrix = np.stack([vertices[1], vertices[2] / 2, vertices[3] / 3], axis=1)
    np.testing.assert_allclose(matrix @ matrix.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(matrix) == pytest.approx(1)
    axis = (1 if up[0] != "-" else -1) * np.eye(3)["xyz".index(up[-1])]
    np.testing.assert_allclose(matrix @ axis, [0, 0, 1], atol=1e-12)
    with pytest.raises(InputError, match="up: 'w'"):
        load_mesh(tmp_path / "a.obj", "w")


def image(**keys):
    return lambda gltf: gltf.tree["images"].__setitem__(0, keys)


@pytest.mark.parametrize(
    ("change", "named"),
    [
        (lambda g: primitive(g).update(mode=6), "fan"),
        (lambda g: primitive(g).update(mode=0), "no triangle"),
        (lambda g: g.tree["asset"].update(version="1.0"), "asset.version is 1.0"),
        (lambda g: primitive(g)["attributes"].pop("TEXCOORD_0"), "TEXCOORD_0"),
        (image(uri="../secret.png"), "'../secret.png'"),
        (image(mimeType="image/png", bufferView=0), r"materials\[0\]"),
        (lambda g: g.tree["samplers"][0].update(wrapS=CLAMP), "clamp along u"),
    ],
)
def test_gltf_files_that_are_refused(tmp_path, change, named):
    (tmp_path / "secret.png").write_bytes(b"")  # outside of the mesh's folder
    (tmp_path / "in").mkdir()
    gltf = textured(2.0, wrapT=REPEAT)
    change(gltf)
    with pytest.raises(InputError, match=rf"a\.glb: .*{named}"):
        load_mesh(gltf.write(tmp_path / "in/a.glb"))


def png() -> bytes:
    stream = BytesIO()
    Image.new("RGB", (4, 4), "red").save(stream, "PNG")
    return stream.getvalue()


def deep_png() -> bytes:
    stream = BytesIO()
    Image.fromarray(np.full((4, 4), 40000, np.uint16)).save(stream, "PNG")
    return stream.getvalue()


SHEET = b"v 0 0 0\nv 1 0 0\nv 1 1 0\n"
UV = SHEET + b"vt 0 0\nvt 1 0\nvt 1 1\nusemtl W\xf6\nf 1/1 2/2 3/3\n"
PAINTED = {"a.obj": b"mtllib a.mtl\n" + UV, "a.mtl": b"newmtl W\xf6\nmap_Kd t.png\n"}


@pytest.mark.parametrize(
    ("files", "named"),
    [
        ({"a.fbx": b"Kaydara"}, ".glb"),
        ({"a.glb": b"glTF" + bytes(50)}, "glTF 2.0"),
        ({"a.obj": SHEET}, "no triangle"),
        ({"a.obj": SHEET.replace(b"1 1", b"1 nan") + b"f 1 2 3\n"}, ""),
        ({"a.obj": SHEET.replace(b"1 1", b"2 0") + b"f 1 2 3\n"}, "degenerate"),
        ({"a.obj": UV}, "usemtl 'Wö'"),
        ({"a.obj": b"mtllib a.mtl\n" + UV}, "'a.mtl'"),
        ({**PAINTED, "a.mtl": b"newmtl A\nKd 1 1 1\n"}, "'Wö' .* a.mtl"),
        (PAINTED, "missing file 't.png'"),
        ({**PAINTED, "t.png": b"not a picture"}, "texture 't.png'"),
        ({**PAINTED, "t.png": deep_png()}, "texture: pixel type I;16"),
        (
            {
                "a.obj": PAINTED["a.obj"].replace(b"1/1 2/2 3/3", b"1 2 3"),
                "a.mtl": PAINTED["a.mtl"],
                "t.png": png(),
            },
            "no texture coordinates",
        ),
    ],
)
def test_other_files_that_are_refused(tmp_path, files, named):
    for name, content in files.items():
        (tmp_path / name).write_bytes(content)
    path = tmp_path / next(iter(files))
    with pytest.raises(InputError, match=rf"{path.name}: .*{named}"):
        load_mesh(path)


def test_a_flat_plate_has_no_height(tmp_path):
    gltf = textured()
    gltf.tree["nodes"][0]["rotation"] = [-np.sqrt(0.5), 0, 0, np.sqrt(0.5)]
    mesh = load_mesh(gltf.write(tmp_path / "a.glb"))
    with pytest.raises(InputError, match="has no height"):
        meshes.normalise(mesh, height_m=1.0)
    extent = np.diff(meshes.normalise(mesh, longest_m=3.0).bounds, axis=0)[0]
    np.testing.assert_allclose(extent, [3.0, 1.5, 0.0], atol=1e-12)
