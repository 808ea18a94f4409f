"""A policy that is a table of weights: one row of a CSV file per row of the image."""

from typing import Literal

import numpy as np
import torch

from mi_nerfattack.errors import InputError
from mi_nerfattack.policy.base import AbstractPolicy
from mi_nerfattack.scenario.policy.base import NO_VIEWS, Views
from mi_nerfattack.scenario.policy.kinds import AbstractNetworkSection


class Linear(torch.nn.Module):
    def __init__(self, weights: np.ndarray) -> None:
        super().__init__()
        self.register_buffer("weights", torch.tensor(weights, dtype=torch.float32))

    def forward(self, image: torch.Tensor) -> torch.Tensor:
        grey = image.mean(1)  # of (n, 3, height, width), sRGB in [0, 1]
        if grey.shape[1:] != self.weights.shape:
            raise ValueError(f"weights {tuple(self.weights.shape)}: one per pixel")
        return (grey * self.weights).sum((1, 2))[:, None]  # (n, 1), rad/s


class LinearSection(AbstractNetworkSection):
    kind: Literal["linear_csv"]

    def build(self, views: Views = NO_VIEWS) -> AbstractPolicy:
        try:
            weights = np.loadtxt(self.file.file, delimiter=",", ndmin=2)
        except ValueError as err:
            raise InputError(f"{self.source}: {err}; give numbers alone") from err
        return self.policy_of(Linear(weights), views)
