"""A policy behind a URL, as the closed loop calls it."""

from __future__ import annotations

import numpy as np

from mi_nerfattack.policy.black_box import AbstractBlackBox
from mi_nerfattack.policy.checks import Output, Scale
from mi_nerfattack.policy.http.client import PolicyClient
from mi_nerfattack.policy.preprocess import Preprocess


class HttpPolicy(AbstractBlackBox):
    """Policy behind a URL; see `PolicyClient` for the protocol.

    Args:
        url: http or https.
        timeout_s: longest wait for a whole answer.
        retries: how often a failed request is repeated.
        preprocess: as for `AbstractBlackBox`; control_scale and output likewise.
        token: that the server wants.
    """

    def __init__(
        self,
        url: str,
        timeout_s: float = 10.0,
        retries: int = 2,
        preprocess: Preprocess | None = None,
        control_scale: Scale = 1.0,
        output: Output = None,
        token: str = "",
    ) -> None:
        self.client: PolicyClient = PolicyClient(url, token, timeout_s, retries)
        AbstractBlackBox.__init__(self, url, preprocess, control_scale, output)

    def answer(self, image: np.ndarray, goals: np.ndarray, step: int) -> np.ndarray:
        """Ask the server."""
        return self.client.ask(image, goals.tolist(), step)
