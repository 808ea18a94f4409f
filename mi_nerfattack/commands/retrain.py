"""``mi-nerfattack retrain``: fine-tune a policy among the attacks found on it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar

import tyro

from mi_nerfattack.commands.shared.options import command_line
from mi_nerfattack.commands.shared.terminal import Result, console
from mi_nerfattack.errors import InputError

if TYPE_CHECKING:
    from mi_nerfattack.commands.shared.progress import StageBars
    from mi_nerfattack.deploy.place import Place
    from mi_nerfattack.deploy.sites import PlaceSite
    from mi_nerfattack.experiment.retrain.among import FramesAmong
    from mi_nerfattack.experiment.retrain.compare import Comparison
    from mi_nerfattack.experiment.retrain.new_policy import Successor
    from mi_nerfattack.experiment.retrain.user_training import (
        AbstractUserTraining,
        TrainingOrder,
    )
    from mi_nerfattack.experiment.transfer.found import FoundAttack
    from mi_nerfattack.scenario.policy.kinds import AbstractPolicySection
    from mi_nerfattack.scenario.vehicle import AbstractVehicleSection
    from mi_nerfattack.system.workers import AbstractWorkers
    from mi_nerfattack.training.settings import ImitationSettings

#: New frames by environment, half of the preset laptop of 'train'.
FRAMES = {"surrogate": 2048, "mitsuba": 3072}


@dataclass(frozen=True)
class Retrain:
    """Fine-tune the attacked policy, with frames of the attacks.

    Drives past the attacks of all runs, held-out runs too. Collects frames of the
    attacked objects, labelled by the expert. Trains the policy further on these and on
    older frames (--more), or lets --command train it. Then drives again. Only runs
    count whose scenario the expert itself can drive. Stopped, it continues from DATA.
    With more --held-out or --adaptive it continues without training again. Next to the
    policy, NAME-retrain.json has the errors before and after, and NAME-retrain.csv the
    drives. Its own training also writes program and record.
    """

    continues: ClassVar[bool] = True

    run_folders: Annotated[
        tyro.conf.Positional[tuple[Path, ...]], tyro.conf.arg(metavar="RUN...")
    ]
    """Folders of finished runs of attack, on one policy, in one place."""
    output: Path
    """Policy to write: suffix as before, or .toml."""
    data: Path
    """Folder of new frames and checkpoints; made if missing."""
    command: str | None = None
    """Your training, such as "python my.py {data} {out}"; there are {policy}, {seed}
    and {threads}, too."""
    module: str | None = None
    """FILE.py:NAME, a function of data, out and seed, instead."""
    trust_code: bool = False
    """Run code of --module with all rights of your account."""
    more: tuple[Path, ...] = ()
    """Folders of frames that the policy was trained on; without them it forgets."""
    held_out: tuple[Path, ...] = ()
    """Runs to drive before and after, and not to train on."""
    frames: dict[str, int] | None = None
    """New frames by environment: surrogate 2048 mitsuba 3072."""
    skies: tuple[str, ...] = ("day",)
    """Times of day of rendered frames; others than day need a sunsky emitter."""
    exposures_ev: tuple[float, ...] = (-1.0, -0.5, 0.0, 0.5, 1.0)
    """Exposures of rendered frames, in powers of two."""
    spp: int = 4
    """Samples per pixel of path-traced frames."""
    epochs: int = 8
    """Passes over all frames."""
    batch: int = 64
    """Images a training step."""
    learning_rate: float = 5e-4
    """Largest learning rate."""
    card_runs: int = 2
    """Drives of each route and environment of the policy's card, without objects."""
    environments: tuple[str, ...] = ("surrogate", "mitsuba")
    """Environments of the drives before and after, as of 'transfer'."""
    runs: int = 4
    """Drives before and after of each case: with an attack, and without objects."""
    adaptive: bool = False
    """Attack the new policy in the same scenarios, too, which takes as long as the
    runs did."""
    workers: int | None = None
    """Processes that collect and drive; one a core by default, 1 works in this one."""
    seed: int = 0
    """Of all random numbers."""
    json: bool = False
    """End with one line of JSON: NAME-retrain.json and the card."""

    def run(self) -> Result:
        """Check, collect, train, drive and write."""
        from mi_nerfattack import variant
        from mi_nerfattack.commands.shared.progress import StageBars
        from mi_nerfattack.experiment.retrain.among import FramesAmong
        from mi_nerfattack.experiment.retrain.anew import check_scenarios
        from mi_nerfattack.experiment.retrain.compare import (
            AFTER,
            BEFORE,
            OLD,
            Comparison,
            with_policy,
            write_comparison,
        )
        from mi_nerfattack.experiment.transfer.found import read_found
        from mi_nerfattack.report.table import card_table, retrain_table
        from mi_nerfattack.training.dataset import find_shards

        training = self._user_training()
        comparison_path = self._check_outputs(training)
        variant.ensure()
        attacks = read_found([*self.run_folders, *self.held_out])
        policy, place = self._policy(attacks, training), self._place(attacks)
        order = self._order(policy, training)
        old_shards = find_shards(*self.more)
        groups, others = self._groups(attacks)
        if self.adaptive:
            check_scenarios(groups[OLD])
        settings = self._settings(policy.attacked, place)
        sites = self._sites(place, settings, attacks[0].scenario.vehicle)
        workers = self._workers(policy.attacked)
        frames = FramesAmong(
            sites, groups[OLD], settings, folder=self.data, workers=workers
        )
        drives = Comparison(groups, self.environments, self.runs, self.spp, self.data)
        with StageBars() as bars:
            before = drives.drive(BEFORE, workers, bars.counter)
        card, trained = {}, {}
        if training is None:
            card = self._fine_tune(frames, policy, old_shards)
        else:
            trained = self._train(training, order, policy, frames)
        setting = policy.setting(self.output)
        workers = self._workers(with_policy(groups[OLD][0], setting).scenario.policy)
        with StageBars() as bars:
            after = drives.drive(AFTER, workers, bars.counter, setting)
            anew = self._adapt(
                drives, before, after, policy=setting, workers=workers, bars=bars
            )
        document = _describe(policy.content, groups, anew, others=others) | trained
        write_comparison(comparison_path, document, before, after)

        def show() -> None:
            tables = [card_table(card)] if card else []
            console().print(*tables, retrain_table(document))
            print(f"{self.output}: written; what came of it is beside it")

        return Result({**document, "environments": card}, show)

    def _user_training(self) -> AbstractUserTraining | None:
        """Return the training that is asked for; None for ours."""
        from mi_nerfattack.experiment.retrain.user_training import chosen_training

        training = chosen_training(self.command, self.module, self.trust_code)
        defaults = {item.name: item.default for item in fields(self)}
        for name in ("more", "epochs", "batch", "learning_rate", "card_runs"):
            if training is not None and getattr(self, name) != defaults[name]:
                raise InputError(
                    f"--{name.replace('_', '-')}: is of our training; leave it out, or "
                    "give it to yours in its own words"
                )
        return training

    def _check_outputs(self, training: AbstractUserTraining | None) -> Path:
        """Check that all can be written; return where the comparison is."""
        from mi_nerfattack.commands.shared.fit_report import check_output
        from mi_nerfattack.io import files
        from mi_nerfattack.policy.exported import SUFFIX

        comparison = self.output.with_name(f"{self.output.stem}-retrain.json")
        written = [self.output, comparison, comparison.with_suffix(".csv")]
        if training is None:
            check_output(self.output)
            written += map(self.output.with_suffix, (SUFFIX, ".json"))
        for path in written:
            files.check_writable(path)
        return comparison

    def _policy(
        self, attacks: Sequence[FoundAttack], training: AbstractUserTraining | None
    ) -> Successor:
        """Return the attacked policy, which -o can follow."""
        from mi_nerfattack.experiment.retrain.among import (
            attacked_policy,
            attacked_weights,
        )
        from mi_nerfattack.experiment.retrain.new_policy import Successor

        if training is None:
            attacked_weights(attacks)  # refuses all but PilotNet
        policy = Successor(attacked_policy(attacks))
        needed = [Successor(attack.scenario.policy).file for attack in attacks]
        if self.output.resolve() in [file.resolve() for file in needed if file]:
            raise InputError(
                f"{self.output}: is the policy that was attacked, which its runs "
                "still need; choose another file with -o"
            )
        policy.check_suffix(self.output)
        return policy

    def _order(
        self, policy: Successor, training: AbstractUserTraining | None
    ) -> TrainingOrder:
        """Return what a training is given, which can do with it."""
        from mi_nerfattack.experiment.retrain.user_training import TrainingOrder
        from mi_nerfattack.system.workers import available_cores

        data = self.data.resolve()
        order = TrainingOrder(
            data=data / "round_0",
            out=data / "trained" / f"policy{self.output.suffix}",
            policy=policy.file,
            seed=self.seed,
            threads=self.workers or available_cores(),
        )
        if training is not None:
            training.check(order)
        return order

    def _fine_tune(
        self,
        frames: FramesAmong,
        policy: Successor,
        old_shards: Sequence[Path],
    ) -> dict[str, Any]:
        """Train PilotNet further, and write it; return its card."""
        from mi_nerfattack.commands.shared.progress import StageBars
        from mi_nerfattack.policy.pilotnet import PilotNet
        from mi_nerfattack.training.record import training_record, write_trained

        assert policy.file is not None
        with StageBars() as bars:
            if not old_shards:
                bars.say("no --more: trained on new frames alone, it may forget others")
            result = frames.imitate(PilotNet.load(policy.file), old_shards, bars.show)
        command = command_line("retrain", self)
        record = training_record(
            frames.settings, frames.sites, self.data, result=result, command=command
        )
        write_trained(self.output, result.module, record)
        return result.card

    def _train(
        self,
        training: AbstractUserTraining,
        order: TrainingOrder,
        policy: Successor,
        frames: FramesAmong,
    ) -> dict[str, Any]:
        """Let somebody else's training write the new policy; return what it was."""
        from mi_nerfattack.commands.shared.progress import StageBars
        from mi_nerfattack.experiment.retrain.new_policy import install, try_policy
        from mi_nerfattack.experiment.retrain.user_training import train_once
        from mi_nerfattack.training.record import count_frames

        with StageBars() as bars:
            shards = frames.collect(bars.show)

        def check() -> str:
            setting = policy.setting(order.out)
            return try_policy(frames.attacks[0], setting, self.adaptive)

        # without bars, which the output of a command would break
        record = train_once(training, order, shards, check)
        install(order.out, self.output)
        return {"training": {**record, "frames": count_frames(self.data, shards)}}

    def _adapt(
        self,
        drives: Comparison,
        before: dict[str, Any],
        after: dict[str, Any],
        policy: str,
        workers: AbstractWorkers,
        bars: StageBars,
    ) -> list[FoundAttack]:
        """Attack the new policy, if asked, and add a group to both stages."""
        from dataclasses import replace

        from mi_nerfattack.experiment.retrain.anew import attack_anew
        from mi_nerfattack.experiment.retrain.compare import ADAPTIVE, AFTER, OLD

        if not self.adaptive:
            return []
        show, folder = bars.counter("attacking anew", "attack "), self.data / ADAPTIVE
        anew = attack_anew(
            drives.groups[OLD], policy, folder, workers=workers, progress=show
        )
        again = replace(drives, groups={ADAPTIVE: anew})
        after.update(again.drive(AFTER, workers, bars.counter))
        before[ADAPTIVE] = before[OLD]  # past the attacks on the policy before
        return anew

    def _workers(self, policy: AbstractPolicySection) -> AbstractWorkers:
        """Return who drives a policy."""
        from mi_nerfattack.system.workers import chosen_workers

        return chosen_workers(self.workers, policy.is_remote)

    def _place(self, attacks: Sequence[FoundAttack]) -> Place:
        from mi_nerfattack.experiment.retrain.among import found_place

        return found_place(attacks[: len(self.run_folders)])

    def _sites(
        self, place: Place, settings: ImitationSettings, vehicle: AbstractVehicleSection
    ) -> list[PlaceSite]:
        from dataclasses import replace

        from mi_nerfattack.deploy.sites import PlaceSite, Weather

        weather = Weather(self.skies, self.exposures_ev, self.spp)
        place = replace(place, motion=None)  # each process makes its own
        return [
            PlaceSite(name, place, weather, motion=vehicle.motion)
            for name in settings.sites
        ]

    def _groups(
        self, attacks: Sequence[FoundAttack]
    ) -> tuple[dict[str, list[FoundAttack]], dict[str, str]]:
        """Divide what was read, and say what does not count."""
        from mi_nerfattack.experiment.retrain.compare import HELD_OUT, OLD
        from mi_nerfattack.experiment.retrain.solvable import divide_solvable

        solvable, others = divide_solvable(attacks)
        for label, trouble in others.items():
            print(f"{label}: left out: {trouble}")
        trained = attacks[: len(self.run_folders)]
        groups = {
            OLD: [attack for attack in solvable if attack in trained],
            HELD_OUT: [attack for attack in solvable if attack not in trained],
        }
        if not groups[OLD]:
            raise InputError("RUN: none can be driven by the expert; give other runs")
        return {name: some for name, some in groups.items() if some}, others

    def _settings(
        self, policy: AbstractPolicySection, place: Place
    ) -> ImitationSettings:
        from dataclasses import replace

        from mi_nerfattack.experiment.retrain.among import attacked_drives
        from mi_nerfattack.experiment.transfer.columns import PASTED
        from mi_nerfattack.training.presets import collecting_for, evaluation_for
        from mi_nerfattack.training.settings import CLONING, ImitationSettings
        from mi_nerfattack.training.sources import Mixture
        from mi_nerfattack.training.train import TrainSettings

        frames = FRAMES if self.frames is None else self.frames
        for name in frames:
            if name not in PASTED:
                raise InputError(f"--frames: {name!r}; of {', '.join(PASTED)}")
        # where the attacked policy goes, the expert shows it the way back
        cloning = Mixture((CLONING, attacked_drives(policy, place.rig)), (0.6, 0.4))
        width = place.car.width
        drives = evaluation_for(width)
        drives = replace(drives, runs=1, objects=(), car_width_m=width)
        return ImitationSettings(
            frames=frames,
            seed=self.seed,
            validate_every=self.epochs,
            cloning=cloning,
            collecting=replace(collecting_for(width), shard=32),
            training=TrainSettings(
                self.epochs, self.batch, learning_rate=self.learning_rate
            ),
            validation=drives,
            final=replace(drives, runs=self.card_runs, seed=1),
        )


def _describe(
    policy: dict[str, str],
    groups: Mapping[str, Sequence[FoundAttack]],
    anew: Sequence[FoundAttack],
    others: dict[str, str],
) -> dict[str, Any]:
    from mi_nerfattack.experiment.retrain.compare import HELD_OUT, OLD

    return {
        "schema": 1,
        "policy": policy,
        "runs": [attack.description for attack in groups[OLD]],
        "held_out": [attack.description for attack in groups.get(HELD_OUT, ())],
        "adaptive": [attack.description for attack in anew],
        "left_out": others,
    }
