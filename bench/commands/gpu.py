"""``python -m bench gpu`` and ``frames``: all of it on a GPU; frames a second."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro

from mi_nerfattack.commands.shared.result import Result


@dataclass(frozen=True)
class BenchGpu:
    """Measure on an NVIDIA GPU, beside PyTorch on the same one, within ten minutes.

    Frames a second by batch, rendering, an attack iteration and a fitting step in
    cuda_ad_rgb, and the tests in the CUDA variants. The file is written anew after each
    step, so that nothing is lost; exit code 1 where one failed or took too long.
    """

    output: Annotated[Path, tyro.conf.arg(aliases=["-o"])] = Path("bench/results")
    """A .json file, or a folder in which it is named by date and machine."""
    json: bool = False
    """Print one line of JSON in place of lines."""

    def run(self) -> Result:
        """Look for the GPU, measure, write and print."""
        from bench import results
        from bench.commands.speed import measure
        from bench.gpu import run as gpu

        found = gpu.find_gpu()
        name = f"{found['name']} gpu"
        about = {"gpu": found, "variant": gpu.VARIANT}
        start = results.stamp(about, ["make", "bench-gpu"])
        paths: set[Path] = set()

        def keep(document: dict[str, Any]) -> None:
            paths.add(results.write(self.output, name, document))

        document = measure(gpu.run, gpu.PLAN, start, keep)
        print("written to", *paths, file=sys.stderr)
        steps = document["steps"].values()
        good = all(step.get("exit_code") == 0 for step in steps)
        return Result(document, lambda: _print(document), int(not good))


@dataclass(frozen=True)
class BenchFrames:
    """Measure frames a second of the policies' camera by how many are rendered at once.

    The bundled intersection with a hydrant, as in `bench attack`; also the latency of
    one frame until it is in main memory, and Dr.Jit's memory.
    """

    size: str = "336x188"
    """Width and height of a frame, pixels."""
    batches: tuple[int, ...] = (1, 8)
    """Frames at a time; with a GPU as many as 128."""
    repeats: int = 5
    """Repetitions of each measurement; the median counts."""
    json: bool = False
    """Print one line of JSON in place of the lines."""

    def run(self) -> Result:
        """Render, and print."""
        from bench.commands.speed import measure, read_sizes
        from bench.render import frames
        from mi_nerfattack.commands.shared.options import check_positive
        from mi_nerfattack.errors import InputError

        (size,) = read_sizes((self.size,))
        check_positive(self, "repeats")
        if not self.batches or min(self.batches) < 1:
            raise InputError(f"--batches: {self.batches}; one or more, each 1 or more")
        document = measure(frames.run, size, self.batches, self.repeats)
        return Result(document, lambda: _print_frames(document))


def _print(document: dict[str, Any]) -> None:
    print(document["gpu"]["name"])
    for name, step in document["steps"].items():
        print(f"{name:7} {step['seconds']:4.0f} s  {step.get('error', 'done')}")
        if name == "frames" and "result" in step:
            _print_frames(step["result"])
        elif name == "tests" and "result" in step:
            print(f"  {step['result']}")


def _print_frames(document: dict[str, Any]) -> None:
    for row in document["batches"]:
        print(
            f"  {row['frames']:4} at a time: {row['frames_per_s']:.1f} frames/s, "
            f"{row['drjit_peak_memory_mb']:.0f} MB"
        )
    print(f"  latency of one: {document['latency_ms']:.1f} ms")
