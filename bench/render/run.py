"""Measure rendering: ours and PyTorch in turns, each in a process of its own."""

from __future__ import annotations

import json
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from bench.full_ngp import NGPData, enlarge
from mi_nerfattack import variant
from mi_nerfattack.errors import NerfAttackError
from mi_nerfattack.fields import NGPField, load_field
from mi_nerfattack.scenes import bundled

SIZES = ((200, 66), (366, 188))
SLAB_SAMPLES = (64, 1024)
SLAB_SIZE = (200, 66)
PAUSE_S = 0.3  # until PyTorch's threads have stopped spinning
QUICK_CHUNK = "1024"

Progress = Callable[[str, int, int, str], None]


@dataclass(frozen=True)
class Settings:
    """What to measure.

    Attributes:
        sizes: widths and heights of the scene's images, pixels.
        object_size: of the object's image, pixels.
        slab_size: of the image whose memory is measured, pixels.
        repeats: of each measurement; the median counts.
        full: measure the full architecture, instead of the bundled field's own.
        chunks: of rays that PyTorch tries, as the worker takes them; none for all.
    """

    sizes: tuple[tuple[int, int], ...] = SIZES
    object_size: tuple[int, int] = SIZES[-1]
    slab_size: tuple[int, int] = SLAB_SIZE
    repeats: int = 5
    full: bool = True
    chunks: tuple[str, ...] = ()

    @staticmethod
    def quick(sizes: tuple[tuple[int, int], ...], repeats: int) -> Settings:
        """Return settings that take seconds: to see that it works, not for figures."""
        return Settings(sizes, sizes[-1], sizes[0], repeats, False, (QUICK_CHUNK,))


class Worker:
    """A side in a process; see :mod:`bench.worker`.

    Args:
        arguments: of the worker.
    """

    def __init__(self, *arguments: str) -> None:
        self.arguments = arguments
        command = [sys.executable, "-m", "bench.worker", *arguments]
        self.process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )

    def __enter__(self) -> Worker:
        self._answer()
        return self

    def __exit__(self, *reason: object) -> None:
        self.process.kill()
        self.process.communicate()

    def ask(self, question: str, *arguments: Any) -> Any:
        """Put a question, a method of a side, and wait for the answer."""
        assert self.process.stdin is not None
        self.process.stdin.write(json.dumps([question, *arguments]) + "\n")
        self.process.stdin.flush()
        return self._answer()

    def _answer(self) -> Any:
        assert self.process.stdout is not None
        line = self.process.stdout.readline()
        if not line:
            self.process.communicate()
            raise NerfAttackError(
                f"bench: the process '{' '.join(self.arguments)}' ended with exit "
                f"code {self.process.returncode}; its message is above"
            )
        return json.loads(line)


@dataclass
class Times:
    """Seconds of one side, one entry a repetition."""

    forward: list[float] = field(default_factory=list)
    derivative: list[float] = field(default_factory=list)
    both: list[float] = field(default_factory=list)

    def take(self, worker: Worker) -> None:
        """Measure once."""
        time.sleep(PAUSE_S)
        self.forward.append(worker.ask("forward"))
        derivative, both = worker.ask("backward")
        self.derivative.append(derivative)
        self.both.append(both)

    @property
    def medians(self) -> tuple[float, float, float]:
        """Medians of forward pass, derivative, and forward pass with derivative."""
        parts = (self.forward, self.derivative, self.both)
        forward, derivative, both = (statistics.median(part) for part in parts)
        return forward, derivative, both


def run(settings: Settings, progress: Progress) -> dict[str, Any]:
    """Measure everything.

    Args:
        settings: what.
        progress: called with stage, steps done, all steps and a remark.

    Returns:
        the document that ``bench render --json`` prints, but for the machine.
    """
    variant.ensure()
    source = load_field(bundled("intersection/field.safetensors"))
    assert isinstance(source, NGPField)
    data = NGPData.of(source)
    data = enlarge(data) if settings.full else data
    document: dict[str, Any] = {
        "sizes": {},
        "kernels_compiled_after_warmup": 0,
        "field": _describe(data),
        "repeats": settings.repeats,
    }
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "field.safetensors"
        data.write(path)
        for size in settings.sizes:
            row, compiled = _compare(settings, size, path, progress)
            document["sizes"][f"{size[0]}x{size[1]}"] = row
            document["kernels_compiled_after_warmup"] += compiled
    document["object_grid"], compiled = _object(settings, progress)
    document["kernels_compiled_after_warmup"] += compiled
    document["memory_by_samples_per_ray"] = _memory(settings, progress)
    return document


def _compare(
    settings: Settings, size: tuple[int, int], path: Path, progress: Progress
) -> tuple[dict[str, Any], int]:
    """Measure one size; also return how many kernels were compiled too late."""
    stage = f"scene {size[0]}x{size[1]}"
    width, height = map(str, size)
    roles = ("ours", "plain", "tuned")
    progress(stage, 0, settings.repeats, "starting")
    with ExitStack() as stack:
        workers = {}
        for role in roles:  # one after the other: the peers try sizes of chunks
            chunks = settings.chunks if role != "ours" else ()
            worker = Worker(role, width, height, str(path), *chunks)
            workers[role] = stack.enter_context(worker)
            worker.ask("backward")  # warm up
        times = {role: Times() for role in roles}
        for repeat in range(settings.repeats):
            for role in roles:
                times[role].take(workers[role])
            progress(stage, repeat + 1, settings.repeats, "")
        facts = {role: workers[role].ask("facts") for role in roles}
        compiled = workers["ours"].ask("kernels")
        memory = {role: workers[role].ask("memory") for role in roles}
    return _row(times, facts, memory), compiled


def _row(
    times: dict[str, Times], facts: dict[str, Any], memory: dict[str, Any]
) -> dict[str, Any]:
    """Put the figures of one size together."""
    row: dict[str, Any] = {}
    prefixes = {"ours": "", "plain": "torch_", "tuned": "torch_tuned_"}
    for role, prefix in prefixes.items():
        samples = facts[role]["samples"]
        forward, derivative, both = times[role].medians
        row |= {
            f"{prefix}samples": samples,
            f"{prefix}forward_samples_per_s": samples / forward,
            f"{prefix}backward_samples_per_s": samples / derivative,
            f"{prefix}forward_and_backward_samples_per_s": samples / both,
            f"{prefix}frame_ms": 1e3 * forward,
            f"{prefix}backward_ms": 1e3 * derivative,
            f"{prefix}peak_memory_mb": memory[role]["peak_memory_mb"],
        }
    row["drjit_peak_memory_mb"] = memory["ours"]["drjit_peak_memory_mb"]
    for prefix in ("torch_", "torch_tuned_"):
        row[f"{prefix}forward_ratio"] = (
            row["forward_samples_per_s"] / row[f"{prefix}forward_samples_per_s"]
        )
        keys = ("backward_samples_per_s", "forward_and_backward_samples_per_s")
        row[f"{prefix}backward_ratio"] = min(row[k] / row[prefix + k] for k in keys)
    row["settings"] = facts
    return row


def _object(settings: Settings, progress: Progress) -> tuple[dict[str, Any], int]:
    width, height = settings.object_size
    stage = f"object {width}x{height}"
    progress(stage, 0, settings.repeats, "starting")
    with Worker("object", str(width), str(height)) as worker:
        worker.ask("backward")
        times = Times()
        for repeat in range(settings.repeats):
            times.take(worker)
            progress(stage, repeat + 1, settings.repeats, "")
        facts, compiled = worker.ask("facts"), worker.ask("kernels")
        memory = worker.ask("memory")
    forward, derivative, _ = times.medians
    row = {
        "size": f"{width}x{height}",
        **facts,
        "forward_ms": 1e3 * forward,
        "backward_ms": 1e3 * derivative,
        "ratio": derivative / forward,
        **memory,
    }
    return row, compiled


def _memory(settings: Settings, progress: Progress) -> dict[str, Any]:
    """Measure the peak of a backward pass for few and for many samples per ray."""
    width, height = map(str, settings.slab_size)
    result: dict[str, Any] = {}
    rounds = (SLAB_SAMPLES[0], *SLAB_SAMPLES)  # the first one may have to compile
    for done, samples in enumerate(rounds):
        progress("memory", done, len(rounds), f"{samples} samples per ray")
        with Worker("slab", width, height, str(samples)) as worker:
            worker.ask("backward")
            result[str(samples)] = worker.ask("memory")
    progress("memory", len(rounds), len(rounds), "")
    few, many = (result[str(samples)] for samples in SLAB_SAMPLES)
    result["change"] = {key: many[key] / few[key] - 1 for key in few}
    return result


def _describe(data: NGPData) -> str:
    layout = data.layout
    return (
        f"bundled intersection in an NGP of {layout.levels} levels from "
        f"{layout.base_resolution} to {layout.max_resolution}, 2^{layout.log2_table} "
        f"vertices of {layout.features} features a level, two networks "
        f"{layout.width} wide; its densities, occupancy and step; camera at the start "
        "of the route 'straight', 90 degrees; rays end at transmittance 0.001"
    )
