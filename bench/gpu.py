"""``python -m bench gpu`` and ``frames``: all of it on a GPU; frames per second."""

from __future__ import annotations

import contextlib
import json
import os
import re
import signal
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import drjit as dr
import mitsuba as mi
import torch
import tyro

from bench import results
from bench.attack.drive import MOUNT, Job
from bench.render.cameras import STOP
from bench.tables import markdown, number
from mi_nerfattack import variant
from mi_nerfattack.commands.shared.options import check_positive
from mi_nerfattack.commands.shared.terminal import Result
from mi_nerfattack.deploy.surrogate.scene import field_sensor
from mi_nerfattack.errors import InputError, SetupError
from mi_nerfattack.fields import load_field, load_grid
from mi_nerfattack.render.posed import PosedField
from mi_nerfattack.rollout.scene_sensor import SceneSensor
from mi_nerfattack.scenes import bundled
from mi_nerfattack.vehicle.dynamics import to_state

VARIANT = "cuda_ad_rgb"


@dataclass(frozen=True)
class Step:
    """One benchmark: its name, arguments of Python, and seconds until it is stopped."""

    name: str
    arguments: tuple[str, ...]
    limit_s: float


def _bench(name: str, limit_s: float, *words: str) -> Step:
    return Step(name, ("-m", "bench", name, *words, "--json"), limit_s)


_TESTS = ("-m", "pytest", "-q", "-m", "not slow", "-k", "cuda_ad", "-n", "4", "tests")
#: What matters most comes first; within ten minutes, whatever happens.
PLAN = (
    _bench("frames", 60, "--size", "336x188", "--batches", "1", "8", "32", "128"),
    _bench("render", 100, "--sizes", "366x188", "--repeats", "3"),
    _bench("attack", 150, "--sizes", "200x66", "--repeats", "1"),
    _bench("fit", 110, "--repeats", "2"),
    Step("tests", _TESTS, 160),
)


@dataclass(frozen=True)
class BenchGpu:
    """Measure on an NVIDIA GPU, beside PyTorch on the same one, within ten minutes.

    Frames a second by batch, rendering, an attack iteration and a fitting step in
    cuda_ad_rgb, and the tests in the CUDA variants. The file is written again after
    each step, so that nothing is lost; exit code 1 where one failed or took too long.
    """

    output: Annotated[Path, tyro.conf.arg(aliases=["-o"])] = Path("bench/results")
    """A .json file, or a folder in which it is named by date and machine."""
    json: bool = False
    """Print one line of JSON in place of lines."""

    def run(self) -> Result:
        """Look for the GPU, measure, write and print."""
        gpu = find_gpu()
        setup = {"gpu": gpu, "variant": VARIANT}
        start = results.stamp(setup, "make bench-gpu")
        name = f"{gpu['name']} gpu"
        document = measure(
            PLAN, start, lambda made: results.write(self.output, name, made)
        )
        steps = document["steps"]
        good = all(step.get("exit_code") == 0 for step in steps.values())

        def show() -> None:
            print(gpu["name"])
            for name, step in steps.items():
                outcome = step.get("error", "done")
                print(f"{name:7} {step['seconds']:4.0f} s  {outcome}")
            if "result" in steps["frames"]:
                print(*frame_lines(steps["frames"]["result"]), sep="\n")

        return Result(document, show, int(not good))


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
        (size,) = results.read_sizes((self.size,))
        check_positive(self, "repeats")
        if not self.batches or min(self.batches) < 1:
            raise InputError(f"--batches: {self.batches}; one or more, each 1 or more")
        document: dict[str, Any] = {"variant": variant.ensure(), "size_px": [*size]}
        sensor, one = _sensor(Job(*size, 1, 1)), to_state(Job(*size, 1, 1).initial())

        def latency() -> float:
            return results.timed(
                lambda: sensor.observe(one, 0).image.numpy(), time.perf_counter
            )

        latency()  # compiles
        seconds = [latency() for _ in range(self.repeats)]
        document["latency_ms"] = 1e3 * statistics.median(seconds)
        states = [to_state(Job(*size, n, 1).initial()) for n in self.batches]
        document["batches"] = [_row(sensor, state, self.repeats) for state in states]
        return Result(document, lambda: print(*frame_lines(document), sep="\n"))


def find_gpu() -> dict[str, Any]:
    """Describe the GPU that both sides compute on.

    Raises:
        SetupError: Dr.Jit or PyTorch finds none.
    """
    if not dr.has_backend(dr.JitBackend.CUDA):
        raise SetupError(
            "bench gpu: Dr.Jit finds no NVIDIA GPU with a driver; run it on a machine "
            "where nvidia-smi lists one, and see 'mi-nerfattack doctor'"
        )
    if not torch.cuda.is_available():
        raise SetupError(
            f"bench gpu: PyTorch {torch.__version__} finds no GPU, Dr.Jit does; "
            "install the build of PyTorch for the driver's version of CUDA"
        )
    properties = torch.cuda.get_device_properties(0)
    return {
        "name": properties.name,
        "memory_mb": properties.total_memory / 1e6,
        "torch_cuda": torch.version.cuda,
    }


def measure(
    plan: Sequence[Step],
    document: dict[str, Any],
    keep: Callable[[dict[str, Any]], Any],
) -> dict[str, Any]:
    """Do steps, and keep what is known after each.

    Args:
        plan: the steps.
        document: that ``steps`` is added to.
        keep: called with the document after each step.

    Returns:
        the document; a step has its ``command``, ``seconds``, and ``result``, or the
        ``error`` that there is none.
    """
    steps: dict[str, Any] = {}
    document = {**document, "steps": steps}
    with results.progress() as show:
        for done, step in enumerate(plan):
            show("steps", done, len(plan), step.name)
            start = time.monotonic()
            outcome = _outcome(step)
            seconds = time.monotonic() - start
            command = " ".join(["python", *step.arguments])
            steps[step.name] = {"command": command, "seconds": seconds, **outcome}
            keep(document)
        show("steps", len(plan), len(plan), "")
    return document


def _outcome(step: Step) -> dict[str, Any]:
    """Run a step, and read what it prints; ends all that it has started."""
    with subprocess.Popen(
        [sys.executable, *step.arguments],
        env=os.environ | {variant.VARIABLE: VARIANT},
        stdout=subprocess.PIPE,
        text=True,
        start_new_session=True,
    ) as process:
        try:
            output, _ = process.communicate(timeout=step.limit_s)
        except subprocess.TimeoutExpired:
            return {"error": f"not done after {step.limit_s:g} s"}
        finally:  # Ctrl-C, too: others would compute on
            with contextlib.suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)
    figures, code = _figures(output), process.returncode
    if figures is None:
        return {"error": f"ended with {code}, without figures; see above"}
    return {"exit_code": code, "result": figures}


def _figures(output: str) -> dict[str, Any] | None:
    """Read JSON, or the counts in the last line of pytest."""
    *_, last = output.strip().splitlines() or [""]
    try:
        return json.loads(last)
    except json.JSONDecodeError:
        counts = re.findall(r"(\d+) (passed|failed|skipped|errors?)", last)
        return {name: int(count) for count, name in counts} or None


def _sensor(job: Job) -> SceneSensor:
    scene = PosedField(load_field(bundled("intersection/field.safetensors")))
    hydrant = load_grid(bundled("hydrant/field.safetensors"))
    items = [PosedField(hydrant, pose) for pose in job.object_poses()]
    return field_sensor(scene, items, job.camera, mount=MOUNT, stop=STOP)


def _row(sensor: SceneSensor, state: Any, repeats: int) -> dict[str, float]:
    sensor.observe(state, 0)
    dr.sync_thread()
    dr.flush_malloc_cache()
    dr.detail.malloc_clear_statistics()
    seconds = [
        results.timed(lambda: sensor.observe(state, 0), time.perf_counter)
        for _ in range(repeats)
    ]
    count, median = dr.width(state), statistics.median(seconds)
    peak = dr.detail.malloc_watermark(dr.backend_v(mi.Float))
    return {
        "frames": count,
        "batch_ms": 1e3 * median,
        "frames_per_s": count / median,
        "drjit_peak_memory_mb": peak / 1e6,
    }


def frame_lines(document: dict[str, Any]) -> list[str]:
    """Return frames a second by batch as a table, and the latency of one frame."""
    keys = ("frames", "frames_per_s", "drjit_peak_memory_mb")
    rows = [[number(row[key]) for key in keys] for row in document["batches"]]
    table = markdown(("frames at a time", "frames/s", "Dr.Jit's memory, MB"), rows)
    return [table, "", f"latency of one frame: {document['latency_ms']:.1f} ms"]
