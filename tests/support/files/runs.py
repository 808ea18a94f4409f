"""Run folders, drives and documents of given errors, made without driving."""

from __future__ import annotations

import numpy as np
from support.worlds.fields import SMALL

from mi_nerfattack.drives.table import write_steps
from mi_nerfattack.evaluation import metrics
from mi_nerfattack.fields import GridField, save_field
from mi_nerfattack.io import files
from mi_nerfattack.rollout.drive import Drive, Lane

#: Files that `--pictures none` leaves out.
PICTURES = ("triptych", "overhead", "errors", "convergence", "strip")
PICTURES += ("attribution", "attribution_object")


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
        make_drive([0.4, -attacked, 0.8], case="attack", environment="mitsuba"),
    ]
    method = {"method": {"kind": "gradient"}, "freedom": {"kind": "texture"}}
    scenario = {"name": "a <ball>", "vehicle": {"dt_s": 0.1}, "attack": method}
    scenario["objects"] = [{"id": "ball"}]
    curve = {"frames": [10, 20, 30], "objective": [-1.0, -2.0, -3.0]}
    document = metrics.metrics_document(scenario, 7, drives, LANES, COST) | {
        "flags": ["not converged: <the> search"],
        "verdict": ["The attack beats random looks."],
        "converged": False,
        "curve": curve | {"cross_track_mean_m": [0.1, 0.2, attacked]},
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


def case(mean, out, of=2):
    return {
        "cross_track_mean_m": mean,
        "cross_track_mean_ci95_m": [mean / 2, 2 * mean],
        "cross_track_max_m": 3 * mean,
        "drives": 4 * of,
        "drives_departed": 4 * out,
        "attacks_out": out,
        "attacks_out_rate_ci95": [0.25, 0.75],
    }


def make_transfer(folder, complete=True):
    """Write the folder of a transfer: light has no effect in the surrogate."""

    def column(environment, condition, mean, out):
        cases = {"no_object": case(0.05, 0), "attack": case(mean, out)}
        transfer = {"of": 2, "kept": out, "rate_ci95": [0.25, 0.75]}
        entry = {"environment": environment, "condition": condition, "attacks": 2}
        return entry | {"cases": cases, "ratio_to_surrogate": 0.5, "transfer": transfer}

    rows = [
        {"attack": name, "environment": environment, "condition": "day"}
        for name in ("one", "two")
        for environment in ("surrogate", "mitsuba")
    ]
    document = {"schema": 1, "complete": complete, "starts": 4, "success_s": 1.0}
    document |= {
        "cases": ["no_object", "attack"],
        "conditions": {"day": {}, "<noon>": {}},
        "attacks": [{"label": name} for name in ("one", "two")],
        "rows": [row | {"cases": {"attack": case(0.7, 1)}} for row in rows],
        "columns": [
            column("surrogate", "day", 0.8, 2),
            column("mitsuba", "day", 0.4, 1),
            column("mitsuba", "<noon>", 0.2, 0),
        ],
        "surrogates": [],
    }
    files.make_folder(folder)
    files.write_json(folder / "transfer.json", document)


def make_retraining(path):
    before = {"no_object": case(0.05, 0), "attack": case(0.8, 2)}
    after = {"no_object": case(0.06, 0), "attack": case(0.09, 0)}
    row = {"group": "held_out", "environment": "mitsuba", "attacks": 2}
    row |= {"before": before, "after": after, "clean_ratio": 1.2}
    row["attack_to_clean"] = {"before": 16.0, "after": 1.5}
    left_out = {"third": "the expert leaves its lane"}
    header = {"policy": {}, "runs": [{}, {}], "held_out": [], "left_out": left_out}
    files.write_json(path, {"schema": 1, **header, "table": [row]})


#: What `metrics.json` of a run folder holds.
RUN_ENVIRONMENTS = ("surrogate", "mitsuba")
LANES = {"straight": Lane(0.85, 1.75)}
COST = {"wall_s": 12.5, "peak_memory_mb": 900.0, "renders": 240}


def make_drive(
    errors, environment="surrogate", case="random", run=0, route="straight", **changes
):
    """Return a drive along +x in steps of half a metre with the given errors."""
    errors = np.asarray(errors, dtype=float)
    steps = len(errors)
    states = np.zeros((steps + 1, 3))
    states[:, 0] = 0.5 * np.arange(steps + 1)
    states[1:, 1] = errors
    time_s, controls = 0.1 * np.arange(1, steps + 1), np.linspace(-0.1, 0.1, steps)
    rows = {"states": states, "controls": controls}
    rows |= {"cross_track_m": errors, "time_s": time_s, **changes}
    return Drive(environment, route, case, run, 100 + run, **rows)


def make_document(drives=None):
    drives = drives or [
        make_drive([0.1, -0.3], case="own"),
        make_drive([0.1, -0.3, 0.2], run=0),
        make_drive([0.5, 0.9, 1.0], run=1),
        make_drive([1.0, 1.2], case="attack", environment="mitsuba"),
    ]
    return metrics.metrics_document({"name": "x"}, 7, drives, LANES, COST)


HEAD = """\
name = "test"
[scene]
field = "scene.safetensors"
deployment = "deployment.xml"
routes = "routes.json"
route = "lane"
[[objects]]
id = "hydrant"
field = "object.safetensors"
position_m = [1.0, 2.0, 0.0]
[policy]
file = "policy.safetensors"
"""


def write_named_files(folder):
    """Write files that have content, and no use."""
    for name in ("scene", "object", "policy"):
        (folder / f"{name}.safetensors").write_bytes(name.encode())
    (folder / "routes.json").write_text("{}")
    (folder / "deployment.xml").write_text('<scene version="3.0.0"/>')
