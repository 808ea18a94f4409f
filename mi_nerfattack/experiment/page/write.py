"""Read folders of results, whose files show their kind, and write their page."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from mi_nerfattack.errors import InputError
from mi_nerfattack.evaluation.metrics import cells
from mi_nerfattack.experiment.page.run import read_run
from mi_nerfattack.experiment.page.sweep import read_sweep
from mi_nerfattack.experiment.run_folder import SCENARIO, folder_labels
from mi_nerfattack.experiment.sweep.cell import CELLS
from mi_nerfattack.experiment.sweep.table import RESULTS
from mi_nerfattack.experiment.transfer.figures import DOCUMENT, QUALITY, read_document
from mi_nerfattack.io import files
from mi_nerfattack.report.pages.elements import (
    PageContents,
    RetrainPart,
    RunPart,
    TransferPart,
)
from mi_nerfattack.report.pages.results import write_results_page
from mi_nerfattack.report.plots import curves as plots
from mi_nerfattack.rollout.drive import ATTACK

_KINDS = (
    "give run folders of 'mi-nerfattack attack', folders of 'sweep' and 'transfer', "
    "and NAME-retrain.json of 'retrain'"
)
_KIND = re.compile(r"\.objects\[\d+\]\.kind")
_RETRAINED = {"policy", "runs", "held_out", "left_out", "table"}


def read_folders(
    paths: Sequence[Path],
    scratch: Path,
    on_run: Callable[[str], None] = lambda label: None,
) -> PageContents:
    """Read finished runs, sweeps, transfers and retrainings.

    Args:
        paths: folders, and files of retrainings.
        scratch: folder for plots that are made for the page.
        on_run: called with the label of each run before the run is read and its
            objects are rendered.

    Raises:
        InputError: none or one twice, one is of another kind or not finished, or a
            file is damaged.
    """
    if not paths or len({path.resolve() for path in paths}) < len(paths):
        raise InputError("FOLDER: at least one, each once")
    runs, sweeps, transfers, retrainings = [], [], [], []
    for path, label in zip(paths, folder_labels(paths), strict=True):
        if (path / RESULTS).is_file():
            sweeps.append(read_sweep(path, label, scratch, on_run=on_run))
        elif (path / DOCUMENT).is_file():
            transfers.append(_transfer(path, label))
        elif path.is_file():
            retrainings.append(_retraining(path))
        elif (path / SCENARIO).is_file():
            on_run(label)
            runs.append(read_run(path, label))
        elif (path / CELLS).is_dir():
            raise InputError(
                f"{path}: is of a sweep of which no cell is done, {RESULTS} is "
                "missing; the sweep's command goes on with it"
            )
        else:
            raise InputError(f"{path}: holds no results; {_KINDS}")
    return PageContents(runs, sweeps, transfers, retrainings=retrainings)


def _transfer(folder: Path, label: str) -> TransferPart:
    quality = folder / QUALITY
    document = read_document(folder)
    return TransferPart(label, document, quality if quality.is_file() else None)


def _retraining(path: Path) -> RetrainPart:
    document = files.read_json(path)
    if not isinstance(document, dict) or not document.keys() >= _RETRAINED:
        raise InputError(f"{path}: is not of 'mi-nerfattack retrain'; {_KINDS}")
    return RetrainPart(path.name.removesuffix("-retrain.json"), document)


_MOST_BYTES = 1 << 28  # of a plot
#: Parts of a scenario that decide how an attack searched, not what it attacked.
_SEARCHED = ("name", "seed", "attack", "baseline")
#: Keys of `[attack.freedom]` that limit textures, and their largest values.
_LIMITS = {"linf": 1.0, "l2": 1.0}


def write_page(
    path: Path, contents: PageContents, scratch: Path, title: str | None = None
) -> None:
    """Write one HTML file, atomically.

    Plots that were made in other formats, too, go to the folder ``NAME_plots`` next
    to it.

    Args:
        path: of the file.
        contents: what it shows.
        scratch: folder for plots that are made for the page.
        title: of the page; names of what it shows by default.
    """
    damage = {**_damage(scratch, contents), **_by_limit(scratch, contents)}
    write_results_page(
        path, title or _title(contents), replace(contents, damage=damage)
    )
    for sweep in contents.sweeps:
        damage |= {f"{sweep.label} {key}": own for key, own in sweep.pictures.items()}
    for key, picture in damage.items():
        for plot in (picture.with_suffix(".pdf"), picture.with_suffix(".svg")):
            if plot.is_file():
                name = re.sub(r"[^A-Za-z0-9-]+", "_", key) + plot.suffix
                folder = files.make_folder(path.with_name(f"{path.stem}_plots"))
                files.write_bytes(folder / name, files.read_bytes(plot, _MOST_BYTES))


def _title(contents: PageContents) -> str:
    names = [run.document["scenario"]["name"] for run in contents.runs]
    groups = contents.sweeps, contents.transfers, contents.retrainings
    for word, group in zip(("sweep", "transfer", "retraining"), groups, strict=True):
        labels = [part.label for part in group]
        names += [x if x.startswith(word) else f"{word} {x}" for x in labels]
    names = list(dict.fromkeys(names))
    return ", ".join(names) if len(names) < 4 else f"{len(names)} results"


def _settings(contents: PageContents, deployed: bool) -> dict[str, list[RunPart]]:
    """Return the runs by what decides about their drives, in the page's order.

    Args:
        contents: of the page.
        deployed: whether drives in deployments count.
    """
    runs: dict[str, list[RunPart]] = {}
    for run in contents.runs:
        runs.setdefault(_setting(run, deployed), []).append(run)
    return runs


def _setting(run: RunPart, deployed: bool) -> str:
    """Return what decides about a run's drives but not how its attack searched.

    Scene, objects and their places, policy, camera, vehicle, starts and objective;
    files count by their checksums.
    """
    without = _SEARCHED if deployed else (*_SEARCHED, "deployment")
    scenario = run.document["scenario"].items()
    values = dict(_values("", {k: v for k, v in scenario if k not in without}))
    # The kind of an object that is a file; older runs do not say it
    values = {k: v for k, v in values.items() if not (_KIND.match(k) and v == "field")}
    for key, digest in run.digests.items():
        name = f".{key.partition(': ')[0]}"
        if name.startswith(tuple(f".{section}" for section in without)):
            continue
        values[name] = digest
    return json.dumps(values, sort_keys=True)


def _values(name: str, value: Any) -> Iterator[tuple[str, Any]]:
    """Yield the values of a document by names such as ``.objects[0].field``."""
    if isinstance(value, dict):
        for key, item in value.items():
            yield from _values(f"{name}.{key}", item)
    elif isinstance(value, list) and any(isinstance(item, dict) for item in value):
        for index, item in enumerate(value):
            yield from _values(f"{name}[{index}]", item)
    else:
        yield name, value


def _groups(contents: PageContents, deployed: bool) -> dict[str, PageContents]:
    """Split runs and sweeps so that the attacks of a part may share a curve.

    Args:
        contents: of the page.
        deployed: as of :func:`_settings`.

    Returns:
        by what follows the title of a plot: runs of one setting, or one sweep, which
        has one policy and vehicle; nothing follows where there is one part.
    """
    groups = {
        f": {', '.join(run.label for run in own)}": PageContents(runs=own)
        for own in _settings(contents, deployed).values()
    }
    groups |= {
        f": {sweep.label}": PageContents(sweeps=[sweep]) for sweep in contents.sweeps
    }
    return groups if len(groups) > 1 else dict.fromkeys([""], contents)


def _damage(scratch: Path, contents: PageContents) -> dict[str, Path]:
    """Plot what attacks found against its cost, a plot for each group and route."""
    pictures = {}
    for name, part in _groups(contents, deployed=False).items():
        routes: dict[str, dict[str, plots.Curves]] = {}
        for route, method, curve in _curves(part):
            if curve is not None:
                routes.setdefault(route, {}).setdefault(method, []).append(curve)
        for route, methods in routes.items():
            if sum(map(len, methods.values())) > 1:
                path = scratch / f"damage_{len(pictures)}.png"
                plots.damage(path, methods)
                pictures[f"Damage against frames, {route}{name}"] = path
    return pictures


def _curves(contents: PageContents) -> Iterator[tuple[str, str, Any]]:
    """Yield route, method and curve of every attack; of a sweep, objects too."""
    for run in contents.runs:
        for route in run.document["routes"]:
            method = run.document["scenario"]["attack"]["method"]["kind"]
            yield route, method, run.document.get("curve")
    for sweep in contents.sweeps:
        attacks = sweep.document["attacks"]
        several = len({attack["objects"] for attack in attacks}) > 1
        for attack in attacks:
            words = attack["method"], attack["budget"]
            method = " ".join(str(word) for word in words if word is not None)
            objects = f", {attack['objects']}" if several else ""
            yield f"{attack['route']}{objects}", method, attack["curve"]


def _by_limit(scratch: Path, contents: PageContents) -> dict[str, Path]:
    """Plot what attacks did against what their textures might change, by group."""
    pictures = {}
    for name, part in _groups(contents, deployed=True).items():
        for key, most in _LIMITS.items():
            points: dict[str, list[tuple[float, float]]] = {}
            for line, attack, error in _attacked(part):
                limit = attack["freedom"].get(key)
                at = most if limit is None else limit
                points.setdefault(line, []).append((at, error))
            if len({at for own in points.values() for at, _ in own}) > 1:
                path = scratch / f"limit_{len(pictures)}_{key}.png"
                label = f"attack.freedom.{key}, sRGB (without one: {most:g})"
                plots.against_limit(path, label, points)
                pictures[f"Damage against the texture's budget, {key}{name}"] = path
    return pictures


def _attacked(contents: PageContents) -> Iterator[tuple[str, Mapping[str, Any], float]]:
    """Yield line, section `attack` and mean error of every attack in an environment.

    A line is of one route, environment and method; of a sweep, of one kind of objects
    and one budget.
    """
    for run in contents.runs:
        section = run.document["scenario"]["attack"]
        for row in cells(run.document["routes"], "route", "environment"):
            if ATTACK in row:
                line = f"{row['route']}, {row['environment']}"
                error = row[ATTACK]["cross_track_mean_m"]
                yield f"{line}, {section['method']['kind']}", section, error
    for sweep in contents.sweeps:
        for row in sweep.attacks:
            if ATTACK in row["cases"] and row["section"] is not None:
                words = [row[k] for k in ("route", "objects", "environment", "method")]
                if row["budget"] is not None:
                    words.append(f"{row['budget']:.0f} frames")
                yield ", ".join(words), row["section"], row["cases"][ATTACK]
