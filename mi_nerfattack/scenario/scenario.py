"""The scenario file: one TOML file that replays one result.

Paths are relative to the file, or name bundled data as ``bundled:FILE``; they are
found when the file is read. Every section but ``scene``, ``objects`` and ``policy`` may
be left out; unknown keys are refused with their line.
"""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
from pydantic import Field, ValidationError, model_validator

from mi_nerfattack.errors import InputError
from mi_nerfattack.io import files
from mi_nerfattack.io.overrides import set_keys, tell
from mi_nerfattack.io.strict import parse_toml
from mi_nerfattack.policy.base import AbstractPolicy
from mi_nerfattack.ranges import Count, Finite, Fraction, Natural, NonNegative, Positive
from mi_nerfattack.render.camera.pose import Pose
from mi_nerfattack.render.camera.rig import Rig
from mi_nerfattack.render.march import STOP
from mi_nerfattack.scenario.attack import AttackSection
from mi_nerfattack.scenario.deployment import (
    SURROGATE,
    DeploymentSections,
    RenderedDeployment,
    labelled,
)
from mi_nerfattack.scenario.named_file import File, NamedFile, portable_text
from mi_nerfattack.scenario.objective import ObjectiveSection
from mi_nerfattack.scenario.objects import FieldObjectSection, ObjectSection, Triple
from mi_nerfattack.scenario.policy.base import misfit
from mi_nerfattack.scenario.policy.kinds import PolicySection, build_differentiable
from mi_nerfattack.scenario.section import (
    CameraSection,
    NamedCameraSection,
    Section,
    problems,
    refuse,
    rig_of,
)
from mi_nerfattack.scenario.upgrade import new_lines
from mi_nerfattack.scenario.vehicle import DubinsSection, VehicleSection
from mi_nerfattack.vehicle.route.route import Route

#: Returns the name of a file without its folder, and the SHA-256 of its content.
Content = Callable[[NamedFile], dict[str, str]]
_MAX_CHARACTERS = 1 << 16
_LAYER = re.compile(r"scene\d*|background|cost|input")  # of frames, beside objects'

Row = tuple[Finite, Finite, Finite, Finite]

#: Of `[scene]`, what only drives in the surrogate depend on.
SURROGATE_KEYS = ("field", "composite", "spp", "step_m", "stop", "to_world")
#: Rays per pixel with which the objective is smooth: docs/results/roughness.md.
SMOOTH_SPP = 9
_LONGEST = 1_000_000  # control periods of a drive
Periods = Annotated[int, Field(ge=1, lt=_LONGEST)]


class SceneSection(Section):
    """Where the drive takes place."""

    field: File | None = None  # or splats: the surrogate
    bricks: File | None = None  # of field, by bake: attacks are optimised in them
    surrogate: File | None = None  # Mitsuba scene XML with a field_integrator, instead
    deployment: File  # Mitsuba scene XML: the deployment environment
    routes: File  # JSON of routes
    route: str  # name of the route that is driven
    composite: Literal["depth", "interleaved"] = "depth"  # of fields, in the surrogate
    spp: Literal[1, 4, 9, 16] = SMOOTH_SPP  # rays per pixel in the surrogate
    step_m: Positive | None = None  # of the march near the camera; the field's own
    stop: Fraction = STOP  # transmittance at which rays end in the surrogate
    to_world: tuple[Row, Row, Row, Row] | None = None  # of the field: uniform scale

    @property
    def pose(self) -> Pose:
        """Field to world.

        Raises:
            InputError: `to_world` shears, reflects or scales unequally.
        """
        matrix = np.eye(4) if self.to_world is None else np.array(self.to_world)
        try:
            return Pose.from_matrix(matrix)
        except ValueError as err:
            raise InputError(
                f"scene.to_world: {err}; give rotation, uniform scale and translation"
            ) from err

    @model_validator(mode="after")
    def _check_surrogate(self) -> Any:
        """Refuse two surrogates, none, and what a Mitsuba scene says itself."""
        if self.surrogate is None:
            if self.field is None:
                refuse("field", "is missing; give it, or surrogate")
            return self
        for key in ("bricks", *SURROGATE_KEYS):
            if getattr(self, key) != self.defaults()[key]:
                refuse(key, f"{self.surrogate} says it; leave out this, or surrogate")
        return self


class DriveSection(Section):
    """What is driven."""

    start_m: NonNegative = 0.0  # along the route: the nominal pose
    length_m: Positive | None = None  # of a drive; to the end of the route, or one lap
    horizon: Periods | None = None  # of a drive, in place of length_m
    runs: Count = 4  # drives of each case but random
    lateral_sd_m: NonNegative = 0.1
    heading_sd_deg: NonNegative = 0.5
    covariance: tuple[Triple, Triple, Triple] | None = None  # see _check_covariance

    def steps(self, route: Route, period: float) -> int:
        """Return the control periods of a drive, at least 1.

        As many as a vehicle of the route's speed needs at most for the length.

        Args:
            route: that is driven, with the vehicle's speed.
            period: seconds between two controls.

        Raises:
            InputError: a million periods or more.
        """
        if self.horizon is not None:
            return self.horizon
        distance = route.length if route.closed else route.length - self.start_m
        length = distance if self.length_m is None else self.length_m
        if (periods := length / (route.speed_ms * period)) >= _LONGEST:
            raise InputError(
                f"drive.length_m: {length:g} m are {periods:.3g} control periods; "
                f"allowed are fewer than {_LONGEST}"
            )
        return max(1, int(periods + 1e-6))

    def stretch(self, route: Route, period: float) -> tuple[float, float]:
        """Return the arc lengths, metres, from which and to which is driven.

        Args:
            route: as of :meth:`steps`; unless it is closed, nothing lies beyond it.
            period: seconds between two controls.
        """
        end = self.start_m + self.steps(route, period) * route.speed_ms * period
        return self.start_m, end if route.closed else min(end, route.length)

    @model_validator(mode="after")
    def _check_end(self) -> Any:
        if self.horizon is not None and self.length_m is not None:
            refuse("horizon", "stands beside length_m; give one of them, or neither")
        return self

    @model_validator(mode="after")
    def _check_covariance(self) -> Any:
        """Refuse what is no covariance of metres along, metres to the left, radians."""
        if self.covariance is None:
            return self
        for key in ("lateral_sd_m", "heading_sd_deg"):
            if getattr(self, key) != self.defaults()[key]:
                refuse("covariance", f"stands beside {key}; give one of them")
        matrix = np.array(self.covariance)
        if not np.allclose(matrix, matrix.T, rtol=1e-9, atol=0):
            refuse("covariance", "is not symmetric; entry (i, j) must equal (j, i)")
        least, *_, most = np.linalg.eigvalsh(matrix)
        if least < -1e-12 * max(most, 0.0) or most < 0:
            refuse(
                "covariance",
                f"has the eigenvalue {least:.3g}; a covariance has none below 0",
            )
        return self


class BaselineSection(Section):
    """Random textures, or poses, to compare with."""

    textures: Count | None = None  # looks; as many as cost what the attack does
    deployment_textures: Count = 8  # of these, driven with in each deployment
    kind: Literal["noise", "blobs", "flat", "mixed"] = "mixed"


class Scenario(Section):
    """A complete scenario."""

    name: Annotated[str, Field(min_length=1)]
    seed: Annotated[Natural, Field(lt=2**31)] = 0
    scene: SceneSection
    objects: Annotated[tuple[ObjectSection, ...], Field(min_length=1)]
    policy: PolicySection
    camera: CameraSection = CameraSection()
    cameras: tuple[NamedCameraSection, ...] = ()  # or several
    vehicle: VehicleSection = DubinsSection()
    drive: DriveSection = DriveSection()
    objective: ObjectiveSection = ObjectiveSection()
    attack: AttackSection = AttackSection()
    baseline: BaselineSection = BaselineSection()
    deployment: DeploymentSections = RenderedDeployment()
    later: ClassVar[tuple[str, ...]] = ("cameras",)

    def __repr__(self) -> str:
        return (
            f"Scenario({self.name!r}, route {self.scene.route!r}, "
            f"objects: {len(self.objects)}, policy {Path(self.policy.source).name}, "
            f"{self.attack.method.kind} attack)"
        )

    def rig(self) -> Rig:
        """Make the cameras on the vehicle."""
        return rig_of(self.cameras) if self.cameras else self.camera.rig()

    def build_policy(self) -> AbstractPolicy:
        """Make the policy under test.

        Raises:
            InputError: it cannot be made, or the attack's method needs derivatives,
                which it does not have.
        """
        if self.attack.method.needs_derivatives:
            return build_differentiable(self.policy, self.rig().views)
        return self.policy.build(self.rig().views)

    @model_validator(mode="after")
    def _check_sections(self) -> Any:
        """Refuse sections that do not go together."""
        names = [item.id for item in self.objects]
        if len(set(names)) != len(names) or any(map(_LAYER.fullmatch, names)):
            refuse(
                "objects",
                f"ids {names}; must differ, and not be names of other layers of a "
                "frame: scene, scene1, ..., background, cost, input",
            )
        self._check_cameras()
        if self.scene.surrogate is None:
            self._check_placed()
        else:
            self._check_named(self.scene.surrogate)
        model, sections = self.vehicle.kind, labelled(self.deployment)
        labels = [label for label, _ in sections]
        if len(set(labels)) != len(labels) or SURROGATE in labels:
            refuse(
                "deployment",
                f"environments called {labels}; give each a name of its own, which is "
                f"not {SURROGATE}",
            )
        if not self.vehicle.fits_wheels:
            for label, section in sections:
                if section.kind.startswith("mujoco"):
                    refuse(
                        "deployment",
                        f"{label}: {section.kind} drives a car with wheels, whose "
                        "control is not that of a custom vehicle; take mitsuba",
                    )
        policy, taken = self.policy, self.vehicle.unit
        if reason := misfit(policy.unit(), taken, policy.source):
            refuse("vehicle.kind", f"{model} {reason}")
        policy.check_driven(self.rig().views, self.vehicle.car())
        return self

    def _check_cameras(self) -> None:
        if not self.cameras:
            return
        if "camera" in self.model_fields_set:
            refuse("cameras", "stands beside [camera]; give one of them")
        if self.scene.surrogate is not None:
            refuse("cameras", f"{self.scene.surrogate} has one sensor; give [camera]")
        if len(set(names := [item.name for item in self.cameras])) != len(names):
            refuse("cameras", f"names {names}; must differ")

    def _check_placed(self) -> None:
        for index, item in enumerate(self.objects):
            for key in ("field", "position_m"):
                if getattr(item, key, "") is None:
                    refuse(f"objects.{index}.{key}", "is missing")

    def _check_named(self, xml: NamedFile) -> None:
        """Refuse what the Mitsuba scene of the surrogate says itself."""
        lens = ("width", "height", "fov_x_deg", *CameraSection.lens)
        groups = [("camera", self.camera, lens), ("attack", self.attack, ("jitter",))]
        own = ("field", "position_m", "yaw_deg", "scale", "step_m")
        for index, item in enumerate(self.objects):
            if not isinstance(item, FieldObjectSection):
                refuse(f"objects.{index}.kind", f"{xml} says it; leave it out")
            groups.append((f"objects.{index}", item, own))
        for where, section, keys in groups:
            for key in keys:
                if getattr(section, key) != section.defaults()[key]:
                    refuse(f"{where}.{key}", f"{xml} says it; leave it out")

    def identity(self, content: Content = NamedFile.content) -> dict[str, str]:
        """Return all values by key, as JSON, and the content of the files they name.

        Args:
            content: reads it; one that remembers serves many scenarios.

        Returns:
            ``{"scenario.drive.horizon": "60", ...}``; a file is given by its name and
            the SHA-256 of its content.

        Raises:
            InputError: a file cannot be read.
        """
        identity = {}
        for location, value in self.leaves():
            key = "".join(f"[{p}]" if isinstance(p, int) else f".{p}" for p in location)
            value = content(value) if isinstance(value, NamedFile) else value
            identity[f"scenario{key}"] = json.dumps(value, sort_keys=True)
        return identity

    def digest(self) -> str:
        """Hash all values, and the content of the files that they name.

        Returns:
            16 hexadecimal digits; equal where the results are, wherever the files lie
            and whatever they are called.
        """
        return self.digests()["scenario"]

    def digests(self, content: Content = NamedFile.content) -> dict[str, str]:
        """Return :meth:`digest` as ``scenario``, and the files' SHA-256 by their keys.

        Args:
            content: as of :meth:`identity`.

        Raises:
            InputError: a file cannot be read.
        """
        values = {
            key: json.loads(value) for key, value in self.identity(content).items()
        }
        named = {key: value for key, value in values.items() if isinstance(value, dict)}
        for value in named.values():
            value.pop("file")
        text = json.dumps(values, sort_keys=True)
        own = hashlib.sha256(text.encode()).hexdigest()[:16]
        checksums = {key[len("scenario.") :]: v["sha256"] for key, v in named.items()}
        return {"scenario": own, **checksums}


def is_within(key: str, names: Sequence[str]) -> bool:
    """Whether a key of :meth:`Scenario.identity` is of these parts of a scenario.

    Args:
        key: such as ``scenario.scene.field``.
        names: of the parts, such as ``scene`` or ``scene.field``.
    """
    prefixes = [f"scenario.{name}" for name in names]
    return any(key == p or key.startswith((f"{p}.", f"{p}[")) for p in prefixes)


def load_scenario(
    path: str | Path, object_field: Path | None = None, settings: Sequence[str] = ()
) -> tuple[Scenario, str]:
    """Read and check a scenario file.

    Args:
        path: the file.
        object_field: grid field that replaces the one of every object.
        settings: keys that replace those of the file, see `overrides.set_keys`.

    Returns:
        the scenario, and the text of the file with what was replaced.

    Raises:
        InputError: the file cannot be read, is no TOML, or a key is unknown,
            missing, of the wrong type or out of range; with file and line.
    """
    text, data = files.read_text(path), files.read_toml(path)
    own = text
    if settings:
        text = set_keys(str(path), own, settings)
        data = parse_toml(path, text)
    if len(text) > _MAX_CHARACTERS:
        raise InputError(
            f"{path}: {len(text)} characters; a scenario has at most {_MAX_CHARACTERS}"
        )
    try:
        folder = {"folder": Path(path).parent}
        scenario = Scenario.model_validate(data, context=folder)
    except ValidationError as err:
        message = new_lines(path, own) or tell(path, text, problems(err), settings)
        raise InputError(message) from err
    if object_field is None:
        return scenario, text
    field = NamedFile(str(object_field.resolve()), object_field.resolve())
    objects = [
        o.model_copy(update={"field": field})
        if isinstance(o, FieldObjectSection)
        else o
        for o in scenario.objects
    ]
    scenario = scenario.model_copy(update={"objects": tuple(objects)})
    return scenario, portable_text(scenario, text)
