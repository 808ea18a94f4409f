"""Choices of the whole way from a place to a policy."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from mi_nerfattack.deploy.place import Scatter
from mi_nerfattack.deploy.roadside.rule import Roadside
from mi_nerfattack.errors import InputError
from mi_nerfattack.evaluation.evaluate import EvaluateSettings
from mi_nerfattack.ranges import Count, Fraction, Natural, Positive, Share, checked
from mi_nerfattack.training.sources import (
    AbstractSource,
    ExpertDrives,
    Mixture,
    Scattered,
)
from mi_nerfattack.training.train import TrainSettings

#: Scattered states and recoveries of the expert.
CLONING = Mixture((Scattered(), ExpertDrives()), (0.7, 0.3))


@dataclass(frozen=True)
@checked("CollectSettings")
class CollectSettings:
    """Choices of a collection; the same settings and site give the same frames.

    Args:
        frames: wanted.
        seed: of everything random.
        shard: frames that are written together, under the same conditions.
        group: states that are drawn around one point, with the same objects.
        objects: most of them at a time; each number from 1 is equally likely.
        object_share: share of the groups with objects.
        original_share: share of the textures that are an object's own; each object has
            one texture a shard.
        spread_m: states of a group lie within this arc length of their centre.
        ahead_m: arc length from a group's centre to where the drive ends from which
            its objects are in view; it begins `spread_m` before the centre.
        margin_m: arc length before and after an open route, from where frames come
            too.
        scatter: deviations of the states from the route.
        roadside: the rule by which the objects stand.
        waypoints_s: times ahead of the expert's future positions, seconds, ascending.
    """

    frames: Count = 9000
    seed: int = 0
    shard: Count = 64
    group: Count = 8
    objects: Count = 6
    object_share: Share = 0.75
    original_share: Share = 0.1
    spread_m: float = 3.0
    ahead_m: float = 8.0
    margin_m: float = 2.0
    scatter: Scatter = field(default_factory=Scatter)
    roadside: Roadside = field(default_factory=Roadside)
    waypoints_s: tuple[Positive, ...] = (0.5, 1.0, 1.5, 2.0)

    def __post_init__(self) -> None:
        times = self.waypoints_s
        if not times or list(times) != sorted(set(times)):
            raise InputError(
                f"waypoints_s: {list(times)}; at least one time, ascending"
            )

    @property
    def shards(self) -> int:
        """Number of shards."""
        return -(-self.frames // self.shard)

    def size(self, index: int) -> int:
        """Return the number of frames of a shard; the last one may have fewer."""
        return min(self.shard, self.frames - index * self.shard)


@dataclass(frozen=True)
@checked()
class ImitationSettings:
    """Choices of the whole way from a place to a policy.

    Args:
        frames: of the first collection, by site.
        validation_frames: of a collection for the held-out loss, by site; none: some
            shards of the others, about the part `training.held_out`.
        dagger_rounds: number of rounds.
        dagger_frames: added in every round, by site.
        dagger_epochs: epochs of the training after each round, which starts from the
            weights before.
        dagger_rate: learning rate of these.
        expert_share: of the control periods of a round in which the expert drives.
        horizon: control periods of a drive of a round.
        seed: of everything but the closed-loop drives; overrides those of `collecting`
            and `training`.
        validate_every: epochs from one validation in the closed loop to the next.
        validate_in: names of the sites of these validations; none: all.
        cloning: source of the first collection's states.
        collecting: of the frames; their number and seed are overridden.
        training: of the first training.
        validation: of the closed-loop drives between epochs.
        final: of those at the end.
    """

    frames: Mapping[str, Natural]
    validation_frames: Mapping[str, Natural] = field(default_factory=dict)
    dagger_rounds: Natural = 0
    dagger_frames: Mapping[str, Natural] = field(default_factory=dict)
    dagger_epochs: Count = 3
    dagger_rate: Fraction = 5e-4
    expert_share: Share = 0.0
    horizon: Count = 16
    seed: Natural = 0
    validate_every: Count = 4
    validate_in: tuple[str, ...] = ()
    cloning: AbstractSource = CLONING
    collecting: CollectSettings = field(default_factory=CollectSettings)
    training: TrainSettings = field(default_factory=TrainSettings)
    validation: EvaluateSettings = field(
        default_factory=lambda: EvaluateSettings(runs=1)
    )
    final: EvaluateSettings = field(default_factory=lambda: EvaluateSettings(runs=2))

    def __post_init__(self) -> None:
        if self.dagger_rounds and not sum(self.dagger_frames.values()):
            raise InputError(
                f"dagger_rounds: {self.dagger_rounds} without dagger_frames, which "
                "would train on the same frames again; give some, or no rounds"
            )

    @property
    def sites(self) -> tuple[str, ...]:
        """Names of the sites of which frames are wanted, and of `validate_in`."""
        counts = [self.frames, self.validation_frames]
        counts += [self.dagger_frames] if self.dagger_rounds else []
        names = [name for by_site in counts for name in by_site if by_site[name]]
        return tuple(dict.fromkeys([*names, *self.validate_in]))

    @property
    def holds_out_shards(self) -> bool:
        """Whether the held-out loss has no collection of its own."""
        return not sum(self.validation_frames.values())
