"""Finished run folders of given errors, made without driving."""

from __future__ import annotations

import numpy as np
from helpers.made_drives import COST, LANES, make_drive
from helpers.small_fields import SMALL

from mi_nerfattack.evaluation import metrics
from mi_nerfattack.fields import GridField, save_field
from mi_nerfattack.io import files
from mi_nerfattack.report.table import write_steps

#: Files that `--no-pictures` leaves out.
PICTURES = (
    "triptych",
    "overhead",
    "errors",
    "convergence",
    "strip",
    "attribution",
    "attribution_object",
)


def make_run(folder, attacked=1.2, frames=4, pictures=True, **changes):
    """Write a run folder; returns its `metrics.json`.

    Args:
        folder: of the run, made.
        attacked: error past the attack, metres.
        frames: control periods of which there are pictures.
        pictures: whether there are plots and frames.
        changes: keys of the document.
    """
    drives = [
        make_drive([0.1, -0.3, 0.2], case="no_object"),
        make_drive([0.1, -0.3, 0.25], case="own"),
        make_drive([0.1, -0.3, 0.2]),
        make_drive([0.5, 0.6, 0.7], run=1),
        make_drive([0.4, -attacked, 0.8], case="attack"),
        make_drive([0.4, -attacked, 0.8], case="attack", environment="deployment"),
    ]
    scenario = {
        "name": "a <ball>",
        "vehicle": {"dt_s": 0.1},
        "objects": [{"id": "ball"}],
        "attack": {"method": "gradient", "parameters": "texture"},
    }
    document = metrics.metrics_document(scenario, 7, drives, LANES, COST) | {
        "flags": ["not converged: <the> search"],
        "verdict": ["The attack beats random looks."],
        "converged": False,
        "curve": {
            "frames": [10, 20, 30],
            "objective": [-1.0, -2.0, -3.0],
            "cross_track_mean_m": [0.1, 0.2, attacked],
        },
        **changes,
    }
    files.make_folder(folder)
    files.write_json(folder / "metrics.json", document)
    files.write_text(folder / "scenario.toml", 'name = "</pre>a <ball>"\n')
    write_steps(folder / "steps.csv", drives, LANES)
    files.make_folder(folder / "objects")
    grid = GridField(SMALL, -np.ones(3), np.ones(3))
    save_field(folder / "objects" / "ball.safetensors", grid)
    if pictures:
        _draw(folder, frames)
    return document


def _draw(folder, frames):
    generator = np.random.default_rng(4)
    for name in PICTURES:
        pixels = generator.integers(0, 256, (5, 6, 3), dtype=np.uint8)
        files.write_image(folder / f"{name}.png", pixels)
    for number, case in enumerate(("no_object", "random", "attack")):
        own = folder / "frames" / f"surrogate_{case}"
        for step in range(frames):
            pixels = np.full((4, 8, 3), 60 * number + 10 * step, np.uint8)
            files.make_folder(own)
            files.write_image(own / f"{step:04d}.png", pixels)
