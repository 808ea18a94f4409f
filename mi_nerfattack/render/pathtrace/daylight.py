"""Times of day of scenes that a `sunsky` emitter lights."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import mitsuba as mi

from mi_nerfattack.errors import InputError


@dataclass(frozen=True)
class Daylight:
    """Sun and sky; x is east and y is north.

    Args:
        elevation_deg: of the sun above the horizon.
        azimuth_deg: of the sun, clockwise from north.
        sun: factor of the file's sun.
        sky: factor of the file's sky.
        turbidity: of the air, 1 to 10.
    """

    elevation_deg: float
    azimuth_deg: float
    sun: float = 1.0
    sky: float = 1.0
    turbidity: float = 4.0

    @property
    def sun_direction(self) -> tuple[float, float, float]:
        """Unit vector towards the sun."""
        up, around = math.radians(self.elevation_deg), math.radians(self.azimuth_deg)
        flat = math.cos(up)
        return flat * math.sin(around), flat * math.cos(around), math.sin(up)


#: Times of day by name; "day" leaves the scene as its file has it.
DAYLIGHT: Mapping[str, Daylight | None] = {
    "day": None,
    "morning": Daylight(28.0, 100.0, sun=1.3, sky=1.9),
    "noon": Daylight(68.0, 180.0),
    "evening": Daylight(18.0, 262.0, sun=1.7, sky=2.3, turbidity=6.0),
    "overcast": Daylight(50.0, 180.0, sun=0.0, sky=1.5, turbidity=10.0),
}


def set_daylight(scene: Any, name: str) -> None:
    """Light a scene as at another time of day.

    Args:
        scene: `mi.Scene`; its emitter is changed in place.
        name: key of `DAYLIGHT`.

    Raises:
        InputError: unknown name, no `sunsky` emitter in the scene, or one whose sun
            follows from place and time instead of a direction.
    """
    if name not in DAYLIGHT:
        raise InputError(f"sky: {name!r}; one of {', '.join(DAYLIGHT)}")
    daylight = DAYLIGHT[name]
    if daylight is None:
        return
    parameters: Any = mi.traverse(scene)
    suns = [key for key in parameters.keys() if key.endswith(".sun_direction")]
    if not suns:
        raise InputError(
            f"sky: {name!r} needs a scene with a `sunsky` emitter; add one to the "
            "scene's file, or use 'day'"
        )
    for key in suns:
        emitter = key.removesuffix(".sun_direction")
        if parameters.flags(key) & mi.ParamFlags.ReadOnly.value:
            raise InputError(
                f"sky: {name!r}: the sun of {emitter!r} follows from place and time; "
                "give it a sun_direction in the scene's file, or use 'day'"
            )
        parameters[key] = mi.Vector3f(*daylight.sun_direction)
        parameters[f"{emitter}.sun_scale"] *= daylight.sun
        parameters[f"{emitter}.sky_scale"] *= daylight.sky
        parameters[f"{emitter}.turbidity"] = daylight.turbidity
    parameters.update()
