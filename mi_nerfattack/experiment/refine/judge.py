"""Textures of a found attack, judged by drives in an environment."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from mi_nerfattack.attack.black_box.search import Judged, Proposal, Textures
from mi_nerfattack.backend.determinism import one_thread
from mi_nerfattack.deploy.driving import drive
from mi_nerfattack.deploy.environment import AbstractEnvironment
from mi_nerfattack.experiment.transfer.columns import Column
from mi_nerfattack.experiment.transfer.found import FoundAttack
from mi_nerfattack.rollout.loop import OnStep
from mi_nerfattack.scenario.world import Appearance, World, optimised_states


class EnvironmentJudge:
    """Drives from the poses that the attack was optimised from, objects at its places.

    The objective is minus the mean distance from the lane centre, times the control
    periods of a drive: that of an attack without ``[objective]``, but for its rounding.

    Args:
        world: of the attack; what its objects show is changed.
        found: the attack.
        column: environment and condition.
        on_drive: called after each drive.
    """

    def __init__(
        self,
        world: World,
        found: FoundAttack,
        column: Column,
        on_drive: Callable[[], None] = lambda: None,
    ) -> None:
        self.world, self.found, self.column = world, found, column
        self._on_drive = on_drive
        self._poses = optimised_states(found.scenario, found.route)
        self._opened: AbstractEnvironment | None = None

    def __call__(self, textures: Textures, on_step: OnStep | None = None) -> Judged:
        """Drive past textures; see `Judge`."""
        world, errors = self.world, []
        world.show(Appearance(textures, self.found.offsets))
        environment = self._environment()
        for number, pose in enumerate(self._poses):
            seed = self.found.scenario.seed + number
            with one_thread():
                result = drive(
                    environment,
                    world.policy,
                    world.route,
                    pose,
                    seed,
                    world.horizon,
                    on_step,
                )
            errors.append(result.distance_m)
            self._on_drive()
        distance = np.concatenate(errors)
        mean = float(distance.mean())
        largest = float(distance.max())
        return Judged(-mean * world.horizon, mean, largest, len(distance))

    def guess(self, proposal: Proposal) -> float:
        """Return the objective of a proposal, penalty and all; see `PriorJudge`."""
        return self(proposal.textures).objective + proposal.penalty

    def close(self) -> None:
        """Close the environment."""
        if self._opened is not None:
            self._opened.close()
        self._opened = None

    def _environment(self) -> AbstractEnvironment:
        """Return the environment; one that builds objects in is made anew."""
        if self.column.builds_in:
            self.close()
        if self._opened is None:
            objects = self.world.surrogate.objects
            self._opened = self.column.open(self.world, objects, 0)
        return self._opened
