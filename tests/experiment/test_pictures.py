"""What a run leaves beside its figures: frames, what they say, what replays them."""

from __future__ import annotations

import errno
import hashlib
import json
import os
import shutil

import av
import mitsuba as mi
import numpy as np
import pytest
from support.reference.derivatives import central_difference
from support.worlds import loops as toy
from support.worlds.attacks import job

from mi_nerfattack.backend.colour import linear_to_uint8
from mi_nerfattack.backend.versions import versions
from mi_nerfattack.deploy.environment import CameraFrame, drive
from mi_nerfattack.deploy.replay.environment import ReplayEnvironment, open_recording
from mi_nerfattack.drives.store import read_drive
from mi_nerfattack.errors import InputError
from mi_nerfattack.experiment.pictures.frames import FrameFolder, frame_steps
from mi_nerfattack.io import files
from mi_nerfattack.io.exr import read_layers, read_metadata
from mi_nerfattack.policy.torch_policy import TorchPolicy
from mi_nerfattack.render.camera.intrinsics import CameraMount, from_fov
from mi_nerfattack.render.camera.rig import Rig
from mi_nerfattack.report.plots.strip import GAP_PX, TILE_PX
from mi_nerfattack.rollout.drive import CASES, Drive
from mi_nerfattack.rollout.objective import StateHistory
from mi_nerfattack.scenario.scenario import load_scenario
from mi_nerfattack.scenario.world import build_world
from mi_nerfattack.vehicle.dynamics import to_state
from mi_nerfattack.vehicle.route.route import Route

pytestmark = pytest.mark.usefixtures("variant")

HORIZON = 5
LONGER = "horizon = 2", f"horizon = {HORIZON}"
#: How far a colour in half precision is from what was rounded, relative to 1.
HALF = 2.0**-11
LABELS = "surrogate", "mitsuba"


@pytest.fixture(scope="module")
def run(folder, tmp_path_factory):
    """The folder of a finished run."""
    mi.set_variant("llvm_ad_rgb")
    output = tmp_path_factory.mktemp("pictures") / "run"
    longer = job(folder, output, LONGER)
    longer.frames = "all"
    longer.run()
    return output


def kept_drive(run, environment, case):
    """Return the arrays of the first drive."""
    (path,) = (run / "drives" / environment).glob(f"{case}_0000-*.safetensors")
    return read_drive(path).arrays()


@pytest.mark.parametrize("environment", LABELS)
@pytest.mark.parametrize("case", CASES)
def test_a_frame_says_where_it_is_from(folder, run, environment, case):
    step = HORIZON - 1
    path = run / "frames" / f"{environment}_{case}" / f"{step:04d}.exr"
    metadata, read = read_metadata(path), mi.Bitmap(str(path)).metadata()
    assert {name: read[name] for name in metadata} == metadata  # as Mitsuba reads it
    words = {"scenario": "kill", "environment": environment, "case": case}
    assert words.items() <= metadata.items() and "OpenCV" in metadata["pose_convention"]
    frame = {name: json.loads(v) for name, v in metadata.items() if v[0] in "[{-012345"}
    assert frame["versions"] == versions() and metadata["variant"] == mi.variant()
    assert (frame["run"], frame["step"], frame["spp"], frame["seed"]) == (0, step, 1, 1)
    stored = kept_drive(run, environment, case)
    assert frame["time_s"] == pytest.approx(stored["time_s"][step - 1])
    assert frame["state"] == pytest.approx(stored["states"][step])
    assert frame["control"] == stored["controls"][step]
    assert frame["cross_track_m"] == pytest.approx(stored["cross_track_m"][step - 1])
    lens, (x, y, heading) = frame["camera"], frame["state"]
    assert (lens["width"], lens["height"], lens["cx"]) == (toy.WIDTH, toy.HEIGHT, 12)
    eye = [x + 0.5 * np.cos(heading), y + 0.5 * np.sin(heading), 1.4]
    assert np.array(lens["to_world"])[:3, 3] == pytest.approx(eye)
    digests = frame["digests"]
    assert {"scenario", "scene.deployment", "policy.file"} < set(digests)
    content = (folder / "scene.safetensors").read_bytes()
    assert digests["scene.field"] == hashlib.sha256(content).hexdigest()
    assert ("texture.ball" in digests) == (case != "no_object")
    if case in ("own", "attack"):
        owner = folder / "object" if case == "own" else run / "objects" / "ball"
        tensors, _ = files.read_safetensors(owner.with_suffix(".safetensors"))
        expected = hashlib.sha256(tensors["texture"].tobytes()).hexdigest()
        assert digests["texture.ball"] == expected


@pytest.mark.parametrize("case", CASES)
def test_layers_add_up_in_half_precision(run, case):
    layer_names = {"scene"} if case == "no_object" else {"scene", "object"}
    for environment in LABELS:
        folder = run / "frames" / f"{environment}_{case}"
        layers, _ = read_layers(folder / "0002.exr")
        shown = linear_to_uint8(layers[""][..., :3])
        picture = files.read_image(folder / "0002.png")
        assert np.abs(shown.astype(int) - picture).max() <= 1
        assert ("object" in layers) == ("object" in layer_names)
        if environment == "mitsuba" and case == "no_object":
            assert "scene" not in layers  # nothing to take apart
            continue
        half = environment == "surrogate"
        summands = [
            layers[name] for name in layer_names | ({"background"} if half else set())
        ]
        bound = HALF * (sum(np.abs(part) for part in summands) + np.abs(layers[""]))
        error = np.abs(sum(summands) - layers[""])
        assert (error <= (bound if half else 1e-6) + 1e-7).all(), environment


def test_the_policys_input_is_what_it_answered(run):
    policy = TorchPolicy(toy.SmoothPolicy())
    for environment in LABELS:
        driven = kept_drive(run, environment, "attack")
        folder = run / "frames" / f"{environment}_attack"
        for step in range(HORIZON):
            layers, _ = read_layers(folder / f"{step:04d}.exr")
            image = np.stack([layers[f"input.{k}"] for k in range(3)], axis=-1)
            again = policy.control(mi.TensorXf(image[None]), 0)
            assert float(np.array(again)[0]) == driven["controls"][step]
            assert ("cost.dR" in layers) == (environment == "surrogate")
        last, _ = read_layers(folder / f"{HORIZON:04d}.exr")
        assert not {"cost.dR", "input.0"} & set(last)  # which no policy sees


@pytest.mark.parametrize("case", ["no_object", "attack"])
def test_the_cost_of_each_pixel_is_that_of_a_difference(folder, run, case):
    """Of the last image, which nothing but the last state follows."""
    scenario, _ = load_scenario(folder / "changed.toml")
    policy = TorchPolicy(toy.SmoothPolicy())
    world, states = build_world(scenario, policy), kept_drive(run, "surrogate", case)
    transition, states = world.loop(world.surrogate).transition, states["states"]
    path = run / "frames" / f"surrogate_{case}" / f"{HORIZON - 1:04d}.exr"
    layers, _ = read_layers(path)
    image = np.stack([layers[f"input.{k}"] for k in range(3)], axis=-1)
    by_image = np.stack([layers[f"cost.d{c}"] for c in "RGB"], axis=-1)
    direction = np.sign(by_image)
    before = to_state(states[-2:-1])

    def cost(s):
        changed = mi.TensorXf((image + s * direction)[None].astype(np.float32))
        control = np.array(policy.control(changed, 0), np.float64)
        row = to_state(np.repeat(control[None], 3, axis=1))[0]
        after = np.array(transition.advance(before, row, row)).T
        rows = to_state(np.concatenate([states[1:-1], after]))
        history = StateHistory(rows, 1, HORIZON, scenario.vehicle.dt_s)
        return float(world.objective.evaluate(history)[0])

    expected = central_difference(cost, 0.02)
    assert abs(by_image).sum() == pytest.approx(abs(expected), rel=1e-3) != 0


@pytest.mark.parametrize("environment", LABELS)
@pytest.mark.parametrize("case", CASES)
def test_a_replay_of_the_frames_gives_the_controls(folder, run, environment, case):
    scenario, _ = load_scenario(folder / "changed.toml")
    mount, period = scenario.camera.build()[1], scenario.vehicle.dt_s
    path = run / "frames" / f"{environment}_{case}"
    replay = ReplayEnvironment(open_recording(path, None, mount), mount, period)
    policy, stored = TorchPolicy(toy.SmoothPolicy()), kept_drive(run, environment, case)
    routes = scenario.scene.routes.file
    route = Route.from_file(routes, scenario.scene.route)
    replayed = drive(replay, policy, route, stored["states"][0], 0, 100)
    assert np.array_equal(replayed.controls, stored["controls"])
    assert replayed.states == pytest.approx(stored["states"], abs=1e-6)
    depth = read_layers(path / "0001.exr")[0]["Z"]
    assert np.array_equal(replay.recording.depth(1), depth)


@pytest.mark.parametrize("label", LABELS)
def test_videos_show_all_cases_side_by_side(run, label):
    """Each tile is the frame of its case and time, as far as H.264 keeps colours."""
    with av.open(str(run / "videos" / f"{label}.mp4")) as container:
        (stream,) = container.streams
        pictures = [f.to_ndarray(format="rgb24") for f in container.decode(stream)]
    assert len(pictures) == HORIZON + 1 and stream.average_rate == 10
    scale = TILE_PX // toy.WIDTH
    height, width = scale * toy.HEIGHT, scale * toy.WIDTH
    header = scale * toy.WIDTH // 22 + 2 * GAP_PX
    for index, case in enumerate(CASES):
        top = index // 2 * (header + height) + header
        left = GAP_PX + index % 2 * (width + GAP_PX)
        for step, picture in enumerate(pictures):
            tile = picture[top : top + height, left : left + width]
            path = run / "frames" / f"{label}_{case}" / f"{step:04d}.png"
            centres = tile[scale // 2 :: scale, scale // 2 :: scale].astype(int)
            assert np.abs(centres - files.read_image(path)).mean() < 4, (case, step)
            assert picture[top - header : top, left : left + width].min() < 80  # title


def made(distances):
    """Return a drive of 0.1 s a period at some distances from the lane's centre."""
    count = len(distances)
    states = np.zeros((count + 1, 3))
    time_s = 0.1 * np.arange(1, count + 1)
    labels = "surrogate", "line", "own", 0, 0
    return Drive(*labels, states, np.zeros(count), np.array(distances), time_s)


def test_frames_are_chosen():
    rising = made([0.01 * k for k in range(30)])
    assert frame_steps(rising, "all") == list(range(31))
    assert frame_steps(rising, "worst") == list(range(20, 31))
    assert frame_steps(made([0.1, -0.9, 0.2]), "worst") == [0, 1, 2]
    assert frame_steps(rising, 3) == [0, 14, 29]
    assert frame_steps(rising, 1) == [0]
    assert frame_steps(made([0.1]), 3) == [0]


def test_an_input_of_another_size_has_a_file_of_its_own(tmp_path):
    for name in ("0002_input.exr", "0003.png", "notes.txt"):
        (tmp_path / name).write_text("")
    camera, image = from_fov(8, 6, 90.0), np.zeros((6, 8, 3), np.uint8)
    frame = CameraFrame(image, np.ones((6, 8), np.float32), np.eye(4))
    plane = np.arange(20, dtype=np.float32).reshape(4, 5)
    folder = FrameFolder(tmp_path, Rig.of_one(camera, CameraMount()))
    # frames of an earlier run are removed, and nothing else
    assert [path.name for path in tmp_path.iterdir()] == ["notes.txt"]
    layers = frame.layers([]) | {"input.0": plane}
    folder.add(7, 0.7, frame, layers, {"step": "7"}, half=True)
    folder.finish()
    assert set(read_layers(tmp_path / "0007.exr")[0]) == {"", "Z"}
    input_layers, metadata = read_layers(tmp_path / "0007_input.exr")
    assert np.array_equal(input_layers["input.0"], plane) and metadata["step"] == "7"
    assert open_recording(tmp_path, None, CameraMount()).track.times == [0.7]


@pytest.mark.parametrize("error", [OSError(errno.ENOSPC, "full"), KeyboardInterrupt()])
def test_figures_are_safe_when_pictures_fail(folder, run, tmp_path, monkeypatch, error):
    """A full disk or Ctrl-C, while frames are written, loses no figure."""
    output, notices, write = tmp_path / "run", [], os.write

    def fail(descriptor, data):
        if (output / "frames" / "surrogate_own" / "0001.exr").exists():
            raise error
        return write(descriptor, data)

    shutil.copytree(run, output, ignore=lambda *_: {"metrics.json", "frames"})
    again = job(folder, output, LONGER, notices=notices)
    again.frames = "all"
    with monkeypatch.context() as patch, pytest.raises((InputError, KeyboardInterrupt)):
        patch.setattr(os, "write", fail)
        again.run()
    assert notices[-1].startswith(f"{output / 'metrics.json'}: ")
    before, after = (files.read_json(x / "metrics.json") for x in (run, output))
    assert before["routes"] == after["routes"]
