"""The sections of a scenario file: keys, types, ranges, defaults."""

from __future__ import annotations

from typing import Annotated, Any, Literal, NoReturn

import numpy as np
from pydantic import AfterValidator, BaseModel, ConfigDict, Field, model_validator
from pydantic_core import ErrorDetails, PydanticCustomError


def _not_zero(value: float) -> float:
    if value == 0:
        raise ValueError("must not be 0")
    return value


Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
NonNegative = Annotated[float, Field(ge=0, allow_inf_nan=False)]
Finite = Annotated[float, Field(allow_inf_nan=False)]
NonZero = Annotated[float, Field(allow_inf_nan=False), AfterValidator(_not_zero)]
Count = Annotated[int, Field(ge=1)]
Whole = Annotated[int, Field(ge=0)]
Trust = Annotated[bool, Field(exclude=True)]  # results do not depend on it
Part = Annotated[float, Field(ge=0, lt=1)]
Row = tuple[Finite, Finite, Finite, Finite]
Matrix = tuple[Row, Row, Row, Row]
Triple = tuple[Finite, Finite, Finite]


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


class PreprocessSection(Section):
    """From the camera's image to the policy's input, in the order of the keys."""

    crop_px: tuple[Whole, Whole, Whole, Whole] | None = None  # see crop_fraction
    crop_fraction: tuple[Part, Part, Part, Part] | None = None  # top bottom left right
    resize_px: tuple[Count, Count] | None = None  # width, height
    filter: Literal["antialias", "bilinear", "area"] = "antialias"
    colour: Literal["srgb", "linear", "yuv", "grey", "bgr"] = "srgb"
    scale: Positive = 1.0  # of values in [0, 1]
    mean: Annotated[tuple[Finite, ...], Field(min_length=1)] = (0.0,)
    std: Annotated[tuple[Positive, ...], Field(min_length=1)] = (1.0,)
    frames: Count = 1  # in the stack
    stride: Count = 1  # control periods between them
    layout: Literal["NCHW", "NHWC", "NTCHW", "NTHWC"] = "NCHW"

    @model_validator(mode="after")
    def _check_crops(self) -> Any:
        """Refuse two crops."""
        if self.crop_px is not None and self.crop_fraction is not None:
            _refuse("crop_fraction", "stands beside crop_px; give one of them")
        return self


class PolicySection(Section):
    """The policy under test."""

    kind: (
        Literal[
            "pilotnet",
            "module",
            "exported",
            "torchscript",
            "onnx",
            "drjit",
            "callable",
            "http",
        ]
        | None
    ) = None  # told by the suffix of the file: .safetensors .py .pt2 .pt .onnx
    file: str | None = None  # or FILE.py:NAME
    trust_code: Trust = False  # it runs with all rights of the account
    weights_file: str | None = None  # of a module: .safetensors, or a state dict .pt
    url: str | None = None
    timeout_s: Positive = 10.0  # of an answer from the URL
    retries: Whole = 2
    goal: Literal["integer", "one_hot", "none"] | None = None  # PilotNet's own, or none
    goals: Count | None = None
    recurrent: tuple[tuple[int, ...], ...] = ()  # shapes, -1 for the vehicles
    batch: Literal[1] | None = None  # where it takes one image at a time
    output: Whole | None = None  # column of the control, where there are several
    control_scale: NonZero = 1.0  # to rad/s (dubins) or rad, positive to the left
    preprocess: PreprocessSection = PreprocessSection()

    @model_validator(mode="after")
    def _check_source(self) -> Any:
        """Refuse anything but one source, and goals without their number."""
        if (self.file is None) == (self.url is None):
            _refuse("file", "give either file or url")
        if self.goal in ("integer", "one_hot") and self.goals is None:
            _refuse("goals", f'is missing; goal = "{self.goal}" needs it')
        if self.goal not in ("integer", "one_hot") and self.goals is not None:
            _refuse("goals", 'needs goal = "integer" or "one_hot"')
        return self


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

    model: Literal["dubins", "ackermann", "ackermann_rate", "bicycle", "custom"] = (
        "dubins"
    )
    integrator: Literal["euler", "rk4", "implicit_midpoint"] = "rk4"
    speed_ms: Positive = 5.0
    dt_s: Positive = 0.1  # control period
    substeps: Count = 1  # integration steps a control period
    delay_steps: Annotated[int, Field(ge=0)] = 0  # integration steps
    width_m: Positive = 1.8
    wheelbase_m: Positive = 2.7
    front_axle_m: Positive = 1.35  # from the centre of gravity
    rear_axle_m: Positive = 1.35
    max_heading_rate: Positive = 1.5
    max_steer_deg: Annotated[float, Field(gt=0, lt=90)] = 34.0
    max_steer_rate_deg_s: Positive = 40.0
    steer_time_s: Positive = 0.1  # time constant of the steering's lag
    function: Annotated[str, Field(pattern=r"^.+:[A-Za-z_]\w*$")] | None = None
    trust_code: Trust = False  # see PolicySection
    framework: Literal["drjit", "torch"] = "drjit"  # of the function
    state_size: Annotated[int, Field(ge=3, le=16)] = 3
    control_limit: Positive | None = None  # in the unit of the function's control
    rest_state: tuple[Finite, ...] = ()  # initial values of the rows after theta

    @model_validator(mode="after")
    def _check_keys(self) -> Any:
        """Refuse keys that do not go together, and steps that oscillate."""
        for key, models in _MODEL_KEYS.items():
            _check_pair(self, key, "model", models)
        if len(self.rest_state) not in (0, self.state_size - 3):
            _refuse(
                "rest_state",
                f"has {len(self.rest_state)} numbers; state_size = {self.state_size} "
                f"needs {self.state_size - 3} or none",
            )
        ratio = self.dt_s / self.substeps / self.steer_time_s
        limit = _STABLE_RATIO[self.integrator]
        if self.model == "ackermann_rate" and ratio >= limit:
            _refuse(
                "steer_time_s",
                f"integration steps of dt_s / substeps = {self.dt_s / self.substeps:g} "
                f"s diverge with {self.integrator}: they must be below {limit:g} x "
                f"{self.steer_time_s:g} s; raise substeps",
            )
        return self


#: Models that each key of a vehicle belongs to; the others belong to all.
_MODEL_KEYS = {
    "speed_ms": ("dubins", "ackermann", "ackermann_rate", "bicycle"),
    "wheelbase_m": ("ackermann", "ackermann_rate"),
    "front_axle_m": ("bicycle",),
    "rear_axle_m": ("bicycle",),
    "max_heading_rate": ("dubins",),
    "max_steer_deg": ("ackermann", "ackermann_rate", "bicycle"),
    "max_steer_rate_deg_s": ("ackermann_rate",),
    "steer_time_s": ("ackermann_rate",),
    "function": ("custom",),
    "framework": ("custom",),
    "state_size": ("custom",),
    "control_limit": ("custom",),
    "rest_state": ("custom",),
}
#: Ratio of step and time constant at which the integration of a lag diverges.
_STABLE_RATIO = {"euler": 2.0, "rk4": 2.78, "implicit_midpoint": float("inf")}


class DriveSection(Section):
    """What is driven."""

    horizon: Count = 60
    runs: Count = 4  # drives of the unperturbed and the attacked case
    lateral_sd_m: NonNegative = 0.1
    heading_sd_deg: NonNegative = 0.5
    covariance: tuple[Triple, Triple, Triple] | None = None  # see _check_covariance

    @model_validator(mode="after")
    def _check_covariance(self) -> Any:
        """Refuse what is no covariance of metres along, metres to the left, radians."""
        if self.covariance is None:
            return self
        for key in ("lateral_sd_m", "heading_sd_deg"):
            if getattr(self, key) != type(self).model_fields[key].default:
                _refuse("covariance", f"stands beside {key}; give one of them")
        matrix = np.array(self.covariance)
        if not np.allclose(matrix, matrix.T, rtol=1e-9, atol=0):
            _refuse("covariance", "is not symmetric; entry (i, j) must equal (j, i)")
        least, *_, most = np.linalg.eigvalsh(matrix)
        if least < -1e-12 * max(most, 0.0) or most < 0:
            _refuse(
                "covariance",
                f"has the eigenvalue {least:.3g}; a covariance has none below 0",
            )
        return self


class AttackSection(Section):
    """How the texture is optimised."""

    iterations: Count = 20
    learning_rate: Positive = 0.3
    poses: Count = 1  # initial poses of an iteration; the first is nominal
    parameters: Literal["texture", "pose", "both"] = "texture"  # what may change
    pose_learning_rate: Positive = 0.02  # metres and radians
    pose_axes: Annotated[
        tuple[Literal["x", "y", "z", "roll", "pitch", "yaw"], ...], Field(min_length=1)
    ] = ("x", "y", "yaw")  # world axes
    pose_limit_m: Positive = 1.0  # along each axis
    pose_limit_deg: Positive = 30.0  # about each axis
    adjoint: Literal["replay", "kept_backgrounds", "checkpointed"] = "replay"
    segment: Count = 16  # control periods between the checkpoints of an adjoint
    attached: bool = False
    jitter: bool = False
    checkpoint_every: Count = 10
    deterministic: bool = False  # equal bits from run to run, on one thread

    @model_validator(mode="after")
    def _check_keys(self) -> Any:
        """Refuse keys that do not go together."""
        _check_pair(self, "learning_rate", "parameters", ("texture", "both"))
        for key in (
            "pose_learning_rate",
            "pose_axes",
            "pose_limit_m",
            "pose_limit_deg",
        ):
            _check_pair(self, key, "parameters", ("pose", "both"))
        _check_pair(self, "segment", "adjoint", ("checkpointed",))
        return self


class BaselineSection(Section):
    """Random textures to compare with."""

    textures: Count | None = None  # as many as attack iterations if left out
    kind: Literal["noise", "blobs", "flat", "mixed"] = "mixed"


class DeploymentSection(Section):
    """The path-traced scene."""

    spp: Count = 16


class AbstractTerm(Section):
    """One part of the objective; which keys belong together is checked."""

    kind: Literal[
        "cross_track",
        "absolute_cross_track",
        "heading",
        "departure_time",
        "target_path",
        "function",
    ] = "cross_track"
    at: Literal["all_times", "end"] = "all_times"
    weights: Literal["uniform", "linear", "last", "discount", "listed"] = "uniform"
    last_s: Positive | None = None
    discount_per_s: Annotated[float, Field(gt=0, le=1)] | None = None
    listed_weights: tuple[Finite, ...] | None = None  # one a control period
    rounding_m: Positive = 0.05
    rounding_deg: Positive = 1.0
    limit_m: Positive | None = None  # half of what the lane is wider than the car
    softness_m: Positive = 0.25
    target: str | None = None  # JSON of routes
    target_route: str | None = None
    function: Annotated[str, Field(pattern=r"\.py:[A-Za-z_]\w*$")] | None = None
    trust_code: Trust = False  # see PolicySection
    weight: Finite = 1.0

    @model_validator(mode="after")
    def _check_keys(self) -> Any:
        """Refuse keys that do not go together."""
        for key, other, values in _TERM_KEYS:
            _check_pair(self, key, other, values)
        return self


class TermSection(AbstractTerm):
    """A further part of the objective."""


class ObjectiveSection(AbstractTerm):
    """What the attack makes smaller: the sum of this term and further ones."""

    reduction: Literal["mean", "cvar", "worst"] = "mean"  # over the poses
    cvar_fraction: Annotated[float, Field(gt=0, le=1)] | None = None
    terms: tuple[TermSection, ...] = ()

    @model_validator(mode="after")
    def _check_reduction(self) -> Any:
        """Refuse a fraction without its reduction, and the other way round."""
        _check_pair(self, "cvar_fraction", "reduction", ("cvar",))
        return self


_SUMMED = ("cross_track", "absolute_cross_track", "heading", "target_path", "function")
#: Keys of a term that belong to some values of another key alone.
_TERM_KEYS = (
    ("target", "kind", ("target_path",)),
    ("target_route", "kind", ("target_path",)),
    ("function", "kind", ("function",)),
    ("limit_m", "kind", ("departure_time",)),
    ("softness_m", "kind", ("departure_time",)),
    ("rounding_m", "kind", ("cross_track", "target_path")),
    ("rounding_deg", "kind", ("heading",)),
    ("at", "kind", _SUMMED),
    ("weights", "kind", _SUMMED),
    ("weights", "at", ("all_times",)),
    ("last_s", "weights", ("last",)),
    ("discount_per_s", "weights", ("discount",)),
    ("listed_weights", "weights", ("listed",)),
)
_OPTIONAL = ("limit_m",)


def explain(error: ErrorDetails) -> tuple[list[str | int], str]:
    """Return the keys that lead to a section's error, and what is wrong."""
    location = list(error["loc"])
    if error["type"] == "keys":  # of a section: two keys that do not go together
        location.append(error.get("ctx", {})["key"])
    told = error["type"] in ("missing", "keys", "extra_forbidden")
    value = "" if told else f" (is {error['input']!r})"
    return location, error["msg"] + value


def _check_pair(term: Section, key: str, other: str, values: tuple[str, ...]) -> None:
    """Raise unless `key` is given exactly where `other` has one of `values`.

    Keys with a default may be left out where they belong; a default is the same as
    nothing where they do not.
    """
    default = type(term).model_fields[key].default
    value, chosen = getattr(term, key), getattr(term, other)
    if chosen not in values and value != default:
        allowed = " or ".join(f'"{name}"' for name in values)
        raise PydanticCustomError(
            "keys",
            'has no meaning with {other} = "{chosen}"; leave it out, or set '
            "{other} to {allowed}",
            {"key": key, "other": other, "chosen": chosen, "allowed": allowed},
        )
    required = default is None and key not in _OPTIONAL
    if chosen in values and value is None and required:
        raise PydanticCustomError(
            "keys",
            'is missing; {other} = "{chosen}" needs it',
            {"key": key, "other": other, "chosen": chosen},
        )


def _refuse(key: str, reason: str) -> NoReturn:
    """Raise an error of a key that a check of the whole section found."""
    raise PydanticCustomError("keys", "{reason}", {"key": key, "reason": reason})
