"""Attacks that were found: finished run folders, read back."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mi_nerfattack.drives.spec import short_digest
from mi_nerfattack.errors import InputError
from mi_nerfattack.experiment.baseline import RandomAppearances
from mi_nerfattack.experiment.run_folder import (
    CHECKPOINT,
    SCENARIO,
    folder_labels,
    object_path,
    read_finished,
)
from mi_nerfattack.fields import load_grid
from mi_nerfattack.io import files
from mi_nerfattack.io.resumable import differences, json_digest, refuse
from mi_nerfattack.rollout.drive import ATTACK, BEST_RANDOM, OWN, Lane
from mi_nerfattack.scenario.scenario import Scenario, SceneSection, load_scenario
from mi_nerfattack.scenario.world import (
    Appearance,
    World,
    driven_route,
    initial_states,
    optimised_states,
)
from mi_nerfattack.vehicle.route.route import Route

#: Streams of initial states from here on are of no run, which has 0 and 2.
_FIRST_STREAM = 16
_REMEDY = "put the files back that the attack was made with, or attack anew"


@dataclass(frozen=True, eq=False)
class FoundAttack:
    """A finished run of ``mi-nerfattack attack``; picklable.

    Attributes:
        folder: of the run.
        label: name of the run, different from the names of other runs.
        scenario: of the run.
        route: that it drives along, with the vehicle's speed.
        offsets: (k, 6) of the attacked objects from where the scenario puts them.
        best_random: number of the best of the run's random textures, None without any.
        identity: of the scenario, see :meth:`Scenario.identity`.
        digest: of attacked textures and offsets.
        surrogate: in which it was found: ``file``, ``sha256``, ``psnr_heldout_db`` and
            ``steps`` of its fit, which may be None.
    """

    folder: Path
    label: str
    scenario: Scenario
    route: Route
    offsets: np.ndarray
    best_random: int | None
    identity: Mapping[str, str]
    digest: str
    surrogate: Mapping[str, Any]

    @property
    def content(self) -> tuple[str, str]:
        """Digests of what was found, and of its scenario."""
        return self.digest, short_digest(self.identity)

    @property
    def horizon(self) -> int:
        """Control periods of a drive."""
        return self.scenario.drive.steps(self.route, self.scenario.vehicle.dt_s)

    @property
    def lane(self) -> Lane:
        """Of the route."""
        return Lane.of(self.route, self.scenario.vehicle.width_m)

    @property
    def description(self) -> dict[str, Any]:
        """What documents say of it."""
        return {
            "label": self.label,
            "scenario": self.scenario.name,
            "seed": self.scenario.seed,
            "route": self.route.name,
            "objects": [item.id for item in self.scenario.objects],
            "found_sha256": self.digest,
        }

    def start(self, seed: int, number: int) -> tuple[np.ndarray, int]:
        """Draw a start as the scenario draws its own, but another one.

        Args:
            seed: of all starts.
            number: of the start.

        Returns:
            pose (3,), metres and radians; and the seed of a drive from there.
        """
        stream = _FIRST_STREAM + number
        like = self.scenario.model_copy(update={"seed": seed})
        pose = initial_states(like, self.route, count=1, stream=stream)[0]
        sequence = np.random.SeedSequence([seed, stream])
        return pose, int(sequence.generate_state(1)[0] >> 1)

    def check_starts(self, seed: int, count: int) -> None:
        """Raise InputError if the attack has seen one of the starts."""
        scenario, route = self.scenario, self.route
        evaluated = initial_states(scenario, route, count=scenario.drive.runs, stream=0)
        poses = np.concatenate([evaluated, optimised_states(scenario, route)])
        for number in range(count):
            pose, _ = self.start(seed, number)
            if np.isclose(poses, pose, rtol=0, atol=1e-6).all(1).any():
                raise InputError(
                    f"{self.folder}: start {number} is one of the run's own; drives "
                    "from there tell nothing new. Its scenario's [drive] must let "
                    "starts vary (lateral_sd_m, heading_sd_deg or covariance)"
                )

    def looks(self, world: World) -> dict[str, Appearance]:
        """Load how the objects of a world look, and where they stand, by case."""
        own = world.appearance()
        attacked = []
        for item, texture in zip(self.scenario.objects, own.textures, strict=True):
            path = object_path(self.folder, item.id)
            attacked.append(load_grid(path).texture.numpy())
            if attacked[-1].shape != texture.shape:
                raise InputError(
                    f"{path}: {len(attacked[-1])} vertices, the object of the scenario "
                    f"has {len(texture)}; {_REMEDY}"
                )
        looks = {OWN: own, ATTACK: Appearance(attacked, self.offsets)}
        if self.best_random is not None:
            looks[BEST_RANDOM] = RandomAppearances.of(world, own)(self.best_random)
        return looks


def read_found(folders: Sequence[Path]) -> tuple[FoundAttack, ...]:
    """Read run folders.

    Raises:
        InputError: none, or one twice or with its copy; a folder holds no finished
            attack; or a file that its scenario names has changed since.
    """
    paths = [os.path.abspath(folder) for folder in folders]
    if not paths or len(set(paths)) < len(paths):
        raise InputError("RUN: at least one run folder, each once")
    pairs = zip(folders, folder_labels(folders), strict=True)
    attacks = tuple(_read(Path(path), label) for path, label in pairs)
    first: dict[tuple[str, str], FoundAttack] = {}
    for attack in attacks:
        if (other := first.setdefault(attack.content, attack)) is not attack:
            raise InputError(
                f"{attack.folder}: is a copy of {other.folder}; give each run once"
            )
    return attacks


def _read(folder: Path, label: str) -> FoundAttack:
    document = read_finished(folder)
    scenario, _ = load_scenario(folder / SCENARIO)
    identity = scenario.identity()
    check_unchanged(folder / CHECKPOINT, identity)
    offsets = np.zeros((len(scenario.objects), 6))
    for number, item in enumerate(scenario.objects):
        pose = (document.get("object_poses") or {}).get(item.id)
        if pose is not None:
            offsets[number] = [*pose["shift_m"], *pose["rotation_vector"]]
    return FoundAttack(
        folder,
        label,
        scenario,
        route=driven_route(scenario, scenario.vehicle.motion()),
        offsets=offsets,
        best_random=(document.get("baseline") or {}).get("best"),
        identity=identity,
        digest=_digest(folder, scenario, offsets),
        surrogate=_surrogate(scenario.scene, identity),
    )


def _digest(folder: Path, scenario: Scenario, offsets: np.ndarray) -> str:
    sums = [files.sha256(object_path(folder, item.id)) for item in scenario.objects]
    return json_digest([sums, offsets.tolist()])


def check_unchanged(checkpoint: Path, identity: Mapping[str, str]) -> None:
    """Raise InputError if a scenario, or a file of it, has changed since its run."""
    if not checkpoint.is_file():  # it takes much room, and may have been removed
        return
    _, metadata = files.read_safetensors(checkpoint, ())
    recorded = {key: value for key, value in metadata.items() if key in identity}
    refuse(checkpoint, differences(recorded, identity), _REMEDY)


def _surrogate(scene: SceneSection, identity: Mapping[str, str]) -> dict[str, Any]:
    """Say in what an attack was made, and how well that shows what was photographed.

    Returns:
        ``file`` and ``sha256``; ``psnr_heldout_db`` and ``steps`` of its fit, None
        where its header does not tell.
    """
    key = "surrogate" if scene.field is None else "field"
    named = getattr(scene, key)
    header: dict[str, str] = {}
    if named.file.suffix.lower() == ".safetensors":
        _, header = files.read_safetensors(named.file, ())
    numbers = {"psnr_heldout_db": None, "steps": None}
    for name, kind in {"psnr_heldout_db": float, "steps": int}.items():
        with suppress(KeyError, ValueError):  # written by somebody else
            number = kind(header[f"fit.{name}"])
            numbers[name] = number if math.isfinite(number) else None
    file_identity = json.loads(identity[f"scenario.scene.{key}"])
    return {"file": str(named), "sha256": file_identity["sha256"], **numbers}
