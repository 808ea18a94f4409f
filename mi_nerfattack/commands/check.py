"""``mi-nerfattack check``: look at a scenario before its attack."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from mi_nerfattack.commands.shared.result import Result


@dataclass(frozen=True)
class Check:
    """Show a scenario from above and through the lens, and tell what is wrong with it.

    Writes one picture: surrogate and scene from above with route, lane, objects, starts
    and camera, and the first images. Tells why attack would refuse the scenario, and
    what it would cost. Ends with 0, or with 1 if attack would refuse.
    """

    scenario: tyro.conf.Positional[Path]
    """Scenario file (TOML)."""
    output: Annotated[Path | None, tyro.conf.arg(aliases=["-o"])] = None
    """Picture to write (.png); SCENARIO-check.png in this folder by default."""
    no_drives: bool = False
    """Tell only what needs no drive; by default, check drives once from each start,
    unattacked, and times the attack."""
    json: bool = False
    """End with one line of JSON in place of the sentences."""

    def run(self) -> Result:
        """Check, draw and tell."""
        from mi_nerfattack import variant
        from mi_nerfattack.backend.determinism import one_thread
        from mi_nerfattack.commands.shared.progress import StageBars
        from mi_nerfattack.errors import InputError
        from mi_nerfattack.experiment.checks import check as checks
        from mi_nerfattack.io import files
        from mi_nerfattack.scenario.scenario import load_scenario
        from mi_nerfattack.scenario.world import build_world

        picture = self.output or Path(f"{self.scenario.stem}-check.png")
        if picture.suffix.lower() != ".png":
            raise InputError(f"--output: {picture}; give a file that ends in .png")
        files.check_writable(picture)
        scenario, _ = load_scenario(self.scenario)
        variant.ensure()
        with StageBars() as bars, one_thread():

            def show(stage: str, done: int, total: int, remark: str) -> None:
                bars.show(stage, done, total, f"{done}/{total} {remark}")

            world = build_world(scenario, scenario.build_policy())
            check = checks.Check(world, show)
            check.run(not self.no_drives)
            show("drawing", 0, 1, "")
            drawn = picture if check.picture(picture) else None
            show("drawing", 1, 1, "")
            check.price()
        document = {**check.document(), "picture": drawn and str(drawn)}
        told = checks.sentences(check, str(self.scenario), drawn)
        return Result(
            document, lambda: print(*told, sep="\n"), int(bool(check.refused))
        )
