"""`bench attack`: an attack iteration beside a rollout, and beside PyTorch."""

from __future__ import annotations

import statistics
import tempfile
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from bench.attack.drive import BAKED, MOUNT, OBJECT_POSE, Job
from bench.full_ngp import NGPData
from bench.render.run import PAUSE_S, Worker
from bench.render.sides import FOV_DEG
from bench.torch.object import ObjectData
from mi_nerfattack import variant
from mi_nerfattack.fields import NGPField, load_field, load_grid, save_field
from mi_nerfattack.fit.bake.bake import bake
from mi_nerfattack.fit.bake.scores import score_bake
from mi_nerfattack.render.camera.intrinsics import from_fov
from mi_nerfattack.render.posed import PosedField
from mi_nerfattack.scenes import bundled
from mi_nerfattack.vehicle.route.route import Route, load_routes

WAYS = ("kept_backgrounds", "replay")
PEERS = {"plain": "torch_", "tuned": "torch_tuned_", BAKED: "torch_baked_"}
#: Keys of milliseconds by whose they are.
MILLISECONDS = {
    "rollout": "rollout_ms",
    WAYS[0]: "iteration_ms",
    WAYS[1]: "replay_iteration_ms",
    f"ours, {BAKED}": "baked_iteration_ms",
    "plain": "torch_iteration_ms",
    "tuned": "torch_tuned_iteration_ms",
    BAKED: "torch_baked_iteration_ms",
}
_SCORE_EVERY_M = 8.0
PARTS = ("time", "memory")

Progress = Callable[[str, int, int, str], None]
Turns = dict[str, list[dict[str, float]]]


@dataclass(frozen=True)
class Settings:
    """What to measure.

    Attributes:
        sizes: widths and heights of the images, pixels.
        parts: of `PARTS`.
        horizon: of what is timed, control periods.
        repeats: of what is timed; the median counts.
        batch: poses that are timed beside one, at the first size.
        memory_poses: in the batch whose memory is measured.
        replay_horizons: of the constant-memory mode; the short and the long one.
        kept_horizons: of the mode that keeps backgrounds.
        torch_horizon: of the peer; beyond it, its memory grows by its tape.
        choices: chunk of rays and lookup of the peers; none to try them out.
    """

    sizes: tuple[tuple[int, int], ...] = ((200, 66), (366, 188))
    parts: tuple[str, ...] = PARTS
    horizon: int = 25
    repeats: int = 3
    batch: int = 8
    memory_poses: int = 4
    replay_horizons: tuple[int, int] = (25, 400)
    kept_horizons: tuple[int, int] = (25, 100)
    torch_horizon: int = 25
    choices: tuple[str, ...] = ()

    @staticmethod
    def quick(
        sizes: tuple[tuple[int, int], ...], parts: tuple[str, ...], repeats: int
    ) -> Settings:
        """Return settings that take seconds: to see that it works, not for figures."""
        return Settings(
            sizes, parts, 2, repeats, 2, 1, (1, 2), (1, 2), 1, ("4096", "bag")
        )


def run(settings: Settings, progress: Progress) -> dict[str, Any]:
    """Measure everything.

    Args:
        settings: what.
        progress: called with stage, steps done, all steps and a remark.

    Returns:
        the document that ``bench attack --json`` prints, but for the machine.
    """
    variant.ensure()
    document: dict[str, Any] = {f"{w}x{h}": {} for w, h in settings.sizes}
    with tempfile.TemporaryDirectory() as name:
        bench = Bench(settings, Path(name), progress)
        bench.write_files()
        for size, row in zip(settings.sizes, document.values(), strict=True):
            if "time" in settings.parts:
                row |= bench.times(size)
                if size == settings.sizes[0]:
                    row |= bench.batch(size)
            if "memory" in settings.parts:
                row |= bench.memory(size)
    return document


class Bench:
    """The measurements.

    Args:
        settings: what to measure.
        folder: for the files that the peers read.
        progress: as :func:`run` takes it.
    """

    def __init__(self, settings: Settings, folder: Path, progress: Progress) -> None:
        self.settings, self.progress = settings, progress
        names = ("scene", "item", "baked")
        self.scene, self.item, self.baked = (
            folder / f"{name}.safetensors" for name in names
        )

    def write_files(self) -> None:
        """Write background, bricks and object for all sides."""
        scene = _scene()
        NGPData.of(scene).write(self.scene)
        camera = from_fov(*Settings().sizes[0], FOV_DEG)
        save_field(self.baked, bake(PosedField(scene), _routes(), camera, MOUNT))
        item = load_grid(bundled("hydrant/field.safetensors"))
        ObjectData.of(PosedField(item, OBJECT_POSE)).write(self.item)

    def times(self, size: tuple[int, int]) -> dict[str, Any]:
        """Time rollouts and iterations of one vehicle, all sides in turns."""
        stage, repeats = f"time, {size[0]}x{size[1]}", self.settings.repeats
        job = Job(*size, 1, self.settings.horizon)
        self.progress(stage, 0, repeats, "starting")
        turns: Turns = {}
        with ExitStack() as stack:
            ours = stack.enter_context(self._ours(job, str(self.baked)))
            for way in (*WAYS, BAKED):  # traces and compiles
                ours.ask("iterate", way)
            peers = {role: stack.enter_context(self._peer(role, job)) for role in PEERS}
            for repeat in range(repeats):
                self._turn(ours, turns)
                turns.setdefault(f"ours, {BAKED}", []).append(
                    ours.ask("iterate", BAKED)
                )
                for role, peer in peers.items():
                    self.progress(stage, repeat, repeats, f"PyTorch, {role}")
                    time.sleep(PAUSE_S)
                    turns.setdefault(role, []).append(peer.ask("iterate", ""))
                self.progress(stage, repeat + 1, repeats, "")
            facts = {role: peer.ask("facts") for role, peer in peers.items()}
            facts["ours"] = ours.ask("facts")
            launches = {way: ours.ask("launches", way) for way in (*WAYS, BAKED)}
        return _time_row(turns) | {
            "bake_psnr_db": self._bake_psnr_db(size),
            "bake_mb": self.baked.stat().st_size / 1e6,
            "horizon": job.horizon,
            "launches_per_step": launches,
            "kernels_compiled_after_warmup": sum(
                some["compiled"] for some in launches.values()
            ),
            "settings": facts,
        }

    def batch(self, size: tuple[int, int]) -> dict[str, Any]:
        """Compare a batch of vehicles with a single one, in turns."""
        count, repeats = self.settings.batch, self.settings.repeats
        stage, ways = f"batch of {count}", WAYS[:1]
        self.progress(stage, 0, repeats, "starting")
        single, many = (Job(*size, n, self.settings.horizon) for n in (1, count))
        turns: dict[str, Turns] = {"one": {}, "many": {}}
        with self._ours(single) as one, self._ours(many) as batch:
            for worker in (one, batch):
                worker.ask("iterate", *ways)
            for repeat in range(repeats):
                self._turn(one, turns["one"], ways)
                self._turn(batch, turns["many"], ways)
                self.progress(stage, repeat + 1, repeats, "")
            launches = batch.ask("launches", *ways)
        ratios = {
            key + suffix: _ratio(turns["many"][way], turns["one"][way], unit)
            for way, key in (("rollout", "rollout"), (ways[0], "iteration"))
            for unit, suffix in (("seconds", ""), ("cpu_seconds", "_cpu"))
        }
        return {"batch": {"poses": count, **ratios, "launches_per_step": launches}}

    def memory(self, size: tuple[int, int]) -> dict[str, Any]:
        """Measure the peaks of both adjoints and of the peer by horizon."""
        settings, poses = self.settings, self.settings.memory_poses
        stage = f"memory, {size[0]}x{size[1]}"
        jobs = [
            *(("replay", horizon) for horizon in settings.replay_horizons),
            *((WAYS[0], horizon) for horizon in settings.kept_horizons),
            ("tuned", settings.torch_horizon),
        ]
        peaks: dict[str, dict[str, float]] = {way: {} for way, _ in jobs}
        stated: dict[str, float] = {}
        for done, (way, horizon) in enumerate(jobs):
            self.progress(stage, done, len(jobs), f"{way}, {horizon} steps")
            job = Job(*size, poses, horizon)
            with self._peer(way, job) if way in PEERS else self._ours(job) as worker:
                found = worker.ask("iterate", way)
                peaks[way][str(horizon)] = worker.ask("memory")["peak_memory_mb"]
                if way in PEERS:
                    stated[way] = found["tape_mb"]
                elif way not in stated:
                    stated[way] = worker.ask("kept_bytes") / 1e6
        self.progress(stage, len(jobs), len(jobs), "")
        return {"memory_poses": poses, **memory_row(peaks, stated)}

    def _turn(self, ours: Worker, turns: Turns, ways: Sequence[str] = WAYS) -> None:
        """Take our rollout and iterations once."""
        time.sleep(PAUSE_S)
        turns.setdefault("rollout", []).append(ours.ask("drive"))
        for way in ways:
            turns.setdefault(way, []).append(ours.ask("iterate", way))

    def _bake_psnr_db(self, size: tuple[int, int]) -> float:
        """Return the mean PSNR of the bricks against the field."""
        camera = from_fov(*size, FOV_DEG)
        pair = PosedField(_scene()), PosedField(load_field(self.baked))
        views = score_bake(*pair, _routes(), camera, MOUNT, spacing_m=_SCORE_EVERY_M)
        return statistics.fmean(view.psnr_db for view in views)

    def _ours(self, job: Job, *baked: str) -> Worker:
        return Worker("attack", "ours", *job.arguments(), *baked)

    def _peer(self, role: str, job: Job) -> Worker:
        scene = self.baked if role == BAKED else self.scene
        files = (str(scene), str(self.item))
        arguments = (*job.arguments(), *files, *self.settings.choices)
        return Worker("attack", role, *arguments)


def _scene() -> NGPField:
    field = load_field(bundled("intersection/field.safetensors"))
    assert isinstance(field, NGPField)
    return field


def _routes() -> list[Route]:
    return load_routes(bundled("intersection/routes.json"))


def memory_row(
    peaks: dict[str, dict[str, float]], stated: dict[str, float]
) -> dict[str, Any]:
    """Put the figures of memory together.

    Args:
        peaks: MB by horizon, of `replay`, `kept_backgrounds` and the peer, `tuned`.
        stated: MB a control period, of the latter two.
    """
    replay, kept, peer = (dict(peaks[key]) for key in ("replay", WAYS[0], "tuned"))
    (_, first), (long, last) = replay.items()
    (few, low), (many, high) = kept.items()
    [(known, peak)] = peer.items()
    for horizon in replay:
        more = int(horizon) - int(known)
        peer.setdefault(horizon, peak + stated["tuned"] * more)
    ratios = {horizon: peer[horizon] / replay[horizon] for horizon in replay}
    return {
        "peak_memory_mb_by_horizon": replay,
        "peak_memory_change": last / first - 1,
        "kept_backgrounds": {
            "peak_memory_mb_by_horizon": kept,
            "stated_mb_per_step": stated[WAYS[0]],
            "measured_mb_per_step": (high - low) / (int(many) - int(few)),
        },
        "torch_peak_memory_mb_by_horizon": peer,
        "torch_measured_horizons": [known],
        "torch_tape_mb_per_step": stated["tuned"],
        "torch_memory_ratio": ratios[long],
        "torch_memory_ratio_by_horizon": ratios,
    }


def _time_row(turns: Turns) -> dict[str, Any]:
    """Put the figures of time together."""
    row: dict[str, Any] = {
        "iteration_over_rollout": _ratio(turns[WAYS[0]], turns["rollout"]),
        "replay_over_rollout": _ratio(turns["replay"], turns["rollout"]),
    }
    for role, prefix in PEERS.items():
        ours = turns[f"ours, {BAKED}" if role == BAKED else WAYS[0]]
        row[f"{prefix}time_ratio"] = _ratio(turns[role], ours)
        row[f"{prefix}cpu_ratio"] = _ratio(turns[role], ours, "cpu_seconds")
    for name, some in turns.items():
        prefix = {**PEERS, f"ours, {BAKED}": f"{BAKED}_"}.get(name, f"{name}_")
        seconds = statistics.median(turn["seconds"] for turn in some)
        row[MILLISECONDS[name]] = 1000 * seconds
        for unit in ("seconds", "cpu_seconds"):
            row[f"{prefix}{unit}"] = statistics.median(turn[unit] for turn in some)
    return row


def _ratio(
    many: list[dict[str, float]], one: list[dict[str, float]], unit: str = "seconds"
) -> float:
    """Divide medians."""
    above, below = (statistics.median(t[unit] for t in some) for some in (many, one))
    return above / below
