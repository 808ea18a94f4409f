"""A vehicle whose heading rate follows its command with a lag."""

from dataclasses import dataclass
from typing import Any, ClassVar, Literal

import drjit as dr

from mi_nerfattack.ranges import Positive
from mi_nerfattack.scenario.vehicle import AbstractVehicleSection
from mi_nerfattack.vehicle.dynamics import AbstractDynamics, soft_limit


@dataclass(frozen=True)
class YawLag(AbstractDynamics):
    speed: float  # m/s
    max_heading_rate: float  # rad/s
    lag: float  # s
    control_names: ClassVar[tuple[str, ...]] = ("heading_rate",)
    state_size: ClassVar[int] = 4  # x, y, heading, heading rate

    def derivative(self, state: Any, control: Any) -> Any:
        sin, cos = dr.sincos(state[2])
        slope = (control - state[3]) / self.lag
        return type(state)(self.speed * cos, self.speed * sin, state[3], slope)

    def saturate(self, control: Any) -> Any:
        return soft_limit(control, self.max_heading_rate)


class YawLagSection(AbstractVehicleSection):
    kind: Literal["yaw_lag"]
    speed_ms: Positive = 5.0
    max_heading_rate: Positive = 1.5
    lag_s: Positive = 0.3

    def build(self) -> AbstractDynamics:
        return YawLag(self.speed_ms, self.max_heading_rate, self.lag_s)

    def handling(self) -> dict[str, Any]:
        return {"max_control": self.max_heading_rate, "control_unit": "rad/s"}
