"""``python -m bench attack``: an iteration beside a drive, and beside PyTorch."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import astuple, dataclass
from pathlib import Path
from typing import Any

from bench.attack.drive import OBJECT_POSE, Job
from bench.ngp_data import NGPData
from bench.results import Comparison, Progress, compare, read_sizes, run_for_output
from bench.tables import markdown, number
from bench.torch.object import ObjectData
from bench.worker import Worker, medians
from mi_nerfattack.commands.shared.terminal import Result
from mi_nerfattack.errors import NerfAttackError
from mi_nerfattack.fields import NGPField, load_field, load_grid
from mi_nerfattack.render.posed import PosedField
from mi_nerfattack.scenes import bundled

WAYS = ("kept_backgrounds", "one_level", "replay")
#: Keys of the times, and whose they are.
TIMES = {
    "rollout": "drive alone",
    "kept_backgrounds": "iteration, backgrounds kept",
    "one_level": "the same, objects as one level",
    "replay": "iteration, replay",
    "bricks_rollout": "drive alone in bricks",
    "bricks_kept_backgrounds": "iteration in bricks, backgrounds kept",
    "bricks_one_level": "the same, objects as one level",
    "torch": "iteration, PyTorch",
}
HORIZON = 25  # control periods


@dataclass(frozen=True)
class BenchAttack(Comparison):
    """Measure an attack iteration against a drive and against the loop in PyTorch.

    One drive past the bundled hydrant, both sides in turns, in processes of their own,
    on all cores; medians count. We also drive before the scene in bricks, PyTorch does
    not. Keep the machine otherwise idle. Takes about five minutes.
    """

    repeats: int = 3
    """Turns of each side."""
    sizes: tuple[str, ...] = ("200x66", "366x188")
    """Widths and heights of the camera's image, pixels."""

    def run(self) -> Result:
        """Measure, print and write."""
        read_sizes(self.sizes)
        return compare("attack", self, measure, lines=lines)


def measure(options: BenchAttack, folder: Path, show: Progress) -> dict[str, Any]:
    """Measure everything, and return the document, but for its stamp."""
    scene, item = folder / "scene.safetensors", folder / "item.safetensors"
    field = load_field(bundled("intersection/field.safetensors"))
    assert isinstance(field, NGPField)
    NGPData.of(field).write(scene)
    hydrant = load_grid(bundled("hydrant/field.safetensors"))
    ObjectData.of(PosedField(hydrant, OBJECT_POSE)).write(item)
    bricks = folder / "bricks.safetensors"
    words = ["bake", str(bundled("base.toml")), "-o", str(bricks)]
    code, text = run_for_output([*words, *(["--passes", "0"] * options.quick)])
    if code:
        raise NerfAttackError(f"bench: `bake` ended with exit code {code}: {text}")
    horizon = 2 if options.quick else HORIZON
    sizes = read_sizes(options.sizes)
    rows: dict[str, Any] = {}
    for text, size in zip(options.sizes, sizes, strict=True):
        job = Job(*size, 1, horizon)
        peer = [str(scene), str(item), astuple(job), *[[4096]] * options.quick]
        rows[text] = _times(job, str(bricks), peer, repeats=options.repeats, show=show)
    return {"horizon": horizon, "repeats": options.repeats, "sizes": rows}


def _times(
    job: Job, bricks: str, peer: Sequence[Any], repeats: int, show: Progress
) -> dict[str, Any]:
    """Time drives and iterations of one vehicle, both sides in turns."""
    stage = f"time, {job.width}x{job.height}"
    show(stage, 0, repeats, "starting")
    turns: dict[str, list[dict[str, float]]] = {name: [] for name in TIMES}
    with ExitStack() as stack:
        ours = stack.enter_context(Worker("attack.ours", "OurAttack", *astuple(job)))
        in_bricks = stack.enter_context(
            Worker("attack.ours", "in_bricks", bricks, *astuple(job))
        )
        sides = [("", ours, WAYS), ("bricks_", in_bricks, WAYS[:2])]
        for _, side, ways in sides:  # traces and compiles
            for way in ways:
                side.ask("iterate", way)
        theirs = stack.enter_context(Worker("attack.peer", "TorchAttack", *peer))
        for repeat in range(repeats):
            for name, side, ways in sides:
                turns[f"{name}rollout"].append(side.timed("drive"))
                for way in ways:
                    turns[f"{name}{way}"].append(side.ask("iterate", way))
            turns["torch"].append(theirs.timed("iterate"))
            show(stage, repeat + 1, repeats, "")
        row = {
            "settings": {"ours": ours.ask("facts"), "torch": theirs.ask("facts")},
            "kernels_compiled_after_warmup": sum(
                side.ask("compiled", way) for _, side, ways in sides for way in ways
            ),
            "peak_memory_mb": ours.ask("memory")["peak_memory_mb"],
            "torch_peak_memory_mb": theirs.ask("memory")["peak_memory_mb"],
        }
    median = {name: medians(some) for name, some in turns.items()}
    row |= {f"{n}_{key}": v for n, some in median.items() for key, v in some.items()}
    iteration, rollout = (row[f"{name}_seconds"] for name in (WAYS[0], "rollout"))
    return row | {
        "iteration_over_rollout": iteration / rollout,
        "replay_over_rollout": row["replay_seconds"] / rollout,
        "torch_time_ratio": row["torch_seconds"] / iteration,
        "torch_cpu_ratio": row["torch_cpu_seconds"] / row[f"{WAYS[0]}_cpu_seconds"],
    }


def lines(document: dict[str, Any]) -> list[str]:
    """Return the table and the lines below it."""
    rows, notes = [], []
    for size, row in document["sizes"].items():
        iteration = row["kept_backgrounds_seconds"]
        for name, whose in TIMES.items():
            values = row[f"{name}_seconds"], row[f"{name}_cpu_seconds"]
            ratio = row[f"{name}_seconds"] / iteration
            rows.append((size, whose, *map(number, (*values, ratio))))
        facts = row["settings"]["ours"]
        notes += [
            f"{size}: an iteration costs {row['iteration_over_rollout']:.2f} drives "
            f"with kept backgrounds, {row['replay_over_rollout']:.2f} with replay",
            f"{size}: the object fills {facts['object_share_mean']:.1%} of the frame "
            f"on average, {facts['object_share_max']:.1%} at most",
            f"{size}: peak memory {row['peak_memory_mb']:.0f} MB; of PyTorch "
            f"{row['torch_peak_memory_mb']:.0f} MB",
            f"{size}: compiled after the warm-up: "
            f"{row['kernels_compiled_after_warmup']} kernels",
        ]
    header = ("size", "what", "seconds", "CPU seconds", "to ours")
    return [markdown(header, rows), "", *notes]
