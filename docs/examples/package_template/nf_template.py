"""A vehicle that drifts: it moves at a constant angle to its heading."""

from __future__ import annotations

from dataclasses import dataclass
from math import radians
from typing import Annotated, Any, ClassVar, Literal

import drjit as dr
from pydantic import Field

from mi_nerfattack.ranges import Positive
from mi_nerfattack.scenario.vehicle import AbstractVehicleSection
from mi_nerfattack.vehicle.dynamics import AbstractDynamics, soft_limit

Angle = Annotated[float, Field(gt=-90, lt=90)]


@dataclass(frozen=True)
class Drift(AbstractDynamics):
    """`dx/dt = (v cos(theta + beta), v sin(theta + beta), u)`.

    Args:
        speed: v, metres per second.
        slip: beta, radians, positive to the left.
        max_heading_rate: limit of ``|u|``, radians per second.
    """

    speed: float
    slip: float
    max_heading_rate: float
    control_names: ClassVar[tuple[str, ...]] = ("heading_rate",)

    def derivative(self, state: Any, control: Any) -> Any:
        """Compute (3, n) from a state (3, n) and a heading rate (n,)."""
        sin, cos = dr.sincos(state[2] + self.slip)
        return type(state)(self.speed * cos, self.speed * sin, control)

    def saturate(self, control: Any) -> Any:
        """Limit the heading rate (n,) smoothly."""
        return soft_limit(control, self.max_heading_rate)


class DriftSection(AbstractVehicleSection):
    """The table ``[vehicle]`` with ``kind = "drift"``."""

    kind: Literal["drift"]
    speed_ms: Positive = 5.0
    max_heading_rate: Positive = 1.5
    slip_deg: Angle = 3.0

    def build(self) -> AbstractDynamics:
        """Make the model."""
        return Drift(self.speed_ms, radians(self.slip_deg), self.max_heading_rate)

    def handling(self) -> dict[str, Any]:
        """Say what the control is, and where it ends."""
        return {"max_control": self.max_heading_rate, "control_unit": "rad/s"}
