"""`bench soak`: one attack of thousands of iterations, and the same resumed half way.

Both are deterministic and of processes of their own: the whole one is watched from
iteration to iteration, and leaves a copy of its folder from which the other goes on.
"""

from __future__ import annotations

import shutil
import subprocess
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from bench.kill.scenario import SCENARIO, make_scenario
from bench.soak.watched import HALF, JUDGED, SAMPLES
from mi_nerfattack.errors import InputError
from mi_nerfattack.experiment.run_folder import CHECKPOINT
from mi_nerfattack.io import files
from mi_nerfattack.system.processes import module_command

EVERY = 10
#: What differs from the scenario that is killed: a small image, steps so small that
#: colours move from the first iteration to the last, objects that move, too, and noise.
_CHANGES = {
    "[drive]": "[policy.preprocess]\nresize_px = [200, 66]\n"
    "[camera]\nwidth = 32\nheight = 16\n[drive]",
    "learning_rate = 0.5": 'parameters = "both"\nlearning_rate = 0.0005\n'
    "pose_learning_rate = 0.0005\nfinal_rate = 1.0\njitter = true\nnoise_sd = 0.02",
    "checkpoint_every = 3": f"checkpoint_every = {EVERY}",
}
#: Of an iteration, bytes: its record in the history, and room for a copy at a
#: checkpoint, take one to two thousand; an image or a texture would take more.
MOST_GROWTH = 4096


@dataclass(frozen=True)
class Soak:
    """What is attacked, and from when on it is watched.

    Attributes:
        iterations: of the attack, a multiple of 20.
        settled: iterations after which memory may not grow, and nothing compile.
    """

    iterations: int = 2000
    settled: int = 200

    def __post_init__(self) -> None:
        enough = 0 < 4 * self.settled <= self.iterations
        if self.iterations % (2 * EVERY) or not enough:
            raise InputError(
                f"iterations: {self.iterations}; a multiple of {2 * EVERY}, at least "
                f"four times the {self.settled} that settle, which are 1 or more"
            )


def run(soak: Soak) -> dict[str, Any]:
    """Attack, go on from the middle, and compare."""
    with tempfile.TemporaryDirectory(prefix="soak-") as name:
        folder = Path(name)
        _write_scenario(folder, soak.iterations)
        whole, resumed = (files.make_folder(folder / n) for n in ("whole", "resumed"))
        _attack(folder, whole)
        shutil.move(whole / HALF, resumed / CHECKPOINT)
        _attack(folder, resumed)
        samples, _ = files.read_safetensors(whole / SAMPLES)
        return {
            "iterations": soak.iterations,
            "settled": soak.settled,
            **figures(samples, soak.settled),
            "objective": files.read_json(whole / JUDGED),
            "differing": _differing(whole, resumed),
        }


def figures(samples: dict[str, np.ndarray], settled: int) -> dict[str, Any]:
    """Say what memory, kernels, time and handles came to.

    Args:
        samples: (n,) each, of the ends of the iterations.
        settled: iterations that do not count.
    """
    resident = samples["resident_bytes"].astype(np.float64)[settled - 1 :]
    slope = np.polyfit(np.arange(len(resident)), resident, 1)[0]
    ends = {"first": slice(settled, 2 * settled), "last": slice(-settled, None)}
    times = {
        f"{end}_{kind}_ms": 1e3 * float(np.median(np.diff(samples[f"{kind}_s"])[part]))
        for end, part in ends.items()
        for kind in ("cpu", "wall")
    }
    counts = {
        name: [int(some.min()), int(some.max())]
        for name in ("descriptors", "threads")
        for some in [samples[name][settled - 1 :]]
    }
    return {
        "resident_mb": [float(resident[0]) / 1e6, float(resident[-1]) / 1e6],
        "growth_b_per_iteration": float(slope),
        "kernels_compiled": int(samples["compiled"][settled:].sum()),
        **counts,
        **times,
    }


def faults(document: dict[str, Any]) -> list[str]:
    """Return what grew or drifted, a sentence each."""
    found = []
    if document["growth_b_per_iteration"] > MOST_GROWTH:
        found.append(f"memory grows by {document['growth_b_per_iteration']:.0f} B each")
    if document["kernels_compiled"]:
        found.append(f"{document['kernels_compiled']} kernels were compiled late")
    for name in ("descriptors", "threads"):
        least, most = document[name]
        if least != most:
            found.append(f"{name}: {least} to {most}")
    tracked, judged = (document["objective"][name] for name in ("tracked", "judged"))
    if tracked != judged:
        found.append(f"the best objective is another when judged anew: {judged}")
    if document["differing"]:
        found.append(f"resumed half way, others: {', '.join(document['differing'])}")
    return found


def _write_scenario(folder: Path, iterations: int) -> None:
    make_scenario(folder)
    text = SCENARIO
    count = {"max_iterations = 30": f"max_iterations = {iterations}"}
    for old, new in {**_CHANGES, **count}.items():
        assert old in text
        text = text.replace(old, new)
    files.write_text(folder / "scenario.toml", text)


def _attack(folder: Path, output: Path) -> None:
    command = module_command("bench.soak.watched")
    words = folder / "scenario.toml", output
    subprocess.run([*command, *map(str, words)], check=True)


def _differing(*folders: Path) -> list[str]:
    """Return which tensors of the last checkpoints are not equal in every bit."""
    one, other = (files.read_safetensors(path / CHECKPOINT)[0] for path in folders)
    names = one.keys() | other.keys()
    raw = [{k: v.tobytes() for k, v in some.items()} for some in (one, other)]
    return sorted(name for name in names if raw[0].get(name) != raw[1].get(name))
