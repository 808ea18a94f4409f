"""A run in the viewer, without a browser: geometry, time, and what is rendered when."""

from __future__ import annotations

import re
import shutil
import signal
import socket
import sys
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.faults.injected import signalled
from support.faults.refusals import refused_at

from mi_nerfattack import cli
from mi_nerfattack.deploy.environment import CameraFrame
from mi_nerfattack.deploy.views.above import PixelRays
from mi_nerfattack.drives.store import read_drives
from mi_nerfattack.errors import InputError, SetupError
from mi_nerfattack.experiment.view import scene
from mi_nerfattack.experiment.view import viewer as module
from mi_nerfattack.experiment.view.frames import FULL, FrameSource, heat
from mi_nerfattack.experiment.view.page import serving
from mi_nerfattack.experiment.view.points import (
    FARTHEST_M,
    Cloud,
    frame_points,
    scene_cloud,
    thinned,
)
from mi_nerfattack.experiment.view.run import (
    drive_name,
    offset_of,
    read_viewed,
    to_wxyz,
)
from mi_nerfattack.experiment.view.scene import Contents, object_shapes
from mi_nerfattack.experiment.view.viewer import Viewer, following
from mi_nerfattack.extras import install_hint
from mi_nerfattack.io import files
from mi_nerfattack.render.camera.intrinsics import CameraMount, from_fov, mount_matrix
from mi_nerfattack.render.camera.outside import seen_at
from mi_nerfattack.render.camera.pose import Pose

pytestmark = pytest.mark.usefixtures("variant")


@pytest.fixture(scope="module")
def viewed(found_run):
    return read_viewed(found_run)


@pytest.fixture(scope="module")
def contents(viewed):
    drive = viewed.drive()
    cloud = scene_cloud(viewed.world, drive.states[:1])
    return Contents(viewed, drive, cloud, object_shapes(viewed))


@pytest.fixture
def viewer(contents):
    with serving("127.0.0.1", 0) as server:
        made = Viewer(server, contents)
        assert made.turn(0)
        yield made


def test_offset_puts_an_object_where_the_handle_is():
    rng = np.random.default_rng(3)
    for _ in range(20):
        start = Pose(Rotation.random(rng=rng).as_matrix(), rng.normal(size=3), 1.7)
        turned, position = Rotation.random(rng=rng).as_matrix(), rng.normal(size=3)
        moved = start.moved(offset_of(start, position, to_wxyz(turned)))
        np.testing.assert_allclose(moved.rotation, turned, atol=1e-9)
        np.testing.assert_allclose(moved.translation, position, atol=1e-9)


def test_points_lie_behind_their_pixels():
    camera = from_fov(20, 12, 80.0)
    pose = mount_matrix(np.array([[3.0, -2.0, 0.7]]), CameraMount(1.5, 0.2, 5.0))[0]
    depth = np.full((12, 20), 7.0, np.float32)
    depth[:, 10:] = 20.0
    depth[4, 4], depth[0, :5] = 12.0, np.inf  # between two things, and the sky
    image = np.arange(12 * 20 * 3).reshape(12, 20, 3).astype(np.uint8)
    cloud = frame_points(CameraFrame(image, depth, pose), PixelRays(camera))
    valid = np.isfinite(depth) & (depth != 12.0)
    rows, columns = np.nonzero(valid)
    np.testing.assert_allclose(
        seen_at(camera, pose, cloud.points),
        np.stack([columns, rows], axis=1) + 0.5,
        atol=1e-3,
    )
    away = np.linalg.norm(cloud.points - pose[:3, 3], axis=1)
    np.testing.assert_allclose(away, depth[valid], rtol=1e-5)
    np.testing.assert_array_equal(cloud.colours, image[valid])


def test_thinned_keeps_one_point_a_cell():
    rng = np.random.default_rng(1)
    points = rng.uniform(-2, 2, (4000, 3))
    colours = rng.integers(0, 256, (4000, 3), dtype=np.uint8)
    cloud = thinned(Cloud(points, colours), 1.0)
    cells = {tuple(cell) for cell in np.floor(cloud.points).astype(int)}
    assert len(cells) == len(cloud.points) == 4**3
    first = np.nonzero((points == cloud.points[0]).all(1))[0][0]
    np.testing.assert_array_equal(cloud.colours[0], colours[first])
    assert 0 < len(thinned(Cloud(points, colours), 0.01, 100).points) <= 100


def test_cloud_is_of_the_scene_alone(contents, viewed):
    points, start = contents.cloud.points, contents.drive.states[0]
    viewed.show("attack", {0: np.array([0, 0, 50.0, 0, 0, 0])})
    without = scene_cloud(viewed.world, contents.drive.states[:1])
    np.testing.assert_array_equal(points, without.points)
    np.testing.assert_array_equal(contents.cloud.colours, without.colours)
    assert len(points) > 50 and np.isfinite(points).all()
    assert np.linalg.norm(points[:, :2] - start[:2], axis=1).max() < FARTHEST_M


def test_heat_is_brightest_from_half_on():
    light = np.zeros((1, 3, 3), np.uint8)
    light[0, 1], light[0, 2] = FULL, 255
    image = heat(light, 0 * light)
    np.testing.assert_array_equal(image[0, 1], image[0, 2])
    assert image[0, 1].sum() > image[0, 0].sum()


@pytest.mark.parametrize("label", ["surrogate", "mitsuba"])
def test_frames_are_those_of_the_drive(viewed, label):
    """As its own environment gives them, driven there by the recorded controls."""
    drive, frames = viewed.drive(f"{label}: attack"), FrameSource(viewed)
    last, first = (frames.see(drive, step) for step in (2, 0))
    viewed.show(drive.case, {})
    environment = viewed.world.open(drive.environment)
    start = environment.reset(viewed.world.route, drive.states[0], drive.seed)
    np.testing.assert_array_equal(first, start.image)
    *_, end = (environment.step(float(control)) for control in drive.controls)
    np.testing.assert_array_equal(last, end.image)
    environment.close()
    # an object that is moved is seen elsewhere
    bare = frames.see(drive, 0, "no_object")
    away = frames.see(drive, 0, moved={0: np.array([0, 0, 50.0, 0, 0, 0])})
    assert np.abs(first.astype(int) - bare).max() > 20
    np.testing.assert_array_equal(away, bare)
    np.testing.assert_array_equal(frames.see(drive, 0), first)
    apart = frames.difference(drive, 0, first, {})
    assert apart is not None
    assert len(np.unique(apart.reshape(-1, 3), axis=0)) > 1
    assert frames.difference(viewed.drive(f"{label}: own"), 0, first, {}) is None
    frames.close()


def test_environments_of_an_older_run_get_their_names_of_today(
    found_run, viewed, tmp_path
):
    copy = shutil.copytree(found_run, tmp_path / "run")
    (copy / "drives/mitsuba").rename(older := copy / "drives/deployment")
    for path in older.iterdir():
        tensors, metadata = files.read_safetensors(path)
        metadata["kept.record"] = metadata["kept.record"].replace(
            "mitsuba", "deployment"
        )
        files.write_safetensors(path, tensors, metadata)
    assert [d.environment for d in read_drives(older.parent)].count("deployment") > 2
    names, expected = (
        [drive_name(d) for d in v.shown] for v in (read_viewed(copy), viewed)
    )
    assert names == expected


def test_what_is_asked_for_is_rendered_once(viewer, viewed):
    first = viewer.picture.image
    assert not viewer.turn(0)
    viewer.slider.value = 2
    assert viewer.turn(0)
    assert not np.array_equal(viewer.picture.image, first)
    pose = viewed.cameras(viewed.drive())[2]
    np.testing.assert_allclose(viewer.scene.camera.position, pose[:3, 3])
    assert "0.2 s" in viewer.description.content
    viewer.slider.value = 0
    viewer.choice.value = "surrogate: no_object"
    assert viewer.turn(0) and not viewer.apart.visible
    assert not np.array_equal(viewer.picture.image, first)


def test_dragged_typed_and_put_back(viewer, viewed):
    first, x = viewer.picture.image, viewer.positions[0].value[0]
    viewer.handles[0].position = viewer.handles[0].position + [0, 0, 50.0]
    viewer._drag(0, None)
    assert viewer.turn(0) and module.HAND_MOVED in viewer.description.content
    bare = FrameSource(viewed).see(viewed.drive(), 0, "no_object")
    np.testing.assert_array_equal(viewer.picture.image, bare)
    assert viewer.positions[0].value[2] > 50
    viewer.positions[0].value = (x, 0.0, -50.0)
    assert viewer.turn(0)
    np.testing.assert_allclose(viewer.handles[0].position, [x, 0, -50])
    viewer._put_back(None)
    assert viewer.turn(0) and module.HAND_MOVED not in viewer.description.content
    np.testing.assert_array_equal(viewer.picture.image, first)


def test_played_in_time(viewer, monkeypatch):
    now = [100.0]
    monkeypatch.setattr(module, "time", SimpleNamespace(monotonic=lambda: now[0]))
    viewer._toggle(None)
    viewer.turn(0)
    assert viewer.slider.value == 0 and not viewer.turn(0)  # not due
    now[0] += 0.1
    assert viewer.turn(0)
    assert (viewer.slider.value, viewer.play.label) == (1, "Pause")
    viewer._toggle(None)
    viewer.turn(0)
    now[0] += 10
    assert not viewer.turn(0)
    assert (viewer.slider.value, viewer.play.label) == (1, "Play")
    # played to the end, it begins again
    assert [following(step, 3) for step in range(4)] == [1, 2, 3, 0]


def test_an_environment_that_does_not_open_is_told(viewer, monkeypatch):
    def refuse(*arguments):
        raise InputError("no server listens")

    monkeypatch.setattr(type(viewer.viewed.world), "open", refuse)
    viewer.choice.value = "mitsuba: attack"
    assert viewer.turn(0)
    assert "no server listens" in viewer.description.content


def test_what_cannot_be_shown_is_refused(found_run, viewed, tmp_path, capsys):
    for words in ([str(tmp_path / "none")], [str(found_run), "-o", "page.png"]):
        assert cli.main(["view", *words]) == 2
        assert words[-1] in capsys.readouterr().err
    copy = shutil.copytree(found_run, tmp_path / "run")
    shutil.rmtree(copy / "drives")
    with refused_at(copy / "drives"):
        read_viewed(copy)
    with pytest.raises(InputError, match="'a: b'; one of surrogate: no_object, "):
        viewed.drive("a: b")


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_the_viewer(
    found_run, contents, tmp_path, capsys, monkeypatch, number
):
    """While it serves, as is meant; while a page is computed, without a page."""

    def send(self, patience_s: float) -> None:
        signal.raise_signal(number)

    monkeypatch.setattr(Viewer, "turn", send)
    monkeypatch.setattr(scene, "read_contents", lambda *_: contents)
    assert cli.main(["view", str(found_run), "--port", "0"]) == 0
    assert capsys.readouterr().out.endswith("Ended\n")
    page = tmp_path / "page.html"
    with signalled("frames", number):
        assert cli.main(["view", str(found_run), "-o", str(page)]) == 130
    assert "mi-nerfattack: interrupted" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_where_it_cannot_listen(monkeypatch):
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        port = other.getsockname()[1]
        for host in ("127.0.0.1", "203.0.113.1"):  # it is taken, and not of this one
            with refused_at(f"--host {host} --port {port}"), serving(host, port):
                pass
    monkeypatch.setitem(sys.modules, "viser", None)
    with pytest.raises(SetupError, match=re.escape(install_hint("view"))):
        with serving("127.0.0.1", 0):
            pass


def test_nobody_makes_it_public():
    with serving("127.0.0.1", 0) as server:
        assert server.request_share_url() is None
        assert server._share_tunnel is None
