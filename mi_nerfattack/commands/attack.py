"""``mi-nerfattack attack``: attack a policy and measure the transfer."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, ClassVar, Literal

import tyro

from mi_nerfattack.commands.shared.result import Result


@dataclass(frozen=True)
class Attack:
    """Optimise the textures of a scenario's objects until the policy leaves its lane.

    Drives without objects, past the objects as they are, past random textures that
    cost together what the attack does, past the best of them and past the attack, in
    the surrogate and in the deployment environments that the scenario names; writes
    everything to a run folder.
    """

    continues: ClassVar[bool] = True

    scenario: tyro.conf.Positional[Path]
    """Scenario file (TOML)."""
    output: Annotated[Path, tyro.conf.arg(aliases=["-o"])]
    """Run folder: new, or of the same attack, which then goes on."""
    force: bool = False
    """Go on although scenario, files or versions have changed."""
    anyway: bool = False
    """Attack although the checks before find that it would prove nothing: the policy
    leaves its lane by itself, an object is not in view, stands on the lane, in a wall,
    in the air or in another, or the route is too short. metrics.json keeps what was
    found as flags."""
    no_pictures: bool = False
    """Leave out frames, plots, attribution and page, which take about as long as five
    drives in each environment."""
    frames: Literal["all", "worst"] | int | None = None
    """Frames of each case that are written: all (with videos), worst (of the second
    that ends where the drive is farthest from the lane's centre), or so many, equally
    spaced; 3 by default."""
    json: bool = False
    """End with one line of JSON, the content of metrics.json, in place of the table."""

    def run(self) -> Result:
        """Run the job and print the table."""
        from mi_nerfattack.commands.shared.run_scenario import run_scenario
        from mi_nerfattack.errors import InputError

        if isinstance(self.frames, int) and self.frames < 1:
            raise InputError(f"--frames: {self.frames}; all, worst, or at least 1")
        if self.no_pictures and self.frames is not None:
            raise InputError(
                "--frames: --no-pictures leaves them out; give one of both"
            )
        return run_scenario(
            self.scenario,
            self.output,
            force=self.force,
            anyway=self.anyway,
            frames=None if self.no_pictures else self.frames or 3,
        )
