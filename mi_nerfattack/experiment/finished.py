"""What a run came to, before anything of it is written."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from mi_nerfattack.attack.base import AbstractAttack
from mi_nerfattack.rollout.drive import Drive, Lane
from mi_nerfattack.scenario.world import Appearance, World

#: Which frames of a drive become files: see :func:`pictures.frames.frame_steps`.
Frames = Literal["all", "worst"] | int


@dataclass(frozen=True)
class Finished:
    """What a run came to.

    Attributes:
        world: what was driven in; its textures are changed by what looks at it.
        drives: all drives.
        attack: the finished attack.
        looks: how the objects look and where they stand, per case; None: nowhere.
        ignored: changes between interruption and resumption that were ignored.
        baseline: figures of the random looks.
        flags: findings of the checks before the attack.
    """

    world: World
    drives: list[Drive]
    attack: AbstractAttack
    looks: Mapping[str, Appearance | None]
    ignored: list[str]
    baseline: dict[str, Any]
    flags: list[str]

    def look(self, case: str) -> Appearance:
        """Return how the objects look in a case that has any."""
        look = self.looks[case]
        assert look is not None, "objects are there"
        return look

    @property
    def curve(self) -> dict[str, list[float]] | None:
        """What the attack had found after how many frames, for ``metrics.json``.

        None where changes were ignored: then its objectives may have several units.
        """
        if self.ignored:
            return None
        multiple = self.baseline["backward_multiple"]
        frames, objectives, means = self.attack.curve(multiple).T
        return {
            "frames": np.rint(frames).astype(int).tolist(),
            "objective": objectives.tolist(),
            "cross_track_mean_m": means.tolist(),
        }

    @property
    def replayed(self) -> list[Drive]:
        """The drives of recordings."""
        return [d for d in self.drives if self.world.is_open_loop(d.environment)]

    @property
    def driven(self) -> list[Drive]:
        """The drives in closed loops."""
        return [d for d in self.drives if not self.world.is_open_loop(d.environment)]

    @property
    def lane(self) -> Lane:
        """Of the route."""
        return Lane.of(self.world.route, self.world.scenario.vehicle.width_m)
