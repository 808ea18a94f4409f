"""The section ``[attack.vary]``: what differs between the drives of an attack."""

from __future__ import annotations

from dataclasses import replace
from typing import Annotated

from pydantic import Field

from mi_nerfattack.ranges import NonNegative
from mi_nerfattack.render.camera.disturbance import Disturbance
from mi_nerfattack.rollout.loop import ClosedLoop
from mi_nerfattack.rollout.scene_sensor import SceneSensor
from mi_nerfattack.rollout.variation import Variation, Varied
from mi_nerfattack.scenario.section import Section

Stops = Annotated[float, Field(ge=0, le=8)]  # powers of two
Logarithm = Annotated[float, Field(ge=0, le=1)]  # of factors


class VarySection(Section):
    """Standard deviations of normal draws, one of each for the drive of a pose."""

    light_ev_sd: Stops = 0.0  # of the light on objects, powers of two
    light_colour_ev_sd: Stops = 0.0  # of each channel of it
    exposure_ev_sd: Stops = 0.0  # of the whole image, powers of two
    colour_ev_sd: Stops = 0.0  # of each channel of it
    blur_px_sd: NonNegative = 0.0  # of the number whose size blurs a drive
    noise_sd: NonNegative = 0.0  # of each frame, sRGB in [0, 1]
    pitch_deg_sd: Annotated[float, Field(ge=0, le=45)] = 0.0  # of the camera
    height_sd: Logarithm = 0.0  # of the logarithm of its height
    speed_sd: Logarithm = 0.0  # of the logarithm of the vehicle's speed
    steering_sd: Logarithm = 0.0  # of the logarithm of its heading rate

    def applied(self, loop: ClosedLoop, seed: int) -> ClosedLoop:
        """Return a loop whose drives differ.

        Args:
            loop: through a `SceneSensor`.
            seed: of all draws.

        Raises:
            InputError: there are no objects whose light could vary.
        """
        drawn = self.model_dump()
        sizes = ("exposure_ev_sd", "blur_px_sd", "noise_sd", "colour_ev_sd")
        disturbance = Disturbance(
            **{name: drawn.pop(name) for name in sizes}, seed=seed
        )
        variation = Variation(**drawn, seed=seed)
        sensor, dynamics = loop.sensor, loop.dynamics
        if variation.of_light or variation.of_mount:
            assert isinstance(sensor, SceneSensor)  # as that of every world
            sensor = sensor.varied(variation)
        if variation.of_vehicle:
            dynamics = Varied(dynamics, variation)
        return replace(loop, sensor=sensor, dynamics=dynamics, disturbance=disturbance)
