"""Options of ``evaluate``: where a policy drives, and how it is called."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from mi_nerfattack.commands.shared.policy_file import is_toml, read_toml
from mi_nerfattack.errors import InputError

if TYPE_CHECKING:
    from mi_nerfattack.deploy.place import Place
    from mi_nerfattack.evaluation.identity import EnvironmentUnder
    from mi_nerfattack.scenario.policy import AbstractPolicySection

#: The policy that is evaluated where none is given.
BUNDLED_POLICY = "bundled:policy/pilotnet.safetensors"


@dataclass(frozen=True)
class PlaceOptions:
    """Where a policy drives."""

    place: str | None = None
    """Bundled place: intersection, or room (a small car that takes steering angles).
    That of a scenario is its own, and otherwise intersection."""
    scene: Path | None = None
    """Mitsuba XML of a scene of your own; needs --routes-file."""
    field: Path | None = None
    """Field file of the scene, for the surrogate."""
    routes_file: Path | None = None
    """Routes, JSON."""
    object: tuple[Path, ...] = ()
    """Grid fields that stand beside the road with random textures; the bundled place's
    by default."""
    server: str | None = None
    """Server of carla, and the town of --routes-file: HOST:PORT/TOWN."""

    @property
    def bundled(self) -> str:
        """Name of the bundled place."""
        return self.place or "intersection"

    def check(self, environments: tuple[str, ...]) -> None:
        """Check that what CARLA needs is given, and only for CARLA.

        Args:
            environments: their names.

        Raises:
            InputError: the server's town, its routes or its scene is missing, or the
                server is of no use.
        """
        from mi_nerfattack.deploy.carla.session import CarlaServer

        if "carla" not in environments:
            if self.server is not None:
                raise InputError(
                    f"--server: {self.server!r}; only the environment carla has one: "
                    "name it in --environments"
                )
            return
        town = CarlaServer.parse(self.server).town if self.server else None
        if town is None or self.routes_file is None:
            raise InputError(
                "--environments: carla drives along routes of a town; give --server "
                "HOST:PORT/TOWN and --routes-file (deploy.carla.route makes routes)"
            )
        if self.scene is None and (len(environments) > 1 or self.object):
            raise InputError(
                "--environments: carla beside others, or past objects, needs the "
                "town's --scene: the bundled ones are elsewhere"
            )

    def build(self) -> Place:
        """Return the place; camera and car are those of the bundled one."""
        from mi_nerfattack.deploy.place import bundled_place

        place = bundled_place(self.bundled)
        if self.scene is not None:
            if self.routes_file is None:
                raise InputError(f"--scene: {self.scene}; it needs its --routes-file")
            place = replace(place, scene=self.scene, field=None, objects=())
        elif self.server is not None:  # where the ground of a town is nobody knows
            place = replace(place, field=None, objects=())
        return replace(
            place,
            field=self.field or place.field,
            routes=self.routes_file or place.routes,
            objects=self.object or place.objects,
            server=self.server or place.server,
        )


@dataclass(frozen=True)
class PolicyOptions:
    """How a policy is called; a TOML file can say more, as a scenario does."""

    kind: str | None = None
    """Kind, where the suffix does not tell it: drjit, callable, ..."""
    trust_code: bool = False
    """Run the policy's code: FILE.py:NAME, .pt2 and .pt are programs, with all rights
    of your account."""
    weights_file: str | None = None
    """Weights of a module: .safetensors or a state dict."""
    goal: str | None = None
    """How the goal is passed: integer, one_hot or none."""
    goals: int | None = None
    """Number of goals."""
    control_scale: float | None = None
    """Factor to the car's unit, rad/s or rad, positive to the left; 1 by default."""
    column: int | None = None
    """Column of the control, where the network gives several numbers."""

    def section(self, policy: str | None) -> AbstractPolicySection:
        """Return what a scenario's section [policy] would say.

        Raises:
            InputError: an option does not fit, or the TOML file is not usable.
        """
        from mi_nerfattack.scenario.policy import PolicySection
        from mi_nerfattack.scenario.section import read_section

        if is_toml(policy):
            if self != PolicyOptions():
                raise InputError(
                    f"{policy}: says itself how the policy is called; leave out "
                    "--kind, --trust-code, --weights-file, --goal, --goals, "
                    "--control-scale, --column"
                )
            found, path = read_toml(policy)
            values = found.get("policy")
            if not isinstance(values, dict):
                raise InputError(f"{policy}: has no section [policy]")
            return read_section(f"{policy}: policy", PolicySection, values, path.parent)
        chosen = policy or BUNDLED_POLICY
        values = {
            "url" if chosen.startswith(("http://", "https://")) else "file": chosen,
            "kind": self.kind,
            "trust_code": self.trust_code,
            "weights_file": self.weights_file,
            "goal": self.goal,
            "goals": self.goals,
            "control_scale": self.control_scale,
            "output": self.column,
        }
        values = {key: value for key, value in values.items() if value is not None}
        return read_section(f"{chosen}: policy", PolicySection, values, Path())


def parse_conditions(
    names: tuple[str, ...], conditions: tuple[str, ...], spp: int
) -> tuple[EnvironmentUnder, ...]:
    """Return the environments under all conditions; the surrogate under none.

    Args:
        names: of the environments.
        conditions: each ``SKY`` or ``SKY:EV``.
        spp: samples per pixel.
    """
    from mi_nerfattack.deploy.place import Conditions
    from mi_nerfattack.evaluation.identity import EnvironmentUnder

    parsed = []
    for text in conditions:
        sky, _, exposure = text.partition(":")
        try:
            parsed.append(Conditions(sky, float(exposure or 0), spp))
        except ValueError as err:
            raise InputError(f"--conditions: {text!r}: {err}") from err
    if not parsed or len(set(parsed)) < len(parsed):
        raise InputError(f"--conditions: {conditions}; at least one, each once")
    found = []
    for name in names:
        several = [Conditions(spp=spp)] if name == "surrogate" else parsed
        found += [EnvironmentUnder(name, item) for item in several]
    return tuple(found)


def parse_scales(
    numbers: tuple[float, ...], objects: int
) -> tuple[tuple[float, float], ...]:
    """Return the ranges of --scale as pairs; none where it is not given.

    Args:
        numbers: least and most, in turns.
        objects: number of fields.
    """
    pairs = tuple(zip(numbers[::2], numbers[1::2], strict=False))
    if len(numbers) % 2 or len(pairs) not in (0, 1, objects):
        raise InputError(
            f"--scale: {' '.join(map(str, numbers))}; least and most of all objects, "
            f"or of each of the {objects} --object files"
        )
    return pairs
