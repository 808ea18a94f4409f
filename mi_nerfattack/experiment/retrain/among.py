"""Frames among found attacks: attacked objects where their scenarios put them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from mi_nerfattack.deploy.place import Place
from mi_nerfattack.deploy.sites import AbstractSite
from mi_nerfattack.drives.spec import short_digest
from mi_nerfattack.errors import InputError
from mi_nerfattack.experiment.run_folder import object_path
from mi_nerfattack.experiment.transfer.found import FoundAttack
from mi_nerfattack.fields.io import holds_splats
from mi_nerfattack.io.resumable import differences, flatten, refuse
from mi_nerfattack.render.posed import PosedField
from mi_nerfattack.scenario.named_file import section_content
from mi_nerfattack.scenario.policy.kinds import PilotNetSection
from mi_nerfattack.scenario.scenario import is_within
from mi_nerfattack.scenario.world import place_of
from mi_nerfattack.training.settings import CollectSettings
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
        runs = [(found.digest, short_digest(found.identity)) for found in self.attacks]
        return flatten("staging.found", sorted(runs))

    def open(
        self, site: AbstractSite, routes: Sequence[Route], settings: CollectSettings
    ) -> AbstractStage:
        """Load nothing yet."""
        del site, routes, settings
        return _FoundStage(self.attacks)


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
        found = self._attacks[self._number]
        return found.route, passed_stretch(found, self._objects)

    def objects(
        self, route: Route, arc: float, rng: np.random.Generator
    ) -> list[PosedField]:
        """Return the run's objects."""
        del route, arc, rng
        return self._objects


def attacked_objects(found: FoundAttack) -> list[PosedField]:
    """Load the objects of a run as it left them, where it left them.

    Raises:
        InputError: a file is missing or damaged.
    """
    result = []
    for item, offset in zip(found.scenario.objects, found.offsets, strict=True):
        field = item.load(object_path(found.folder, item.id))
        result.append(PosedField(field, item.pose))
        result[-1].move(offset)
    return result


def passed_stretch(found: FoundAttack, objects: Sequence[PosedField]) -> Stretch:
    """Return the arc lengths from a drive's start to its farthest object or its end.

    Args:
        found: whose drive it is.
        objects: its own.
    """
    route, scenario = found.route, found.scenario
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
    for found in attacks:
        if found.scenario.scene.surrogate is not None:
            raise InputError(
                f"{found.folder}: its objects stand in {found.scenario.scene.surrogate}"
                ", a Mitsuba scene; frames are taken among objects of a scenario with "
                "scene.field: leave this run out"
            )
        here, there = (_shared(run) for run in (found, first))
        remedy = f"it is compared with {first.folder}; retrain in one place at a time"
        refuse(found.folder, differences(here, there), remedy)
    scenario = first.scenario
    scene = scenario.scene
    assert scene.field is not None  # checked by SceneSection
    plain = scene.to_world is None and not holds_splats(scene.field.file)
    place = place_of(scenario, scenario.rig(), scenario.vehicle.motion())
    return replace(place, field=scene.field.file) if plain else place


def _shared(found: FoundAttack) -> dict[str, str]:
    identity = found.identity.items()
    return {key: value for key, value in identity if is_within(key, _SHARED)}


def attacked_policy(attacks: Sequence[FoundAttack]) -> Path:
    """Return the weights that all runs attacked.

    Raises:
        InputError: they attacked different policies, or one that is not PilotNet alone.
    """
    first = attacks[0]
    for found in attacks:
        policy = found.scenario.policy
        about = section_content(policy)
        if not isinstance(policy, PilotNetSection) or set(about) - _PLAIN:
            raise InputError(
                f"{found.folder}: attacked {policy.source}; only PilotNet of "
                "'mi-nerfattack train', without further keys of [policy], can be "
                "retrained; train another one yourself, on frames that "
                "experiment.retrain.among collects"
            )
        if about != section_content(first.scenario.policy):
            raise InputError(
                f"{found.folder}: attacked {policy.source}, {first.folder} "
                f"{first.scenario.policy.source}, of other content; retrain one policy "
                "at a time"
            )
    assert isinstance(first.scenario.policy, PilotNetSection)
    return first.scenario.policy.file.file
