"""`mi-nerfattack render`: files, paths, videos, continuation, messages."""

from __future__ import annotations

import json
import shlex
from pathlib import Path

import av
import numpy as np
import pytest
from PIL import Image
from support.worlds import films as scenes

from mi_nerfattack import cli
from mi_nerfattack.errors import InputError
from mi_nerfattack.io import exr
from mi_nerfattack.io.video import even_size, write_video

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
    with av.open(str(path)) as container:
        stream = container.streams.video[0]
        frames = [each.to_ndarray(format="rgb24") for each in container.decode(stream)]
        return frames, stream.average_rate, stream


def pose_of(path):
    """Return the camera's pose that a frame tells."""
    return np.array(json.loads(exr.read_metadata(path)["camera"])["to_world"])


def test_one_frame(run, tmp_path):
    assert run("scene.xml -o a.exr --spp 2 --seed 5 --set spp=3 --size 8 6")[0] == 0
    layers, metadata = exr.read_layers("a.exr")
    assert layers[""].shape == (6, 8, 3)
    assert (metadata["spp"], metadata["seed"]) == ("2", "5")
    code, out, _ = run("scene.xml -o a.png --json")
    document = json.loads(out)
    assert (code, document["output"], document["channels"]) == (0, "a.png", [])
    assert document["size_px"] == [scenes.WIDTH, scenes.HEIGHT]
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
    assert run("scene.xml --path path.json -o frames --seed 4")[0] == 0
    paths = sorted(Path("frames").iterdir())
    assert [path.name for path in paths] == [f"frame_000{i}.exr" for i in range(3)]
    for i, eye in enumerate(3 * np.eye(3)[:2]):
        expected = scenes.opengl_pose(eye) * [1, -1, -1, 1]
        np.testing.assert_allclose(pose_of(paths[i]), expected, atol=1e-8)
        assert exr.read_metadata(paths[i])["seed"] == str(4 + i)


def test_route_to_a_folder(run):
    line = "scene.xml --route straight --routes-file routes.json --fps 2 -o frames"
    assert run(f"{line} --mount 1 0 30")[0] == 0
    assert len(list(Path("frames").iterdir())) == 2  # 2 m at 4 m/s and 2 Hz
    matrix = pose_of("frames/frame_0001.exr")
    np.testing.assert_allclose(matrix[:3, 3], [5, 1, 1], atol=1e-8)
    np.testing.assert_allclose(matrix[:3, 2], [0, np.sqrt(0.75), -0.5], atol=1e-8)


def test_path_to_a_video_of_odd_size(run):
    assert run("scene.xml --path path.json -o a.mp4 --fps 10 --spp 4")[0] == 0
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
    assert even_size(367, 189) == (368, 190) and even_size(366, 188) == (366, 188)
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


def test_refused_videos_leave_nothing(tmp_path):
    small, large = np.zeros((4, 4, 3), np.uint8), np.zeros((6, 4, 3), np.uint8)
    for frames, message in (([], "no frames"), ([small, large], "all need one size")):
        with pytest.raises(InputError, match=message):
            write_video(tmp_path / "a.mp4", frames, 25)
    with pytest.raises(InputError, match=r"none/a.mp4: does not exist"):
        write_video(tmp_path / "none" / "a.mp4", [small], 25)
    assert not list(tmp_path.iterdir())


def test_files_beside_the_frames_of_a_video_stay(run):
    Path("a.frames").mkdir()
    Path("a.frames/mine.txt").write_text("mine")
    assert run("scene.xml --path path.json -o a.mp4")[0] == 0
    assert [path.name for path in Path("a.frames").iterdir()] == ["mine.txt"]


def test_only_whole_frames_of_the_same_scene_are_continued(run):
    line = "scene.xml --path path.json -o out"
    assert run(line)[0] == 0
    for change, key in (
        ("--spp 2", "spp"),
        ("--seed 1", "seed"),
        ("--size 8 6", "camera"),
        ("--set spp=1", "scene_parameters"),
        ("--precision float", "precision"),
    ):
        code, _, err = run(f"{line} {change}")
        assert code == 2 and "out/frame_0000.exr: belongs to" in err
        assert f"\n  {key}: " in err
    text = Path("scene.xml").read_text()
    Path("scene.xml").write_text(text.replace("0.25", "0.26"))
    assert "  digests: " in run(line)[2]
    assert run(f"{line} --force")[0] == 0
    Path("out/frame_0002.exr").write_bytes(b"half")
    assert "out/frame_0002.exr: not an EXR file" in run(line)[2]


def test_radiance_beyond_half_is_written_as_float(run):
    text = Path("scene.xml").read_text()
    Path("scene.xml").write_text(text.replace("1,0,0", "1e5,0,0"))
    assert run("scene.xml -o a.exr --precision float")[0] == 0
    assert exr.read_layers("a.exr")[0][""].max() == 1e5
    assert run("scene.xml --path path.json -o a.mp4")[0] == 0
