"""openpilot's pair of networks: images to features, features over time to a plan.

The adapter knows the names, shapes and units of openpilot's public interface. It has
no weights: you bring the two ``.onnx`` files.

Source: openpilot's `selfdrive/modeld`, for the interface alone. Planes are in the
order of its code; its README swaps the second and the third.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch

from mi_nerfattack.errors import InputError
from mi_nerfattack.policy.onnx.network import OnnxNetwork
from mi_nerfattack.policy.preprocess import AbstractTransform

#: Names of the two cameras: narrow and wide.
CAMERAS = ("road", "wide")
#: Control period at which the networks run, seconds.
PERIOD_S = 0.05
_POINTS, _NUMBERS = 33, 15  # of a plan: points over time, numbers of each
#: Times of the positions, seconds from now; the point at time 0 is left out.
TIMES_S = tuple(10.0 * (i / (_POINTS - 1)) ** 2 for i in range(1, _POINTS))

_IMAGES = {"img": 0, "input_imgs": 0, "big_img": 1, "big_input_imgs": 1}
_FEATURES = "features_buffer"
_ZEROS = ("desire", "desire_pulse", "prev_desired_curv")
_OTHERS = ("traffic_convention", "lateral_control_params")
_TRAFFIC = {"right": (1.0, 0.0), "left": (0.0, 1.0)}

#: Luma and colour differences of sRGB bytes by BT.601, studio range.
_LUMA = (0.257, 0.504, 0.098)
_CHROMA = ((-0.148, -0.291, 0.439), (0.439, -0.368, -0.071))


class PackYuv(AbstractTransform):
    """Make six planes of half the size of three: YUV 4:2:0, values of bytes.

    The planes are Y at even rows and columns, Y at odd rows and even columns, Y at even
    rows and odd columns, Y at odd rows and columns, U, and V. U and V are means of
    2 x 2 pixels. Y is in [16, 235], U and V are in [16, 240], not rounded.
    """

    def apply(self, planes: torch.Tensor) -> torch.Tensor:
        """Map sRGB in [0, 1], (n, 3, h, w), to (n, 6, h / 2, w / 2)."""
        count, channels, height, width = planes.shape
        if channels != 3 or height % 2 or width % 2:
            raise InputError(
                f"policy.preprocess: YUV 4:2:0 needs images of 3 channels, even height "
                f"and even width; it gets {(channels, height, width)}"
            )
        bytes_ = 255 * planes
        luma = torch.einsum("c,nchw->nhw", bytes_.new_tensor(_LUMA), bytes_) + 16
        blocks = luma.reshape(count, height // 2, 2, width // 2, 2)
        four = blocks.permute(0, 4, 2, 1, 3).flatten(1, 2)
        half = torch.nn.functional.avg_pool2d(bytes_, 2)
        chroma = torch.einsum("dc,nchw->ndhw", half.new_tensor(_CHROMA), half) + 128
        return torch.cat([four, chroma], 1)


class Openpilot(torch.nn.Module):
    """Call the vision network, remember its features, and call the policy network.

    Args:
        vision: takes two images (n, 12, h, w), see `PackYuv`, older frame first.
        policy: takes features over time, the current ones last.
        features: first number and end of the features in the vision's output.
        plan: first number and end of the plan in the policy's output.
        stride: control periods between two of the features.
        traffic: side of the road that is driven on, "right" or "left".
        steering_delay_s: seconds from a command to the wheels, for files that ask.

    Raises:
        InputError: a file has an input that openpilot's does not have, or lacks one, or
            a slice does not fit.

    Attributes:
        recurrent: shape of the history, -1 for the vehicles.
        batch: 1 if a file takes one image at a time, otherwise None.
    """

    def __init__(
        self,
        vision: OnnxNetwork,
        policy: OnnxNetwork,
        features: Sequence[int],
        plan: Sequence[int],
        stride: int = 4,
        traffic: str = "right",
        steering_delay_s: float = 0.2,
    ) -> None:
        super().__init__()
        self.vision, self.policy = vision, policy
        self.features, self.plan = slice(*features), slice(*plan)
        self.stride, self.traffic = stride, _TRAFFIC[traffic]
        self.steering_delay_s = steering_delay_s
        self.hypotheses = _hypotheses(self.plan)
        self.batch: int | None = vision.batch or policy.batch
        cameras = {_IMAGES[name] for name in _known(vision, _IMAGES)}
        if len(cameras) != len(CAMERAS) or len(vision.inputs) != len(CAMERAS):
            raise InputError(f"{vision.name}: lacks an image; takes {_IMAGES.keys()}")
        names = _known(policy, (_FEATURES, *_ZEROS, *_OTHERS))
        if _FEATURES not in names:
            raise InputError(f"{policy.name}: has no input {_FEATURES!r}; has {names}")
        self._sizes = {item.name: item.sizes[1:] for item in policy.inputs}
        count, width = self._sizes[_FEATURES]
        if count is None or count < 2 or width != len(range(*features)):
            raise InputError(
                f"policy.features: {list(features)}, of {len(range(*features))} "
                f"numbers; {policy.name} takes {_FEATURES!r} of {count} times {width}: "
                "give the slice of the hidden state in the output of the vision file"
            )
        self.recurrent = ((-1, (count - 1) * stride, width),)

    def forward(
        self,
        road: torch.Tensor,
        wide: torch.Tensor,
        speed: torch.Tensor,
        history: torch.Tensor,
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the plan's positions and the next history.

        Args:
            road: two frames of the narrow camera, (n, 12, h, w), values of bytes.
            wide: two frames of the wide camera.
            speed: (n, 1), metres per second.
            history: earlier features, one a control period, the oldest first.

        Returns:
            Positions (n, 32, 2) at `TIMES_S`, metres forward and to the left, and
            the history with these features.
        """
        pictures = road, wide
        images = [pictures[_IMAGES[item.name]] for item in self.vision.inputs]
        feature = _cut("features", self.features, self.vision, *images)
        known = torch.cat([history, feature[:, None]], 1)
        inputs = self._policy_inputs(known[:, :: self.stride], speed)
        plan = _cut("plan", self.plan, self.policy, *inputs)
        return _positions(plan, self.hypotheses), known[:, 1:]

    def _policy_inputs(
        self, features: torch.Tensor, speed: torch.Tensor
    ) -> tuple[torch.Tensor, ...]:
        """Return the policy's arguments in its order."""
        count = len(speed)
        delay = torch.full_like(speed, self.steering_delay_s)
        values = {
            _FEATURES: features,
            "traffic_convention": speed.new_tensor(self.traffic).expand(count, -1),
            "lateral_control_params": torch.cat([speed, delay], 1),
        }
        for name in _ZEROS:
            if name in self._sizes:
                values[name] = speed.new_zeros([count, *map(_fixed, self._sizes[name])])
        return tuple(values[item.name] for item in self.policy.inputs)


def _known(network: OnnxNetwork, known: Mapping[str, int] | Sequence[str]) -> list[str]:
    """Return names of the inputs, and refuse others than the known ones."""
    names = [item.name for item in network.inputs]
    for name in names:
        if name not in known:
            raise InputError(
                f"{network.name}: input {name!r} is not known; this file of openpilot "
                f"may have {', '.join(known)}"
            )
    return names


def _fixed(size: int | None) -> int:
    return 1 if size is None else size


def _cut(
    key: str, part: slice, network: OnnxNetwork, *arguments: torch.Tensor
) -> torch.Tensor:
    """Evaluate a network and return a slice of its first output, (n, k)."""
    output = network(*arguments)[0].flatten(1)
    if part.stop > output.shape[1]:
        raise InputError(
            f"policy.{key}: [{part.start}, {part.stop}]; the output of {network.name} "
            f"has {output.shape[1]} numbers"
        )
    return output[:, part]


def _hypotheses(plan: slice) -> int:
    """Return the number of plans that compete, 0 for one without a logit."""
    size, one = plan.stop - plan.start, 2 * _POINTS * _NUMBERS
    if size == one:
        return 0
    if size < one or size % (one + 1):
        raise InputError(
            f"policy.plan: [{plan.start}, {plan.stop}], {size} numbers; {one} of one "
            f"plan, or h times {one + 1} of h plans, are needed"
        )
    return size // (one + 1)


def _positions(plan: torch.Tensor, hypotheses: int) -> torch.Tensor:
    """Return positions (n, 32, 2), forward and left, of the likeliest plan."""
    if hypotheses:
        plans = plan.unflatten(1, (hypotheses, -1))
        best = plans[:, :, -1].argmax(1)
        plan = plans[torch.arange(len(plan), device=plan.device), best]
    means = plan[:, : _POINTS * _NUMBERS].unflatten(1, (_POINTS, _NUMBERS))
    return means[:, 1:, :2] * plan.new_tensor([1.0, -1.0])
