"""Options of ``evaluate``: where a policy drives, and under which conditions."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from mi_nerfattack.errors import InputError

if TYPE_CHECKING:
    from mi_nerfattack.deploy.place import Place
    from mi_nerfattack.evaluation.identity import EnvironmentUnder

Facing = Literal["shape", "along", "traffic"]


@dataclass(frozen=True)
class PlaceOptions:
    """Where a policy drives."""

    place: str | None = None
    """Bundled place: intersection (by default) or room."""
    scene: Path | None = None
    """Mitsuba scene (.xml); needs --routes-file."""
    field: Path | None = None
    """Field file of the scene, for the surrogate."""
    routes_file: Path | None = None
    """Routes (.json), or those of CARLA's leaderboard (.xml)."""
    object: tuple[Path, ...] = ()
    """Grid fields at the roadside; by default the place's."""
    server: str | None = None
    """CARLA's server and town, HOST:PORT/TOWN."""

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
                "HOST:PORT/TOWN and --routes-file (.json, or the leaderboard's .xml)"
            )
        if self.scene is None and (len(environments) > 1 or self.object):
            raise InputError(
                "--environments: carla beside others, or past objects, needs the "
                "town's --scene: the bundled ones are elsewhere"
            )

    @property
    def names_place(self) -> bool:
        """Whether they name a place, and not only parts of one."""
        return (self.place, self.scene, self.server) != (None, None, None)

    def build(self, base: Place | None = None) -> Place:
        """Return the place.

        Args:
            base: place whose parts the options replace; by default the bundled one,
                with its camera and car.

        Raises:
            InputError: a scene has no routes.
        """
        from mi_nerfattack.deploy.place import bundled_place

        place = base or bundled_place(self.bundled)
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


def parse_conditions(
    names: tuple[str, ...], conditions: tuple[str, ...], spp: int
) -> tuple[EnvironmentUnder, ...]:
    """Return the environments under all conditions; the surrogate under none.

    Args:
        names: of the environments.
        conditions: times of day and exposures, see `columns.parse_condition`.
        spp: samples per pixel.
    """
    from mi_nerfattack.deploy.place import Conditions
    from mi_nerfattack.evaluation.identity import EnvironmentUnder
    from mi_nerfattack.experiment.transfer.columns import Condition, parse_condition

    parsed = []
    for text in conditions:
        condition = parse_condition(text)
        if replace(condition, sky="day", exposure_ev=0.0) != Condition():
            raise InputError(
                f"--conditions: {text!r}; a card is of times of day and exposures "
                "alone: give other conditions to transfer"
            )
        parsed.append(Conditions(condition.sky, condition.exposure_ev, spp))
    if not parsed or len(set(parsed)) < len(parsed):
        raise InputError(f"--conditions: {conditions}; at least one, each once")
    environments = []
    for name in names:
        several = [Conditions(spp=spp)] if name == "surrogate" else parsed
        environments += [EnvironmentUnder(name, item) for item in several]
    return tuple(environments)


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
