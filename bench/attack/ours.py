"""Our side of `bench attack`: the iterations of `attack.gradient.GradientAttack`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import drjit as dr
import numpy as np

from bench.attack.drive import (
    MAX_HEADING_RATE,
    MOUNT,
    RATE,
    ROUNDING_M,
    SPEED_MS,
    Job,
    network,
    route,
)
from bench.render.cameras import STOP
from bench.worker import Clock
from mi_nerfattack.attack.base import Freedom
from mi_nerfattack.attack.gradient import GradientAttack
from mi_nerfattack.attack.objectives import CrossTrackDeviation
from mi_nerfattack.backend.determinism import one_thread
from mi_nerfattack.deploy.surrogate.scene import field_sensor
from mi_nerfattack.fields import load_field, load_grid
from mi_nerfattack.policy.preprocess import Preprocess
from mi_nerfattack.policy.torch_policy import TorchPolicy
from mi_nerfattack.render.posed import PosedField
from mi_nerfattack.rollout.adjoint import KeptBackgrounds, Replay
from mi_nerfattack.rollout.function import Rollout
from mi_nerfattack.rollout.loop import ClosedLoop, Step, simulate
from mi_nerfattack.rollout.objective import StageSum
from mi_nerfattack.scenes import bundled
from mi_nerfattack.vehicle.dynamics import Dubins
from mi_nerfattack.vehicle.integrators import RK4

ADJOINTS = {
    "replay": Replay(),
    "kept_backgrounds": KeptBackgrounds(),
    "one_level": KeptBackgrounds(),
}
VISIBLE = 0.01  # opacity from which a pixel counts as the object's


def in_bricks(scene: str, *values: int) -> OurAttack:
    """Return iterations before a background in bricks."""
    return OurAttack(*values, scene=scene)


class OurAttack:
    """Iterations of ours.

    Args:
        values: what is driven, the values of a :class:`Job`.
        scene: field file of the background; the bundled intersection by default.
    """

    def __init__(self, *values: int, scene: str | None = None) -> None:
        self.job = job = Job(*values)
        hydrant = bundled("hydrant/field.safetensors")
        items = [PosedField(load_grid(hydrant), pose) for pose in job.object_poses()]
        field = load_field(scene or bundled("intersection/field.safetensors"))
        sensor = field_sensor(
            PosedField(field), items, job.camera, mount=MOUNT, stop=STOP
        )
        policy = TorchPolicy(network(), preprocess=Preprocess(job.transforms()))
        path = route()
        vehicle = Dubins(SPEED_MS, MAX_HEADING_RATE)
        self.loop = ClosedLoop(
            sensor=sensor,
            policy=policy,
            goal=path.goal,
            dynamics=vehicle,
            integrator=RK4(),
            dt=job.dt,
            eight_bit=False,  # the peer does not round
        )
        self.initial = self.loop.initial(job.initial())
        objective = StageSum(CrossTrackDeviation(path, ROUNDING_M))
        self.rollout = Rollout(self.loop, objective, job.horizon)
        self.route = path
        self.attacks: dict[str, GradientAttack] = {}

    def iterate(self, way: str) -> dict[str, float]:
        """Drive, differentiate, and update the texture by Adam.

        Args:
            way: a key of `ADJOINTS`.

        Returns:
            ``seconds`` and ``cpu_seconds``.
        """
        if way not in self.attacks:
            self.attacks[way] = self._attack(way, self.job.horizon)
        return _timed(self.attacks[way].step)

    def compile(self, way: str) -> None:
        """Let all kernels of :meth:`iterate` be compiled, and kept for later processes.

        By an iteration of two periods: their length is compiled into kernels.
        """
        self._attack(way, 2).step()

    def drive(self) -> dict[str, float]:
        """Drive without derivatives, and return what :meth:`iterate` does."""
        return _timed(lambda: simulate(self.loop, self.initial, self.job.horizon))

    def facts(self) -> dict[str, Any]:
        """Return the object's share of the pixels, mean and largest, and threads."""
        shares: list[float] = []

        def look(step: Step) -> None:
            marches = step.observation.integrator_state.marches
            visible = marches.layers[1].opacity.numpy().reshape(self.job.poses, -1)
            shares.extend((visible > VISIBLE).mean(1).tolist())

        simulate(self.loop, self.initial, self.job.horizon, keep=look)
        return {
            "object_share_mean": float(np.mean(shares)),
            "object_share_max": max(shares),
            "threads": dr.thread_count(),
        }

    def compiled(self, way: str) -> int:
        """Count the kernels that a further iteration compiles."""
        with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
            dr.kernel_history_clear()
            self.iterate(way)
            history = dr.kernel_history((dr.KernelType.JIT,))
        return sum(not entry["cache_hit"] for entry in history)

    def _attack(self, way: str, horizon: int) -> GradientAttack:
        rollout = replace(self.rollout, adjoint=ADJOINTS[way], horizon=horizon)
        return GradientAttack(
            rollout,
            self.route,
            self.initial,
            freedom=Freedom(texture_rate=RATE),
            one_level=way == "one_level",
        )


def _timed(action: Callable[[], Any]) -> dict[str, float]:
    with one_thread():  # as `attack` has torch
        dr.sync_thread()
        clock = Clock()
        action()
        dr.sync_thread()
        return clock.per_step()
