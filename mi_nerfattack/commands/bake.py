"""``mi-nerfattack bake``: a scene's field as bricks, which are faster to march."""

from __future__ import annotations

import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import tyro

from mi_nerfattack.commands.shared.options import Settings
from mi_nerfattack.commands.shared.terminal import Result

if TYPE_CHECKING:
    from mi_nerfattack.scenario.scenario import Scenario


@dataclass(frozen=True)
class Bake:
    """Bake a field along its routes, for faster attacks and drives.

    Bakes the field of [scene], at its to_world, as the scenario's camera sees it from
    all routes of its file. Name the bricks in the scenario as scene.bricks, or as
    scene.field instead of the field. Bricks and field show nearly the same; FILE.report
    next to the bricks says how nearly.
    """

    scenario: tyro.conf.Positional[Path]
    """Scenario file (.toml)."""
    output: Path | None = None
    """Field file to write (.safetensors); the scenario's scene.bricks by default."""
    settings: Settings = ()
    """Set a key of the scenario: scene.field=mine.safetensors."""
    cone: float = 1 / 64
    """Edge of a brick's parts over the distance to the nearest route; half takes up to
    six times the memory."""
    passes: int = 4
    """Passes of the refinement."""
    views: int = 100
    """Views of a pass."""
    seed: int = 0
    """Of poses and samples."""
    json: bool = False
    """End with one line of JSON."""

    def run(self) -> Result:
        """Bake, score and write."""
        from mi_nerfattack import variant
        from mi_nerfattack.commands.shared.fit_report import report_folder
        from mi_nerfattack.commands.shared.progress import StageBars
        from mi_nerfattack.fields import save_field
        from mi_nerfattack.fit.bake.bake import BakeOptions, bake, plan_bricks
        from mi_nerfattack.fit.bake.scores import score_bake
        from mi_nerfattack.render.posed import PosedField
        from mi_nerfattack.report.pages.bake import (
            bake_summary,
            bake_verdict,
            write_bake_report,
        )
        from mi_nerfattack.scenario.scenario import load_scenario
        from mi_nerfattack.scenario.world import load_posed
        from mi_nerfattack.vehicle.route.route import load_routes

        options = BakeOptions(self.cone, self.passes, self.views, seed=self.seed)
        scenario, _ = load_scenario(self.scenario, settings=self.settings)
        file, output = self._files(scenario)
        rig = scenario.rig()
        camera, mount = rig.cameras[0], rig.mounts[0]
        routes = load_routes(scenario.scene.routes.file)
        variant.ensure()
        scene = load_posed(scenario.scene, file)
        plan = plan_bricks(scene, routes, options)
        with StageBars() as bars:
            bars.say(
                f"{len(plan.subdivisions)} bricks: {plan.file_mb:.0f} MB, "
                f"{plan.peak_mb:.0f} MB while they are baked"
            )
            started = time.perf_counter()
            baked = bake(
                scene,
                routes,
                camera,
                mount=mount,
                options=options,
                plan=plan,
                progress=bars.counter("baking", "pass "),
            )
            seconds = time.perf_counter() - started
            save_field(output, baked)
            posed = PosedField(baked, scene.pose)
            score = bars.counter("comparing", "view ")
            views = score_bake(
                scene, posed, routes, camera=camera, mount=mount, progress=score
            )
        facts = {
            "field": file.name,
            "bricks": len(plan.subdivisions),
            "vertices_mb": round(plan.file_mb, 1),
            **asdict(options),
            "bake_s": round(seconds, 1),
        }
        title = f"Bake of {file.name}"
        page = write_bake_report(report_folder(output), views, facts, title=title)
        message = f"{bake_verdict(views)}\nWrote {output} and {page}."
        return Result(facts | bake_summary(views), lambda: print(message))

    def _files(self, scenario: Scenario) -> tuple[Path, Path]:
        """Return field and output; refuse what would fail after the bake."""
        from mi_nerfattack.commands.shared.fit_report import check_output
        from mi_nerfattack.errors import InputError
        from mi_nerfattack.fit.scores import MIN_EDGE_PX

        scene, camera = scenario.scene, scenario.rig().cameras[0]
        if scene.field is None:
            raise InputError(f"{self.scenario}: scene.field is missing; name the field")
        named = None if scene.bricks is None else scene.bricks.file
        if (output := self.output or named) is None:
            raise InputError(f"--output: give it, or scene.bricks in {self.scenario}")
        check_output(output)
        if output.resolve() == scene.field.file.resolve():
            raise InputError(f"--output: {output} is the field itself")
        if min(camera.width, camera.height) < MIN_EDGE_PX:
            raise InputError(
                f"{self.scenario}: camera of {camera.width} x {camera.height}; SSIM "
                f"takes at least {MIN_EDGE_PX} px each way"
            )
        return scene.field.file, output
