"""`bench fit`: seconds per training step beside the same step in PyTorch."""

from __future__ import annotations

import statistics
import tempfile
import time
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from bench.render.run import PAUSE_S, Worker
from mi_nerfattack import variant
from mi_nerfattack.capture.scene import capture_scene
from mi_nerfattack.fields.ngp import NGPLayout
from mi_nerfattack.io import files
from mi_nerfattack.render.camera.intrinsics import from_fov
from mi_nerfattack.scenes import bundled

NETWORKS = {
    "Instant-NGP": NGPLayout(),
    "small": NGPLayout.small(),
}
ROLES = {"ours": "", "plain": "torch_", "tuned": "torch_tuned_"}

Progress = Callable[[str, int, int, str], None]


@dataclass(frozen=True)
class Settings:
    """What to measure.

    Attributes:
        folder: of posed images; None renders views of the bundled intersection.
        long_edge: of the images, pixels; None keeps their size.
        networks: by name.
        rays, samples: of a step, at most; ours takes as many rays as fill it.
        train_steps: of ours, between the two stages.
        turn_steps: of each side, in turns.
        repeats: turns of each side; the median counts.
        views, view_size: of the rendered views, their width and height in pixels.
        view_step_m: marching step for these.
        chunk: rays that a peer evaluates at once; None tries some out.
    """

    folder: Path | None = None
    long_edge: int | None = None
    networks: dict[str, NGPLayout] = field(default_factory=lambda: dict(NETWORKS))
    rays: int = 1 << 14
    samples: int = 1 << 16
    train_steps: int = 600
    turn_steps: int = 5
    repeats: int = 5
    views: int = 64
    view_size: tuple[int, int] = (160, 80)
    view_step_m: float = 0.12
    chunk: int | None = None

    @staticmethod
    def quick(repeats: int) -> Settings:
        """Return settings that take seconds: to see that it works, not for figures."""
        networks = {"tiny": NGPLayout(4, 2, 12, 4, 64, 16)}
        return Settings(
            networks=networks,
            rays=256,
            samples=1 << 12,
            train_steps=30,
            turn_steps=5,
            repeats=repeats,
            views=9,
            view_size=(32, 16),
            view_step_m=1.0,
            chunk=256,
        )


def run(settings: Settings, progress: Progress) -> dict[str, Any]:
    """Measure everything.

    Args:
        settings: what.
        progress: called with stage, steps done, all steps and a remark.

    Returns:
        the document that ``bench fit --json`` prints, but for the machine.
    """
    variant.ensure()
    rows: list[dict[str, Any]] = []
    with tempfile.TemporaryDirectory() as name:
        root = Path(name)
        job = _job(settings, root, progress)
        job |= {"rays": settings.rays, "samples": settings.samples}
        for network, layout in settings.networks.items():
            files.write_json(root / "job.json", {**job, "layout": asdict(layout)})
            rows += _network(settings, network, root, progress)
    return {
        "ratio": min(row["torch_ratio"] for row in rows),
        "tuned_ratio": min(row["torch_tuned_ratio"] for row in rows),
        "steps": rows,
        "data": job["data"],
        "networks": {k: asdict(v) for k, v in settings.networks.items()},
        "turn_steps": settings.turn_steps,
        "repeats": settings.repeats,
    }


def _job(settings: Settings, root: Path, progress: Progress) -> dict[str, Any]:
    """Say what our side fits to; render the views if no folder is given."""
    if settings.folder is not None:
        return {
            "folder": str(settings.folder.resolve()),
            "long_edge": settings.long_edge,
            "step_m": None,
            "data": settings.folder.resolve().name,
        }
    width, height = settings.view_size
    capture_scene(
        bundled("intersection/scene.xml"),
        bundled("intersection/routes.json"),
        root / "views",
        settings.views,
        from_fov(width, height, 90.0),
        spp=4,
        seed=1,
        progress=lambda done, total: progress("views", done, total, ""),
    )
    return {
        "folder": str(root / "views"),
        "long_edge": None,
        "step_m": settings.view_step_m,
        "data": f"{settings.views} views of the bundled intersection, {width}x{height}",
    }


def _network(
    settings: Settings, network: str, root: Path, progress: Progress
) -> list[dict[str, Any]]:
    """Measure one network at both stages."""
    stage = f"{network}, training"
    with Worker("fit", "ours", str(root / "job.json")) as ours:
        ours.ask("write_pictures", str(root / "pictures.safetensors"))
        early = _stage(settings, network, "early", ours, root, progress)
        for done in range(0, settings.train_steps, settings.turn_steps):
            progress(stage, done, settings.train_steps, "")
            ours.ask("train", min(settings.turn_steps, settings.train_steps - done))
        progress(stage, settings.train_steps, settings.train_steps, "")
        return [early, _stage(settings, network, "late", ours, root, progress)]


def _stage(
    settings: Settings,
    network: str,
    stage: str,
    ours: Worker,
    root: Path,
    progress: Progress,
) -> dict[str, Any]:
    """Copy our field to the peers, and let all sides train in turns."""
    name = f"{network}, {stage}"
    progress(name, 0, settings.repeats, "starting")
    state, rays = root / "field.safetensors", ours.ask("facts")["rays"]
    ours.ask("write_field", str(state))
    chunk = [] if settings.chunk is None else [str(settings.chunk)]
    shared = (str(state), str(root / "pictures.safetensors"), str(rays), *chunk)
    with ExitStack() as stack:
        workers = {"ours": ours}
        for role in ("plain", "tuned"):
            workers[role] = stack.enter_context(Worker("fit", role, *shared))
        facts = {role: worker.ask("facts") for role, worker in workers.items()}
        turns: dict[str, list[dict[str, float]]] = {role: [] for role in workers}
        for turn in range(settings.repeats + 1):  # the first one warms up
            for role, worker in workers.items():
                time.sleep(PAUSE_S)
                turns[role].append(worker.ask("steps", settings.turn_steps))
            progress(name, turn, settings.repeats, "")
        parts = ours.ask("breakdown")
        memory = {role: worker.ask("memory") for role, worker in workers.items()}
    row = {"network": network, "stage": stage, "rays": rays}
    return row | _figures(turns, facts, memory) | {"breakdown": parts}


def _figures(
    turns: dict[str, list[dict[str, float]]],
    facts: dict[str, Any],
    memory: dict[str, Any],
) -> dict[str, Any]:
    """Put the figures of one network and stage together."""
    row: dict[str, Any] = {}
    for role, prefix in ROLES.items():
        timed = turns[role][1:]
        seconds = statistics.median(turn["seconds"] for turn in timed)
        cpu_seconds = statistics.median(turn["cpu_seconds"] for turn in timed)
        samples = facts[role]["samples"]
        row |= {
            f"{prefix}seconds_per_step": seconds,
            f"{prefix}cpu_seconds_per_step": cpu_seconds,
            f"{prefix}samples_per_step": samples,
            f"{prefix}us_per_sample": 1e6 * seconds / samples,
            f"{prefix}loss_first": turns[role][0]["loss"],
            f"{prefix}loss_last": turns[role][-1]["loss"],
            f"{prefix}peak_memory_mb": memory[role]["peak_memory_mb"],
        }
    for prefix in ("torch_", "torch_tuned_"):
        for ratio, key in (("ratio", "seconds"), ("cpu_ratio", "cpu_seconds")):
            theirs, ours = row[f"{prefix}{key}_per_step"], row[f"{key}_per_step"]
            row[prefix + ratio] = theirs / ours
    row["settings"] = facts
    return row
