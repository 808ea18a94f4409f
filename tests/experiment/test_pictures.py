"""What a run leaves beside its figures: frames, what they say, what replays them."""

from __future__ import annotations

import hashlib
import json

import mitsuba as mi
import numpy as np
import pytest
from helpers import toy_loop as toy
from helpers.attack_jobs import job

from mi_nerfattack.backend.versions import versions
from mi_nerfattack.io import files
from mi_nerfattack.io.exr import read_metadata
from mi_nerfattack.rollout.drive import CASES

pytestmark = pytest.mark.usefixtures("variant")

HORIZON = 5


@pytest.fixture(scope="module")
def run(folder, tmp_path_factory):
    """The folder of a finished run."""
    mi.set_variant("llvm_ad_rgb")
    output = tmp_path_factory.mktemp("pictures") / "run"
    job(folder, output, ("horizon = 2", f"horizon = {HORIZON}")).run()
    return output


@pytest.mark.parametrize("environment", ["surrogate", "deployment"])
@pytest.mark.parametrize("case", CASES)
def test_a_frame_says_where_it_is_from(folder, run, environment, case):
    step = HORIZON - 1
    path = run / "frames" / f"{environment}_{case}_{step:04d}.exr"
    found, read = read_metadata(path), mi.Bitmap(str(path)).metadata()
    assert {name: read[name] for name in found} == found  # as Mitsuba reads it
    words = {"scenario": "kill", "environment": environment, "case": case}
    assert words.items() <= found.items() and "OpenCV" in found["pose_convention"]
    told = {name: json.loads(v) for name, v in found.items() if v[0] in "[{-012345"}
    assert told["versions"] == versions() and found["variant"] == mi.variant()
    assert (told["run"], told["step"], told["spp"], told["seed"]) == (0, step, 1, 1)
    drives = run / "drives"
    kept, _ = files.read_safetensors(drives / f"{environment}_{case}_0000.safetensors")
    assert told["time_s"] == pytest.approx(kept["time_s"][step - 1])
    assert told["state"] == pytest.approx(kept["states"][step])
    assert told["control"] == kept["controls"][step]
    assert told["cross_track_m"] == pytest.approx(kept["cross_track_m"][step - 1])
    lens, (x, y, heading) = told["camera"], told["state"]
    assert (lens["width"], lens["height"], lens["cx"]) == (toy.WIDTH, toy.HEIGHT, 12)
    eye = [x + 0.5 * np.cos(heading), y + 0.5 * np.sin(heading), 1.4]
    assert np.array(lens["to_world"])[:3, 3] == pytest.approx(eye)
    digests = told["digests"]
    assert {"scenario", "scene.deployment", "policy.file"} < set(digests)
    for key, name in (("policy.file", "policy"), ("scene.field", "scene")):
        content = (folder / f"{name}.safetensors").read_bytes()
        assert digests[key] == hashlib.sha256(content).hexdigest()
    if case == "no_object":
        assert "texture.ball" not in digests
    if case in ("own", "attack"):
        owner = folder / "object" if case == "own" else run / "objects" / "ball"
        tensors, _ = files.read_safetensors(owner.with_suffix(".safetensors"))
        expected = hashlib.sha256(tensors["texture"].tobytes()).hexdigest()
        assert digests["texture.ball"] == expected
