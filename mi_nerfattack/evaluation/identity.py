"""What decides about the drives of an evaluation, to tell kept ones apart."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

from mi_nerfattack.deploy.place import Conditions, Place
from mi_nerfattack.deploy.sites import PlaceSite, Weather
from mi_nerfattack.drives import spec
from mi_nerfattack.errors import InputError
from mi_nerfattack.evaluation.evaluate import EvaluateSettings
from mi_nerfattack.io.resumable import json_digest
from mi_nerfattack.scenario.named_file import section_content
from mi_nerfattack.scenario.policy.base import AbstractPolicySection
from mi_nerfattack.scenario.vehicle import AbstractVehicleSection
from mi_nerfattack.vehicle.route.route import Route


@dataclass(frozen=True)
class EnvironmentUnder:
    """An environment by name, under conditions.

    Args:
        name: key of `deploy.registry.ENVIRONMENTS`.
        conditions: sky, exposure and samples; an evaluation has no others.

    Raises:
        InputError: the conditions have blur, noise or built-in objects.
    """

    name: str
    conditions: Conditions

    def __post_init__(self) -> None:
        conditions = self.conditions
        if conditions.blur_px or conditions.noise_sd or conditions.built_in:
            raise InputError(
                f"environment {self.name!r}: an evaluation has no blur, noise or "
                "built-in objects; give them to transfer, or to a scenario's deployment"
            )

    @property
    def label(self) -> str:
        """Key of the card: the name, with sky and exposure where they are unusual."""
        sky, exposure = self.conditions.sky, self.conditions.exposure_ev
        suffixes = [] if sky == "day" and exposure == 0 else [sky]
        suffixes += [f"{exposure:+g}EV"] if exposure else []
        return "@".join([self.name, "".join(suffixes)]) if suffixes else self.name


def identify(
    policy: AbstractPolicySection,
    place: Place,
    environments: Sequence[EnvironmentUnder],
    routes: Sequence[Route],
    settings: EvaluateSettings,
    vehicle: AbstractVehicleSection | None = None,
) -> dict[tuple[str, str], dict[str, str]]:
    """Describe everything that the drives of each environment and route depend on.

    Args:
        policy: section of the policy that drives.
        place: where it drives.
        environments: with their conditions.
        routes: that are driven, with different names.
        settings: all but the numbers of runs and objects count.
        vehicle: section of the car; None for the car of the place.

    Returns:
        by label of the environment and name of the route.

    Raises:
        InputError: a file cannot be read.
    """
    shared: dict[str, Any] = {"policy": json_digest(section_content(policy))}
    if vehicle is not None:
        shared["vehicle"] = json_digest(section_content(vehicle))
    shared["settings"] = {**asdict(settings), "runs": None, "objects": None}
    identities = {}
    for under in environments:
        site = PlaceSite(under.name, place, _weather(under.conditions))
        shared["environment"] = json_digest(site.describe())
        for route in routes:
            shared["route"] = json_digest(_route_content(route))
            identities[under.label, route.name] = spec.identify(under.name, shared)
    return identities


def _weather(conditions: Conditions) -> Weather:
    return Weather((conditions.sky,), (conditions.exposure_ev,), conditions.spp)


def _route_content(route: Route) -> list[Any]:
    """Return what decides of a route; its name seeds starts and textures."""
    values = [route.name, route.goal, route.lane_width_m, route.speed_ms, route.closed]
    return [*values, route.points.tolist()]
