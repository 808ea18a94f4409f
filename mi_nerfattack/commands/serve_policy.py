"""``mi-nerfattack car serve``: a policy for a car on another computer."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from mi_nerfattack.commands.shared.evaluate_options import PolicyOptions
from mi_nerfattack.commands.shared.result import Result
from mi_nerfattack.commands.shared.terminal import say

if TYPE_CHECKING:
    from mi_nerfattack.robot.remote.server import Control


@dataclass(frozen=True)
class ServePolicy:
    """Decide for a car that sends its frames, until Ctrl-C.

    One car at a time. Without --key it listens on this computer alone.
    """

    policy: tyro.conf.Positional[str | None] = None
    """Policy: .safetensors of train, .pt2, .pt, .onnx, FILE.py:NAME, a URL, or a TOML
    file with the section [policy] of a scenario; the bundled policy by default."""
    listen: str = "127.0.0.1:7447"
    """HOST:PORT of this computer, as the car reaches it."""
    key: Path | None = None
    """File with the key that the car has, too; needed for other computers."""
    route_goal: int = 0
    """Goal of the route that is driven, as its file says it."""
    size: tuple[int, int] | None = None
    """Width and height of the car's frames: tries the policy on a black one first, so
    that the first decision is as quick as the others."""
    json: bool = False
    """End with one line of JSON: decisions, and how old their frames were."""
    options: Annotated[
        PolicyOptions, tyro.conf.OmitArgPrefixes, tyro.conf.arg(name="policy")
    ] = PolicyOptions()
    """How the policy is called."""

    def run(self) -> Result:
        """Load, listen, and serve."""
        from contextlib import closing, suppress

        import numpy as np

        from mi_nerfattack import variant
        from mi_nerfattack.errors import InputError
        from mi_nerfattack.robot.drive.pilot import policy_control
        from mi_nerfattack.robot.remote.sealed import Endpoint, read_key
        from mi_nerfattack.robot.remote.server import PolicyServer

        endpoint = Endpoint.parse(self.listen)
        key = read_key(self.key, endpoint)
        if self.size is not None and min(self.size) < 1:
            raise InputError(f"--size: {self.size}; width and height, 1 or more")
        variant.ensure()
        policy = self.options.section(self.policy).build()

        def make_control() -> Control:
            return policy_control(policy, self.route_goal)

        if self.size is not None:
            width, height = self.size
            make_control()(np.zeros((height, width, 3), np.uint8))

        with closing(PolicyServer(endpoint, key, make_control, say)) as server:
            sealed = "sealed by the key" if key else "on this computer alone"
            say(f"Serving at {endpoint}, {sealed}; Ctrl-C ends")
            with suppress(KeyboardInterrupt):
                server.run()
            told = f"Ended: {server.summary()}"
        return Result(server.figures(), lambda: say(told))
