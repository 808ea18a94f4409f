"""Our side of `bench attack`: the iterations of `attack.gradient.GradientAttack`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields, is_dataclass, replace
from pathlib import Path
from typing import Any

import drjit as dr
import numpy as np
import torch

from bench.attack.drive import (
    BAKED,
    MAX_HEADING_RATE,
    MOUNT,
    RATE,
    ROUNDING_M,
    SPEED_MS,
    Job,
    network,
    route,
)
from bench.attack.sides import AbstractAttack
from bench.render.sides import STOP, Clock
from mi_nerfattack.attack.freedom import Freedom
from mi_nerfattack.attack.gradient import GradientAttack
from mi_nerfattack.attack.objectives import CrossTrackDeviation
from mi_nerfattack.deploy.surrogate.scene import field_sensor
from mi_nerfattack.fields import load_field, load_grid
from mi_nerfattack.policy.preprocess import Preprocess
from mi_nerfattack.policy.torch_policy import TorchPolicy
from mi_nerfattack.render.posed import PosedField
from mi_nerfattack.rollout.adjoint import KeptBackgrounds, Replay
from mi_nerfattack.rollout.function import Rollout
from mi_nerfattack.rollout.loop import ClosedLoop, Step, simulate
from mi_nerfattack.rollout.objective import StageSum
from mi_nerfattack.rollout.sweep import differentiable
from mi_nerfattack.scenes import bundled
from mi_nerfattack.vehicle.dynamics import Dubins
from mi_nerfattack.vehicle.integrators import RK4

ADJOINTS = {
    "replay": Replay(),
    "kept_backgrounds": KeptBackgrounds(),
    BAKED: KeptBackgrounds(),
}
VISIBLE = 0.01  # opacity from which a pixel counts as the object's


class OurAttack(AbstractAttack):
    """Iterations of ours.

    Args:
        job: what is driven.
        baked: field file of the scene's bricks, for the way `BAKED`.
    """

    def __init__(self, job: Job, baked: Path | None = None) -> None:
        torch.set_num_threads(1)  # as the commands do: more would wait spinning
        self.job = job
        hydrant = bundled("hydrant/field.safetensors")
        items = [PosedField(load_grid(hydrant), pose) for pose in job.object_poses()]
        scene = PosedField(load_field(bundled("intersection/field.safetensors")))
        sensor = field_sensor(scene, items, job.camera, MOUNT, stop=STOP)
        policy = TorchPolicy(network(), preprocess=Preprocess(job.transforms()))
        path = route()
        vehicle = Dubins(SPEED_MS, MAX_HEADING_RATE)
        self.loop = ClosedLoop(
            sensor,
            policy,
            path.goal,
            vehicle,
            RK4(),
            job.dt,
            eight_bit=False,  # the peer does not round
        )
        self.initial = self.loop.initial(job.initial())
        objective = StageSum(CrossTrackDeviation(path, ROUNDING_M))
        self.rollout = Rollout(self.loop, objective, job.horizon)
        self.route = path
        self.attacks: dict[str, GradientAttack] = {}
        self.loops = dict.fromkeys(set(ADJOINTS) - {BAKED}, self.loop)
        if baked is not None:
            view = job.camera, MOUNT, None, STOP
            bricks = field_sensor(PosedField(load_field(baked)), items, *view)
            self.loops[BAKED] = replace(self.loop, sensor=bricks)

    def iterate(self, how: str) -> dict[str, float]:
        """See :meth:`AbstractAttack.iterate`; `how` is a key of `ADJOINTS`."""
        if how not in self.attacks:
            self.attacks[how] = self._attack(how, self.job.horizon)
        return _timed(self.attacks[how].step)

    def compile(self, how: str) -> None:
        """Let all kernels of :meth:`iterate` be compiled, and kept for later processes.

        By an iteration of two periods: their length is compiled into kernels.
        """
        self._attack(how, 2).step()

    def drive(self, how: str = "replay") -> dict[str, float]:
        """Drive without derivatives, and return what :meth:`iterate` does."""
        loop = self.loops[how]
        return _timed(lambda: simulate(loop, self.initial, self.job.horizon))

    def facts(self) -> dict[str, Any]:
        """Return the object's share of the pixels, mean and largest, and threads."""
        shares: list[float] = []

        def look(step: Step) -> None:
            seen = step.observation.kept.seen
            visible = seen.layers[1].opacity.numpy().reshape(self.job.poses, -1)
            shares.extend((visible > VISIBLE).mean(1).tolist())

        simulate(self.loop, self.initial, self.job.horizon, keep=look)
        return {
            "object_share_mean": float(np.mean(shares)),
            "object_share_max": max(shares),
            "threads": dr.thread_count(),
        }

    def launches(self, how: str) -> dict[str, float]:
        """Count kernels of a further iteration.

        Returns:
            ``compiled``, and launches a control period: ``rollout``, those of it over
            all pixels of all poses (``rollout_over_pixels``; the others are over
            poses or single numbers), and ``iteration``, with its backward pass.
        """
        rollout, wide, compiled = self._history(lambda: self.drive(how))
        iteration, _, late = self._history(lambda: self.iterate(how))
        horizon = self.job.horizon
        return {
            "compiled": compiled + late,
            "rollout": rollout / horizon,
            "rollout_over_pixels": wide / horizon,
            "iteration": iteration / horizon,
        }

    def kept_bytes(self) -> float:
        """Return what `KeptBackgrounds` keeps of a control period, bytes."""
        sizes: list[int] = []

        def look(step: Step) -> None:
            kept = differentiable(self.loop).keep(step.observation)
            sizes.append(_bytes(kept))

        simulate(self.loop, self.initial, 1, keep=look)
        return sizes[0]

    def _attack(self, how: str, horizon: int) -> GradientAttack:
        parts = {"loop": self.loops[how], "adjoint": ADJOINTS[how]}
        rollout = replace(self.rollout, **parts, horizon=horizon)
        freedom = Freedom(texture_rate=RATE)
        return GradientAttack(rollout, self.route, self.initial, freedom)

    def _history(self, action: Callable[[], Any]) -> tuple[int, int, int]:
        """Count kernels: launched, those over all pixels, and compiled."""
        with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
            dr.kernel_history_clear()
            action()
            history = dr.kernel_history((dr.KernelType.JIT,))
        pixels = self.job.width * self.job.height * self.job.poses
        wide = sum(entry["size"] == pixels for entry in history)
        return len(history), wide, sum(not entry["cache_hit"] for entry in history)


def _timed(action: Callable[[], Any]) -> dict[str, float]:
    dr.sync_thread()
    clock = Clock()
    action()
    dr.sync_thread()
    return clock.per_step(1)


def _bytes(value: Any) -> int:
    """Count the bytes of Dr.Jit arrays in lists and data classes."""
    if value is None:
        return 0
    if is_dataclass(value):
        return sum(_bytes(getattr(value, item.name)) for item in fields(value))
    if isinstance(value, list | tuple):
        return sum(map(_bytes, value))
    parts = value if dr.depth_v(value) > 1 else [value]
    return sum(dr.width(part) * dr.itemsize_v(type(part)) for part in parts)
