"""`mi-nerfattack render`: files, paths, videos, continuation, messages."""

from __future__ import annotations

import errno
import json
import os
import re
import shlex
from pathlib import Path

import numpy as np
import pytest
from helpers import film_scenes as scenes
from helpers.faults import kill, short_of_memory
from PIL import Image

from mi_nerfattack import cli
from mi_nerfattack.errors import InputError
from mi_nerfattack.io import exr, files, locks
from mi_nerfattack.io.video import even_size, write_video
from mi_nerfattack.render.pathtrace.frames import FrameRenderer

pytestmark = pytest.mark.usefixtures("variant")


@pytest.fixture
def run(tmp_path, monkeypatch, capsys):
    """Run `render` in a folder with scene.xml, path.json and routes.json."""
    scenes.write_balls(tmp_path)
    scenes.write_path(tmp_path, name="path.json")
    scenes.write_route(tmp_path)
    monkeypatch.chdir(tmp_path)

    def call(line: str) -> tuple[int, str, str]:
        words = shlex.split(line)
        mode = "path" if {"--path", "--route"} & {*words} else "frame"
        code = cli.main(["render", mode, *words])
        captured = capsys.readouterr()
        return code, captured.out, captured.err

    return call


def decode(path):
    """Return the frames of a video and its rate."""
    import av

    with av.open(str(path)) as container:
        stream = container.streams.video[0]
        frames = [
            frame.to_ndarray(format="rgb24") for frame in container.decode(stream)
        ]
        return frames, stream.average_rate, stream


def pose_of(path):
    """Return the camera's pose that a frame tells."""
    return np.array(json.loads(exr.read_metadata(path)["camera"])["to_world"])


def test_one_frame(run, tmp_path):
    code, out, _ = run("scene.xml -o a.exr --spp 2 --seed 5 --set spp=3 --size 8 6")
    assert code == 0
    assert "a.exr: 8 x 6 px, 2 samples per pixel" in out and "channels R G B" in out
    layers, metadata = exr.read_layers("a.exr")
    assert layers[""].shape == (6, 8, 3)
    assert (metadata["spp"], metadata["seed"]) == ("2", "5")
    code, out, _ = run("scene.xml -o a.png --json")
    told = json.loads(out)
    assert (code, told["output"], told["channels"]) == (0, "a.png", [])
    assert told["size_px"] == [scenes.WIDTH, scenes.HEIGHT]
    with Image.open("a.png") as image:
        assert (image.size, image.mode) == ((scenes.WIDTH, scenes.HEIGHT), "RGB")
    assert run("scene.xml -o a.exr --set spp=3")[0] == 0
    metadata = exr.read_metadata("a.exr")
    assert metadata["spp"] == "3"
    assert json.loads(metadata["scene_parameters"]) == {"spp": "3"}


def test_second_sensor(run, tmp_path):
    body = scenes.PATH + scenes.sensor() + scenes.sensor(eye="0,3,0") + scenes.BALLS
    scenes.write_scene(tmp_path, body)
    assert run("scene.xml -o a.exr --sensor 1")[0] == 0
    pose = pose_of("a.exr")
    np.testing.assert_allclose(pose[:, 3], [0, 3, 0, 1], atol=1e-6)


def test_path_to_a_folder(run):
    code, out, err = run("scene.xml --path path.json -o frames --seed 4")
    assert code == 0 and "3/3" in err and "3 frames" in out
    names = sorted(path.name for path in Path("frames").iterdir())
    assert names == [f"frame_000{i}.exr" for i in range(3)]
    poses = [scenes.opengl_pose(3 * np.array(e)) for e in np.eye(3)[:2]]
    for i, expected in enumerate(poses):
        metadata = exr.read_metadata(f"frames/{names[i]}")
        pose = pose_of(f"frames/{names[i]}")
        np.testing.assert_allclose(pose, expected * [1, -1, -1, 1], atol=1e-8)
        assert metadata["seed"] == str(4 + i)


def test_route_to_a_folder(run):
    line = "scene.xml --route straight --routes routes.json --fps 2 -o frames"
    assert run(f"{line} --mount 1 0 30")[0] == 0
    assert len(list(Path("frames").iterdir())) == 2  # 2 m at 4 m/s and 2 Hz
    matrix = pose_of("frames/frame_0001.exr")
    np.testing.assert_allclose(matrix[:3, 3], [5, 1, 1], atol=1e-8)
    np.testing.assert_allclose(matrix[:3, 2], [0, np.sqrt(0.75), -0.5], atol=1e-8)


def test_path_to_a_video_of_odd_size(run):
    code, out, _ = run("scene.xml --path path.json -o a.mp4 --fps 10 --spp 4")
    assert code == 0
    assert "3 frames, 18 x 14 px" in out and "17 x 13 px" in out and "repeated" in out
    frames, rate, stream = decode("a.mp4")
    assert rate == 10 and len(frames) == 3 and stream.pix_fmt == "yuv420p"
    assert frames[0].shape == (14, 18, 3)
    assert sorted(path.name for path in Path().glob("a*")) == ["a.mp4"]
    assert run("scene.xml --path path.json -o b --spp 4")[0] == 0
    red = exr.read_layers("b/frame_0000.exr")[0][""][..., 0]
    row, column = np.argwhere(red > 0.9)[4]
    assert frames[0][row, column, 0] > 180 and frames[0][row, column, 1] < 60


def test_video_shows_the_colours_that_it_got(tmp_path):
    # blocks of 16 pixels: chroma subsampling changes nothing inside them
    colours = np.random.default_rng(0).integers(30, 226, (3, 4, 3), np.uint8)
    image = np.kron(colours, np.ones((16, 16, 1), np.uint8))[:47, :61]
    assert write_video(tmp_path / "a.mp4", [image] * 5, 25) == (62, 48)
    frames, rate, stream = decode(tmp_path / "a.mp4")
    assert len(frames) == 5 and rate == 25
    context = stream.codec_context
    assert (context.colorspace, context.color_primaries) == (1, 1)  # BT.709
    for frame in frames:
        centres = frame[8::16, 8::16].astype(int)
        assert np.abs(centres - colours).max() <= 6
        # the padding repeats the border: no black line
        assert np.abs(frame[8::16, 61].astype(int) - colours[:, 3]).max() < 25


def test_even_sizes_are_kept():
    assert even_size(366, 188) == (366, 188)
    assert even_size(367, 189) == (368, 190)


def test_refused_videos_leave_nothing(tmp_path):
    small, large = np.zeros((4, 4, 3), np.uint8), np.zeros((6, 4, 3), np.uint8)
    for frames, message in (([], "no frames"), ([small, large], "all need one size")):
        with pytest.raises(InputError, match=message):
            write_video(tmp_path / "a.mp4", frames, 25)
    with pytest.raises(InputError, match=r"none/a.mp4: does not exist"):
        write_video(tmp_path / "none" / "a.mp4", [small], 25)
    assert not list(tmp_path.iterdir())


@pytest.fixture
def interrupted(monkeypatch):
    """Let Ctrl-C come with the third frame; return what to call to end that."""
    render = FrameRenderer.render
    calls: list[int] = []

    def interrupt(self, pose=None, seed=0):
        calls.append(seed)
        if len(calls) == 3:
            raise KeyboardInterrupt
        return render(self, pose, seed)

    monkeypatch.setattr(FrameRenderer, "render", interrupt)
    return calls


@pytest.mark.parametrize(("output", "folder"), [("out", "out"), ("a.mp4", "a.frames")])
def test_interrupted_path_is_continued(run, interrupted, output, folder):
    line = f"scene.xml --path path.json -o {output}"
    code, _, err = run(line)
    assert code == cli.EXIT_INTERRUPTED
    assert f"2 of 3 frames are in {folder}" in err
    kept = sorted(Path(folder).iterdir())
    assert [path.name for path in kept] == ["frame_0000.exr", "frame_0001.exr"]
    assert not Path("a.mp4").exists()
    before = [path.read_bytes() for path in kept] if output == "out" else []
    assert run(line)[0] == 0
    assert interrupted == [0, 1, 2, 2]  # the seeds: two frames were kept
    if output == "out":
        assert [path.read_bytes() for path in kept] == before
    else:
        assert len(decode("a.mp4")[0]) == 3
        assert not Path(folder).exists()


def test_files_beside_the_frames_of_a_video_stay(run):
    Path("a.frames").mkdir()
    Path("a.frames/mine.txt").write_text("mine")
    assert run("scene.xml --path path.json -o a.mp4")[0] == 0
    assert [path.name for path in Path("a.frames").iterdir()] == ["mine.txt"]


@pytest.mark.parametrize(
    ("change", "key"),
    [
        ("--spp 2", "spp"),
        ("--seed 1", "seed"),
        ("--size 8 6", "camera"),
        ("--set spp=1", "scene_parameters"),
        ("--precision float", "precision"),
    ],
)
def test_frames_of_something_else_are_not_continued(run, change, key):
    assert run("scene.xml --path path.json -o out")[0] == 0
    code, _, err = run(f"scene.xml --path path.json -o out {change}")
    assert code == 2 and "out/frame_0000.exr: belongs to" in err
    assert f"\n  {key}: " in err


def test_changed_scene_and_damaged_frame_are_not_continued(run):
    line = "scene.xml --path path.json -o out"
    assert run(line)[0] == 0
    text = Path("scene.xml").read_text()
    Path("scene.xml").write_text(text.replace("0.25", "0.26"))
    assert "  digests: " in run(line)[2]
    assert run(f"{line} --force")[0] == 0
    Path("scene.xml").write_text(text)
    assert run(f"{line} --force")[0] == 0
    Path("out/frame_0002.exr").write_bytes(b"half")
    assert "out/frame_0002.exr: not an EXR file" in run(line)[2]


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("none.xml -o a.exr", r"none.xml: does not exist"),
        ("bundled:none.xml -o a.exr", r"none.xml: not a bundled file"),
        ("path.json -o a.exr", r"path.json: .*XML"),
        ("scene.xml -o a.exr --sensor 1", r"no sensor 1; it has 0 \(eye3\)"),
        ("scene.xml -o a.exr --sensor -1", r"no sensor -1"),
        ("scene.xml -o a.exr --spp 0", r"spp: 0; at least 1"),
        ("scene.xml -o a.exr --seed -1", r"seed: -1"),
        ("scene.xml -o a.exr --size 0 6", r"at least 1 x 1"),
        ("scene.xml -o a.exr --size 90000 90000", r"at most 134217728 pixels"),
        ("scene.xml -o a.exr --set width=3", r"width=3.*no <default>"),
        ("scene.xml -o a.exr --set spp", r"--set spp: needs NAME=VALUE"),
        ("scene.xml -o a.exr --set spp=x", r"could not parse integer"),
        ("scene.xml -o none/a.exr", r"none/a.exr: does not exist"),
        ("scene.xml -o .", r": one frame is written as .exr or .png"),
        ("scene.xml -o a.mp4", r"a.mp4: one frame is .*'mi-nerfattack render path'"),
        ("scene.xml -o a.jpg", r"a.jpg: one frame is written as .exr or .png"),
        ("scene.xml -o a --route u --path path.json", r"--path, --route: give one"),
        ("scene.xml -o a.exr --path path.json", r"a.exr: one image cannot hold"),
        ("scene.xml -o a.avi --path path.json", r"a.avi: unknown suffix '.avi'"),
        ("scene.xml -o out --path none.json", r"none.json: does not exist"),
        ("scene.xml -o out --path scene.xml", r"scene.xml: line 1.*valid JSON"),
        ("scene.xml -o out --path routes.json", r"routes.json: frames: missing"),
        ("scene.xml -o scene.xml/a --path path.json", r"not a folder"),
        ("scene.xml -o a.mp4 --fps 0 --path path.json", r"fps: 0"),
        ("scene.xml -o out --route straight", r"--route, --routes: one without"),
        ("scene.xml -o out --route u --routes routes.json", r"no route 'u'"),
    ],
)
def test_refusals_are_one_line_and_write_nothing(run, line, message):
    before = sorted(Path().rglob("*"))
    code, out, err = run(line)
    assert (code, out) == (2, "")
    assert re.fullmatch(rf"mi-nerfattack: error: .*{message}.*\n", err), err
    assert sorted(Path().rglob("*")) == before


def test_bad_poses_are_named(run):
    good = scenes.opengl_pose(scenes.EYE)
    for matrix, message in (
        (good * 2, "last row"),
        (good * [-1, 1, 1, 1], "reflection"),
        (good[:2], "needs 4 x 4"),
        ([["a"]], "not a matrix of numbers"),
    ):
        matrix = np.asarray(matrix).tolist()
        table = {"frames": [{"transform_matrix": matrix}]}
        Path("bad.json").write_text(json.dumps(table))
        code, _, err = run("scene.xml -o out --path bad.json")
        assert code == 2 and "frames[0].transform_matrix" in err and message in err


def test_scenes_without_what_a_frame_needs(run, tmp_path):
    for body, message in (
        (scenes.PATH, "has no sensor"),
        (scenes.sensor(), "has no integrator"),
    ):
        scenes.write_scene(tmp_path, body)
        code, _, err = run("scene.xml -o a.exr")
        assert code == 2 and message in err
    scenes.write_slab(tmp_path)
    Path("box.safetensors").unlink()
    code, _, err = run("scene.xml -o a.exr")
    assert code == 2 and re.search(r"box.safetensors: does not exist; check", err)
    assert len(err.splitlines()) == 1


@pytest.mark.parametrize("output", ["out", "a.mp4"])
def test_full_disk_keeps_whole_frames(run, monkeypatch, output):
    write, written = os.write, []

    def full(descriptor, data):
        written.append(len(data))
        if len(written) > 2:
            raise OSError(errno.ENOSPC, "No space left on device")
        return write(descriptor, data)

    monkeypatch.setattr(files.os, "write", full)
    code, _, err = run(f"scene.xml --path path.json -o {output}")
    assert code == 2 and "no space left on the disk; free some" in err
    assert "2 of 3 frames are in" in err
    names = {path.name for path in Path().rglob("*") if path.is_file()}
    names -= {"scene.xml", "path.json", "routes.json"}
    assert names == {"frame_0000.exr", "frame_0001.exr"}


def test_too_little_memory_keeps_whole_frames(run):
    with short_of_memory("rendering", at=2):
        code, _, err = run("scene.xml --path path.json -o out")
    assert code == 2 and "not enough memory: 249 TiB" in err
    assert "2 of 3 frames are in out; the same command" in err
    assert len(list(Path("out").iterdir())) == 2


@pytest.mark.parametrize("output", ["out", "a.mp4"])
def test_a_second_process_is_refused(run, output):
    folder = Path(output).with_suffix("" if output == "out" else ".frames")
    folder.mkdir()
    with locks.exclusive(folder):
        code, _, err = run(f"scene.xml --path path.json -o {output}")
    assert code == 2 and "another process works in it" in err
    assert not list(folder.iterdir()) and not Path("a.mp4").exists()


def test_a_killed_path_is_continued(run, tmp_path):
    """Its whole frames stay, and what it left of another one is removed."""
    words = "render path scene.xml --path path.json -o out".split()
    kill(words, tmp_path, "frame_0001")
    names = [path.name for path in Path("out").iterdir()]
    assert len(names) == 2 and "frame_0000.exr" in names
    first = Path("out/frame_0000.exr")
    written = first.stat().st_mtime_ns
    assert run(" ".join(words[2:]))[0] == 0
    assert first.stat().st_mtime_ns == written
    names = sorted(path.name for path in Path("out").iterdir())
    assert names == [f"frame_000{i}.exr" for i in range(3)]


def test_too_bright_for_half_says_what_to_do(run):
    text = Path("scene.xml").read_text()
    Path("scene.xml").write_text(text.replace("1,0,0", "1e5,0,0"))
    code, _, err = run("scene.xml -o a.exr")
    assert code == 2 and "channel 'R' reaches 100000" in err
    assert "--precision float" in err and not Path("a.exr").exists()
    assert run("scene.xml -o a.exr --precision float")[0] == 0
    assert exr.read_layers("a.exr")[0][""].max() == 1e5
    assert run("scene.xml --path path.json -o a.mp4")[0] == 0


def test_nan_is_refused_by_channel(run, monkeypatch):
    def spoilt(self, seed):
        image = np.ones((scenes.HEIGHT, scenes.WIDTH, 3), np.float32)
        image[1, 2, 1] = np.nan
        return image

    monkeypatch.setattr(FrameRenderer, "_render_pass", spoilt)
    monkeypatch.setattr(FrameRenderer, "_channel_names", lambda self, count: [*"RGB"])
    for suffix in ("exr", "png"):
        code, _, err = run(f"scene.xml -o a.{suffix}")
        assert code == 2 and f"a.{suffix}: channel 'G' holds NaN" in err
    assert not list(Path().glob("a.*"))
