"""Where driving frames are taken, and what is at the roadside there."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mi_nerfattack.deploy.sites import AbstractSite
from mi_nerfattack.fields.random_textures import random_texture
from mi_nerfattack.render.posed import PosedField
from mi_nerfattack.training.settings import CollectSettings
from mi_nerfattack.vehicle.route.route import Route

#: Arc lengths of a route, metres.
Stretch = tuple[float, float]


class AbstractStage(ABC):
    """What a process keeps of a staging from shard to shard."""

    @abstractmethod
    def begin(self, rng: np.random.Generator) -> None:
        """Draw what is the same in all frames of a shard."""

    @abstractmethod
    def draw_stretch(self, rng: np.random.Generator) -> tuple[Route, Stretch]:
        """Draw a route, and the part of it on which a group of states lies."""

    @abstractmethod
    def objects(
        self, route: Route, arc: float, rng: np.random.Generator
    ) -> list[PosedField]:
        """Return the objects that a group sees; may be none.

        Args:
            route: of `draw_stretch`.
            arc: arc length of the group's centre, metres.
            rng: source of all draws.
        """


class AbstractStaging(ABC):
    """Rule for routes and objects of frames; picklable, to be sent to workers."""

    @abstractmethod
    def identity(self) -> dict[str, str]:
        """Return what the frames depend on besides site, routes and settings."""

    @abstractmethod
    def open(
        self, site: AbstractSite, routes: Sequence[Route], settings: CollectSettings
    ) -> AbstractStage:
        """Load what is needed, once for each process."""


@dataclass(frozen=True)
class RandomObjects(AbstractStaging):
    """Objects of the site in random textures, placed by the rule of the settings.

    Routes take turns by chance, longer ones more often.
    """

    def identity(self) -> dict[str, str]:
        """Return nothing: site, routes and settings say it all."""
        return {}

    def open(
        self, site: AbstractSite, routes: Sequence[Route], settings: CollectSettings
    ) -> AbstractStage:
        """Load the site's objects and surroundings."""
        return _RandomStage(site, routes, settings)


#: Of frames unless something else is asked for.
ROADSIDE = RandomObjects()


class _RandomStage(AbstractStage):
    def __init__(
        self, site: AbstractSite, routes: Sequence[Route], settings: CollectSettings
    ) -> None:
        self._routes, self._settings = routes, settings
        has_objects = settings.object_share > 0
        self._fields = site.load_objects(settings.objects) if has_objects else []
        self._own = [item.texture.numpy().copy() for item in self._fields]
        self._surroundings = site.load_surroundings() if self._fields else None
        lengths = np.array([route.length for route in routes])
        self._shares = lengths / lengths.sum()

    def begin(self, rng: np.random.Generator) -> None:
        """Give each object a random texture, or its own."""
        for item, own in zip(self._fields, self._own, strict=True):
            keep = rng.uniform() < self._settings.original_share
            texture = random_texture(item, "mixed", int(rng.integers(2**31)))
            item.set_parameter("texture", own if keep else texture)

    def draw_stretch(self, rng: np.random.Generator) -> tuple[Route, Stretch]:
        """Draw a route; the stretch is all of it, an open one's margins included."""
        route = self._routes[rng.choice(len(self._routes), p=self._shares)]
        margin = 0.0 if route.closed else self._settings.margin_m
        return route, (-margin, route.length + margin)

    def objects(
        self, route: Route, arc: float, rng: np.random.Generator
    ) -> list[PosedField]:
        """Put objects beside the road, as many as find a place, or none."""
        settings = self._settings
        if self._surroundings is None or rng.uniform() >= settings.object_share:
            return []
        count = int(rng.integers(1, settings.objects + 1))
        chosen = sorted(rng.permutation(len(self._fields))[:count].tolist())
        fields = [self._fields[index] for index in chosen]
        stretch = _in_view(route, arc, settings)
        poses = settings.roadside.find(
            fields, self._surroundings, route, stretch=stretch, rng=rng, kinds=chosen
        )
        pairs = zip(fields, poses, strict=True)
        return [PosedField(item, pose) for item, pose in pairs if pose is not None]


def _in_view(route: Route, arc: float, settings: CollectSettings) -> Stretch:
    """Return the drive from which a group's objects are in view; no longer a route's.

    At the ends of an open route it is as long, and ends where the frames do.
    """
    begin, end = arc - settings.spread_m, arc + settings.ahead_m
    if route.closed:
        return begin, end
    least, most = -settings.margin_m, route.length + settings.margin_m
    shift = max(least - begin, 0.0) + min(most - end, 0.0)
    return max(begin + shift, least), min(end + shift, most)
