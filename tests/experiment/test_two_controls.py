"""A whole attack on a car with steering and acceleration, and what it writes."""

from __future__ import annotations

import json

import mitsuba as mi
import numpy as np
import pytest
from support.worlds.attacks import write_scenario

from mi_nerfattack import cli
from mi_nerfattack.drives.store import read_drives
from mi_nerfattack.drives.table import FURTHER, STEPS, read_csv
from mi_nerfattack.experiment.view.run import read_viewed
from mi_nerfattack.experiment.view.viewer import describe
from mi_nerfattack.io.exr import read_metadata

pytestmark = pytest.mark.usefixtures("variant")

POLICY = """
import torch
from support.worlds.loops import SmoothPolicy


class Two(SmoothPolicy):
    def forward(self, image, goal):
        steering = 0.3 * super().forward(image, goal)
        return torch.stack([steering, 2 * super().forward(image.flip(3), goal)], 1)
"""
SECTIONS = """[policy]
file = "two.py:Two"
trust_code = true
goal = { kind = "integer", count = 3 }
output = [0, 1]
control_unit = "rad"
[vehicle]
kind = "kinematic_single_track"
delay_steps = 1
substeps = 2
[camera]
width = 24
height = 10
"""


@pytest.fixture(scope="module")
def scenario(tmp_path_factory):
    mi.set_variant("llvm_ad_rgb")
    changes = {
        '[policy]\nfile = "policy.safetensors"\n': SECTIONS,
        "max_iterations = 30": "max_iterations = 2",
        "textures = 4": "textures = 2",
        "horizon = 2": "horizon = 3",
        "runs = 2": "runs = 1",
    }
    folder = write_scenario(tmp_path_factory.mktemp("two"), changes)
    (folder / "two.py").write_text(POLICY)
    return folder / "scenario.toml"


def test_check_finds_no_fault(scenario, capsys, tmp_path):
    arguments = ["check", str(scenario), "--json", "-o", str(tmp_path / "p.png")]
    cli.main(arguments)
    document = json.loads(capsys.readouterr().out)
    assert not [line for line in document["refused"] if "control" in line], document


def test_an_attack_and_its_pictures(scenario, tmp_path):
    run = tmp_path / "run"
    words = ["attack", str(scenario), "-o", str(run), "--anyway", "--workers", "1"]
    assert cli.main(words) == 0
    table = read_csv(run / "steps.csv", STEPS, FURTHER)
    drives = {(d.environment, d.case, d.run): d for d in read_drives(run / "drives")}
    drive = drives["surrogate", "own", 0]
    rows = table[(table["environment"] == "surrogate") & (table["case"] == "own")]
    np.testing.assert_array_equal(rows["control"], drive.controls[:, 0])
    np.testing.assert_array_equal(rows["control_1"], drive.controls[:, 1])
    assert drive.controls.shape == (3, 2) and drive.controls[:, 1].any()
    assert (np.diff(drive.states[:, 3]) != 0).any()
    picture = run / "frames" / "surrogate_own" / "0000.exr"
    metadata = read_metadata(picture)
    np.testing.assert_allclose(json.loads(metadata["control"]), drive.controls[0])
    viewed = read_viewed(run)
    assert describe(viewed, drive, 0).count("rad, ") == 1
    assert describe(viewed, drive, 0).endswith("m/s^2")
