"""The sections of a scenario file: keys, types, ranges, defaults."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field

Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
NonNegative = Annotated[float, Field(ge=0, allow_inf_nan=False)]
Finite = Annotated[float, Field(allow_inf_nan=False)]
Count = Annotated[int, Field(ge=1)]
Row = tuple[Finite, Finite, Finite, Finite]
Matrix = tuple[Row, Row, Row, Row]


class Section(BaseModel):
    """A table of the file; unknown keys are refused."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)


class SceneSection(Section):
    """Where the drive takes place."""

    field: str  # field file of the scene, or .ply of Gaussian splats: the surrogate
    deployment: str  # Mitsuba scene XML: the deployment environment
    routes: str  # JSON of routes
    route: str  # name of the route that is driven
    composite: Literal["depth", "interleaved"] = "depth"  # of fields, in the surrogate
    to_world: Matrix | None = None  # of the field: turn, uniform scale, translation


class ObjectSection(Section):
    """An object whose texture is attacked."""

    id: Annotated[str, Field(pattern=r"^[A-Za-z][A-Za-z0-9_]*$")]
    field: str  # grid field file
    position_m: tuple[Finite, Finite, Finite]
    yaw_deg: Finite = 0.0
    scale: Positive = 1.0


class PolicySection(Section):
    """The policy under test."""

    file: str  # PilotNet, safetensors


class CameraSection(Section):
    """The camera on the vehicle."""

    width: Count = 200
    height: Count = 66
    fov_x_deg: Annotated[float, Field(gt=0, lt=180)] = 90.0
    height_m: Positive = 1.4
    forward_m: Finite = 0.5
    pitch_deg: Annotated[float, Field(gt=-90, lt=90)] = 6.0


class VehicleSection(Section):
    """The vehicle and its time step."""

    model: Literal["dubins", "ackermann"] = "dubins"
    integrator: Literal["euler", "rk4", "implicit_midpoint"] = "rk4"
    speed_ms: Positive = 5.0
    dt_s: Positive = 0.1
    width_m: Positive = 1.8
    wheelbase_m: Positive = 2.7
    max_heading_rate: Positive = 1.5
    max_steer_deg: Annotated[float, Field(gt=0, lt=90)] = 34.0


class DriveSection(Section):
    """What is driven."""

    horizon: Count = 60
    runs: Count = 4  # drives of the unperturbed and the attacked case
    lateral_sd_m: NonNegative = 0.1
    heading_sd_deg: NonNegative = 0.5


class AttackSection(Section):
    """How the texture is optimised."""

    iterations: Count = 20
    learning_rate: Positive = 0.3
    poses: Count = 1  # initial poses of an iteration; the first is nominal
    attached: bool = False
    keep_frames: bool = False
    jitter: bool = False
    checkpoint_every: Count = 10


class BaselineSection(Section):
    """Random textures to compare with."""

    textures: Count | None = None  # as many as attack iterations if left out
    kind: Literal["noise", "blobs", "flat", "mixed"] = "mixed"


class DeploymentSection(Section):
    """The path-traced scene."""

    spp: Count = 16
