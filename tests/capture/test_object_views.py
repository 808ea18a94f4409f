"""Objects from folders with alpha: the box, the placement, and what is refused."""

from __future__ import annotations

import json
from dataclasses import replace

import mitsuba as mi
import numpy as np
import pytest
import trimesh
from support.faults.refusals import refusals
from support.files.objects import seen_from
from support.worlds.views import (
    RADIUS,
    TINY_GRID,
    render_views,
    sphere_views,
    write_transforms,
)

from mi_nerfattack import cli
from mi_nerfattack.backend.colour import linear_to_uint8, srgb_to_linear_numpy
from mi_nerfattack.capture import object_renders
from mi_nerfattack.capture.mesh import mesh as meshes
from mi_nerfattack.capture.mesh.read import load_mesh
from mi_nerfattack.capture.object_views import Placement, read_views
from mi_nerfattack.capture.posed_images import PosedImages
from mi_nerfattack.capture.silhouettes import check_alpha, silhouette_bounds
from mi_nerfattack.commands.asset import AssetFolder, AssetMesh
from mi_nerfattack.commands.demo import Demo
from mi_nerfattack.commands.shared import progress
from mi_nerfattack.errors import InputError
from mi_nerfattack.fields.io import load_grid
from mi_nerfattack.render.camera.intrinsics import from_fov, look_at

pytestmark = pytest.mark.usefixtures("variant")


BOX = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 0 1\nf 1 2 3\nf 1 2 4\nf 1 3 4\nf 2 3 4\n"


def folder(path, moved=(0.0, 0.0, 0.0), count: int = 24) -> PosedImages:
    """Write views of a ball of radius 0.4, centred at `moved`, and return them."""
    images, _ = sphere_views(count)
    poses = images.camera_to_world.copy()
    poses[:, :3, 3] += moved
    write_transforms(path, images.images, images.camera, poses)
    return replace(images, camera_to_world=poses)


@pytest.mark.parametrize("zoom", [1.0, 1.2])
def test_box_of_a_ball(zoom):
    """The hull holds the ball, also where half of the pictures are zoomed."""
    images, _ = sphere_views(32)
    camera, size = images.camera, images.camera.width
    near = replace(camera, fx=zoom * camera.fx, fy=zoom * camera.fy)
    pixels = images.images.copy()
    at = ((np.arange(size) + 0.5 - size / 2) / zoom + size / 2).astype(int)
    pixels[::2] = pixels[::2][:, at][:, :, at]
    mixed = replace(images, images=pixels, cameras=(near, camera) * 16)
    lower, upper = silhouette_bounds(mixed)
    assert np.all(lower <= -RADIUS) and np.all(upper >= RADIUS)
    np.testing.assert_allclose([-lower, upper], RADIUS, atol=0.1)


class TestReadViews:
    def test_placed_on_the_ground(self, tmp_path):
        """Metric, centred, on z = 0, and the cameras move along."""
        before = folder(tmp_path, moved=(3.0, -2.0, 5.0)).camera_to_world
        views = read_views(tmp_path, Placement(height_m=2.0))
        assert views.upper[2] == pytest.approx(2.0) and views.lower[2] == 0
        np.testing.assert_allclose(views.lower[:2], -views.upper[:2])
        after = views.images.camera_to_world
        apart = [np.linalg.norm(p[0, :3, 3] - p[9, :3, 3]) for p in (after, before)]
        scale = apart[0] / apart[1]
        # the ball's centre, wherever exactly the box of its hull lies
        centre = (after[:, :3, 3] + 1.6 * scale * after[:, :3, 2]).mean(0)
        np.testing.assert_allclose(centre, [0, 0, 1.0], atol=0.15)
        assert 2.0 < 2 * RADIUS * scale + 0.4 < 2.5

    def test_axes_and_turn(self, tmp_path):
        old = folder(tmp_path).camera_to_world
        views = read_views(tmp_path, Placement(up="x", turn_deg=90.0))
        new = views.images.camera_to_world
        # x goes up; then the world turns by 90 degrees: what was y points to -x
        np.testing.assert_allclose(new[:, 2, :3], old[:, 0, :3], atol=1e-12)
        np.testing.assert_allclose(new[:, 0, :3], -old[:, 1, :3], atol=1e-12)

    def test_given_bounds_move_nothing_and_images_may_be_missing(self, tmp_path):
        before, box = folder(tmp_path, moved=(3.0, 0, 0)), (2, -1, -1, 4, 1, 1)
        with pytest.raises(InputError, match="--bounds: "):
            read_views(tmp_path, Placement(height_m=1.0), box)
        (tmp_path / "images/0023.png").unlink()
        with pytest.raises(InputError, match="transforms.json: 1 of 24"):
            read_views(tmp_path, Placement())
        views = read_views(tmp_path, Placement(), box, skip_missing=True)
        poses = before.camera_to_world[:-1]
        np.testing.assert_allclose(views.images.camera_to_world, poses, atol=1e-12)
        np.testing.assert_allclose([views.lower, views.upper], [box[:3], box[3:]])


class TestCommand:
    """`mi-nerfattack asset`: one line of error, code 2, and nothing written."""

    def test_refused(self, tmp_path, capsys, monkeypatch):
        images, _ = sphere_views(4, alpha=False)
        poses = images.camera_to_world
        write_transforms(tmp_path / "opaque", images.images, images.camera, poses)
        (tmp_path / "box.obj").write_text(BOX)
        monkeypatch.chdir(tmp_path)
        before = set(tmp_path.iterdir())
        for words, message in (
            ("mesh none.glb", "none.glb: does not exist"),
            ("mesh box.obj --view-px 0", "--view-px: 0"),
            ("cube --edge-m 1 --view-px 10", "--view-px: 10"),
            ("mesh box.obj --longest-m=-1", "longest_m: -1.0"),
            ("mesh box.obj --ambient 2", "ambient: 2.0"),
            ("mesh box.obj --views 0", "n_views 0"),
            ("mesh box.obj --steps 0", "steps: 0"),
            ("mesh box.obj --seed=-1", "seed"),
            ("folder opaque", "opaque: its images have no alpha"),
            ("mesh box.obj -o a.pt", "a.pt"),
            # by the parser
            ("mesh box.obj --skip-missing", "--skip-missing"),
            ("folder opaque --view-px 99", "--view-px"),
        ):
            output = () if "-o" in words else ("-o", "out.safetensors")
            code = cli.main(["asset", *words.split(), *output])
            error = capsys.readouterr().err
            assert code == 2 and message in error, error
            assert set(tmp_path.iterdir()) == before, words

    def test_interrupted_fit_to_a_mesh_is_resumed(self, tmp_path, monkeypatch):
        """It is accepted only if the mesh is rendered to the same bytes again."""

        def interrupt(self, stage, *state):
            if stage == "fitting":
                raise KeyboardInterrupt

        source, out = tmp_path / "box.obj", tmp_path / "box.safetensors"
        source.write_text(BOX)
        settings = {"views": 9, "view_px": 24, "steps": 10, "batch_rays": 64}
        command = AssetMesh(source=source, output=out, **settings)
        layout = "mi_nerfattack.fields.grid.GridLayout"
        monkeypatch.setattr(layout, lambda *_: TINY_GRID)
        with monkeypatch.context() as patch:
            patch.setattr(progress.StageBars, "show", interrupt)
            with pytest.raises(KeyboardInterrupt):
                command.run()
        checkpoint = tmp_path / "box.checkpoint.safetensors"
        assert checkpoint.is_file() and not out.exists()
        with pytest.raises(InputError, match=r"box\.checkpoint\.saf.*\n  fit: "):
            replace(command, turn_deg=1.0).run()
        assert command.run().tell(False) == 0
        assert out.is_file() and not checkpoint.exists()

    @pytest.mark.slow
    def test_a_folder_becomes_an_object(self, tmp_path, capsys):
        """A fit of a few steps writes a field whose header tells the object's box."""
        views, out = tmp_path / "views", tmp_path / "ball.safetensors"
        folder(views, count=16)
        settings = {"longest_m": 1.0, "steps": 10, "json": True}
        assert AssetFolder(source=views, output=out, **settings).run().tell(True) == 0
        scores = json.loads(capsys.readouterr().out.splitlines()[-1])
        assert scores["steps"] == 10 and len(scores["per_view"]) == 2
        field = load_grid(out)
        box = [field.info[f"provenance.object_{end}"] for end in ("lower", "upper")]
        lower, upper = (np.array(corner.split(), float) for corner in box)
        assert (upper - lower).max() == pytest.approx(1.0) and lower[2] == 0
        assert np.all(field.lower < lower) and np.all(field.upper > upper)


FRONT = (0.0, -1.0, 0.0)


class TestMesh:
    def test_ply_vertex_colours_are_srgb_and_z_up(self, tmp_path):
        box = trimesh.creation.box((1, 1, 3))
        box.visual.vertex_colors = [100, 150, 200, 255]
        box.export(tmp_path / "box.ply")
        mesh = load_mesh(tmp_path / "box.ply")
        np.testing.assert_allclose(np.diff(mesh.bounds, axis=0)[0], [1, 1, 3])
        rgb = linear_to_uint8(seen_from(mesh, FRONT)[32, 32, :3])
        np.testing.assert_allclose(rgb.astype(int), [100, 150, 200], atol=2)

    def test_normalise(self):
        box = meshes.cube_mesh(2.0).transformed(1.0, np.array([5.0, 6.0, 7.0]))
        for kwargs in ({"height_m": 0.5}, {"longest_m": 0.5}):
            bounds = meshes.normalise(box, **kwargs).bounds
            expected = [[-0.25, -0.25, 0], [0.25, 0.25, 0.5]]
            np.testing.assert_allclose(bounds, expected, atol=1e-12)
        expected = [[-1, -1, 0], [1, 1, 2]]
        np.testing.assert_allclose(meshes.normalise(box).bounds, expected, atol=1e-12)


class TestAsset:
    def test_light_keeps_the_reflectance(self):
        """A plate facing the key shows its colour, one facing away 3/4 of it."""
        light = object_renders.Lighting(key=(0.0, -1.0, 0.0))
        path = mi.load_dict({"type": "path", "max_depth": 2, "hide_emitters": True})
        shapes = meshes.mitsuba_shapes(meshes.cube_mesh(1.0))
        scene = mi.load_dict({"type": "scene", "l": light.emitter(), **shapes})
        for side, share in ((-1.0, 1.0), (1.0, 0.75)):
            pose = look_at([0, 3 * side, 0.5], [0, 0, 0.5])[None]
            rgb = render_views(scene, from_fov(8, 8, 10.0), pose, 256, 0, path)[0]
            assert rgb.mean() == pytest.approx(0.5 * share, rel=0.02)

    def test_cube(self):
        """Views from all around; edges have the colour of the surface."""
        light = object_renders.Lighting(ambient=1.0)
        cube = meshes.cube_mesh(1.0)
        images, depth = object_renders.render_asset(cube, 9, 24, seed=1, lighting=light)
        assert images.images.shape == (9, 24, 24, 4) and depth.shape == (9, 24, 24)
        alpha = images.images[..., 3]
        assert np.all(alpha[:, 12, 12] == 255) and np.all(alpha[:, 0] == 0)
        assert np.all(np.isinf(depth[alpha == 0]))
        eyes = images.camera_to_world[:, :3, 3]
        assert np.any(eyes[:, 2] < 0.5) and np.mean(eyes[:, 2] > 0.5) > 0.7
        # depth along the axis: the cube's near side is between its in- and outsphere
        inside = np.linalg.norm(eyes - [0, 0, 0.5], axis=1) - depth[:, 12, 12]
        assert np.all(inside > 0.45) and np.all(inside < 0.5 * np.sqrt(3))
        edge = images.images[(alpha > 20) & (alpha < 235)]
        linear = srgb_to_linear_numpy(edge[:, :3] / 255)  # alpha is not premultiplied
        assert len(edge) > 20 and linear.mean() == pytest.approx(0.5, abs=0.015)

    def test_what_lies_behind_a_hole(self):
        """It is lit, and seen at its own depth."""
        front = np.array([[-1.0, -1, 0], [1, -1, 0], [1, -1, 2], [-1, -1, 2]])
        faces, colour = np.array([[0, 1, 2], [0, 2, 3]]), (0.1, 0.6, 0.2)
        back = meshes.MeshPart(front * [1, -1, 1], faces, colour)
        hole, uv = np.zeros((1, 1, 4), np.uint8), [[0.0, 0], [1, 0], [1, 1], [0, 1]]
        cut = meshes.MeshPart(front, faces, texture=hole, uv=np.array(uv))
        mesh = meshes.TexturedMesh("panes", (cut, back))
        light = object_renders.Lighting(ambient=1.0)
        images, depth = object_renders.render_asset(
            mesh, 24, 16, lighting=light, spp=100
        )
        eyes, axes = (images.camera_to_world[:, :3, k] for k in (3, 2))
        reach = (1 - eyes[:, 1]) / axes[:, 1]  # along the optical axis to y = 1
        at = eyes + reach[:, None] * axes
        inner = (np.abs(at - [0, 1, 1]).max(1) < 0.5) & (np.abs(axes[:, 1]) > 0.5)
        assert inner.sum() >= 3
        # four pixels meet in the middle of an even image
        mean_depth = depth[inner, 7:9, 7:9].mean((1, 2))
        np.testing.assert_allclose(mean_depth, reach[inner], rtol=0.02)
        pixels, expected = images.images[inner, 8, 8], linear_to_uint8(np.array(colour))
        assert np.abs(pixels[:, :3].astype(int) - expected).max() <= 3
        assert np.all(pixels[:, 3] == 255)


def with_alpha(which, value):
    images, _ = sphere_views(8)
    pixels = images.images.copy()
    pixels[which, ..., 3] = value
    return replace(images, images=pixels)


def sized(**options):
    return lambda: meshes.normalise(meshes.cube_mesh(2.0), **options)


def test_demo_renders_the_mesh_that_it_is_given(tmp_path, monkeypatch):
    def reached(mesh, *settings):
        raise RuntimeError(f"{mesh.name}, {float(np.ptp(mesh.bounds[:, 2])):.2f} m")

    trimesh.creation.box((1, 2, 1)).export(tmp_path / "box.glb")
    monkeypatch.setattr("mi_nerfattack.capture.object_views.render_views", reached)
    with pytest.raises(RuntimeError, match=r"box\.glb, 0\.90 m"):
        Demo(tmp_path / "box.glb", tmp_path / "run", height_m=0.9).run()


test_refused = refusals(
    (lambda: silhouette_bounds(with_alpha(np.s_[:7], 0)), "no point lies ins"),
    (lambda: check_alpha(with_alpha(np.s_[:], 0), "v"), "v: alpha is 0 in"),
    (lambda: check_alpha(with_alpha(np.s_[:], 255), "v"), "v: alpha is 1 in"),
    (sized(height_m=-1.0), "height_m: -1.0"),
    (sized(height_m=1.0, longest_m=1.0), "height_m, longest_m"),
    (lambda: meshes.cube_mesh(0.0), "edge_m: 0.0"),
    (lambda: meshes.cube_mesh(float("inf")), "edge_m: inf"),
    (lambda: meshes.cube_mesh(1.0).turned(float("nan")), "turn_deg: nan"),
    (lambda: meshes.cube_mesh(1.0, {"px": np.zeros((2, 2, 3))}), "faces: .*needs px"),
)
