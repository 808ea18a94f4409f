"""A policy of openpilot's form: two ONNX files, two cameras, positions over time."""

from __future__ import annotations

from typing import Any, ClassVar, Literal

from pydantic import model_validator

from mi_nerfattack.errors import InputError
from mi_nerfattack.policy.base import AbstractPolicy, Numbers
from mi_nerfattack.policy.inputs import Inputs, NoGoal
from mi_nerfattack.policy.one_image import OneImage
from mi_nerfattack.policy.onnx.network import load_onnx
from mi_nerfattack.policy.onnx.openpilot import (
    CAMERAS,
    PERIOD_S,
    TIMES_S,
    Openpilot,
    PackYuv,
)
from mi_nerfattack.policy.preprocess import Preprocess
from mi_nerfattack.policy.torch_policy import TorchPolicy
from mi_nerfattack.ranges import Count, Natural, NonNegative
from mi_nerfattack.scenario.named_file import File
from mi_nerfattack.scenario.policy.base import NO_VIEWS, AbstractPolicySection, Views
from mi_nerfattack.scenario.policy.parts import PreprocessSection, TrajectorySection
from mi_nerfattack.scenario.section import refuse

_SIZE_KEYS = {"crop_px", "crop_fraction", "resize_px", "filter"}


class OpenpilotSection(AbstractPolicySection):
    """openpilot's vision and policy networks, which the user brings."""

    kind: Literal["openpilot"]
    file: File  # the policy network
    vision_file: File
    features: tuple[Natural, Natural]  # the hidden state in the vision's output
    plan: tuple[Natural, Natural]  # in the policy's output
    stride: Count = 4  # control periods between two features of the policy's input
    frame_stride: Count = 4  # control periods between the two frames of an image
    traffic: Literal["right", "left"] = "right"
    steering_delay_s: NonNegative = 0.2
    trajectory: TrajectorySection | None = TrajectorySection()

    own_times_s: ClassVar[tuple[float, ...]] = TIMES_S
    period_s: ClassVar[float | None] = PERIOD_S

    def build(self, views: Views = NO_VIEWS) -> AbstractPolicy:
        """Load both networks."""
        missing = [name for name in CAMERAS if name not in views]
        if missing:
            cameras = ", ".join(views) or "those of one camera"
            raise InputError(
                f"{self.source}: takes images of cameras called "
                f"{' and '.join(CAMERAS)}, and gets {cameras}; give the scenario a "
                "table [[cameras]] for each of these names"
            )
        module: Any = Openpilot(
            vision=load_onnx(self.vision_file.file, rounds=True),
            policy=load_onnx(self.file.file),
            features=self.features,
            plan=self.plan,
            stride=self.stride,
            traffic=self.traffic,
            steering_delay_s=self.steering_delay_s,
        )
        recurrent, batch = module.recurrent, module.batch
        if batch not in (None, 1):
            raise InputError(f"{self.source}: takes {batch} images at a time, not 1")
        transforms = (*self.preprocess.build().transforms, PackYuv())
        return TorchPolicy(
            module if batch is None else OneImage(module, recurrent),
            goal=NoGoal(),
            preprocess=Preprocess(transforms, 2, self.frame_stride),
            recurrent=recurrent,
            action=self.action(),
            inputs=self.build_inputs(views),
            name=self.source,
        )

    def build_inputs(self, views: Views) -> Inputs:
        """Return what the networks are given."""
        return Inputs((*CAMERAS, "speed"), Numbers(speed=True), views)

    @model_validator(mode="after")
    def _check_fixed(self) -> Any:
        """Refuse keys whose values the files fix."""
        if self.inputs:
            refuse("inputs", f"are {', '.join(CAMERAS)} and speed; leave it out")
        if self.trajectory is None or self.trajectory.axes != "forward_left":
            refuse("trajectory.axes", "the files fix the axes; leave it out")
        usual = PreprocessSection.defaults()
        for key, value in self.preprocess:
            if key not in _SIZE_KEYS and value != usual[key]:
                refuse(f"preprocess.{key}", "the files fix it; leave it out")
        return self
