"""The benchmarks on a GPU one after the other, each in a process that may fail."""

from __future__ import annotations

import contextlib
import json
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from mi_nerfattack import variant
from mi_nerfattack.errors import SetupError

VARIANT = "cuda_ad_rgb"


@dataclass(frozen=True)
class Step:
    """One benchmark.

    Attributes:
        name: of its result.
        arguments: of Python.
        limit_s: after which it is stopped.
    """

    name: str
    arguments: tuple[str, ...]
    limit_s: float


def _bench(name: str, limit_s: float, *words: str) -> Step:
    return Step(name, ("-m", "bench", name, *words, "--json"), limit_s)


#: What matters most comes first; within ten minutes, whatever happens.
PLAN = (
    _bench("frames", 60, "--size", "336x188", "--batches", "1", "8", "32", "128"),
    _bench("render", 100, "--sizes", "366x188", "--repeats", "3"),
    _bench("attack", 120, "--sizes", "200x66", "--parts", "time", "--repeats", "1"),
    _bench("fit", 110, "--repeats", "2"),
    Step(
        "tests",
        ("-m", "pytest", "-q", "-m", "not slow", "-k", "cuda_ad", "-n", "4", "tests"),
        190,
    ),
)


def find_gpu() -> dict[str, Any]:
    """Describe the GPU that both sides compute on.

    Raises:
        SetupError: Dr.Jit or PyTorch finds none.
    """
    import drjit as dr
    import torch

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
    about = torch.cuda.get_device_properties(0)
    return {
        "name": about.name,
        "memory_mb": about.total_memory / 1e6,
        "torch_cuda": torch.version.cuda,
    }


def run(
    plan: Sequence[Step],
    document: dict[str, Any],
    keep: Callable[[dict[str, Any]], Any],
    progress: Callable[[str, int, int, str], None],
) -> dict[str, Any]:
    """Do steps, and keep what is known after each.

    Args:
        plan: the steps.
        document: that ``steps`` is added to.
        keep: called with the document after each step.
        progress: called with stage, steps done, all steps and a remark.

    Returns:
        the document; a step has its ``command``, ``seconds``, and ``result``, or the
        ``error`` that there is none.
    """
    steps: dict[str, Any] = {}
    document = {**document, "steps": steps}
    for done, step in enumerate(plan):
        progress("steps", done, len(plan), step.name)
        start = time.monotonic()
        found = _outcome(step)
        steps[step.name] = {
            "command": " ".join(["python", *step.arguments]),
            "seconds": time.monotonic() - start,
            **found,
        }
        keep(document)
    progress("steps", len(plan), len(plan), "")
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
    found, code = _figures(output), process.returncode
    if found is None:
        return {"error": f"ended with {code}, without figures; see above"}
    return {"exit_code": code, "result": found}


def _figures(output: str) -> dict[str, Any] | None:
    """Read JSON, or the counts in the last line of pytest."""
    *_, last = output.strip().splitlines() or [""]
    try:
        return json.loads(last)
    except json.JSONDecodeError:
        counts = re.findall(r"(\d+) (passed|failed|skipped|errors?)", last)
        return {name: int(count) for count, name in counts} or None
