"""Pieces of work as tasks of a Ray cluster."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from mi_nerfattack.errors import InputError, SetupError
from mi_nerfattack.extras import load_extra
from mi_nerfattack.system.workers import (
    AbstractWork,
    AbstractWorkers,
    OnEnd,
    OnUnits,
    do_alone,
    failure,
)

#: Starts a cluster of this machine alone, which ends with the work.
LOCAL = "local"


@dataclass(frozen=True)
class RayTasks(AbstractWorkers):
    """One task for each piece, each in a separate process.

    Ray itself never repeats a task. The caller decides how often a piece is tried, and
    does so in the same way with every executor. Units of work are not reported.

    Args:
        address: of the cluster, HOST:PORT or ray://HOST:PORT; "auto": the one that
            this machine is part of; `LOCAL`.
        cores: cores of each task.
        memory_gb: memory of each task, GB.
        count: most tasks at a time; None: as many as the cluster has room for.
    """

    address: str
    cores: int = 1
    memory_gb: float = 4.0
    count: int | None = None

    def _do(
        self, work: AbstractWork, pieces: Sequence[int], report: OnUnits, on_end: OnEnd
    ) -> None:
        """See :meth:`run`.

        Raises:
            InputError: no machine of the cluster has the cores and the memory.
            SetupError: there is no cluster, or Ray is not installed.
        """
        ray = self._connect()
        try:
            self._check(ray)
            remote = ray.remote(
                num_cpus=self.cores,
                memory=self._bytes,
                max_retries=0,
                max_calls=1,  # another process for each
            )
            task = remote(do_alone)
            left, running = list(reversed(pieces)), {}
            most = len(pieces) if self.count is None else self.count
            while left or running:
                while left and len(running) < most:
                    piece = left.pop()
                    running[task.remote(work, piece)] = piece
                (ended,), _ = ray.wait(list(running), num_returns=1)
                piece = running.pop(ended)
                on_end(piece, _error(ray, piece, ended))
        finally:
            ray.shutdown()  # which ends what is left

    @property
    def _bytes(self) -> int:
        return round(self.memory_gb * (1 << 30))

    def _connect(self) -> Any:
        os.environ["RAY_USAGE_STATS_ENABLED"] = "0"  # it tells its makers otherwise
        ray = load_extra("ray", "Ray")
        options = {}
        if self.address == LOCAL:
            count = self.count and self.count * self.cores
            options = {"include_dashboard": False, "num_cpus": count}
        try:
            ray.init(
                self.address, log_to_driver=False, logging_level="error", **options
            )
        except (ConnectionError, RuntimeError, ValueError) as err:
            raise SetupError(
                f"Ray: {self.address!r}: {err}; start a cluster with 'ray start "
                f"--head --disable-usage-stats', or give {LOCAL!r}"
            ) from err
        return ray

    def _check(self, ray: Any) -> None:
        nodes = [node["Resources"] for node in ray.nodes() if node["Alive"]]
        for node in nodes:
            has = node.get("CPU", 0) >= self.cores, node.get("memory", 0) >= self._bytes
            if all(has):
                return
        shown = ", ".join(
            f"{node.get('CPU', 0):g} and {node.get('memory', 0) / (1 << 30):.1f} GB"
            for node in nodes
        )
        raise InputError(
            f"Ray: no machine has {self.cores} cores and {self.memory_gb:g} GB for a "
            f"task; they have {shown}"
        )


def _error(ray: Any, piece: int, ended: Any) -> Exception | None:
    """Return why a task that has ended did not do its piece."""
    try:
        return failure(piece, ray.get(ended))
    except ray.exceptions.RayError as err:
        message = " ".join(str(err).split())[:500]
        return InputError(f"a task of Ray ended in piece {piece}: {message}")
