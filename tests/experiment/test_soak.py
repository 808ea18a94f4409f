"""One attack of thousands of iterations, which watches what its process holds.

More of them than by default:

    ITERATIONS=20000 python -m pytest -m slow -s tests/experiment/test_soak.py

``python -m experiment.test_soak SCENARIO FOLDER`` does all iterations of the scenario,
or goes on from the folder's checkpoint, and writes what it saw after each of them.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import drjit as dr
import numpy as np
import pytest
from support.worlds.attacks import write_scenario

from mi_nerfattack import variant
from mi_nerfattack.backend.determinism import deterministic
from mi_nerfattack.backend.versions import versions
from mi_nerfattack.experiment.run_folder import CHECKPOINT, CheckpointFile
from mi_nerfattack.io import files
from mi_nerfattack.scenario.scenario import load_scenario
from mi_nerfattack.scenario.world import build_attack, build_world
from mi_nerfattack.system.processes import module_command

ITERATIONS = int(os.environ.get("ITERATIONS", "2000"))
SAMPLES, JUDGED, HALF = "samples.safetensors", "judged.json", "half.safetensors"
EVERY, SETTLED = 10, 200  # iterations: between checkpoints; that may take memory
#: Of the tiny scenario: a small image, steps so small that colours move from the first
#: iteration to the last, objects that move, too, and noise.
CHANGES = {
    "[drive]": "[policy.preprocess]\nresize_px = [200, 66]\n"
    "[camera]\nwidth = 32\nheight = 16\n[drive]",
    "learning_rate = 0.5": 'kind = "both"\nfreedom.learning_rate = 0.0005\n'
    "freedom.pose_learning_rate = 0.0005\nmethod.final_rate = 1.0\n"
    "jitter = true\nvary.noise_sd = 0.02",
    "checkpoint_every = 3": f"checkpoint_every = {EVERY}",
}
#: Of an iteration, bytes: its record in the history, and room for a copy at a
#: checkpoint, take one to two thousand; an image or a texture would take more.
MOST_GROWTH = 4096


def figures(samples: dict[str, np.ndarray]) -> dict[str, Any]:
    """Return what memory, kernels and handles came to after the settled iterations."""
    settled = {name: values[SETTLED - 1 :] for name, values in samples.items()}
    resident = settled["resident_bytes"].astype(np.float64)
    return {
        "growth_b": float(np.polyfit(np.arange(len(resident)), resident, 1)[0]),
        "compiled": int(settled["compiled"][1:].sum()),
        "descriptors": int(np.ptp(settled["descriptors"])),
        "threads": int(np.ptp(settled["threads"])),
    }


def _held(compiled: int) -> dict[str, int]:
    pages = int(files.read_text("/proc/self/statm").split()[1])
    return {
        "resident_bytes": pages * os.sysconf("SC_PAGE_SIZE"),
        "compiled": compiled,
        "descriptors": len(os.listdir("/proc/self/fd")),
        "threads": len(os.listdir("/proc/self/task")),
    }


def main(scenario_file: Path, output: Path) -> None:
    """Attack, or go on from the checkpoint, and write what was seen."""
    scenario, _ = load_scenario(scenario_file)
    section = scenario.attack
    identity = {**versions(), **scenario.identity()}
    checkpoint = CheckpointFile(output / CHECKPOINT, identity)
    checkpoint.read()
    with deterministic(), dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        world = build_world(scenario, scenario.build_policy())
        attack, count = build_attack(world), section.method.iterations(world.horizon)
        samples = {name: np.zeros(count, np.int64) for name in _held(0)}
        if checkpoint.is_loaded:
            checkpoint.restore(attack)
        while attack.iteration < count:
            attack.step()
            if attack.iteration % section.checkpoint_every == 0:
                checkpoint.save(attack)
            if attack.iteration == count // 2:
                shutil.copy(checkpoint.path, output / HALF)
            history = dr.kernel_history((dr.KernelType.JIT,))  # and clears it
            compiled = sum(not kernel["cache_hit"] for kernel in history)
            for name, value in _held(compiled).items():
                samples[name][attack.iteration - 1] = value
        tracked = attack.best_objective
        attack.judge_best()
        judged = {"tracked": tracked, "judged": attack.best_objective}
        files.write_json(output / JUDGED, judged)
    files.write_safetensors(output / SAMPLES, samples)


@pytest.mark.slow
@pytest.mark.usefixtures("variant")
def test_two_thousand_iterations_neither_grow_nor_drift(tmp_path):
    """In one go, and once more from half way on, each in a process of its own."""
    assert ITERATIONS % (2 * EVERY) == 0 and ITERATIONS >= 4 * SETTLED
    count = {"max_iterations = 30": f"max_iterations = {ITERATIONS}"}
    scenario = write_scenario(tmp_path, CHANGES | count) / "scenario.toml"
    uninterrupted, resumed = (
        files.make_folder(tmp_path / n) for n in ("whole", "resumed")
    )
    command = [*module_command("experiment.test_soak"), str(scenario)]
    subprocess.run([*command, str(uninterrupted)], check=True)
    shutil.move(uninterrupted / HALF, resumed / CHECKPOINT)
    subprocess.run([*command, str(resumed)], check=True)

    measured = figures(files.read_safetensors(uninterrupted / SAMPLES)[0])
    print(json.dumps(measured))
    assert measured["growth_b"] < MOST_GROWTH and measured["compiled"] == 0
    assert measured["descriptors"] == measured["threads"] == 0
    objective = files.read_json(uninterrupted / JUDGED)
    assert objective["tracked"] == objective["judged"] < 0
    one, other = (
        files.read_safetensors(path / CHECKPOINT)[0]
        for path in (uninterrupted, resumed)
    )
    assert one.keys() == other.keys()
    for name, tensor in one.items():
        assert tensor.tobytes() == other[name].tobytes(), name


if __name__ == "__main__":
    variant.ensure()
    main(Path(sys.argv[1]), Path(sys.argv[2]))
