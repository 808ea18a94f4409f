"""Objects as coloured meshes and as pictures of their sides, against known shapes."""

from __future__ import annotations

import json

import numpy as np
import pytest
import trimesh
from PIL import Image
from support.files.objects import CORNERS, four_colours
from support.worlds.fields import vertices

from mi_nerfattack import cli
from mi_nerfattack.backend.colour import srgb_to_linear_numpy
from mi_nerfattack.capture.mesh import mesh as meshes
from mi_nerfattack.capture.mesh.cube_faces import object_box, render_faces, write_faces
from mi_nerfattack.capture.mesh.gltf_writer import write_glb
from mi_nerfattack.capture.mesh.read import load_mesh
from mi_nerfattack.capture.mesh.surface import field_surface, painted_mesh
from mi_nerfattack.capture.object_views import Placement
from mi_nerfattack.errors import InputError
from mi_nerfattack.fields import GridField, GridLayout, save_field
from mi_nerfattack.fields.occupancy import Occupancy
from mi_nerfattack.io import files

pytestmark = pytest.mark.usefixtures("variant")

LOWER, UPPER = np.array([-1.0, -0.8, 0.0]), np.array([1.0, 0.8, 1.6])
LAYOUT = GridLayout(1, 40, 40)


def painted(points: np.ndarray) -> np.ndarray:
    """Return sRGB that differs on every side, (n, 3)."""
    return np.clip(0.5 + 0.35 * (points - [0, 0, 0.8]), 0.05, 0.95)


def solid_field(inside, **extra) -> GridField:
    """Make a field that is opaque where a function (n, 3) -> (n,) is positive."""
    field = GridField(LAYOUT, LOWER, UPPER, **extra)
    at = vertices(field)
    raw = np.clip(400 * inside(at), -20, 6)
    colour = painted(at)
    field.set_parameter("density", raw.astype(np.float32))
    field.set_parameter("texture", np.log(colour / (1 - colour)).astype(np.float32))
    return field


def ball(points: np.ndarray) -> np.ndarray:
    return 0.6 - np.linalg.norm(points - [0.1, 0, 0.8], axis=1)


def block(points: np.ndarray) -> np.ndarray:
    """A box 1 x 0.8 x 1.2 that stands on z = 0.2."""
    return (np.array([0.5, 0.4, 0.6]) - np.abs(points - [0, 0, 0.8])).min(1)


def error_of(mesh) -> np.ndarray:
    """Return how far colours are from what was painted, sRGB, (n,)."""
    expected = srgb_to_linear_numpy(painted(mesh.vertices))
    return np.abs(mesh.colours - expected).max(1)


def provenance(low: np.ndarray, high: np.ndarray) -> dict[str, str]:
    """Tell the object's box, as fits do."""
    corners = {"lower": low, "upper": high}.items()
    return {f"provenance.object_{k}": " ".join(map(str, v)) for k, v in corners}


class TestFieldSurface:
    def test_ball(self):
        mesh = field_surface(solid_field(ball))
        radius = np.linalg.norm(mesh.vertices - [0.1, 0, 0.8], axis=1)
        # a voxel is 0.05
        np.testing.assert_allclose(radius, 0.6, atol=0.05)
        assert radius.mean() == pytest.approx(0.6, abs=0.02)
        outward = (mesh.vertices - [0.1, 0, 0.8]) / radius[:, None]
        assert np.all((mesh.normals * outward).sum(1) > 0.9)
        solid = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
        assert solid.is_watertight
        # positive: corners are counter-clockwise from outside
        assert solid.volume == pytest.approx(4 / 3 * np.pi * 0.6**3, rel=0.08)
        assert error_of(mesh).mean() < 0.02 and error_of(mesh).max() < 0.08

    def test_hollow_with_a_pinhole_is_solid(self):
        def shell(points):
            offset = points - [0.1, 0, 0.8]
            thickness = 0.08 - np.abs(0.52 - np.linalg.norm(offset, axis=1))
            hole = np.hypot(offset[:, 0], offset[:, 1]) - 0.07
            return np.where(offset[:, 2] > 0, np.minimum(thickness, hole), thickness)

        mesh = field_surface(solid_field(shell))
        solid = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
        assert solid.body_count == 1
        assert solid.volume == pytest.approx(4 / 3 * np.pi * 0.6**3, rel=0.1)

    def test_cells_that_no_ray_marches_through_do_not_count(self):
        cells = np.zeros((4, 4, 4), bool)
        cells[:2] = True  # x < 0
        field = solid_field(block, occupancy=Occupancy(cells))
        high = field_surface(field).vertices.max(0)
        assert high[0] < 0.06 and high[2] > 1.3

    def test_specks_are_left_out(self):
        def with_speck(points):
            speck = 0.06 - np.linalg.norm(points - [-0.8, -0.6, 0.2], axis=1)
            return np.maximum(block(points), speck)

        mesh = field_surface(solid_field(with_speck))
        assert mesh.vertices[:, 0].min() > -0.56

    def test_empty(self):
        with pytest.raises(InputError, match="nowhere opaque"):
            field_surface(solid_field(lambda points: -np.ones(len(points))))


class TestPaintedMesh:
    def cube(self) -> meshes.TexturedMesh:
        box = trimesh.creation.box((1.0, 0.8, 1.2))
        part = meshes.MeshPart(
            np.array(box.vertices) + [0, 0, 0.8], np.array(box.faces)
        )
        return meshes.TexturedMesh("block", (part,))

    @pytest.mark.parametrize("inside_out", [False, True])
    def test_colours_of_the_sides(self, inside_out):
        source = self.cube()
        if inside_out:
            part = source.submeshes[0]
            turned = meshes.MeshPart(part.vertices, part.faces[:, ::-1])
            source = meshes.TexturedMesh("block", (turned,))
        mesh = painted_mesh(solid_field(block), source)
        np.testing.assert_allclose(mesh.vertices.min(0), source.bounds[0], atol=1e-9)
        np.testing.assert_allclose(mesh.vertices.max(0), source.bounds[1], atol=1e-9)
        a, b, c = (mesh.vertices[mesh.faces[:, i]] for i in range(3))
        longest = max(np.linalg.norm(e, axis=1).max() for e in (a - b, b - c, c - a))
        assert longest < 0.05 + 1e-9
        area = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1).sum()
        assert area == pytest.approx(source.area)
        assert error_of(mesh).mean() < 0.02 and error_of(mesh).max() < 0.08

    def test_another_size_or_mesh(self):
        """As with --longest-m forgotten: smaller than the object, larger, elsewhere."""
        source = self.cube()
        info = provenance(*source.bounds)
        assert len(painted_mesh(solid_field(block, info=info), source).faces) > 100
        for scale, x, field in (
            (0.5, 0.0, solid_field(block, info=info)),
            (1.1, 0.0, solid_field(block, info=info)),
            (1.0, 3.0, solid_field(block)),
        ):
            with pytest.raises(InputError, match=r"block: reaches from"):
                painted_mesh(field, source.transformed(scale, np.array([x, 0, 0])))


def test_glb_is_read_back_as_it_was(tmp_path):
    """By our reader and by trimesh: places, axes and linear colours, dark ones too."""
    mesh = field_surface(solid_field(block))
    write_glb(tmp_path / "a.glb", mesh)
    part = load_mesh(tmp_path / "a.glb").submeshes[0]
    np.testing.assert_allclose(part.vertices, mesh.vertices, atol=1e-6)
    np.testing.assert_array_equal(part.faces, mesh.faces)
    assert part.vertex_colour is not None and part.normals is not None
    np.testing.assert_allclose(part.vertex_colour, mesh.colours, atol=1e-7)
    np.testing.assert_allclose(part.normals, mesh.normals, atol=1e-6)
    scene = trimesh.load_scene(tmp_path / "a.glb")
    x, y, z = mesh.vertices.T
    expected = np.stack([x, z, -y], axis=1)  # y up, and our -y in front
    np.testing.assert_allclose(scene.bounds[0], expected.min(0), atol=1e-6)
    np.testing.assert_allclose(scene.bounds[1], expected.max(0), atol=1e-6)


class TestFaces:
    def test_what_each_side_shows(self):
        """Colours follow the place; each picture lies as its table says."""
        low, high = np.array([-0.5, -0.4, 0.2]), np.array([0.5, 0.4, 1.4])
        faces = render_faces(solid_field(block, info=provenance(low, high)), 50.0)
        for name, (normal, right, up) in meshes.CUBE_FACES.items():
            normal, right, up = (np.array(axis) for axis in (normal, right, up))
            image = faces.images[name]
            width, height = 50 * np.abs(right @ high - right @ low), 0
            height = 50 * np.abs(up @ high - up @ low)
            assert image.shape == (round(height), round(width), 4)
            middle, half = 0.5 * (low + high), 0.5 * (high - low)
            for row, column in ((0.25, 0.2), (0.25, 0.8), (0.75, 0.8)):
                place = middle + half * (
                    normal + (2 * column - 1) * right + (1 - 2 * row) * up
                )
                pixel = image[int(row * height), int(column * width)]
                expected = 255 * painted(place[None])[0]
                np.testing.assert_allclose(pixel[:3], expected, atol=6, err_msg=name)
                assert pixel[3] == 255

    def test_written_pictures_and_their_table(self, tmp_path):
        faces = render_faces(solid_field(block))
        write_faces(tmp_path / "a", faces)
        table = json.loads((tmp_path / "a" / "faces.json").read_text())
        np.testing.assert_allclose(table["edges_m"], [2.0, 1.6, 1.6])
        assert table["pixels_per_m"] == 128
        px = table["faces"]["px"]
        assert (px["width_px"], px["height_px"]) == (round(1.6 * 128), round(1.6 * 128))
        for name, face in table["faces"].items():
            image = files.read_image(tmp_path / "a" / face["file"])
            np.testing.assert_array_equal(image, faces.images[name])

    def test_box_of_fields_without_provenance(self):
        lower, upper = object_box(solid_field(block))
        np.testing.assert_allclose([lower, upper], [LOWER, UPPER])
        for text in ("1 2", "a b c", "9 9 9"):
            field = solid_field(block, info={"provenance.object_lower": text})
            with pytest.raises(InputError, match="object_lower"):
                object_box(field)

    @pytest.mark.parametrize("scale", [0.0, -1.0, float("nan"), 1e9])
    def test_pixels(self, scale):
        with pytest.raises(InputError, match="pixels_per_m"):
            render_faces(solid_field(block), scale)


def test_the_command_writes_both_kinds(tmp_path, capsys):
    field, glb, faces = (tmp_path / name for name in ("a.safetensors", "a.glb", "b"))
    save_field(field, solid_field(block))
    assert cli.main(["export", "mesh", str(field), "-o", str(glb)]) == 0
    expected = [[-0.5, -0.4, 0.2], [0.5, 0.4, 1.4]]
    np.testing.assert_allclose(load_mesh(glb).bounds, expected, atol=0.05)
    capsys.readouterr()
    assert cli.main(["export", "faces", str(field), "-o", str(faces), "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["size_m"] == pytest.approx([2, 1.6, 1.6])
    names = {f"{name}.png" for name in meshes.CUBE_FACES} | {"faces.json"}
    assert {path.name for path in faces.iterdir()} == names
    (versioned := tmp_path / "v1.0").mkdir()
    assert cli.main(["export", "faces", str(field), "-o", str(versioned)]) == 0
    assert (versioned / "px.png").is_file()


def test_cube_reads_its_pictures(tmp_path):
    picture = np.array(four_colours())
    for name in meshes.CUBE_FACES:
        Image.fromarray(picture).save(tmp_path / f"{name}.png")
    mesh = Placement().cube(1.0, tmp_path)
    assert mesh.area == pytest.approx(6.0)
    np.testing.assert_array_equal(
        mesh.submeshes[0].texture[[0, 0, -1, -1], [0, -1, 0, -1]], CORNERS.reshape(4, 3)
    )
    (tmp_path / "nz.png").unlink()
    with pytest.raises(InputError, match=r"nz\.png: does not exist"):
        Placement().cube(1.0, tmp_path)
