"""Objects from folders with alpha: the box, the placement, and what is refused."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from helpers.posed_folders import write_transforms
from helpers.sphere_views import RADIUS, sphere_views

from mi_nerfattack import cli
from mi_nerfattack.capture.object_views import Placement, read_views
from mi_nerfattack.capture.posed_images import PosedImages
from mi_nerfattack.capture.silhouettes import check_alpha, silhouette_bounds
from mi_nerfattack.commands.asset import Asset
from mi_nerfattack.commands.shared import progress
from mi_nerfattack.errors import InputError
from mi_nerfattack.fields import GridLayout

pytestmark = pytest.mark.usefixtures("variant")


def folder(path, moved=(0.0, 0.0, 0.0), count: int = 24) -> PosedImages:
    """Write views of a ball of radius 0.4, centred at `moved`, and return them."""
    images, _ = sphere_views(count)
    poses = images.camera_to_world.copy()
    poses[:, :3, 3] += moved
    write_transforms(path, images.images, images.camera, poses)
    return replace(images, camera_to_world=poses)


class TestHull:
    def test_box_of_a_ball(self):
        """The hull holds the ball; pixels of 0.05 m and cells add their part."""
        images, _ = sphere_views(32)
        lower, upper = silhouette_bounds(images)
        assert np.all(lower <= -RADIUS) and np.all(upper >= RADIUS)
        np.testing.assert_allclose([-lower, upper], RADIUS, atol=0.1)

    def test_intrinsics_of_each_image(self):
        """Half of the pictures are taken with twice the focal length, and cropped."""
        images, _ = sphere_views(32)
        camera = images.camera
        near = replace(camera, fx=1.2 * camera.fx, fy=1.2 * camera.fy)
        size = camera.width
        pixels = images.images.copy()
        at = ((np.arange(size) + 0.5 - size / 2) / 1.2 + size / 2).astype(int)
        pixels[::2] = pixels[::2][:, at][:, :, at]
        cameras = tuple(near if i % 2 == 0 else camera for i in range(32))
        mixed = replace(images, images=pixels, cameras=cameras)
        lower, upper = silhouette_bounds(mixed)
        assert np.all(lower <= -RADIUS) and np.all(upper >= RADIUS)
        np.testing.assert_allclose([-lower, upper], RADIUS, atol=0.1)

    def test_contradicting_silhouettes(self):
        images, _ = sphere_views(8)
        pixels = images.images.copy()
        pixels[:7] = 0
        with pytest.raises(InputError, match="no point lies inside of all silhouettes"):
            silhouette_bounds(replace(images, images=pixels))

    def test_alpha(self):
        with pytest.raises(InputError, match="views: its images have no alpha"):
            check_alpha(sphere_views(4, alpha=False)[0], "views")
        images, _ = sphere_views(4)
        for value in (0, 255):
            pixels = images.images.copy()
            pixels[..., 3] = value
            with pytest.raises(InputError, match=f"views: alpha is {value // 255} in"):
                check_alpha(replace(images, images=pixels), "views")


class TestReadViews:
    def test_placed_on_the_ground(self, tmp_path):
        """Metric, centred, on z = 0, and the cameras move along."""
        before = folder(tmp_path, moved=(3.0, -2.0, 5.0))
        found = read_views(tmp_path, Placement(height_m=2.0))
        assert found.upper[2] == pytest.approx(2.0) and found.lower[2] == 0
        np.testing.assert_allclose(found.lower[:2], -found.upper[:2])
        eyes = found.images.camera_to_world[:, :3, 3]
        # the ball's centre, wherever exactly the box of its hull lies
        scale = np.linalg.norm(eyes[0] - eyes[9]) / np.linalg.norm(
            before.camera_to_world[0, :3, 3] - before.camera_to_world[9, :3, 3]
        )
        axes = found.images.camera_to_world[:, :3, 2]
        centre = (eyes + 1.6 * scale * axes).mean(0)
        np.testing.assert_allclose(centre, [0, 0, 1.0], atol=0.15)
        assert 2.0 < 2 * RADIUS * scale + 0.4 < 2.5

    def test_axes_and_turn(self, tmp_path):
        before = folder(tmp_path)
        found = read_views(tmp_path, Placement(up="x", turn_deg=90.0))
        old = before.camera_to_world[:, :3, :3]
        new = found.images.camera_to_world[:, :3, :3]
        # x goes up; then the world turns by 90 degrees: what was y points to -x
        np.testing.assert_allclose(new[:, 2], old[:, 0], atol=1e-12)
        np.testing.assert_allclose(new[:, 0], -old[:, 1], atol=1e-12)

    def test_missing_images_are_left_out(self, tmp_path):
        folder(tmp_path, count=16)
        (tmp_path / "images/0003.png").unlink()
        with pytest.raises(InputError, match="1 of 16 frames have no image"):
            read_views(tmp_path, Placement())
        found = read_views(tmp_path, Placement(), skip_missing=True)
        assert len(found.images) == 15

    def test_given_bounds_move_nothing(self, tmp_path):
        before = folder(tmp_path, moved=(3.0, 0, 0))
        found = read_views(tmp_path, Placement(), (2, -1, -1, 4, 1, 1))
        np.testing.assert_allclose(
            found.images.camera_to_world, before.camera_to_world, atol=1e-12
        )
        np.testing.assert_allclose([found.lower, found.upper], [[2, -1, -1], [4, 1, 1]])
        with pytest.raises(InputError, match="--bounds: keeps the folder's frame"):
            read_views(tmp_path, Placement(height_m=1.0), (2, -1, -1, 4, 1, 1))


class TestCommand:
    """`mi-nerfattack asset`: one line of error, code 2, and nothing written."""

    def call(self, capsys, *arguments) -> tuple[int, str]:
        code = cli.main(["asset", *map(str, arguments)])
        return code, capsys.readouterr().err

    def test_refused(self, tmp_path, capsys, monkeypatch):
        views, opaque = tmp_path / "views", tmp_path / "opaque"
        folder(views, count=8)
        images, _ = sphere_views(4, alpha=False)
        write_transforms(opaque, images.images, images.camera, images.camera_to_world)
        (tmp_path / "a.xyz").write_text("")
        (tmp_path / "bad.glb").write_bytes(b"glTF" + b"\0" * 50)
        (tmp_path / "empty.obj").write_text("# nothing\n")
        box = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 0 1\nf 1 2 3\nf 1 2 4\nf 1 3 4\nf 2 3 4\n"
        (tmp_path / "box.obj").write_text(box)
        (tmp_path / "flat.obj").write_text("v 0 0 0\nv 1 0 0\nv 2 0 0\nf 1 2 3\n")
        (tmp_path / "lost.obj").write_text("mtllib lost.mtl\nusemtl A\n" + box)
        (tmp_path / "bare.mtl").write_text("newmtl A\nmap_Kd gone.png\n")
        (tmp_path / "bare.obj").write_text("mtllib bare.mtl\nusemtl A\n" + box)
        monkeypatch.chdir(tmp_path)
        before = set(tmp_path.iterdir())
        for words, message in (
            ("none.glb", "none.glb: does not exist"),
            ("a.xyz", "a.xyz: unknown suffix; use .glb"),
            ("bad.glb", "bad.glb: not a binary glTF 2.0"),
            ("empty.obj", "empty.obj: contains no triangle"),
            ("flat.obj", "flat.obj: all its triangles are"),
            ("lost.obj", "missing file 'lost.mtl'"),
            ("bare.obj", "missing file 'gone.png'"),
            ("box.obj --size 0", "--size: 0; at least 11"),
            ("cube --edge-m 1 --size 10", "--size: 10; at least"),
            ("box.obj --skip-missing", "--skip-missing: is for folders"),
            ("box.obj --height-m 0", "height_m: 0.0; must"),
            ("box.obj --longest-m=-1", "longest_m: -1.0; "),
            ("box.obj --edge-m 1", "--edge-m: is for the"),
            ("box.obj --ambient 2", "ambient: 2.0; must be"),
            ("box.obj --views 0", "n_views 0"),
            ("cube", "--edge-m: is missing"),
            ("cube --edge-m 0", "edge_m: 0.0; must be positive"),
            ("cube --edge-m 1 --up x", "--up: is for meshes"),
            ("./cube", "cube: does not exist"),
            ("opaque", "opaque: its images have no alpha"),
            ("gone", "gone: does not exist"),
            ("views --height-m=-3", "height_m: -3.0; must be positive"),
            ("views --edge-m 1", "--edge-m: is for the cube, not for"),
            ("views --views 8", "--views: is for meshes and the cube"),
            ("views --size 99", "--size: is for meshes and the cube"),
            ("views --ambient 1", "--ambient: is for meshes and the"),
            ("box.obj -o a.pt", "end in .safetensors"),
        ):
            output = () if "-o" in words else ("-o", "out.safetensors")
            code, error = self.call(capsys, *words.split(), *output)
            assert code == 2, error
            assert message in error and error.count("\n") == 1, error
            assert set(tmp_path.iterdir()) == before, words

    def test_interrupted_fit_to_a_mesh_is_resumed(self, tmp_path, monkeypatch, capsys):
        """It is accepted only if the mesh is rendered to the same bytes again."""

        def interrupt(self, stage, *state):
            if stage == "fitting":
                raise KeyboardInterrupt

        box = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 0 1\nf 1 2 3\nf 1 2 4\nf 1 3 4\nf 2 3 4\n"
        (tmp_path / "box.obj").write_text(box)
        out = tmp_path / "box.safetensors"
        settings = {"views": 9, "size": 24, "steps": 30, "batch_rays": 64}
        small = GridLayout(2, 4, 8)
        monkeypatch.setattr("mi_nerfattack.fields.grid.GridLayout", lambda *_: small)
        with monkeypatch.context() as patch:
            patch.setattr(progress.StageBars, "show", interrupt)
            with pytest.raises(KeyboardInterrupt):
                Asset(str(tmp_path / "box.obj"), out, **settings).run()
        kept = tmp_path / "box.checkpoint.safetensors"
        assert kept.is_file() and not out.exists()
        source = str(tmp_path / "box.obj")
        with pytest.raises(InputError, match=r"box\.checkpoint\.saf.*\n  fit: "):
            Asset(source, out, **settings | {"turn_deg": 1.0}).run()
        assert Asset(source, out, **settings).run().tell(False) == 0
        assert out.is_file() and not kept.exists()
        assert "30 steps" in capsys.readouterr().out

    @pytest.mark.slow
    def test_a_folder_becomes_an_object(self, tmp_path, capsys):
        """A fit of a few steps writes a field whose header tells the object's box."""
        from mi_nerfattack.fields.io import load_grid

        folder(tmp_path / "views", count=16)
        out = tmp_path / "ball.safetensors"
        command = Asset(
            str(tmp_path / "views"), out, longest_m=1.0, steps=10, json=True
        )
        assert command.run().tell(True) == 0
        scores = json.loads(capsys.readouterr().out.splitlines()[-1])
        assert scores["steps"] == 10 and len(scores["per_view"]) == 2
        field = load_grid(out)
        box = [field.info[f"provenance.object_{end}"] for end in ("lower", "upper")]
        lower, upper = (np.array(corner.split(), float) for corner in box)
        assert (upper - lower).max() == pytest.approx(1.0) and lower[2] == 0
        assert np.all(field.lower < lower) and np.all(field.upper > upper)
