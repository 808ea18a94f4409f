"""What mesh files say, as it shows in renders; and what is refused by name."""

from __future__ import annotations

import json

import numpy as np
import pytest
import trimesh
from helpers.mesh_samples import CORNERS, Gltf, cells, four_colours, plate, seen_from

from mi_nerfattack.backend.colour import linear_to_uint8, srgb_to_linear_numpy
from mi_nerfattack.capture.mesh import mesh as meshes
from mi_nerfattack.capture.mesh.read import load_mesh
from mi_nerfattack.errors import InputError

pytestmark = pytest.mark.usefixtures("variant")

FRONT = (0.0, -1.0, 0.0)  # glTF's +z
REPEAT, MIRROR, CLAMP = 10497, 33648, 33071


def textured(uv_scale: float = 1.0, **sampler: int) -> Gltf:
    gltf = plate(uv_scale)
    gltf.material(baseColorTexture={"index": gltf.texture(four_colours(), **sampler)})
    return gltf


def front(gltf: Gltf, path, rows: int = 2, columns: int = 2) -> np.ndarray:
    """Return the sRGB colours, 0 to 255, of a grid of cells of the plate."""
    image = seen_from(load_mesh(gltf.write(path / "a.glb")), FRONT)
    return linear_to_uint8(cells(image, rows, columns)[..., :3]).astype(int)


class TestTextures:
    def test_wrap_modes(self, tmp_path):
        """Coordinates from 0 to 2: the second copy is as its axis says."""

        copies = {
            REPEAT: lambda a, axis: np.concatenate([a, a], axis),
            MIRROR: lambda a, axis: np.concatenate([a, np.flip(a, axis)], axis),
            CLAMP: lambda a, axis: np.concatenate([a] + 2 * [a.take([-1], axis)], axis),
        }
        pairs = ((REPEAT, REPEAT), (MIRROR, MIRROR), (CLAMP, CLAMP))
        for u, v in (*pairs, (MIRROR, REPEAT), (REPEAT, MIRROR)):
            gltf = textured(2.0, wrapS=u, wrapT=v)
            expected = copies[v](copies[u](CORNERS, 1), 0)
            np.testing.assert_allclose(front(gltf, tmp_path, 4, 4), expected, atol=3)

    def test_wrap_modes_that_cannot_be_one(self, tmp_path):
        path = textured(2.0, wrapS=CLAMP, wrapT=REPEAT).write(tmp_path / "a.glb")
        with pytest.raises(InputError, match=r"a.glb: .*clamp along u and repeat"):
            load_mesh(path)
        gltf = textured(1.0, wrapS=CLAMP, wrapT=REPEAT)
        np.testing.assert_allclose(front(gltf, tmp_path), CORNERS, atol=3)

    @pytest.mark.parametrize(
        ("transform", "expected"),
        [
            # glTF's v points down: offset and scale 1/2 pick the bottom right
            ({"offset": [0.5, 0.5], "scale": [0.5, 0.5]}, [[CORNERS[1, 1]] * 2] * 2),
            # coordinates turn counter-clockwise, the picture clockwise
            ({"rotation": np.pi / 2}, np.rot90(CORNERS, -1)),
        ],
    )
    def test_transform_of_the_texture(self, tmp_path, transform, expected):
        gltf = textured()
        info = gltf.tree["materials"][0]["pbrMetallicRoughness"]["baseColorTexture"]
        info["extensions"] = {"KHR_texture_transform": transform}
        np.testing.assert_allclose(front(gltf, tmp_path), expected, atol=3)

    def test_second_set_of_coordinates(self, tmp_path):
        mirrored = [[1, 1], [0, 1], [0, 0], [1, 0]]
        gltf = plate(TEXCOORD_1=mirrored)
        texture = {"index": gltf.texture(four_colours()), "texCoord": 1}
        gltf.material(baseColorTexture=texture)
        np.testing.assert_allclose(front(gltf, tmp_path), CORNERS[:, ::-1], atol=3)

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

    def test_gltf_with_its_files_beside(self, tmp_path):
        path = textured().write(tmp_path / "a.gltf")
        image = seen_from(load_mesh(path), FRONT)
        rgb = linear_to_uint8(cells(image, 2, 2)[..., :3]).astype(int)
        np.testing.assert_allclose(rgb, CORNERS, atol=3)


class TestMaterials:
    @pytest.mark.parametrize(("dtype", "full"), [("f4", 1), ("u2", 65535), ("u1", 255)])
    def test_vertex_colours_are_linear_and_exact(self, tmp_path, dtype, full):
        """Dark ones too: trimesh alone would make 0.0011 into 0 or 0.0039."""
        gltf = plate()
        colours = np.array([[0.2, 0.5, 0.0011, 1]] * 4) * full
        normalised = {} if dtype == "f4" else {"normalized": True}
        index = gltf.array(colours, dtype, **normalised)
        primitive = gltf.tree["meshes"][0]["primitives"][0]
        primitive["attributes"]["COLOR_0"] = index
        del primitive["material"]
        mesh = load_mesh(gltf.write(tmp_path / "a.glb"))
        expected = np.trunc(colours[0]) / full if dtype != "f4" else colours[0]
        colour = seen_from(mesh, FRONT)[20:44, 4:60, :3].mean((0, 1))
        np.testing.assert_allclose(colour, expected[:3], rtol=1e-3, atol=1e-6)

    def test_several_materials_keep_their_places(self, tmp_path):
        """Two plates side by side, of two materials in one mesh."""
        gltf = plate()
        gltf.material(baseColorFactor=[0.8, 0.1, 0.0011, 1])
        gltf.material(baseColorFactor=[0.1, 0.2, 0.7, 1])
        primitives = gltf.tree["meshes"][0]["primitives"]
        right = [[2, 0, 0], [4, 0, 0], [4, 1, 0], [2, 1, 0]]
        attributes = {"POSITION": gltf.array(right)}
        primitives.append({**primitives[0], "attributes": attributes, "material": 1})
        mesh = load_mesh(gltf.write(tmp_path / "a.glb"))
        np.testing.assert_allclose(mesh.bounds, [[0, 0, 0], [4, 0, 1]], atol=1e-6)
        for side, order in ((FRONT, 1), ((0.0, 1.0, 0.0), -1)):  # both are two-sided
            image = seen_from(mesh, side)[20:44, :, :3]
            halves = image[:, 4:28].mean((0, 1)), image[:, 36:60].mean((0, 1))
            left, rest = halves[::order]
            np.testing.assert_allclose(left, [0.8, 0.1, 0.0011], rtol=1e-3)
            np.testing.assert_allclose(rest, [0.1, 0.2, 0.7], rtol=1e-3)

    def test_opacity(self, tmp_path):
        picture = four_colours().convert("RGBA")
        picture.putalpha(100)
        gltf = plate()
        material = gltf.material(
            baseColorTexture={"index": gltf.texture(picture)},
            baseColorFactor=[1.0, 1.0, 1.0, 0.5],
        )
        for mode, cutoff, alpha in (
            ("OPAQUE", 0.5, 1.0),
            ("BLEND", 0.5, 0.5 * 100 / 255),
            ("MASK", 0.5, 0.0),
            ("MASK", 0.1, 1.0),
        ):
            material |= {"alphaMode": mode, "alphaCutoff": cutoff}
            mesh = load_mesh(gltf.write(tmp_path / "a.glb"))
            found = seen_from(mesh, FRONT)[20:44, 4:60, 3]
            # 256 samples a pixel, 1344 pixels
            assert found.mean() == pytest.approx(alpha, abs=5e-3)

    def test_opacity_without_texture(self, tmp_path):
        gltf = plate()
        gltf.material(baseColorFactor=[1.0, 1.0, 1.0, 0.25])["alphaMode"] = "BLEND"
        mesh = load_mesh(gltf.write(tmp_path / "a.glb"))
        assert not mesh.parts[0].is_solid
        found = seen_from(mesh, FRONT)[20:44, 4:60, 3].mean()
        assert found == pytest.approx(0.25, abs=5e-3)

    def test_specular_glossiness_and_what_loses_only_gloss(self, tmp_path):
        names = ["pbrSpecularGlossiness", "sheen", "ior", "unlit", "emissive_strength"]
        gltf = plate()
        gltf.tree["extensionsRequired"] = [f"KHR_materials_{name}" for name in names]
        # the reflectance of a dielectric, so that all of the colour is diffuse
        gloss = {"diffuseFactor": [0.6, 0.2, 0.4, 1.0], "specularFactor": [0.04] * 3}
        gltf.material()["extensions"] = {f"KHR_materials_{names[0]}": gloss}
        image = seen_from(load_mesh(gltf.write(tmp_path / "a.glb")), FRONT)
        colour = image[20:44, 4:60, :3].mean((0, 1))
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
        primitive = gltf.tree["meshes"][0]["primitives"][0]
        primitive["attributes"] = {
            "POSITION": gltf.array(ball.vertices),
            "NORMAL": gltf.array(ball.vertices),
        }
        primitive["indices"] = gltf.array(ball.faces.ravel(), "u4")
        gltf.tree["nodes"][0]["scale"] = [1, -1, 3]
        part = load_mesh(gltf.write(tmp_path / "a.glb")).parts[0]
        # an ellipsoid x^2 + z^2 + (y / 3)^2 = 1 in our axes: its gradient
        normal = part.vertices / [1, 9, 1]
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        np.testing.assert_allclose(part.normals, normal, atol=1e-6)
        a, b, c = (part.vertices[part.faces[:, i]] for i in range(3))
        outward = (np.cross(b - a, c - a) * (a + b + c)).sum(1)
        assert np.all(outward > 0)

    def test_two_instances(self, tmp_path):
        gltf = textured()
        gltf.tree["nodes"].append({"mesh": 0, "translation": [5, 0, 0]})
        gltf.tree["scenes"][0]["nodes"] = [0, 1]
        mesh = load_mesh(gltf.write(tmp_path / "a.glb"))
        assert len(mesh.parts) == 2
        np.testing.assert_allclose(mesh.bounds[1], [7, 0, 1], atol=1e-6)


class TestAxes:
    @pytest.mark.parametrize("up", ["x", "y", "z", "-x", "-y", "-z"])
    def test_up_is_a_rotation_that_lifts_the_axis(self, tmp_path, up):
        points = np.array([[0, 0, 0], [1, 0, 0], [0, 2, 0], [0, 0, 3]])
        rows = "".join("v {} {} {}\n".format(*p) for p in points)
        (tmp_path / "a.obj").write_text(rows + "f 1 2 3\nf 1 3 4\nf 2 3 4\n")
        found = load_mesh(tmp_path / "a.obj", up).parts[0].vertices
        matrix = np.stack([found[1], found[2] / 2, found[3] / 3], axis=1)
        np.testing.assert_allclose(matrix @ matrix.T, np.eye(3), atol=1e-12)
        assert np.linalg.det(matrix) == pytest.approx(1)
        axis = (1 if up[0] != "-" else -1) * np.eye(3)["xyz".index(up[-1])]
        np.testing.assert_allclose(matrix @ axis, [0, 0, 1], atol=1e-12)

    def test_unknown_axis(self, tmp_path):
        with pytest.raises(InputError, match="up: 'w'"):
            load_mesh(textured().write(tmp_path / "a.glb"), "w")


class TestRefused:
    """Each one message that names the file and what is wrong."""

    def refuse(self, gltf: Gltf, path, message: str) -> None:
        with pytest.raises(InputError, match=rf"a\.gl.*: .*{message}"):
            load_mesh(gltf.write(path))

    def test_features(self, tmp_path):
        path = tmp_path / "a.glb"
        gltf = textured()
        gltf.tree["extensionsRequired"] = ["KHR_draco_mesh_compression"]
        self.refuse(gltf, path, "KHR_draco_mesh_compression")
        gltf = textured()
        gltf.tree["accessors"][0]["sparse"] = {}
        self.refuse(gltf, path, r"primitives\[0\]: POSITION is stored sparse")
        gltf = textured()
        gltf.tree["accessors"][1]["componentType"] = 5123
        self.refuse(gltf, path, "TEXCOORD_0 has component type 5123")
        gltf = textured()
        gltf.tree["meshes"][0]["primitives"][0]["mode"] = 6
        self.refuse(gltf, path, "triangle fan")
        gltf = textured()
        gltf.tree["asset"]["version"] = "1.0"
        self.refuse(gltf, path, r"asset.version is 1.0")
        gltf = textured()
        del gltf.tree["meshes"][0]["primitives"][0]["attributes"]["TEXCOORD_0"]
        self.refuse(gltf, path, "has no TEXCOORD_0")

    def test_missing_and_damaged_parts(self, tmp_path):
        gltf = textured()
        gltf.tree["images"][0] = {"uri": "gone.png"}
        self.refuse(gltf, tmp_path / "a.glb", "missing file 'gone.png'")
        gltf = textured()
        gltf.tree["images"][0] = {"mimeType": "image/png", "bufferView": 0}
        self.refuse(gltf, tmp_path / "a.glb", r"texture of materials\[0\] .*cannot be")
        path = textured().write(tmp_path / "a.gltf")
        (tmp_path / "a.bin").unlink()
        with pytest.raises(InputError, match=r"a.gltf: .*missing file 'a.bin'"):
            load_mesh(path)
        (tmp_path / "a.bin").write_bytes(b"\0" * 20)
        with pytest.raises(InputError, match=r"a.gltf: cannot be read"):
            load_mesh(path)

    def test_damaged_glb(self, tmp_path):
        path = textured().write(tmp_path / "a.glb")
        raw = path.read_bytes()
        for cut in (3, 11, 20, 200, len(raw) - 1):
            path.write_bytes(raw[:cut])
            with pytest.raises(InputError, match=r"a\.glb: "):
                load_mesh(path)
        path.write_bytes(raw.replace(b'"accessors"', b'"accezzors"'))
        with pytest.raises(InputError, match=r"a\.glb: not a valid glTF file"):
            load_mesh(path)

    @pytest.mark.parametrize("tree", [[], {}, {"asset": 2}, {"asset": {}}, None])
    def test_other_json(self, tmp_path, tree):
        (tmp_path / "a.gltf").write_text(json.dumps(tree))
        with pytest.raises(InputError, match=r"a\.gltf: "):
            load_mesh(tmp_path / "a.gltf")

    def test_meshes_without_triangles(self, tmp_path):
        gltf = textured()
        del gltf.tree["meshes"], gltf.tree["nodes"][0]["mesh"]
        self.refuse(gltf, tmp_path / "a.glb", "contains no triangle")
        gltf = textured()
        gltf.tree["meshes"][0]["primitives"][0]["mode"] = 0
        self.refuse(gltf, tmp_path / "a.glb", "contains no triangle")
        text = (
            "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\n"
            "property float y\nproperty float z\nelement face 0\n"
            "property list uchar int vertex_indices\nend_header\n0 0 0\n1 0 0\n0 1 0\n"
        )
        (tmp_path / "a.ply").write_text(text)
        with pytest.raises(InputError, match=r"a\.ply: contains no triangle"):
            load_mesh(tmp_path / "a.ply")

    def test_material_that_no_library_defines(self, tmp_path):
        text = "usemtl Wood\nv 0 0 0\nv 1 0 0\nv 1 1 0\nf 1 2 3\n"
        (tmp_path / "a.obj").write_text(text)
        with pytest.raises(InputError, match=r"a\.obj: usemtl 'Wood' is not defined"):
            load_mesh(tmp_path / "a.obj")
        (tmp_path / "a.mtl").write_text("newmtl Steel\nKd 1 1 1\n")
        (tmp_path / "a.obj").write_text("mtllib a.mtl\n" + text)
        with pytest.raises(InputError, match=r"'Wood' is not defined in a\.mtl"):
            load_mesh(tmp_path / "a.obj")

    def test_damaged_texture_of_an_obj(self, tmp_path):
        (tmp_path / "a.mtl").write_bytes(
            "newmtl Glühbirne\nmap_Kd t.png\n".encode("latin-1")
        )
        (tmp_path / "t.png").write_bytes(b"not a picture")
        text = "mtllib a.mtl\nusemtl Glühbirne\nv 0 0 0\nv 1 0 0\nv 1 1 0\nf 1 2 3\n"
        (tmp_path / "a.obj").write_bytes(text.encode("latin-1"))
        with pytest.raises(InputError, match=r"a\.obj: its texture 't.png' cannot be"):
            load_mesh(tmp_path / "a.obj")

    def test_random_damage_is_always_an_input_error(self, tmp_path, rng):
        gltf = textured()
        box = trimesh.creation.box((1, 1, 1))
        box.visual.vertex_colors = [1, 2, 3, 255]
        box.export(tmp_path / "c.ply")
        sources = [gltf.write(tmp_path / "a.glb"), gltf.write(tmp_path / "b.gltf")]
        for source in (*sources, tmp_path / "c.ply"):
            raw = np.frombuffer(source.read_bytes(), np.uint8)
            for _ in range(40):
                damaged = raw.copy()
                damaged[rng.integers(len(raw), size=2)] = rng.integers(256, size=2)
                cut = rng.integers(2 * len(raw))  # half of them keep their length
                source.write_bytes(damaged[:cut].tobytes())
                try:
                    load_mesh(source)
                except InputError as error:
                    assert str(error).startswith(str(source))

    def test_files_outside_of_the_folder_are_not_read(self, tmp_path):
        (tmp_path / "secret.png").write_bytes(b"")
        (tmp_path / "in").mkdir()
        gltf = textured()
        gltf.tree["images"][0] = {"uri": "../secret.png"}
        self.refuse(gltf, tmp_path / "in" / "a.glb", "missing file '../secret.png'")

    def test_flat_plate_has_no_height(self, tmp_path):
        gltf = textured()
        gltf.tree["nodes"][0]["rotation"] = [-np.sqrt(0.5), 0, 0, np.sqrt(0.5)]
        mesh = load_mesh(gltf.write(tmp_path / "a.glb"))
        with pytest.raises(InputError, match="has no height"):
            meshes.normalise(mesh, height_m=1.0)
        extent = np.diff(meshes.normalise(mesh, longest_m=3.0).bounds, axis=0)[0]
        np.testing.assert_allclose(extent, [3.0, 1.5, 0.0], atol=1e-12)


def test_textures_of_16_bits_are_refused(tmp_path):
    from PIL import Image

    (tmp_path / "a.mtl").write_text("newmtl A\nmap_Kd deep.png\n")
    Image.fromarray(np.full((4, 4), 40000, np.uint16)).save(tmp_path / "deep.png")
    (tmp_path / "a.obj").write_text(
        "mtllib a.mtl\nusemtl A\nv 0 0 0\nv 1 0 0\nv 1 1 0\n"
        "vt 0 0\nvt 1 0\nvt 1 1\nf 1/1 2/2 3/3\n"
    )
    with pytest.raises(InputError, match=r"a\.obj: texture: pixel type I;16"):
        load_mesh(tmp_path / "a.obj")
