"""Frames among found attacks: attacked objects where their scenarios put them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from mi_nerfattack.deploy.environment import (
    policy_image,
    policy_numbers,
    single_control,
)
from mi_nerfattack.deploy.place import Place
from mi_nerfattack.deploy.sites import AbstractSite
from mi_nerfattack.deploy.vehicle import Controls
from mi_nerfattack.errors import InputError
from mi_nerfattack.experiment.run_folder import object_path
from mi_nerfattack.experiment.transfer.found import FoundAttack
from mi_nerfattack.fields.io import holds_splats
from mi_nerfattack.io.resumable import differences, flatten, refuse
from mi_nerfattack.policy.base import AbstractPolicy
from mi_nerfattack.policy.pilotnet import PilotNet
from mi_nerfattack.render.camera.rig import Rig
from mi_nerfattack.render.posed import PosedField
from mi_nerfattack.scenario.named_file import section_content
from mi_nerfattack.scenario.policy.kinds import AbstractPolicySection, PilotNetSection
from mi_nerfattack.scenario.scenario import is_within
from mi_nerfattack.scenario.world import place_of
from mi_nerfattack.system.workers import AbstractWorkers
from mi_nerfattack.training.imitate import Imitated, OnStage, collect_frames, imitate
from mi_nerfattack.training.settings import CollectSettings, ImitationSettings
from mi_nerfattack.training.sources import (
    AbstractSource,
    Labelled,
    PolicyDrives,
    Scenery,
)
from mi_nerfattack.training.staging import AbstractStage, AbstractStaging, Stretch
from mi_nerfattack.vehicle.route.route import Route

#: Parts of a scenario in which all runs must agree: the world, but for its routes.
_SHARED = ("scene.field", "scene.surrogate", "scene.to_world", "scene.deployment")
_SHARED += ("scene.routes", "camera", "cameras", "vehicle")
#: Keys that say no more of a policy than its weights.
_PLAIN = {"kind", "file_sha256"}


@dataclass(frozen=True, eq=False)
class AmongFound(AbstractStaging):
    """Each shard shows the attacked objects of one run, drawn at random.

    Groups lie where the run's drive comes past them: from where it starts to the
    farthest object, or to its end.

    Args:
        attacks: of one place, see :func:`found_place`.
    """

    attacks: tuple[FoundAttack, ...]

    def identity(self) -> dict[str, str]:
        """Return digests of what was found, and of its scenarios."""
        return flatten("staging.found", [attack.content for attack in self._sorted])

    def open(
        self, site: AbstractSite, routes: Sequence[Route], settings: CollectSettings
    ) -> AbstractStage:
        """Load nothing yet."""
        del site, routes, settings
        return _FoundStage(self._sorted)

    @property
    def _sorted(self) -> list[FoundAttack]:
        """The attacks in an order that does not depend on how they were given."""
        return sorted(self.attacks, key=lambda attack: attack.content)


class _FoundStage(AbstractStage):
    def __init__(self, attacks: Sequence[FoundAttack]) -> None:
        self._attacks, self._number = attacks, -1
        self._objects: list[PosedField] = []

    def begin(self, rng: np.random.Generator) -> None:
        """Draw a run, and load its objects."""
        number = int(rng.integers(len(self._attacks)))
        if number != self._number:
            self._objects = attacked_objects(self._attacks[number])
            self._number = number

    def draw_stretch(self, rng: np.random.Generator) -> tuple[Route, Stretch]:
        """Return the run's route, and the part from which it passes its objects."""
        del rng
        attack = self._attacks[self._number]
        return attack.route, passed_stretch(attack, self._objects)

    def objects(
        self, route: Route, arc: float, rng: np.random.Generator
    ) -> list[PosedField]:
        """Return the run's objects."""
        del route, arc, rng
        return self._objects


def attacked_objects(attack: FoundAttack) -> list[PosedField]:
    """Load the objects of a run as it left them, where it left them.

    Raises:
        InputError: a file is missing or damaged.
    """
    result = []
    for item, offset in zip(attack.scenario.objects, attack.offsets, strict=True):
        field = item.load(object_path(attack.folder, item.id))
        result.append(PosedField(field, item.pose))
        result[-1].move(offset)
    return result


def passed_stretch(attack: FoundAttack, objects: Sequence[PosedField]) -> Stretch:
    """Return the arc lengths from a drive's start to its farthest object or its end.

    Args:
        attack: whose drive it is.
        objects: its own.
    """
    route, scenario = attack.route, attack.scenario
    start, end = scenario.drive.stretch(route, scenario.vehicle.dt_s)
    poses = [[*posed.placed.translation[:2], 0.0] for posed in objects]
    ahead = route.project_numpy(np.array(poses))[0] - start
    if route.closed:
        ahead = ahead % route.length
    farthest = float(ahead.max())
    return start, min(start + farthest, end) if farthest > 0 else end


def found_place(attacks: Sequence[FoundAttack]) -> Place:
    """Return the place in which all runs were made.

    Raises:
        InputError: they differ in scene, camera or vehicle, or objects stand in a
            Mitsuba scene of the surrogate.
    """
    first = attacks[0]
    for attack in attacks:
        if attack.scenario.scene.surrogate is not None:
            raise InputError(
                f"{attack.folder}: its objects stand in "
                f"{attack.scenario.scene.surrogate}, a Mitsuba scene; frames are taken "
                "among objects of a scenario with scene.field: leave this run out"
            )
        shared, reference = (_shared(run) for run in (attack, first))
        remedy = f"it is compared with {first.folder}; retrain in one place at a time"
        refuse(attack.folder, differences(shared, reference), remedy)
    scenario = first.scenario
    scene = scenario.scene
    assert scene.field is not None  # checked by SceneSection
    plain = scene.to_world is None and not holds_splats(scene.field.file)
    place = place_of(scenario, scenario.rig(), scenario.vehicle.motion())
    return replace(place, field=scene.field.file) if plain else place


def _shared(attack: FoundAttack) -> dict[str, str]:
    identity = attack.identity.items()
    return {key: value for key, value in identity if is_within(key, _SHARED)}


def attacked_policy(attacks: Sequence[FoundAttack]) -> AbstractPolicySection:
    """Return the policy that all runs attacked, as the first one names it.

    Raises:
        InputError: they attacked different policies.
    """
    first = attacks[0]
    policy = first.scenario.policy
    for attack in attacks:
        other = attack.scenario.policy
        if section_content(other) != section_content(policy):
            raise InputError(
                f"{attack.folder}: attacked {other.source}, {first.folder} "
                f"{policy.source}, of other content; retrain one policy at a time"
            )
    return policy


def attacked_weights(attacks: Sequence[FoundAttack]) -> Path:
    """Return the weights of the PilotNet that all runs attacked.

    Raises:
        InputError: they attacked different policies, or one that is not PilotNet alone.
    """
    for attack in attacks:
        if not _is_plain(policy := attack.scenario.policy):
            raise InputError(
                f"{attack.folder}: attacked {policy.source}; only PilotNet of "
                "'mi-nerfattack train', without further keys of [policy], can be "
                "retrained without your help; give your own training with --command "
                "or --module"
            )
    policy = attacked_policy(attacks)
    assert isinstance(policy, PilotNetSection)
    return policy.file.file


def _is_plain(policy: AbstractPolicySection) -> bool:
    """Whether weights of PilotNet say all about a policy."""
    return isinstance(policy, PilotNetSection) and set(section_content(policy)) <= (
        _PLAIN
    )


def attacked_drives(policy: AbstractPolicySection, rig: Rig) -> AbstractSource:
    """Return drives of an attacked policy, in which the expert labels each frame.

    Args:
        policy: that was attacked.
        rig: by which it sees.
    """
    if isinstance(policy, PilotNetSection) and _is_plain(policy):
        return PolicyDrives(policy.file.file)
    return SectionDrives(policy, rig)


@dataclass(frozen=True)
class SectionDrives(AbstractSource):
    """As `PolicyDrives`, of any policy that a scenario can name.

    Args:
        policy: that drives.
        rig: by which it sees.
        horizon: control periods of a drive, each a frame.
    """

    policy: AbstractPolicySection
    rig: Rig
    horizon: int = PolicyDrives.horizon
    kind: ClassVar[str] = "section"

    def describe(self) -> dict[str, Any]:
        """Return the policy, its files by their checksums, and the horizon."""
        policy = section_content(self.policy)
        return {"kind": self.kind, "policy": policy, "horizon": self.horizon}

    def prepare(self) -> AbstractPolicy:
        """Make the policy."""
        return self.policy.build(self.rig.views)

    def frames(self, prepared: AbstractPolicy, scenery: Scenery) -> Iterator[Labelled]:
        """Drive until the horizon, or until the vehicle has strayed."""
        memory, step = prepared.initial_memory(1), 0
        environment, route = scenery.environment, scenery.route

        def control(image: np.ndarray) -> Controls:
            nonlocal memory, step
            numbers = policy_numbers(prepared, environment, route, step=step)
            observation, step = policy_image(image), step + 1
            row, memory = prepared.step(observation, route.goal, memory, numbers)
            return single_control(row, environment.control_names)

        yield from scenery.drive(control, self.horizon)


@dataclass(frozen=True, eq=False)
class FramesAmong:
    """A collection among attacks, and a training on it.

    Args:
        sites: see `imitate`, as `settings` and `folder`.
        attacks: whose objects and routes the frames show.
        settings: of both.
        folder: of the frames.
        workers: who collects.
    """

    sites: Sequence[AbstractSite]
    attacks: Sequence[FoundAttack]
    settings: ImitationSettings
    folder: Path
    workers: AbstractWorkers

    def collect(self, progress: OnStage) -> list[Path]:
        """Collect the frames that are not there yet; return all shards."""
        return collect_frames(
            self.sites,
            self.routes,
            self.settings,
            folder=self.folder,
            workers=self.workers,
            progress=progress,
            staging=AmongFound(tuple(self.attacks)),
        )

    def imitate(
        self, start: PilotNet, earlier_shards: Sequence[Path], progress: OnStage
    ) -> Imitated:
        """Collect them, and train PilotNet further on them and on other shards."""
        return imitate(
            self.sites,
            self.routes,
            self.settings,
            folder=self.folder,
            workers=self.workers,
            progress=progress,
            start=start,
            earlier_shards=earlier_shards,
            staging=AmongFound(tuple(self.attacks)),
        )

    @property
    def routes(self) -> list[Route]:
        """Routes of the attacks, each once, by their names."""
        named = {attack.route.name: attack.route for attack in self.attacks}
        return [named[name] for name in sorted(named)]
