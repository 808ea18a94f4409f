"""A process of :mod:`bench.soak.run`: it attacks, and watches itself meanwhile."""

from __future__ import annotations

import os
import shutil
import sys
import time
from pathlib import Path

import drjit as dr
import numpy as np

from mi_nerfattack import variant
from mi_nerfattack.attack.base import AbstractAttack
from mi_nerfattack.backend.determinism import deterministic
from mi_nerfattack.backend.versions import versions
from mi_nerfattack.experiment.checkpoint import CheckpointFile
from mi_nerfattack.experiment.run_folder import CHECKPOINT
from mi_nerfattack.io import files
from mi_nerfattack.scenario.scenario import load_scenario

SAMPLES, JUDGED, HALF = "samples.safetensors", "judged.json", "half.safetensors"
_INTEGERS = "resident_bytes", "compiled", "descriptors", "threads"
_SECONDS = "cpu_s", "wall_s"
_PAGE_BYTES = os.sysconf("SC_PAGE_SIZE")


class Watch:
    """Notes after each iteration what the process holds; grows by nothing itself.

    Args:
        iterations: of the attack.
    """

    def __init__(self, iterations: int) -> None:
        self.samples: dict[str, np.ndarray] = {
            name: np.zeros(iterations, np.int64) for name in _INTEGERS
        }
        self.samples |= {name: np.zeros(iterations) for name in _SECONDS}

    def note(self, index: int) -> None:
        """Note what is held after an iteration, and what was compiled since the last.

        Args:
            index: of the iteration, from 0.
        """
        history = dr.kernel_history((dr.KernelType.JIT,))  # and clears it
        pages = int(files.read_text("/proc/self/statm").split()[1])
        now = {
            "resident_bytes": pages * _PAGE_BYTES,
            "compiled": sum(not kernel["cache_hit"] for kernel in history),
            "descriptors": len(os.listdir("/proc/self/fd")),
            "threads": len(os.listdir("/proc/self/task")),
            "cpu_s": time.process_time(),
            "wall_s": time.perf_counter(),
        }
        for name, value in now.items():
            self.samples[name][index] = value


def judge(attack: AbstractAttack) -> dict[str, float]:
    """Return the best objective as it was tracked, and as it is when driven anew."""
    tracked = attack.best_objective
    attack.judge_best()
    return {"tracked": tracked, "judged": attack.best_objective}


def main(scenario_file: str, folder: str) -> None:
    """Attack, or go on from the folder's checkpoint, and write what was seen.

    Whether the attack has converged does not matter: all iterations are done.
    """
    from mi_nerfattack.scenario.world import build_attack, build_world

    output = Path(folder)
    scenario, _ = load_scenario(Path(scenario_file))
    section = scenario.attack
    identity = {**versions(), **scenario.identity()}
    checkpoint = CheckpointFile(output / CHECKPOINT, identity)
    effort = checkpoint.read()
    with deterministic(), dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        world = build_world(scenario, scenario.build_policy())
        attack, count = build_attack(world), section.method.iterations(world.horizon)
        watch = Watch(count)
        if checkpoint.found:
            checkpoint.restore(attack)
        while attack.iteration < count:
            attack.step()
            if attack.iteration % section.checkpoint_every == 0:
                checkpoint.save(attack, effort)
            if attack.iteration == count // 2:
                shutil.copy(checkpoint.path, output / HALF)
            watch.note(attack.iteration - 1)
        files.write_json(output / JUDGED, judge(attack))
    files.write_safetensors(output / SAMPLES, watch.samples)


if __name__ == "__main__":
    variant.ensure()
    main(*sys.argv[1:])
