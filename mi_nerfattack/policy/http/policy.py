"""A policy behind a URL, as the closed loop calls it."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from mi_nerfattack.policy.action import Action
from mi_nerfattack.policy.black_box import AbstractBlackBox
from mi_nerfattack.policy.http.client import PolicyClient
from mi_nerfattack.policy.inputs import IMAGE, Inputs
from mi_nerfattack.policy.preprocess import Preprocess


class HttpPolicy(AbstractBlackBox):
    """Policy behind a URL; see `PolicyClient` for the protocol.

    Args:
        url: http or https.
        timeout_s: longest wait for a whole answer.
        retries: how often a failed request is repeated.
        preprocess: as for `AbstractBlackBox`.
        action: as for `AbstractBlackBox`.
        inputs: the server gets the numbers that `inputs` names, and the frame
            unchanged, with the images of several cameras side by side.
        token: that the server asks for.
    """

    def __init__(
        self,
        url: str,
        timeout_s: float = 10.0,
        retries: int = 2,
        preprocess: Preprocess | None = None,
        action: Action | None = None,
        inputs: Inputs | None = None,
        token: str = "",
    ) -> None:
        self.client: PolicyClient = PolicyClient(url, token, timeout_s, retries=retries)
        named, numbers = (inputs or Inputs()).names, (inputs or Inputs()).numbers
        self.sent: tuple[str, ...] = tuple(k for k in numbers.columns if k in named)
        AbstractBlackBox.__init__(
            self, url, preprocess, action, Inputs(numbers=numbers)
        )

    def answer(
        self, arrays: Mapping[str, np.ndarray], goals: np.ndarray, step: int
    ) -> np.ndarray:
        """Ask the server."""
        columns = [arrays[name].reshape(len(goals), -1) for name in self.sent]
        numbers = np.hstack(columns) if columns else None
        return self.client.ask(arrays[IMAGE], goals.tolist(), step, numbers)
