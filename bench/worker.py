"""A side of a comparison as a process: questions and answers are lines of JSON.

A question on stdin is the name of a method of the side and its arguments, in a list.

Sides run in processes of their own because PyTorch's threads keep spinning for a while
after their work, which slows down whatever else its process computes, and because the
largest memory of a process is that of one side alone.
"""

from __future__ import annotations

import importlib
import json
import os
import statistics
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from typing import Any

import torch

from mi_nerfattack import variant
from mi_nerfattack.errors import NerfAttackError
from mi_nerfattack.system.machine import cores, peak_memory_mb

PAUSE_S = 0.3  # until PyTorch's threads have stopped spinning


class Worker:
    """A side in a process; on a GPU where a `cuda_*` variant is chosen.

    Args:
        module: of the side, under `bench`; a module called ``peer`` is in PyTorch.
        side: name of its class, or of a function that makes it.
        arguments: of that, as JSON has them.
    """

    def __init__(self, module: str, side: str, *arguments: Any) -> None:
        self.name = f"{module}.{side}"
        words = [module, side, json.dumps(arguments)]
        self.process = subprocess.Popen(
            [sys.executable, "-m", "bench.worker", *words],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )

    def __enter__(self) -> Worker:
        self._answer()
        return self

    def __exit__(self, *reason: object) -> None:
        self.process.kill()
        self.process.communicate()

    def ask(self, question: str, *arguments: Any) -> Any:
        """Call a method of the side, and wait for the answer."""
        assert self.process.stdin is not None
        self.process.stdin.write(json.dumps([question, *arguments]) + "\n")
        self.process.stdin.flush()
        return self._answer()

    def timed(self, question: str, *arguments: Any) -> Any:
        """Ask when the threads of other sides have stopped spinning."""
        time.sleep(PAUSE_S)
        return self.ask(question, *arguments)

    def _answer(self) -> Any:
        assert self.process.stdout is not None
        line = self.process.stdout.readline()
        if not line:
            self.process.communicate()
            raise NerfAttackError(
                f"bench: the process '{self.name}' ended with exit code "
                f"{self.process.returncode}; its message is above"
            )
        return json.loads(line)


class Clock:
    """Measures from where it is made."""

    def __init__(self) -> None:
        self._wall, self._cpu = time.perf_counter(), time.process_time()

    def per_step(self, count: int = 1) -> dict[str, float]:
        """Return ``seconds`` of time and of all cores' work, one of `count` parts."""
        return {
            "seconds": (time.perf_counter() - self._wall) / count,
            "cpu_seconds": (time.process_time() - self._cpu) / count,
        }


def medians(turns: Sequence[Mapping[str, float]]) -> dict[str, float]:
    """Return the median of each figure over turns."""
    return {key: statistics.median(turn[key] for turn in turns) for key in turns[0]}


def memory() -> dict[str, float]:
    """Return the largest resident size of this process so far, MB.

    On a GPU also what PyTorch's tensors took of it at most.
    """
    peaks = {"peak_memory_mb": peak_memory_mb()}
    if torch.get_default_device().type == "cuda":
        peaks["gpu_memory_mb"] = torch.cuda.max_memory_allocated() / 1e6
    return peaks


def wait() -> None:
    """Wait until all that PyTorch asked of the GPU is done; without one, at once."""
    if torch.get_default_device().type == "cuda":
        torch.cuda.synchronize()


def _serve(module: str, side: str, arguments: str) -> None:
    """Serve one side until stdin ends."""
    if module.endswith("peer"):
        torch.set_num_threads(cores())
        if os.environ.get(variant.VARIABLE, variant.DEFAULT).startswith("cuda"):
            torch.set_default_device("cuda")
    else:
        variant.ensure()
        torch.set_num_threads(1)  # as the commands do: more would wait spinning
    make = getattr(importlib.import_module(f"bench.{module}"), side)
    one = make(*json.loads(arguments))
    print(json.dumps("ready"), flush=True)
    for line in sys.stdin:
        question, *inputs = json.loads(line)
        ask = memory if question == "memory" else getattr(one, question)
        print(json.dumps(ask(*inputs)), flush=True)


if __name__ == "__main__":
    _serve(*sys.argv[1:])
