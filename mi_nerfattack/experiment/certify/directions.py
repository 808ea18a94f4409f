"""An attack's end, its gradient there, and changes of its parameters."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from mi_nerfattack.attack.base import offset_gradients
from mi_nerfattack.attack.gradient import OFFSETS, GradientAttack, Parameters
from mi_nerfattack.attack.texture.colours import AbstractColouring, Colours
from mi_nerfattack.errors import InputError
from mi_nerfattack.experiment.claim import CHECKPOINT, SCENARIO
from mi_nerfattack.experiment.run_folder import (
    CHECKPOINT_FORMAT,
    CheckpointRecord,
    read_finished,
)
from mi_nerfattack.experiment.transfer.found import check_unchanged
from mi_nerfattack.io.resumable import Unit, array_digest, misfits_reported
from mi_nerfattack.render.posed import move_all
from mi_nerfattack.rollout.function import Evaluation, Rollout
from mi_nerfattack.rollout.loop import OnStep
from mi_nerfattack.rollout.objective import truncated
from mi_nerfattack.scenario.scenario import Scenario, load_scenario
from mi_nerfattack.scenario.world import World, build_attack, build_world

#: Shares of the horizon at which gradients are compared.
SHARES = (0.125, 0.25, 0.5, 0.75, 1.0)
#: Length of the change along the gradient, in standard deviations of the random ones.
ALONG = 3.0


@dataclass(frozen=True, eq=False)
class Ended:
    """An attack by gradient, at its best parameters, and changes of these.

    Changes are of the raw colours (before the sigmoid) of the level that the attack
    steps in, and of the offsets where the attack moves objects. Raw colours have no
    limits, so a change to both sides is always allowed.

    Attributes:
        world: what its scenario describes.
        attack: finished; its best parameters are installed.
        textures: (n_vertices, 3) raw colours of each object, the best ones.
        rows: of each texture that changes; none where textures stay as they are.
        moves: whether offsets change.
    """

    world: World
    attack: GradientAttack
    textures: list[np.ndarray]
    rows: list[Any]
    moves: bool

    @classmethod
    def of(cls, folder: Path, scenario: Scenario) -> Ended:
        """Take up a finished run.

        Args:
            folder: of the run.
            scenario: of the run.

        Raises:
            InputError: its method takes no gradient, or its checkpoint is missing,
                damaged, or of another scenario.
        """
        if not scenario.attack.method.needs_derivatives:
            raise InputError(
                f"{folder}: an attack by {scenario.attack.method.kind!r} has no "
                "gradient; give a run whose attack.method.kind is 'gradient'"
            )
        path, identity = folder / CHECKPOINT, scenario.identity()
        check_unchanged(path, identity)
        format_alone = {"format": CHECKPOINT_FORMAT}
        checkpoint = Unit(path, format_alone, CheckpointRecord, remedy="").read(
            force=True
        )
        if checkpoint is None:
            raise InputError(f"{path}: is missing; make the attack again")
        world = build_world(scenario, scenario.build_policy())
        freedom, rows = scenario.attack.freedom.build(), []
        if freedom.texture_rate is not None:
            rows = [_rows(freedom.colouring(field)) for field in world.fields]
        attack = build_attack(world)
        assert isinstance(attack, GradientAttack), "its method needs derivatives"
        with misfits_reported(path):
            attack.load_tensors(checkpoint.tensors)
        return cls(world, attack, attack.best, rows, freedom.pose_rate is not None)

    @property
    def digest(self) -> str:
        """Tell the best parameters from others."""
        return array_digest((*self.textures, self.attack.best_offsets))

    @property
    def rollout(self) -> Rollout:
        """The attack's, without the rounding of images, which no derivative sees."""
        rollout = self.attack.rollout
        return replace(rollout, loop=replace(rollout.loop, eight_bit=False))

    @property
    def horizons(self) -> list[int]:
        """Control periods up to which gradients are compared, increasing."""
        horizon = self.attack.rollout.horizon
        return sorted({max(1, round(share * horizon)) for share in SHARES})

    def install(self, change: Parameters) -> None:
        """Show the best parameters with a change; none where it is empty."""
        shown = [texture.copy() for texture in self.textures]
        for number, rows in enumerate(self.rows if change else ()):
            shown[number][rows] += change[f"{number}"]
        self.world.set_textures(shown)
        offsets = self.attack.best_offsets
        move_all(self.attack.sensor.objects, offsets + change.get(OFFSETS, 0.0))

    def gradient(self, horizon: int, on_step: OnStep | None = None) -> Parameters:
        """Differentiate the objective of the first periods at the best parameters."""
        self.install({})
        full_rollout, sensor = self.rollout, self.attack.sensor
        objective = truncated(full_rollout.objective, horizon)
        rollout = replace(full_rollout, horizon=horizon, objective=objective)
        evaluation = rollout.run(self.attack.initial, on_step)
        moved = sensor.pose_keys if self.moves else ()
        gradients = rollout.gradient(evaluation, moved, on_step=on_step)
        values = {
            f"{number}": gradients.textures[number].numpy()[rows]
            for number, rows in enumerate(self.rows)
        }
        if self.moves:
            by_offsets = offset_gradients(sensor, gradients)
            values[OFFSETS] = by_offsets * self.attack.freedom.mask
        return values

    def drawn(self, number: int) -> Parameters:
        """Draw a direction: normal; offsets have their learning rate as deviation."""
        rng = np.random.default_rng([self.world.scenario.seed, 21, number])
        pairs = enumerate(zip(self.rows, self.textures, strict=bool(self.rows)))
        drawn = {
            f"{k}": rng.standard_normal(texture[rows].shape)
            for k, (rows, texture) in pairs
        }
        if self.moves:
            normal = rng.standard_normal(self.attack.best_offsets.shape)
            drawn[OFFSETS] = self._pose_scale * normal
        return drawn

    def downhill(self, gradient: Parameters) -> Parameters:
        """Return the direction against a gradient, `ALONG` deviations long."""
        scales = {key: self._pose_scale if key == OFFSETS else 1.0 for key in gradient}
        scaled = {key: scales[key] * value for key, value in gradient.items()}
        length = np.sqrt(sum(float(np.sum(v**2)) for v in scaled.values()))
        factor = -ALONG / length if length else 0.0
        return {key: factor * scales[key] * value for key, value in scaled.items()}

    @property
    def _pose_scale(self) -> np.ndarray:
        rate = self.attack.freedom.pose_rate
        assert rate is not None, "offsets change"
        return rate * self.attack.freedom.mask

    def costs(self, change: Parameters, on_step: OnStep | None = None) -> np.ndarray:
        """Drive a closed loop with a change; return the objective of each horizon."""
        self.install(change)
        rollout = replace(self.rollout, camera_path=None)
        evaluation = rollout.measure(self.attack.initial, on_step)
        return np.array([cost_until(rollout, evaluation, h) for h in self.horizons])


def _rows(colouring: AbstractColouring) -> Any:
    """Return the rows of a texture that a colouring steps in."""
    return colouring.level.vertices if isinstance(colouring, Colours) else slice(None)


def cost_until(rollout: Rollout, evaluation: Evaluation, horizon: int) -> float:
    """Return the objective of the first control periods of drives."""
    import mitsuba as mi

    drive = evaluation.trajectory
    states = drive.states_numpy()[:, 1 : horizon + 1, : drive.rows]
    costs = truncated(rollout.objective, horizon).costs(states, drive.dt)
    return float(rollout.reduction.reduce(mi.Float64(costs))[0])


def product(gradient: Parameters, direction: Parameters) -> float:
    """Return the derivative of an objective along a direction."""
    pairs = ((value, direction[key]) for key, value in gradient.items())
    return sum(float((a.astype(np.float64) * b).sum()) for a, b in pairs)


def scenario_of(folder: Path) -> Scenario:
    """Read the scenario of a finished run.

    Raises:
        InputError: the folder holds no finished run, or a file is damaged.
    """
    read_finished(folder)
    return load_scenario(folder / SCENARIO)[0]
