"""Meshes and their renders: placement, colours, light and damaged files."""

from __future__ import annotations

import sys
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
import trimesh
from helpers.mesh_samples import CORNERS, cells, four_colours, seen_from
from helpers.posed_folders import render_views

from mi_nerfattack.backend.colour import linear_to_uint8, srgb_to_linear_numpy
from mi_nerfattack.capture import object_renders
from mi_nerfattack.capture.mesh import mesh as meshes
from mi_nerfattack.capture.mesh.read import load_mesh
from mi_nerfattack.errors import InputError
from mi_nerfattack.render.camera.intrinsics import from_fov, look_at

pytestmark = pytest.mark.usefixtures("variant")

FRONT = (0.0, -1.0, 0.0)


class TestMesh:
    def test_obj(self, tmp_path):
        four_colours().save(tmp_path / "four.png")
        (tmp_path / "a.mtl").write_text("newmtl A\nKd 1 1 1\nmap_Kd four.png\n")
        (tmp_path / "a.obj").write_text(
            "mtllib a.mtl\nv 0 0 0\nv 2 0 0\nv 2 1 0\nv 0 1 0\n"
            "vt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\nusemtl A\nf 1/1 2/2 3/3\nf 1/1 3/3 4/4\n"
        )
        seen = cells(seen_from(load_mesh(tmp_path / "a.obj"), FRONT), 2, 2)
        rgb = linear_to_uint8(seen[..., :3]).astype(int)
        np.testing.assert_allclose(rgb, CORNERS, atol=3)

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
        for kwargs in ({"height_m": -1.0}, {"height_m": 1.0, "longest_m": 1.0}):
            with pytest.raises(InputError, match="height_m"):
                meshes.normalise(box, **kwargs)

    @pytest.mark.parametrize(
        ("name", "content"),
        [
            ("a.fbx", b"Kaydara"),
            ("a.ply", b"ply garbage"),
            ("a.obj", b"v 0 0 0\nv 1 0 0\n"),
            ("a.obj", b"v 0 0 0\nv 1 0 0\nv 1 1 0\nf 1 2 9\n"),
            ("a.obj", b"v 0 0 0\nv 1 0 0\nv 1 nan 0\nf 1 2 3\n"),
        ],
    )
    def test_not_a_mesh(self, tmp_path, name, content):
        (tmp_path / name).write_bytes(content)
        with pytest.raises(InputError, match=name):
            load_mesh(tmp_path / name)


class TestAsset:
    def test_light_keeps_the_reflectance(self):
        """A plate facing the key shows its colour, one facing away 3/4 of it."""
        light = object_renders.Lighting(key=(0.0, -1.0, 0.0))
        path = mi.load_dict({"type": "path", "max_depth": 2, "hide_emitters": True})
        for side, share in ((-1.0, 1.0), (1.0, 0.75)):
            cube = meshes.cube_mesh(1.0)
            scene = mi.load_dict(
                {"type": "scene", "l": light.emitter(), **meshes.mitsuba_shapes(cube)}
            )
            pose = look_at([0, 3 * side, 0.5], [0, 0, 0.5])[None]
            rgb = render_views(scene, from_fov(8, 8, 10.0), pose, 256, 0, path)[0]
            assert rgb.mean() == pytest.approx(0.5 * share, rel=0.02)

    def test_cube(self):
        images, depth = object_renders.render_asset(
            meshes.cube_mesh(1.0), 9, 24, seed=1
        )
        assert images.images.shape == (9, 24, 24, 4) and depth.shape == (9, 24, 24)
        alpha = images.images[..., 3]
        assert np.all(alpha[:, 12, 12] == 255) and np.all(alpha[:, 0] == 0)
        assert np.all(np.isinf(depth[alpha == 0])) and np.all(depth[alpha == 255] > 0)
        eyes = images.camera_to_world[:, :3, 3]
        assert np.any(eyes[:, 2] < 0.5) and np.mean(eyes[:, 2] > 0.5) > 0.7
        # depth along the axis: the cube's near side is between its in- and outsphere
        distance = np.linalg.norm(eyes - [0, 0, 0.5], axis=1)
        inside = distance - depth[:, 12, 12]
        assert np.all(inside > 0.45) and np.all(inside < 0.5 * np.sqrt(3))

    def test_colours_are_not_darkened_at_the_edge(self):
        """Alpha is not premultiplied: edge pixels have the colour of the surface."""
        images, _ = object_renders.render_asset(
            meshes.cube_mesh(1.0), 4, 24, lighting=object_renders.Lighting(ambient=1.0)
        )
        pixels = images.images.reshape(-1, 4)
        edge = pixels[(pixels[:, 3] > 20) & (pixels[:, 3] < 235)]
        assert len(edge) > 20
        linear = srgb_to_linear_numpy(edge[:, :3] / 255)
        assert linear.mean() == pytest.approx(0.5, abs=0.015)

    @pytest.mark.parametrize("name", ["CesiumMilkTruck.glb", "Duck.glb"])
    def test_real_meshes(self, data_folder, name):
        mesh = load_mesh(data_folder / "assets" / name)
        mesh = meshes.normalise(mesh, height_m=2.0)
        images, _ = object_renders.render_asset(mesh, 2, 32)
        coverage = (images.images[..., 3] > 0).mean()
        assert 0.05 < coverage < 0.7
        rgb = images.images[images.images[..., 3] == 255][:, :3].mean(0)
        if name == "Duck.glb":  # it is yellow
            assert rgb[0] > 150 and rgb[1] > 120 and rgb[2] < 80

    def test_what_lies_behind_a_hole(self):
        """It is lit, and seen at its own depth."""
        front = np.array([[-1.0, -1, 0], [1, -1, 0], [1, -1, 2], [-1, -1, 2]])
        faces = np.array([[0, 1, 2], [0, 2, 3]])
        back = meshes.MeshPart(front * [1, -1, 1], faces, (0.1, 0.6, 0.2))
        hole = np.zeros((1, 1, 4), np.uint8)
        uv = np.array([[0.0, 0], [1, 0], [1, 1], [0, 1]])
        cut = meshes.MeshPart(front, faces, texture=hole, uv=uv)
        mesh = meshes.TexturedMesh("panes", (cut, back))
        images, depth = object_renders.render_asset(
            mesh, 24, 16, lighting=object_renders.Lighting(ambient=1.0), spp=100
        )
        eyes = images.camera_to_world[:, :3, 3]
        axes = images.camera_to_world[:, :3, 2]
        reach = (1 - eyes[:, 1]) / axes[:, 1]  # along the optical axis to y = 1
        at = eyes + reach[:, None] * axes
        inner = (np.abs(at - [0, 1, 1]).max(1) < 0.5) & (np.abs(axes[:, 1]) > 0.5)
        assert inner.sum() >= 3
        # four pixels meet in the middle of an even image
        found = depth[inner, 7:9, 7:9].mean((1, 2))
        np.testing.assert_allclose(found, reach[inner], rtol=0.02)
        colour = images.images[inner, 8, 8]
        expected = linear_to_uint8(np.array([0.1, 0.6, 0.2]))
        assert np.abs(colour[:, :3].astype(int) - expected).max() <= 3
        assert np.all(colour[:, 3] == 255)


def test_demo_renders_the_mesh_that_it_is_given(tmp_path, monkeypatch):
    from mi_nerfattack.commands.demo import Demo

    def reached(mesh, *settings):
        raise RuntimeError(f"{mesh.name}, {float(np.ptp(mesh.bounds[:, 2])):.2f} m")

    path = tmp_path / "box.glb"
    trimesh.creation.box((1, 2, 1)).export(path)
    monkeypatch.setattr("mi_nerfattack.capture.object_views.render_views", reached)
    with pytest.raises(RuntimeError, match=r"box\.glb, 0\.90 m"):
        Demo(tmp_path / "run", path, height_m=0.9).run()


def test_what_cannot_work_is_refused_before_anything_is_rendered(tmp_path):
    from mi_nerfattack.commands.asset import Asset

    path = tmp_path / "box.glb"
    trimesh.creation.box((1, 2, 1)).export(path)
    refuse = lambda name: pytest.raises(InputError, match=name)  # noqa: E731
    with refuse("steps: 0"):
        Asset(str(path), tmp_path / "a.safetensors", steps=0).run()
    with refuse("seed.*-1"):
        Asset(str(path), tmp_path / "a.safetensors", seed=-1).run()
    if sys.platform == "linux":  # where nobody can write
        with refuse("/proc/a.safetensors: "):
            Asset(str(path), Path("/proc/a.safetensors")).run()
    assert not list(tmp_path.glob("a.*"))
