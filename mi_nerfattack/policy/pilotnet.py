"""PilotNet with a goal: the driving policy of appendix B.2."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import torch
from torch import nn

from mi_nerfattack.errors import InputError
from mi_nerfattack.io import files

#: Height and width of the images, pixels.
IMAGE_SHAPE = (66, 200)
ARCHITECTURE = "pilotnet-goal"
MOST_GOALS = 1000


class PilotNet(nn.Module):
    """Five convolutions and five linear layers with the goal as a second input.

    Convolutions of 24, 36, 48 channels (5x5, stride 2) and 64, 64 (3x3) give 1152
    features; with the one-hot goal they pass through 1000, 256, 256 and 10 units to
    one control. Exponential linear units keep the derivative with respect to the
    image continuous. Source: Bojarski et al. 2016; the goal and the wider linear
    layers as appendix B.2.

    Args:
        goals: number of goals, at least 1.
        max_control: the output lies in (-max_control, max_control).
        unit: of the output: "rad/s" of a heading rate, or "rad" of a steering angle.
    """

    def __init__(
        self, goals: int = 3, max_control: float = 1.5, unit: str = "rad/s"
    ) -> None:
        """Initialise with torch's global random generator."""
        super().__init__()
        if not isinstance(goals, int) or goals < 1:
            raise InputError(f"PilotNet.goals: {goals!r}; an integer of at least 1")
        if not 0 < max_control < float("inf"):
            raise InputError(f"PilotNet.max_control: {max_control!r}; positive only")
        if unit not in ("rad/s", "rad"):
            raise InputError(f"PilotNet.unit: {unit!r}; 'rad/s' or 'rad'")
        self.goals = goals
        self.max_control: float = float(max_control)
        self.unit = unit
        self.features: nn.Sequential = nn.Sequential(
            nn.Conv2d(3, 24, 5, stride=2),
            nn.ELU(),
            nn.Conv2d(24, 36, 5, stride=2),
            nn.ELU(),
            nn.Conv2d(36, 48, 5, stride=2),
            nn.ELU(),
            nn.Conv2d(48, 64, 3),
            nn.ELU(),
            nn.Conv2d(64, 64, 3),
            nn.ELU(),
            nn.Flatten(),
        )
        self.head: nn.Sequential = nn.Sequential(
            nn.Linear(1152 + goals, 1000),
            nn.ELU(),
            nn.Linear(1000, 256),
            nn.ELU(),
            nn.Linear(256, 256),
            nn.ELU(),
            nn.Linear(256, 10),
            nn.ELU(),
            nn.Linear(10, 1),
        )

    def forward(self, image: torch.Tensor, goal: torch.Tensor) -> torch.Tensor:
        """Predict the control.

        Args:
            image: (n, 3, 66, 200), sRGB in [0, 1].
            goal: (n,) integers in [0, goals).

        Returns:
            (n,), in `unit`, positive to the left.
        """
        one_hot = nn.functional.one_hot(goal, self.goals).to(image.dtype)
        features = self.features(2 * image - 1)
        raw = self.head(torch.cat([features, one_hot], dim=1))
        return self.max_control * torch.tanh(raw[:, 0])

    def save(self, path: str | Path) -> None:
        """Write weights and architecture as one safetensors file, atomically."""
        tensors = {
            name: value.detach().cpu().numpy().astype(np.float32)
            for name, value in self.state_dict().items()
        }
        metadata = {
            "architecture": ARCHITECTURE,
            "goals": json.dumps(self.goals),
            "max_control": json.dumps(self.max_control),
            "unit": self.unit,
            "image": "sRGB in [0, 1], (n, 3, 66, 200)",
        }
        files.write_safetensors(path, tensors, metadata)

    @classmethod
    def load(cls, path: str | Path) -> PilotNet:
        """Read a file written by `save`, in evaluation mode, on the CPU.

        Raises:
            InputError: unreadable file, another architecture, tensors missing,
                unknown, of a wrong shape or type, or not finite.
        """
        tensors, metadata = files.read_safetensors(path)
        kind = metadata.get("architecture")
        if kind != ARCHITECTURE:
            raise InputError(f"{path}: architecture {kind!r}; not {ARCHITECTURE!r}")
        try:
            goals = json.loads(metadata["goals"])
            max_control = json.loads(metadata["max_control"])
            if type(goals) is not int or not 1 <= goals <= MOST_GOALS:
                raise ValueError(f"goals {goals!r}")
            if not isinstance(max_control, float):
                raise ValueError(f"max_control {max_control!r}")
            network = cls(goals, max_control, metadata.get("unit", "rad/s"))
        except (KeyError, ValueError, RecursionError) as error:
            raise InputError(f"{path}: unusable metadata: {error}") from error
        load_checked(network, tensors, str(path))
        return network.eval()


def stored_unit(path: str | Path) -> str | None:
    """Return the unit of the control that a file of `PilotNet.save` gives.

    Returns:
        "rad/s" or "rad"; None of a file that cannot be read, which `load` explains.
    """
    try:
        return files.read_safetensors(path, [])[1].get("unit", "rad/s")
    except InputError:
        return None


def load_checked(module: nn.Module, tensors: dict[str, np.ndarray], owner: str) -> None:
    """Copy tensors into a module after checking each of them.

    Args:
        module: changed in place, only once everything is checked.
        tensors: by the names of the module's state.
        owner: file name for messages.

    Raises:
        InputError: names differ, or a shape or type does, or a value is not finite.
    """
    expected = module.state_dict()
    missing = sorted(set(expected) - set(tensors))
    extra = sorted(set(tensors) - set(expected))
    if missing or extra:
        raise InputError(
            f"{owner}: tensors missing {missing or 'none'}, unknown {extra or 'none'}"
        )
    for name, value in tensors.items():
        shape = tuple(expected[name].shape)
        if value.shape != shape or value.dtype != np.float32:
            raise InputError(
                f"{owner}: tensor {name!r} is {value.dtype} {value.shape}; "
                f"float32 {shape} is needed"
            )
        if not np.isfinite(value).all():
            raise InputError(f"{owner}: tensor {name!r} has values that are not finite")
    module.load_state_dict(
        {name: torch.from_numpy(np.array(value)) for name, value in tensors.items()}
    )
