"""``mi-nerfattack train``: imitate the lane-following expert, and validate."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

if TYPE_CHECKING:
    from mi_nerfattack.policy.imitate import ImitationSettings
    from mi_nerfattack.policy.worlds import WorldFiles


@dataclass(frozen=True)
class Train:
    """Train a driving policy on frames of the surrogate and of the path-traced scene.

    Collects frames (three quarters with an object of random texture beside the road),
    trains PilotNet to imitate the expert, on request lets it drive and trains it on
    what it saw (DAgger), and ends with its closed-loop error. Stopped, it continues
    from DATA. The validation is written beside the policy, as JSON.
    """

    output: Annotated[Path, tyro.conf.arg(aliases=["-o"])]
    """Policy file to write (.safetensors)."""
    data: Path
    """Folder of frames and checkpoints; made if missing."""
    scene: Path | None = None
    """Mitsuba XML of the scene; the bundled intersection by default."""
    field: Path | None = None
    """Field file of the scene; bundled by default."""
    object: tuple[Path, ...] = ()
    """Grid fields that stand beside the road; the bundled hydrant by default."""
    routes: Path | None = None
    """Routes, JSON; bundled by default."""
    frames_surrogate: int = 4096
    """Frames rendered from the fields."""
    frames_deployment: int = 6144
    """Path-traced frames."""
    spp: int = 4
    """Samples per pixel of the path-traced frames."""
    epochs: int = 8
    """Passes over the frames."""
    batch: int = 64
    """Images a training step."""
    learning_rate: float = 1e-3
    """Largest learning rate."""
    dagger_rounds: int = 0
    """Rounds in which the policy drives and the expert labels; if the error is high."""
    dagger_frames: int = 1024
    """Frames of each world in a round."""
    dagger_epochs: int = 3
    """Passes over all frames after a round."""
    runs: int = 2
    """Drives of each case of the validation."""
    objects: int = 3
    """Objects of random texture that each route is driven past in the validation."""
    seed: int = 0
    """Of all random numbers."""

    def run(self) -> int:
        """Collect, train, validate and write."""
        from rich.console import Console

        from mi_nerfattack import files, variant
        from mi_nerfattack.commands.bars import StageBars
        from mi_nerfattack.commands.fit_report import check_output
        from mi_nerfattack.policy.evaluate import card_table
        from mi_nerfattack.policy.imitate import imitate
        from mi_nerfattack.policy.worlds import load_deployment, load_surrogate

        check_output(self.output)
        variant.ensure()
        paths = self._paths()
        routes = paths.load_routes()
        deployment = load_deployment(paths, self.spp, self.seed)
        worlds = [load_surrogate(paths), deployment]
        with StageBars() as bars:
            result = imitate(worlds, routes, self._settings(), self.data, bars.show)
        result.module.save(self.output)
        card = {**result.card, "training": result.history}
        files.write_json(self.output.with_suffix(".json"), card)
        Console().print(card_table(result.card))
        print(f"{self.output}: written; the validation is in the .json beside it")
        return 0

    def _paths(self) -> WorldFiles:
        from mi_nerfattack.policy.worlds import WorldFiles
        from mi_nerfattack.scenes import bundled  # pyright: ignore[reportMissingImports]

        return WorldFiles(
            self.scene or bundled("intersection/scene.xml"),
            self.field or bundled("intersection/field.safetensors"),
            self.object or (bundled("hydrant/field.safetensors"),),
            self.routes or bundled("intersection/routes.json"),
        )

    def _settings(self) -> ImitationSettings:
        from mi_nerfattack.policy.evaluate import EvaluateSettings
        from mi_nerfattack.policy.imitate import ImitationSettings
        from mi_nerfattack.policy.train import TrainSettings

        return ImitationSettings(
            frames={
                "surrogate": self.frames_surrogate,
                "deployment": self.frames_deployment,
            },
            dagger_frames=self.dagger_frames,
            dagger_rounds=self.dagger_rounds,
            dagger_epochs=self.dagger_epochs,
            seed=self.seed,
            training=TrainSettings(
                self.epochs, self.batch, learning_rate=self.learning_rate
            ),
            validation=EvaluateSettings(runs=self.runs, objects=self.objects),
        )
