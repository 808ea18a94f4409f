"""Named sizes of a training: how many frames of what, and how long."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from mi_nerfattack.deploy.car import SMALL_CAR
from mi_nerfattack.deploy.place import Scatter
from mi_nerfattack.deploy.roadside.rule import Roadside
from mi_nerfattack.deploy.sites import ANY_WEATHER, Weather
from mi_nerfattack.errors import InputError
from mi_nerfattack.evaluation.evaluate import EvaluateSettings
from mi_nerfattack.training.settings import CollectSettings


@dataclass(frozen=True)
class Preset:
    """Choices of a training that belong together.

    Args:
        place: key of `deploy.registry.bundled_place`.
        frames: of the first collection, by environment.
        validation_frames: of the collection that the held-out loss is measured on, by
            environment; none: about a tenth of the others.
        dagger_rounds: in which the policy drives and the expert labels.
        dagger_frames: of each round, by environment.
        epochs: passes over the frames.
        dagger_epochs: passes over all frames after each round.
        weather: conditions of the frames.
        collecting: how states, objects and their poses are drawn.
    """

    place: str
    frames: Mapping[str, int]
    validation_frames: Mapping[str, int] = field(default_factory=dict)
    dagger_rounds: int = 0
    dagger_frames: Mapping[str, int] = field(default_factory=dict)
    epochs: int = 8
    dagger_epochs: int = 3
    weather: Weather = ANY_WEATHER
    collecting: CollectSettings = field(default_factory=CollectSettings)


#: Beside the small car's track, in its scale: cubes of 0.15 to 0.35 m.
_ROOM_ROADSIDE = Roadside(((0.15, 0.35),), gap_m=(0.05, 0.6), clearance_m=0.05)

#: How frames are drawn, by bundled place. The lengths of the small car's track are a
#: tenth of those of the intersection.
COLLECTIONS: Mapping[str, CollectSettings] = {
    "intersection": CollectSettings(),
    "room": CollectSettings(
        spread_m=0.3,
        ahead_m=1.6,
        margin_m=0.2,
        scatter=Scatter(lateral_sd_m=0.08, lateral_max_m=0.2),
        roadside=_ROOM_ROADSIDE,
    ),
}

#: Presets by name. "intersection" and "room" have the figures of appendix B.3 and B.4;
#: the room's 9,584 frames of the real car are path-traced ones here.
PRESETS: Mapping[str, Preset] = {
    "laptop": Preset(
        "intersection",
        {"surrogate": 2048, "mitsuba": 4096, "mujoco": 1024},
        dagger_rounds=2,
        dagger_frames={"surrogate": 512, "mitsuba": 512, "mujoco": 512},
    ),
    "intersection": Preset(
        "intersection",
        {"mitsuba": 120_000, "surrogate": 60_000},
        {"surrogate": 12_000},
        epochs=10,
    ),
    "room": Preset(
        "room",
        {"mitsuba": 9_584, "surrogate": 12_000},
        epochs=10,
        weather=Weather(exposures_ev=ANY_WEATHER.exposures_ev),
        collecting=COLLECTIONS["room"],
    ),
}

#: Starts, objects and widths of closed-loop drives, by bundled place.
EVALUATIONS: Mapping[str, EvaluateSettings] = {
    "intersection": EvaluateSettings(),
    "room": EvaluateSettings(
        scatter=Scatter(
            lateral_sd_m=0.03,
            lateral_max_m=0.09,
            heading_sd=np.deg2rad(3.0).item(),
            heading_max=np.deg2rad(9.0).item(),
            close_share=0,
        ),
        car_width_m=SMALL_CAR.width,
        roadside=_ROOM_ROADSIDE,
    ),
}


def evaluation_for(car_width_m: float) -> EvaluateSettings:
    """Return how to drive at a place of somebody else's: as with the most similar car.

    Starts that scatter, and objects that stand, as for a full-size car leave no lane of
    a small one free.
    """
    return EVALUATIONS[_most_similar(car_width_m)]


def collecting_for(car_width_m: float) -> CollectSettings:
    """Return how to draw frames at such a place; see `evaluation_for`."""
    return COLLECTIONS[_most_similar(car_width_m)]


def _most_similar(car_width_m: float) -> str:
    """Return the bundled place whose car has the most similar width."""
    widths = {name: settings.car_width_m for name, settings in EVALUATIONS.items()}
    return min(widths, key=lambda name: abs(widths[name] - car_width_m))


def find_preset(name: str) -> Preset:
    """Return a preset by its name.

    Raises:
        InputError: there is none of the name.
    """
    if name not in PRESETS:
        raise InputError(f"preset: {name!r}; one of {', '.join(PRESETS)}")
    return PRESETS[name]
