"""``mi-nerfattack car serve``: a policy over HTTP, for a car or for `evaluate`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import tyro

from mi_nerfattack.commands.shared.options import Settings
from mi_nerfattack.commands.shared.policy_file import PolicyFile
from mi_nerfattack.commands.shared.terminal import Result, say


@dataclass(frozen=True)
class ServePolicy:
    """Serve a policy over HTTP until Ctrl-C.

    The car on another computer drives by `car drive --policy http://HOST:PORT`. Without
    --token-file the server listens on this computer alone.
    """

    policy: tyro.conf.Positional[str | None] = None
    """Policy as of evaluate; the bundled one by default."""
    settings: Settings = ()
    """Set a key of the policy: policy.kind=callable, policy.trust_code=true."""
    listen: str = "127.0.0.1:8000"
    """HOST:PORT of this computer, as the car reaches it."""
    token_file: Path | None = None
    """File with the token that clients must send; needed for other computers."""
    size: tuple[int, int] | None = None
    """Width and height of the car's frames: tries the policy on a black frame first, so
    that the first decision is as quick as the others."""
    json: bool = False
    """End with one line of JSON: decisions, how quick they were, requests refused."""

    def run(self) -> Result:
        """Load, listen, and serve."""
        from contextlib import closing, suppress

        import numpy as np

        from mi_nerfattack import variant
        from mi_nerfattack.errors import InputError
        from mi_nerfattack.io.network import Endpoint, read_token, require_token
        from mi_nerfattack.policy.http.server import PolicyServer

        endpoint = Endpoint.parse(self.listen)
        token = "" if self.token_file is None else read_token(self.token_file)
        require_token(token, endpoint)
        if self.size is not None and min(self.size) < 1:
            raise InputError(f"--size: {self.size}; width and height, 1 or more")
        variant.ensure()
        file = PolicyFile.read(self.policy, self.settings)
        policy = file.section.build(file.views)
        if self.size is not None:
            import mitsuba as mi

            black = mi.TensorXf(np.zeros((1, *self.size[::-1], 3), np.float32))
            from mi_nerfattack.deploy.environment import trial_numbers

            policy.step(
                black,
                goal=0,
                memory=policy.initial_memory(1),
                numbers=trial_numbers(policy),
            )
        with closing(PolicyServer(endpoint, policy, token)) as server:
            asked = "asks for the token" if token else "on this computer alone"
            say(f"Serving at http://{endpoint}, {asked}; Ctrl-C ends")
            with suppress(KeyboardInterrupt):
                server.serve_forever()
            figures = server.figures()
        return Result(figures, lambda: say(_summary(figures)))


def _summary(figures: dict[str, float]) -> str:
    refused = f"refused {figures['strangers']} requests without the token"
    if not figures["decisions"]:
        return f"Ended: no decisions; {refused}"
    return (
        f"Ended: {figures['decisions']} decisions, {1e3 * figures['median_s']:.1f} ms "
        f"in the median, 95 % within {1e3 * figures['within_s_95']:.1f} ms; {refused}"
    )
