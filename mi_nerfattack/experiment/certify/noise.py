"""Drives past textures under Gaussian changes of their low frequencies."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from mi_nerfattack.attack.black_box.low_frequency import LowFrequency
from mi_nerfattack.attack.texture.colours import Colours
from mi_nerfattack.drives.run import AbstractDrives
from mi_nerfattack.drives.spec import DriveSpec
from mi_nerfattack.errors import InputError
from mi_nerfattack.experiment.cases import CaseDriver, Shown, shared_identity
from mi_nerfattack.experiment.certify.search import BallSearch, severity
from mi_nerfattack.io.resumable import array_digest, flatten
from mi_nerfattack.rollout.drive import ATTACK
from mi_nerfattack.scenario.named_file import section_content
from mi_nerfattack.scenario.scenario import Scenario
from mi_nerfattack.scenario.world import Appearance, World, build_world, initial_states
from mi_nerfattack.system.workers import AbstractWork, OnUnits

#: What drives are for; each purpose has draws of its own.
CENTRE, ATTACKED, SEARCH = "centre", "attacked", "search"
_STREAMS = {CENTRE: 11, ATTACKED: 12, SEARCH: 13}


class Looks:
    """Appearances of objects, by the coefficients of their textures.

    Zeros are the original textures. The objects stay where they are.

    Args:
        world: with the objects as they look and stand by themselves.
        coefficients: of all objects together, at most.

    Raises:
        InputError: textures may not change, or an object gets no coefficient.
    """

    def __init__(self, world: World, coefficients: int) -> None:
        freedom = world.scenario.attack.freedom.build()
        if freedom.texture_rate is None:
            raise InputError(
                "attack.freedom.kind: 'pose'; a certificate is of textures, set it to "
                "'texture'"
            )
        all_colourings = [freedom.colouring(field) for field in world.fields]
        colourings = [item for item in all_colourings if isinstance(item, Colours)]
        self._basis = LowFrequency(colourings, coefficients)
        self._offsets = world.appearance().offsets

    @property
    def count(self) -> int:
        """Number of coefficients."""
        return self._basis.count

    def __call__(self, coefficients: np.ndarray) -> Appearance:
        """Return the appearance of coefficients (count,): changes of sRGB values."""
        return Appearance(self._basis.propose(coefficients).textures, self._offsets)


@dataclass(frozen=True, eq=False)
class Draw:
    """What is random in a drive.

    Attributes:
        noise: (d,), change of the coefficients.
        start: (3,) pose.
        seed: of the environment.
    """

    noise: np.ndarray
    start: np.ndarray
    seed: int


@dataclass(frozen=True, eq=False)
class Smoothing:
    """The distribution of drives around coefficients; picklable.

    Args:
        scenario: of the drives.
        label: of the environment.
        route: name.
        steps: control periods of a drive.
        identity: what decides about all drives, see `shared_identity`.
        count: d, number of coefficients.
        sd: standard deviation of the noise in each of them.
    """

    scenario: Scenario
    label: str
    route: str
    steps: int
    identity: Mapping[str, str]
    count: int
    sd: float

    @classmethod
    def of(cls, world: World, label: str, looks: Looks, sd: float) -> Smoothing:
        """Describe drives of a world.

        Raises:
            InputError: there is no such environment, or it does not close the loop.
        """
        scenario = world.scenario
        if label not in world.labels or world.is_open_loop(label):
            closed = [name for name in world.labels if not world.is_open_loop(name)]
            raise InputError(f"--environment: {label!r}; one of {', '.join(closed)}")
        identity = shared_identity(world, scenario.identity(), label)
        identity |= flatten("freedom", section_content(scenario.attack.freedom))
        identity["coefficients"] = f"{looks.count}"
        return cls(
            scenario=scenario,
            label=label,
            route=world.route.name,
            steps=world.horizon,
            identity=identity,
            count=looks.count,
            sd=sd,
        )

    def draw(self, world: World, purpose: str, number: int) -> Draw:
        """Draw what is random in a drive; the same for all coefficients."""
        stream = _STREAMS[purpose]
        rng = np.random.default_rng([self.scenario.seed, stream, number])
        noise = self.sd * rng.standard_normal(self.count)
        # The words [stream, number, 1], of 32 bits each, are one more than the noise
        # has. So no start shares its random numbers with the noise of any drive.
        own = (1 << 64) + (number << 32) + stream
        [start] = initial_states(self.scenario, world.route, count=1, stream=own)
        return Draw(noise, start, int(rng.integers(2**31)))

    def nominal(self, world: World, number: int) -> Draw:
        """Return one of the scenario's drives, without noise."""
        seed = self.scenario.seed + number
        return Draw(np.zeros(self.count), world.initial[number], seed)

    def spec(self, centre: np.ndarray, draw: Draw, case: str, run: int) -> DriveSpec:
        """Describe the drive of a draw around coefficients (d,)."""
        point = centre + draw.noise
        digest = array_digest([point])
        decided = {"look": digest, "start": draw.start.tolist(), "seed": draw.seed}
        return DriveSpec(
            environment=self.label,
            route=self.route,
            case=case,
            run=run,
            seed=draw.seed,
            steps=self.steps,
            identity={**self.identity, **flatten("drive", decided)},
            context=Shown(draw.start, point, digest),
        )


@dataclass(frozen=True, eq=False)
class NoisyDrives(AbstractDrives):
    """Some drives under noise.

    Args:
        store: of those that are finished.
        scenario: of the drives.
        coefficients: of all objects together, at most.
        specs: of the drives.
        world_looks: world and appearances of this process; another process builds its
            own.
    """

    scenario: Scenario
    coefficients: int
    specs: Sequence[DriveSpec]
    world_looks: tuple[World, Looks] | None

    @cached_property
    def groups(self) -> Sequence[Sequence[DriveSpec]]:
        """Each drive by itself."""
        return [[spec] for spec in self.specs]

    def open(self) -> CaseDriver:
        """Build the world, unless it is there."""
        if self.world_looks is not None:
            world, looks = self.world_looks
            return CaseDriver(world, looks)
        world = build_world(self.scenario, self.scenario.build_policy())
        return CaseDriver(world, Looks(world, self.coefficients))

    def __getstate__(self) -> dict[str, Any]:
        """Leave the world behind, which no process can send."""
        return {**self.__dict__, "world_looks": None}


@dataclass(frozen=True, eq=False)
class Searches(AbstractWork):
    """A search in each ball; a piece is a whole search.

    A point is judged by the mean severity of its drives under a few draws, which are
    the same for all points. The drives are the only result: see :meth:`best`.

    Args:
        drives: drives them, and keeps them.
        smoothing: of the drives.
        draws: of each judgement.
        searches: one for each radius.
        limit_m: departure limit, metres.
    """

    drives: NoisyDrives
    smoothing: Smoothing
    draws: Sequence[Draw]
    searches: Sequence[BallSearch]
    limit_m: float

    def open(self) -> CaseDriver:
        """Build the world, unless it is there."""
        return self.drives.open()

    def do(self, opened: CaseDriver, index: int, report: OnUnits) -> None:
        """Search; a unit is a judged point."""

        def judge(point: np.ndarray) -> float:
            for spec in self._specs(point):
                if not self.drives.store.has(spec):
                    self.drives.drive(opened, spec, lambda step: None)
            report(1)
            return self._judged(point)

        self.searches[index].best(judge)

    def close(self, opened: CaseDriver) -> None:
        """Close the driver."""
        opened.close()

    def best(self, index: int) -> np.ndarray:
        """Return what a finished search found, (d,)."""
        return self.searches[index].best(self._judged)

    def _specs(self, point: np.ndarray) -> list[DriveSpec]:
        pairs = enumerate(self.draws)
        return [self.smoothing.spec(point, draw, ATTACK, run=k) for k, draw in pairs]

    def _judged(self, point: np.ndarray) -> float:
        values = []
        for spec in self._specs(point):
            if (finished := self.drives.store.read(spec)) is None:
                path = self.drives.store.path(spec)
                raise InputError(f"{path}: missing; it was removed")
            largest = float(finished.drive.distance_m.max())
            values.append(severity(largest, self.limit_m))
        return float(np.mean(values))
