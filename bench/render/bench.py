"""``python -m bench render``: rendering and its derivative beside PyTorch."""

from __future__ import annotations

from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from bench.ngp_data import NGPData
from bench.results import Comparison, Progress, compare, read_sizes
from bench.tables import markdown, number
from bench.worker import Worker, medians
from mi_nerfattack.commands.shared.terminal import Result
from mi_nerfattack.fields import NGPField, load_field
from mi_nerfattack.scenes import bundled

#: Figures of both sides: what they are of, key of the seconds, unit.
ROWS = (
    ("forward", "million samples/s", "forward_samples_per_s", 1e-6),
    ("backward", "million samples/s", "backward_samples_per_s", 1e-6),
    ("both", "million samples/s", "forward_and_backward_samples_per_s", 1e-6),
    ("frame", "ms", "frame_ms", 1.0),
    ("gradient", "ms", "backward_ms", 1.0),
    ("samples", "thousand", "samples", 1e-3),
    ("peak memory", "MB", "peak_memory_mb", 1.0),
)


@dataclass(frozen=True)
class BenchRender(Comparison):
    """Measure rendering and its derivative against the same field in PyTorch.

    Both sides run in turns, in processes of their own, on all cores; medians count.
    Keep the machine otherwise idle. Takes some minutes.
    """

    sizes: tuple[str, ...] = ("200x66", "366x188")
    """Widths and heights of the camera's image, pixels."""

    def run(self) -> Result:
        """Measure, print and write."""
        read_sizes(self.sizes)
        return compare("render", self, measure, lines=lines)


def measure(options: BenchRender, folder: Path, show: Progress) -> dict[str, Any]:
    """Measure everything, and return the document, but for its stamp."""
    source = load_field(bundled("intersection/field.safetensors"))
    assert isinstance(source, NGPField)
    data = NGPData.of(source)
    sizes = read_sizes(options.sizes)
    document: dict[str, Any] = {"sizes": {}, "repeats": options.repeats}
    path = folder / "field.safetensors"
    data.write(path)
    for text, size in zip(options.sizes, sizes, strict=True):
        document["sizes"][text] = _compare(options, str(path), size, show=show)
    late = sum(row.pop("compiled") for row in document["sizes"].values())
    return document | {
        "kernels_compiled_after_warmup": late,
        "field": _describe(data),
    }


def _compare(
    options: BenchRender, path: str, size: tuple[int, int], show: Progress
) -> dict[str, Any]:
    """Measure one size, both sides in turns."""
    stage, repeats = f"scene {size[0]}x{size[1]}", options.repeats
    chunks = [[1024]] if options.quick else []
    show(stage, 0, repeats, "starting")
    with ExitStack() as stack:
        sides = {}
        for prefix, (module, name, arguments) in {
            "": ("render.ours", "scene_side", []),
            "torch_": ("render.peer", "TorchSide", chunks),
        }.items():  # one after the other: the peer tries sizes of chunks
            worker = Worker(module, name, path, *size, *arguments)
            sides[prefix] = stack.enter_context(worker)
            worker.ask("backward")  # warms up
        turns: dict[str, list[dict[str, float]]] = {prefix: [] for prefix in sides}
        for repeat in range(repeats):
            for prefix, worker in sides.items():
                turns[prefix].append(_turn(worker))
            show(stage, repeat + 1, repeats, "")
        row: dict[str, Any] = {"settings": {}}
        for prefix, worker in sides.items():
            facts = worker.ask("facts")
            row["settings"][prefix or "ours"] = facts
            figures = _rates(facts["samples"], medians(turns[prefix]))
            figures |= worker.ask("memory")
            row |= {prefix + key: value for key, value in figures.items()}
        row["compiled"] = sides[""].ask("kernels")
        row["drjit_peak_memory_mb"] = sides[""].ask("drjit_memory")
    forward, *backward = (row[key] / row[f"torch_{key}"] for _, _, key, _ in ROWS[:3])
    return row | {"torch_forward_ratio": forward, "torch_backward_ratio": min(backward)}


def _turn(worker: Worker) -> dict[str, float]:
    forward = worker.timed("forward")
    derivative, both = worker.ask("backward")
    return {"forward": forward, "derivative": derivative, "both": both}


def _rates(samples: int, seconds: dict[str, float]) -> dict[str, float]:
    return {
        "samples": samples,
        "forward_samples_per_s": samples / seconds["forward"],
        "backward_samples_per_s": samples / seconds["derivative"],
        "forward_and_backward_samples_per_s": samples / seconds["both"],
        "frame_ms": 1e3 * seconds["forward"],
        "backward_ms": 1e3 * seconds["derivative"],
    }


def _describe(data: NGPData) -> str:
    layout = data.layout
    return (
        f"bundled intersection in an NGP of {layout.levels} levels from "
        f"{layout.base_resolution} to {layout.max_resolution}, 2^{layout.log2_table} "
        f"vertices of {layout.features} features a level, two networks "
        f"{layout.width} wide; its densities, occupancy and step; camera at the start "
        "of the route 'straight', 90 degrees; rays end at transmittance 0.001"
    )


def lines(document: dict[str, Any]) -> list[str]:
    """Return the table and the lines below it."""
    rows = [
        (size, what, unit, *(number(row[p + key] * by) for p in ("", "torch_")))
        for size, row in document["sizes"].items()
        for what, unit, key, by in ROWS
    ]
    report = [markdown(("size", "what", "unit", "ours", "PyTorch"), rows), ""]
    report += [
        f"{size}: times as fast as PyTorch: forward {row['torch_forward_ratio']:.2f}, "
        f"backward {row['torch_backward_ratio']:.2f} (the less favourable of the "
        "derivative alone and of forward with derivative)"
        for size, row in document["sizes"].items()
    ]
    compiled = document["kernels_compiled_after_warmup"]
    return [
        *report,
        f"kernels compiled after the warm-up: {compiled}",
        document["field"],
    ]
