"""What decides about the drives of an evaluation, to tell kept ones apart."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

from mi_nerfattack.backend.versions import versions
from mi_nerfattack.deploy.place import Conditions, Place
from mi_nerfattack.deploy.sites import PlaceSite, Weather
from mi_nerfattack.evaluation.evaluate import EvaluateSettings
from mi_nerfattack.scenario.named_file import NamedFile
from mi_nerfattack.scenario.policy import AbstractPolicySection
from mi_nerfattack.scenario.section import Section
from mi_nerfattack.scenario.vehicle import AbstractVehicleSection
from mi_nerfattack.vehicle.route.route import Route

FORMAT = "mi_nerfattack evaluated drive 4"


@dataclass(frozen=True)
class EnvironmentUnder:
    """An environment by name, under conditions.

    Args:
        name: key of `deploy.registry.ENVIRONMENTS`.
        conditions: of light and camera.
    """

    name: str
    conditions: Conditions

    @property
    def label(self) -> str:
        """Key of the card: the name, with sky and exposure where they are unusual."""
        sky, exposure = self.conditions.sky, self.conditions.exposure_ev
        parts = [] if sky == "day" and exposure == 0 else [sky]
        parts += [f"{exposure:+g}EV"] if exposure else []
        return "@".join([self.name, "".join(parts)]) if parts else self.name


def identify(
    policy: AbstractPolicySection,
    place: Place,
    environments: Sequence[EnvironmentUnder],
    routes: Sequence[Route],
    settings: EvaluateSettings,
    vehicle: AbstractVehicleSection | None = None,
) -> dict[tuple[str, str], dict[str, str]]:
    """Describe all that decides about the drives of each environment and route.

    Args:
        policy: as of `EvaluateWork`, and so are the others.
        place: likewise.
        environments: likewise.
        routes: likewise.
        settings: the numbers of runs and objects do not count.
        vehicle: likewise.

    Returns:
        by label of the environment and name of the route, for `resumable.Unit`.

    Raises:
        InputError: a file cannot be read.
    """
    shared = {
        "format": FORMAT,
        "policy": _digest("policy", section_content(policy)),
        **{f"version.{name}": value for name, value in versions().items()},
    }
    if vehicle is not None:
        shared["vehicle"] = _digest("vehicle", section_content(vehicle))
    worlds = {
        under.label: PlaceSite(under.name, place, _weather(under.conditions)).describe()
        for under in environments
    }
    choices = {**asdict(settings), "runs": None, "objects": None}
    return {
        (under.label, route.name): {
            **shared,
            "environment": _digest(under.label, worlds[under.label]),
            "route": _digest(route.name, _route_content(route)),
            "settings": json.dumps(choices, sort_keys=True),
        }
        for under in environments
        for route in routes
    }


def _weather(conditions: Conditions) -> Weather:
    return Weather((conditions.sky,), (conditions.exposure_ev,), conditions.spp)


def _route_content(route: Route) -> list[Any]:
    values = [route.goal, route.lane_width_m, route.speed_ms, route.closed]
    return [*values, route.points.tolist()]


def section_content(section: Section) -> dict[str, Any]:
    """Return what a policy's or vehicle's section says as JSON, files by checksums."""
    values = section.model_dump(mode="json", exclude_defaults=True)
    for (key, *_), value in section.leaves():
        if isinstance(value, NamedFile):
            values.pop(str(key))
            values[f"{key}_sha256"] = value.content()["sha256"]
    return values


def _digest(name: str, value: Any) -> str:
    """Return a value's checksum, in the form that `resumable` takes for a file's."""
    text = json.dumps(value, sort_keys=True)
    return json.dumps({"file": name, "sha256": _sha256(text.encode())})


def _sha256(raw: bytes) -> str:
    return hashlib.sha256(raw).hexdigest()


def short_digest(identity: Mapping[str, str]) -> str:
    """Return 12 hexadecimal digits that tell one identity from another."""
    return _sha256(json.dumps(identity, sort_keys=True).encode())[:12]
