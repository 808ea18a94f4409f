"""``mi-nerfattack retrain``: fine-tune a policy among the attacks found on it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from mi_nerfattack.commands.shared.words import command_line
from mi_nerfattack.errors import InputError

if TYPE_CHECKING:
    from mi_nerfattack.deploy.place import Place
    from mi_nerfattack.experiment.transfer.found import FoundAttack
    from mi_nerfattack.training.settings import ImitationSettings

#: New frames by environment, a tenth of the preset laptop of 'train'.
FRAMES = {"surrogate": 384, "mitsuba": 640}


@dataclass(frozen=True)
class Retrain:
    """Fine-tune the policy that found attacks are on, among them.

    Collects frames among the attacked objects, labelled by the expert, and trains the
    policy further on them and on those that it was trained on (--more). Only runs count
    whose scenario the expert itself can drive. Stopped, it continues from DATA. Beside
    the policy come its program, its record as 'train' writes it, and which runs it was
    retrained on (NAME-retrain.json).
    """

    run_folders: Annotated[
        tyro.conf.Positional[tuple[Path, ...]], tyro.conf.arg(metavar="RUN...")
    ]
    """Folders of finished runs of attack, on one policy of 'train', in one place."""
    output: Annotated[Path, tyro.conf.arg(aliases=["-o"])]
    """Policy file to write (.safetensors)."""
    data: Path
    """Folder of new frames and checkpoints; made if missing."""
    more: tuple[Path, ...] = ()
    """Folders of frames that the policy was trained on; without them it forgets."""
    frames: dict[str, int] | None = None
    """New frames by environment; surrogate 384 mitsuba 640 by default, a tenth of the
    preset laptop of 'train'."""
    skies: tuple[str, ...] = ("day",)
    """Times of day of rendered frames; others than day need a sunsky emitter."""
    exposures_ev: tuple[float, ...] = (-1.0, -0.5, 0.0, 0.5, 1.0)
    """Exposures of rendered frames, in powers of two."""
    spp: int = 4
    """Samples per pixel of path-traced frames."""
    epochs: int = 4
    """Passes over all frames."""
    batch: int = 64
    """Images a training step."""
    learning_rate: float = 5e-4
    """Largest learning rate."""
    runs: int = 2
    """Drives of each route and environment, without objects, at the end."""
    workers: int | None = None
    """Processes that collect; one a core by default, 1 collects in this process."""
    seed: int = 0
    """Of all random numbers."""

    def run(self) -> int:
        """Check, collect, train, drive and write."""
        from rich.console import Console

        from mi_nerfattack import variant
        from mi_nerfattack.commands.shared.fit_report import check_output
        from mi_nerfattack.commands.shared.progress import StageBars
        from mi_nerfattack.deploy.sites import PlaceSite, Weather
        from mi_nerfattack.experiment.retrain.among import (
            AmongFound,
            attacked_policy,
            found_place,
        )
        from mi_nerfattack.experiment.retrain.solvable import divide_solvable
        from mi_nerfattack.experiment.transfer.found import read_found
        from mi_nerfattack.io import files
        from mi_nerfattack.policy.exported.program import SUFFIX
        from mi_nerfattack.policy.pilotnet import PilotNet
        from mi_nerfattack.report.table import card_table
        from mi_nerfattack.system.workers import chosen_workers
        from mi_nerfattack.training.collect import find_shards
        from mi_nerfattack.training.imitate import imitate
        from mi_nerfattack.training.record import training_record, write_trained

        check_output(self.output)
        about = self.output.with_name(f"{self.output.stem}-retrain.json")
        for path in (*map(self.output.with_suffix, (SUFFIX, ".json")), about):
            files.check_writable(path)
        variant.ensure()
        attacks = read_found(self.run_folders)
        policy, place = attacked_policy(attacks), found_place(attacks)
        if self.output.resolve() == policy.resolve():
            raise InputError(
                f"{self.output}: is the policy that was attacked, which its runs "
                "still need; choose another file with -o"
            )
        more = [shard for folder in self.more for shard in find_shards(folder)]
        solvable, others = divide_solvable(attacks, place)
        for label, trouble in others.items():
            print(f"{label}: left out: {trouble}")
        if not solvable:
            raise InputError("RUN: none can be driven by the expert; give other runs")
        settings = self._settings(policy, place)
        weather = Weather(self.skies, self.exposures_ev, self.spp)
        sites = [PlaceSite(name, place, weather) for name in settings.sites]
        routes = list({found.route.name: found.route for found in solvable}.values())
        with StageBars() as bars:
            if not more:
                bars.say("no --more: trained on new frames alone, it may forget others")
            result = imitate(
                sites,
                routes,
                settings,
                self.data,
                chosen_workers(self.workers, False),
                bars.show,
                PilotNet.load(policy),
                more,
                AmongFound(tuple(solvable)),
            )
        command = command_line("retrain", self)
        record = training_record(settings, sites, self.data, result, command)
        write_trained(self.output, result.module, record)
        files.write_json(about, _describe(policy, solvable, others))
        Console().print(card_table(result.card))
        print(f"{self.output}: written; program, record and runs are beside it")
        return 0

    def _settings(self, policy: Path, place: Place) -> ImitationSettings:
        from dataclasses import replace

        from mi_nerfattack.evaluation.evaluate import EvaluateSettings
        from mi_nerfattack.training.settings import (
            CLONING,
            CollectSettings,
            ImitationSettings,
        )
        from mi_nerfattack.training.sources import Mixture, PolicyDrives
        from mi_nerfattack.training.train import TrainSettings

        frames = FRAMES if self.frames is None else self.frames
        for name in frames:
            if name not in ("surrogate", "mitsuba", "mujoco", "mujoco_gl"):
                raise InputError(
                    f"--frames: {name!r}; of surrogate, mitsuba, mujoco and mujoco_gl"
                )
        # where the attacked policy goes, the expert shows it the way back
        cloning = Mixture((CLONING, PolicyDrives(policy)), (0.6, 0.4))
        width = place.car.width
        drives = EvaluateSettings(runs=1, objects=(), car_width_m=width)
        return ImitationSettings(
            frames=frames,
            seed=self.seed,
            validate_every=self.epochs,
            cloning=cloning,
            collecting=CollectSettings(shard=32),
            training=TrainSettings(
                self.epochs, self.batch, learning_rate=self.learning_rate
            ),
            validation=drives,
            final=replace(drives, runs=self.runs, seed=1),
        )


def _describe(
    policy: Path, solvable: list[FoundAttack], others: dict[str, str]
) -> dict[str, object]:
    from mi_nerfattack.io import files

    return {
        "schema": 1,
        "policy": {"file": policy.name, "sha256": files.sha256(policy)},
        "runs": [
            {
                "label": found.label,
                "scenario": found.scenario.name,
                "seed": found.scenario.seed,
                "route": found.route.name,
                "objects": [item.id for item in found.scenario.objects],
                "found_sha256": found.digest,
            }
            for found in solvable
        ],
        "left_out": others,
    }
