"""``mi-nerfattack demo``: the main job on bundled input."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro


@dataclass(frozen=True)
class Demo:
    """Attack the bundled policy at the bundled intersection.

    Takes a few minutes on two cores and opens nothing but files.
    """

    output: Annotated[Path | None, tyro.conf.arg(aliases=["-o"])] = None
    """Run folder, new or empty; runs/demo-DATE-TIME by default."""

    def run(self) -> int:
        """Run the bundled scenario."""
        from mi_nerfattack.commands.attack_progress import run_scenario
        from mi_nerfattack.scenes import bundled

        stamp = time.strftime("%Y%m%d-%H%M%S")
        output = self.output or Path("runs") / f"demo-{stamp}"
        return run_scenario(bundled("demo.toml"), output, resume=False, as_json=False)
