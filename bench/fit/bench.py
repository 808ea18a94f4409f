"""``python -m bench fit``: a training step beside the same step in PyTorch."""

from __future__ import annotations

from contextlib import ExitStack
from dataclasses import asdict, astuple, dataclass
from pathlib import Path
from typing import Any

from bench.results import Comparison, Progress, compare
from bench.tables import markdown, number
from bench.worker import Worker, medians
from mi_nerfattack.capture.scene import capture_scene
from mi_nerfattack.commands.shared.terminal import Result
from mi_nerfattack.fields.ngp import NGPLayout
from mi_nerfattack.render.camera.intrinsics import from_fov
from mi_nerfattack.scenes import bundled

MOST_APART = 0.05  # of samples a step, before the comparison is called unfair
TURN_STEPS = 5  # of each side, in turns


@dataclass(frozen=True)
class Sizes:
    """How much is fitted.

    Attributes:
        networks: by name.
        rays: of a step at most.
        samples: of a step, which as many rays as fill it take.
        train_steps: of ours, between the two stages.
        views: that are rendered.
        width, height: of the views, pixels.
        step_m: marching step.
        chunk: rays that the peer evaluates at once; none to try some out.
    """

    networks: dict[str, NGPLayout]
    rays: int = 1 << 14
    samples: int = 1 << 16
    train_steps: int = 600
    views: int = 64
    width: int = 160
    height: int = 80
    step_m: float = 0.12
    chunk: tuple[int, ...] = ()


FULL = Sizes({"Instant-NGP": NGPLayout(), "small": NGPLayout.small()})
_TINY = {
    "tiny": NGPLayout(
        levels=4,
        features=2,
        log2_table=12,
        base_resolution=4,
        max_resolution=64,
        width=16,
    )
}
QUICK = Sizes(
    networks=_TINY,
    rays=256,
    samples=1 << 12,
    train_steps=30,
    views=9,
    width=32,
    height=16,
    step_m=1.0,
    chunk=(256,),
)


@dataclass(frozen=True)
class BenchFit(Comparison):
    """Measure a training step of a fit against the same step in PyTorch.

    The same network, rays, occupancy and marching step, both sides from the same
    state and in turns, in processes of their own, on all cores; medians count. Keep the
    machine otherwise idle. Takes about ten minutes.
    """

    def run(self) -> Result:
        """Measure, print and write."""
        return compare("fit", self, measure, lines=lines)


def measure(options: BenchFit, root: Path, show: Progress) -> dict[str, Any]:
    """Measure everything, and return the document, but for its stamp."""
    sizes = QUICK if options.quick else FULL
    capture_scene(
        bundled("intersection/scene.xml"),
        bundled("intersection/routes.json"),
        root / "views",
        n=sizes.views,
        camera=from_fov(sizes.width, sizes.height, 90.0),
        spp=4,
        seed=1,
        progress=lambda done, total: show("views", done, total, ""),
    )
    edges = f"{sizes.width}x{sizes.height}"
    data = f"{sizes.views} views of the bundled intersection, {edges}"
    rows: list[dict[str, Any]] = []
    for network, layout in sizes.networks.items():
        with Worker(
            "fit.ours",
            "OurTrainer",
            str(root / "views"),
            sizes.step_m,
            astuple(layout),
            sizes.rays,
            sizes.samples,
        ) as ours:
            ours.ask("write_pictures", str(root / "pictures.safetensors"))
            for stage in ("early", "late"):
                name = f"{network}, {stage}"
                row = _stage(
                    name,
                    ours,
                    root,
                    repeats=options.repeats,
                    chunk=sizes.chunk,
                    show=show,
                )
                rows.append({"network": network, "stage": stage, **row})
                for done in range(0, sizes.train_steps, TURN_STEPS):
                    if stage == "early":
                        show(f"{network}, training", done, sizes.train_steps, "")
                        ours.ask("train", TURN_STEPS)
    return {
        "ratio": min(row["torch_ratio"] for row in rows),
        "steps": rows,
        "data": data,
        "networks": {name: asdict(layout) for name, layout in sizes.networks.items()},
        "repeats": options.repeats,
    }


def _stage(
    name: str,
    ours: Worker,
    root: Path,
    repeats: int,
    chunk: tuple[int, ...],
    show: Progress,
) -> dict[str, Any]:
    """Copy our field to the peer, and let both sides train in turns."""
    show(name, 0, repeats, "starting")
    rays, state = ours.ask("facts")["rays"], str(root / "field.safetensors")
    ours.ask("write_field", state)
    pictures = str(root / "pictures.safetensors")
    row: dict[str, Any] = {"rays": rays, "settings": {}}
    with ExitStack() as stack:
        peer = stack.enter_context(
            Worker("fit.peer", "TorchTrainer", state, pictures, rays, *chunk)
        )
        sides = {"": ours, "torch_": peer}
        facts = {prefix: worker.ask("facts") for prefix, worker in sides.items()}
        turns: dict[str, list[dict[str, float]]] = {prefix: [] for prefix in sides}
        for turn in range(repeats + 1):  # the first one warms up
            for prefix, worker in sides.items():
                turns[prefix].append(worker.timed("steps", TURN_STEPS))
            show(name, turn, repeats, "")
        for prefix, worker in sides.items():
            median, samples = medians(turns[prefix][1:]), facts[prefix]["samples"]
            figures = {
                "seconds_per_step": median["seconds"],
                "cpu_seconds_per_step": median["cpu_seconds"],
                "samples_per_step": samples,
                "loss_first": turns[prefix][0]["loss"],
                "loss_last": turns[prefix][-1]["loss"],
                **worker.ask("memory"),
            }
            row |= {prefix + key: value for key, value in figures.items()}
            row["settings"][prefix or "ours"] = facts[prefix]
    return row | {
        "torch_ratio": row["torch_seconds_per_step"] / row["seconds_per_step"],
        "torch_cpu_ratio": row["torch_cpu_seconds_per_step"]
        / row["cpu_seconds_per_step"],
    }


def lines(document: dict[str, Any]) -> list[str]:
    """Return the ratio, the table, and what makes a comparison unfair."""
    header = ("network", "stage", "rays", "ours, ms", "PyTorch, ms", "ratio", "of CPU")
    rows, unfair = [], []
    for row in document["steps"]:
        seconds = (row[f"{p}seconds_per_step"] for p in ("", "torch_"))
        ratios = f"{row['torch_ratio']:.2f}", f"{row['torch_cpu_ratio']:.2f}"
        labels = row["network"], row["stage"], str(row["rays"])
        rows.append((*labels, *(number(1e3 * value) for value in seconds), *ratios))
        reasons = []
        apart = row["torch_samples_per_step"] / row["samples_per_step"] - 1
        if abs(apart) > MOST_APART:
            reasons.append(f"samples of PyTorch differ from ours by {apart:+.1%}")
        for side, prefix in {"ours": "", "PyTorch": "torch_"}.items():
            learnt = row[f"{prefix}loss_last"] < row[f"{prefix}loss_first"]
            if row["stage"] == "early" and not learnt:
                reasons.append(f"{side} did not learn")
        unfair += [
            f"{labels[0]}, {labels[1]}: {text}: do not quote" for text in reasons
        ]
    return [
        f"A training step takes PyTorch {document['ratio']:.2f} times as long as us, "
        f"or longer; fitted to {document['data']}",
        "",
        markdown(header, rows),
        *unfair,
    ]
