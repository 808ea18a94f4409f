"""Choices of the whole way from a place to a policy."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from mi_nerfattack.errors import InputError
from mi_nerfattack.evaluation.evaluate import EvaluateSettings
from mi_nerfattack.ranges import Count, Fraction, Share, Whole, checked
from mi_nerfattack.training.collect import CollectSettings
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

    frames: Mapping[str, Whole]
    validation_frames: Mapping[str, Whole] = field(default_factory=dict)
    dagger_rounds: Whole = 0
    dagger_frames: Mapping[str, Whole] = field(default_factory=dict)
    dagger_epochs: Count = 3
    dagger_rate: Fraction = 5e-4
    expert_share: Share = 0.0
    horizon: Count = 16
    seed: Whole = 0
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
        parts = [self.frames, self.validation_frames]
        parts += [self.dagger_frames] if self.dagger_rounds else []
        names = [name for part in parts for name in part if part[name]]
        return tuple(dict.fromkeys([*names, *self.validate_in]))

    @property
    def holds_out_shards(self) -> bool:
        """Whether the held-out loss has no collection of its own."""
        return not sum(self.validation_frames.values())
