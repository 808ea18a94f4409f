"""Parts of the section ``[policy]``: what a policy is given, and what it answers."""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, Field, model_validator

from mi_nerfattack.policy.action import Axes, Trajectory
from mi_nerfattack.policy.preprocess import (
    FILTERS,
    LAYOUTS,
    AbstractTransform,
    Crop,
    FractionalCrop,
    Normalise,
    Preprocess,
    Resize,
    ToLinear,
    to_bgr,
    to_grey,
    to_yuv,
)
from mi_nerfattack.ranges import Count, Finite, Natural, NonNegative, Positive
from mi_nerfattack.scenario.section import Section, refuse

COLOURS: dict[str, Callable[[], AbstractTransform]] = {
    "linear": ToLinear,
    "yuv": to_yuv,
    "grey": to_grey,
    "bgr": to_bgr,
}


def _not_zero(value: float) -> float:
    if value == 0:
        raise ValueError("must not be 0")
    return value


Part = Annotated[float, Field(ge=0, lt=1)]
NonZero = Annotated[Finite, AfterValidator(_not_zero)]


class PreprocessSection(Section):
    """From the camera's image to the policy's input, in the order of the keys."""

    # Both crops: top, bottom, left, right
    crop_px: tuple[Natural, Natural, Natural, Natural] | None = None
    crop_fraction: tuple[Part, Part, Part, Part] | None = None
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
        if self.crop_px is not None and self.crop_fraction is not None:
            refuse("crop_fraction", "stands beside crop_px; give one of them")
        return self

    def build(self) -> Preprocess:
        """Make the transforms, in the order of the keys."""
        transforms: list[AbstractTransform] = []
        if self.crop_px is not None:
            transforms.append(Crop(*self.crop_px))
        if self.crop_fraction is not None:
            transforms.append(FractionalCrop(*self.crop_fraction))
        if self.resize_px is not None:
            transforms.append(Resize(*self.resize_px, FILTERS[self.filter]))
        if self.colour != "srgb":
            transforms.append(COLOURS[self.colour]())
        if (self.scale, self.mean, self.std) != (1.0, (0.0,), (1.0,)):
            transforms.append(Normalise(self.scale, self.mean, self.std))
        return Preprocess(
            transforms, self.frames, self.stride, layout=LAYOUTS[self.layout]
        )


class TrajectorySection(Section):
    """The policy gives positions over time, which are followed; see `Trajectory`."""

    times_s: Annotated[tuple[Positive, ...], Field(min_length=1)] | None = None
    controls: tuple[Literal["heading_rate", "steering", "acceleration"], ...] = (
        "heading_rate",
    )
    wheelbase_m: Positive = 2.7
    look_ahead_m: Positive = 3.0
    look_ahead_s: NonNegative = 0.6
    speed_s: Positive | None = None  # the last of times_s
    speed_gain: Positive = 1.0  # 1 / s
    axes: Axes = "forward_left"

    def build(self, own_times_s: tuple[float, ...] = ()) -> Trajectory:
        """Make it; a kind of policy with times of its own gives them."""
        keys = {key: getattr(self, key) for key in type(self).model_fields}
        keys["times_s"] = self.times_s or own_times_s
        return Trajectory(**keys)

    @property
    def unit(self) -> str:
        """Unit of the first control."""
        return "rad/s" if self.controls[0] == "heading_rate" else "rad"
