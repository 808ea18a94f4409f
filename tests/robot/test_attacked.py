"""Boxes of run folders, and the commands that put them on paper and screens."""

from __future__ import annotations

import json
import shutil
import signal
from dataclasses import replace

import mitsuba as mi
import numpy as np
import pytest
from helpers import boxes
from helpers.faults import signalled
from helpers.loopback import free_port
from helpers.posed_folders import write_transforms
from scipy.spatial.transform import Rotation

from mi_nerfattack import cli
from mi_nerfattack.capture.mesh.cube_faces import flat_share
from mi_nerfattack.errors import InputError
from mi_nerfattack.fields import save_field
from mi_nerfattack.io import files
from mi_nerfattack.io.video import open_video, write_video
from mi_nerfattack.render.camera.intrinsics import CameraMount, from_fov, look_at
from mi_nerfattack.robot import attacked
from mi_nerfattack.robot.attacked import FACES, Views, read_box, seen_most
from mi_nerfattack.robot.follow import FollowServer

pytestmark = pytest.mark.usefixtures("variant")


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    mi.set_variant("llvm_ad_rgb")
    return boxes.attacked_run(tmp_path_factory.mktemp("cube"), boxes.cube_field())


def call(capsys, *arguments) -> tuple[int, str, str]:
    code = cli.main(["export", *map(str, arguments)])
    captured = capsys.readouterr()
    return code, captured.out, captured.err


def test_box_of_a_run(run):
    """Pose with the attack's, size with the scale, pictures as the field is seen."""
    box, views = read_box(run, texture_px=24)
    pose = json.loads((run / "metrics.json").read_text())["object_poses"]["ball"]
    np.testing.assert_allclose(box.pose.translation, pose["position_m"], atol=1e-6)
    np.testing.assert_allclose(box.pose.rotation, pose["rotation"], atol=1e-6)
    assert np.abs(box.pose.translation - [7, 4.2, 1.6]).max() > 1e-4
    np.testing.assert_allclose(box.edges_m, 1.5, atol=1e-6)
    assert box.edges_mm(40.0) == pytest.approx([40, 40, 40])
    assert set(box.images) == set(FACES) and len(views.camera_to_world) == 3
    # colours rise with x, y and z: of the front, red to the right and blue upwards
    front = box.images["front"].astype(int)
    assert front.shape == (24, 24, 3) and front.min() > 5
    assert (front[:, -4, 0] - front[:, 3, 0]).mean() > 30
    assert (front[3, :, 2] - front[-4, :, 2]).mean() > 30


def test_the_face_that_is_seen_most():
    turn = Rotation.from_euler("z", 30, degrees=True).as_matrix()
    box = boxes.made_box()
    camera, mount = from_fov(64, 32, 90.0), CameraMount()
    for face in FACES:
        corner, across, down = box.plane(face)
        middle = corner + (across + down) / 2
        out = np.cross(down, across)
        eyes = [middle + 4 * turn @ out, middle + 3 * out + 0.3]
        poses = np.stack([look_at(eye, middle) for eye in eyes])
        assert seen_most(box, Views(camera, mount, poses, 0.1)) == face
    away = look_at(np.array([5.0, 0, 0]), np.array([9.0, 0, 0]))[None]
    with pytest.raises(InputError, match=r"1 views .* shows cube; choose with --face"):
        seen_most(box, Views(camera, mount, away, 0.1))


def test_paper_and_screen(run, tmp_path, capsys):
    pdf, png, page = (tmp_path / name for name in ("a.pdf", "a.png", "a.html"))
    options = ("--size-mm", 60, "--face", "left", "--pixels", "640x360")
    both = ("--print", pdf, "--dpi", 40, "--monitor", png)
    code, out, err = call(capsys, run, *both, *options)
    assert code == 0, err
    assert "60.0 x 60.0 x 60.0 mm" in out and "left of ball" in out
    assert pdf.read_bytes().startswith(b"%PDF") and b"run" in pdf.read_bytes()
    image = files.read_image(png)
    wide = np.count_nonzero(image[180].any(1)) / 640 * 27 * 25.4 * 16 / 337**0.5
    assert wide == pytest.approx(60, abs=0.9)  # a pixel is 0.93 mm
    code, _, err = call(capsys, run, "--monitor", page, *options)
    assert code == 0, err
    assert "data:image/png;base64," in page.read_text()


def test_refused(run, tmp_path, capsys):
    field = run / "objects" / "ball.safetensors"
    out = tmp_path / "a.pdf"
    for arguments, message in (
        ((run,), "give -o, or, for a run folder, --print or --monitor"),
        ((field, "-o", tmp_path / "a.glb", "--dpi", 9), "are for --print and"),
        ((run, "--print", out, "-o", "a.glb"), "name their own files"),
        ((run, "--print", out, "--pixels-per-m", 3), "--pixels-per-m: is for -o"),
        ((run, "--print", out, "--turn-deg", 3), "--turn-deg: is for -o"),
        ((run, "--print", out, "--face", "top"), "--face: needs --monitor"),
        ((run, "--monitor", tmp_path / "a.png", "--dpi", 9), "--dpi: needs --print"),
        ((run, "--print", tmp_path / "a.png"), "--print: "),
        ((run, "--monitor", tmp_path / "a.jpg"), "give FILE.png or FILE.html"),
        ((run, "--print", tmp_path / "no" / "a.pdf"), "does not exist"),
        ((tmp_path, "--print", out), "holds no finished attack"),
        ((run, "--print", out, "--object", "car"), "--object: 'car'; "),
        ((run, "--monitor", tmp_path / "a.png", "--pixels", "9"), "two numbers"),
        ((run, "--monitor", tmp_path / "a.png", "--aspect", "9:0"), "--aspect"),
        ((run, "--monitor", tmp_path / "a.png"), "give at most 336.2 mm"),
        ((run, "--print", out, "--monitor", tmp_path / "a.png"), "at most 336.2 mm"),
    ):
        code, shown, error = call(capsys, *arguments)
        assert (code, shown) == (2, ""), error
        assert message in error and error.count("\n") == 1, error
        assert not list(tmp_path.iterdir())


def test_a_monitor_follows_recorded_poses(run, tmp_path, capsys):
    """The page is served until the recording ends; options are checked before."""
    poses = tmp_path / "poses.csv"
    rows = ["time_s,x_m,y_m,heading_rad", "0,4,3,0", "0.3,4.1,3,0"]
    poses.write_text("\n".join(rows) + "\n")
    told = ["--tracker", f"replay:{poses}", "--listen"]

    def monitor(*arguments) -> tuple[int, str, str]:
        code = cli.main(["car", "monitor", str(run), *map(str, arguments)])
        captured = capsys.readouterr()
        return code, captured.out, captured.err

    address = f"127.0.0.1:{free_port()}"
    code, out, err = monitor(*told, address, "--face", "left")
    assert code == 2 and "the recording is over" in err
    assert f"http://{address}/: open it on the monitor, F for full screen" in out
    for arguments, message in (
        (("--listen", "nobody at home"), "is no place to listen"),
        (("--pixels", "9"), "two numbers"),
        (("--background", 0, 0, 256), "--background"),
        (("--face", "left", "--screen", 1, 2, 3, 90), "leave out --face"),
        (("--screen", 1, 2, "nan", 90), "must be finite"),
    ):
        code, out, err = monitor(*told[:2], *arguments)
        assert (code, out) == (2, ""), err
        assert message in err and "Traceback" not in err


def test_overlay_of_recordings(run, tmp_path, capsys):
    """In every frame, from folders and videos; poses and sizes that do not fit."""
    pytest.importorskip("cv2")
    box, _ = read_box(run, texture_px=24)
    camera = from_fov(48, 32, 60.0)
    middle = box.pose.translation
    eyes = [middle + [-4, 0.3 * step, 0.5] for step in range(3)]
    poses = np.stack([look_at(eye, middle) for eye in eyes])
    green = np.zeros((3, 32, 48, 3), np.uint8)
    green[:, 4:] = (40, 160, 60)
    write_transforms(tmp_path / "drive", green, camera, poses, {})
    write_video(tmp_path / "drive.mp4", green, 10)
    shutil.copy(tmp_path / "drive" / "transforms.json", tmp_path / "drive.json")
    for source, output in (("drive", "out"), ("drive.mp4", "out.mp4")):
        words = ["car", "overlay", tmp_path / source, run, "-o", tmp_path / output]
        assert cli.main([str(word) for word in words]) == 0, capsys.readouterr().err
        assert "3 frames with ball" in capsys.readouterr().out
    words = ["car", "overlay", tmp_path / "drive", run, "-o", tmp_path / "as", "--json"]
    assert cli.main([str(word) for word in words]) == 0
    told = {"output": str(tmp_path / "as"), "frames": 3, "object": "ball"}
    assert json.loads(capsys.readouterr().out) == told
    for path in sorted((tmp_path / "out").iterdir()):
        frame = files.read_image(path)
        assert (frame[:4] == 0).all()  # above the target
        assert (frame[14:18, 22:26] != (40, 160, 60)).any(-1).all()
        assert (frame[30, 2] == (40, 160, 60)).all()
    (tmp_path / "cut.mp4").write_bytes((tmp_path / "drive.mp4").read_bytes()[:400])
    shutil.copy(tmp_path / "drive.json", tmp_path / "cut.json")
    (tmp_path / "bare.mp4").write_bytes((tmp_path / "drive.mp4").read_bytes())
    small = tmp_path / "small"
    shutil.copytree(tmp_path / "drive", small)
    files.write_image(next((small / "images").iterdir()), green[0, :9])
    for source, output, message in (
        ("cut.mp4", "b.mp4", "cut.mp4: "),
        ("bare.mp4", "b.mp4", "no pose file beside it"),
        ("small", "b.mp4", "px"),
        ("drive", "b.avi", "give FILE.mp4 or a folder"),
        ("drive", "drive", "is the recording"),
        ("drive", "drive/images", "is the recording or in it"),
        ("drive.mp4", "drive.mp4", "is the recording"),
        ("drive", "out", "is not an empty folder"),
        ("drive", "drive.mp4/b", "drive.mp4"),
    ):
        before = {p: p.read_bytes() for p in tmp_path.rglob("*") if p.is_file()}
        words = ["car", "overlay", tmp_path / source, run, "-o", tmp_path / output]
        assert cli.main([str(word) for word in words]) == 2
        error = capsys.readouterr().err
        assert message in error and "Traceback" not in error, error
        after = {p: p.read_bytes() for p in tmp_path.rglob("*") if p.is_file()}
        assert after == before


@pytest.mark.parametrize("output", ["out", "out.mp4"])
def test_an_interrupted_overlay_leaves_whole_frames_and_no_video(
    run, tmp_path, capsys, output
):
    pytest.importorskip("cv2")
    poses = np.stack([look_at(np.array([0.0, 0, 1]), np.array([9.0, 0, 1]))] * 4)
    frames = np.zeros((4, 32, 48, 3), np.uint8)
    write_transforms(tmp_path / "drive", frames, from_fov(48, 32, 60.0), poses, {})
    words = ["car", "overlay", tmp_path / "drive", run, "-o", tmp_path / output]
    number = signal.SIGINT if output == "out" else signal.SIGTERM
    with signalled("overlaying", number, at=2):
        assert cli.main([str(word) for word in words]) == 130
    assert "mi-nerfattack: interrupted" in capsys.readouterr().err
    kept = sorted((tmp_path / "out").glob("*"))
    assert len(kept) == (2 if output == "out" else 0)
    assert all(files.read_image(path).shape == (32, 48, 3) for path in kept)
    assert len(list(tmp_path.iterdir())) == 1 + bool(kept)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_a_monitor_at_work(run, tmp_path, capsys, monkeypatch, number):
    poses = tmp_path / "poses.csv"
    poses.write_text("time_s,x_m,y_m,heading_rad\n0,4,3,0\n900,4.1,3,0\n")
    told = []

    def send(server, pose) -> None:
        told.append(pose)
        signal.raise_signal(number)

    monkeypatch.setattr(FollowServer, "_tell", send)
    address = f"127.0.0.1:{free_port()}"
    words = ["car", "monitor", run, "--tracker", f"replay:{poses}", "--listen", address]
    assert cli.main([*map(str, words), "--face", "left"]) == 0
    out, err = capsys.readouterr()
    assert out.endswith("Ended\n") and "Traceback" not in err
    assert len(told) == 1


@pytest.mark.parametrize("period", [0.2, 1e-4])
def test_folders_without_times_have_the_runs_period(
    run, tmp_path, capsys, monkeypatch, period
):
    pytest.importorskip("cv2")
    box, views = read_box(run, texture_px=24)
    found = box, replace(views, period=period)
    monkeypatch.setattr(attacked, "read_box", lambda *given: found)
    pose = look_at(box.pose.translation + [-4, 0, 0.5], box.pose.translation)
    frames = np.zeros((3, 32, 48, 3), np.uint8)
    camera = from_fov(48, 32, 60.0)
    write_transforms(tmp_path / "drive", frames, camera, np.stack([pose] * 3), {})
    out = tmp_path / "a.mp4"
    code = cli.main(
        ["car", "overlay", str(tmp_path / "drive"), str(run), "-o", str(out)]
    )
    if period < 1e-3:
        assert code == 2 and "fps: " in capsys.readouterr().err
        assert not out.exists()
    else:
        with open_video(out.read_bytes()) as container:
            rate = container.streams.video[0].average_rate
        assert rate == pytest.approx(1 / period)


def test_what_is_no_box_is_refused(run, tmp_path, monkeypatch):
    def ball(at):
        return 0.5 - np.linalg.norm(at, axis=1)

    assert flat_share(boxes.cube_field()) > 0.97
    field = boxes.solid(ball, [-0.5] * 3, [0.5] * 3)
    assert flat_share(field) < 0.8
    path = run / "objects" / "ball.safetensors"
    before = path.read_bytes()
    try:
        save_field(path, field)
        with pytest.raises(InputError, match=r"no box was attacked: .* ball to \d+ %"):
            read_box(run)
    finally:
        path.write_bytes(before)
