"""Frames per second of a collection with several workers, over those with one."""

from __future__ import annotations

import statistics
import tempfile
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any

from mi_nerfattack.deploy.place import bundled_place
from mi_nerfattack.deploy.sites import PlaceSite, Weather
from mi_nerfattack.errors import InputError
from mi_nerfattack.system.workers import Processes
from mi_nerfattack.training.collect import collect
from mi_nerfattack.training.settings import CLONING, CollectSettings
from mi_nerfattack.vehicle.route.route import load_routes

#: Called with a stage's name, units done and wanted, and a remark.
OnStage = Callable[[str, int, int, str], None]

#: Ratio that is wanted of two workers on two cores.
WANTED = 1.7


@dataclass(frozen=True)
class Settings:
    """Sizes of the measurement.

    Args:
        environment: that is rendered, at the bundled intersection by day.
        frames: of one collection.
        warm: of these that are rendered before the clock starts, so that processes and
            scenes are there.
        shard: frames of a piece of work.
        workers: of the side that is compared with one worker.
        repeats: turns of both sides.
        spp: samples per pixel.
    """

    environment: str = "mitsuba"
    frames: int = 640
    warm: int = 128
    shard: int = 16
    workers: int = 2
    repeats: int = 3
    spp: int = 4

    def __post_init__(self) -> None:
        if not 0 < self.warm < self.frames:
            raise InputError(f"warm: {self.warm}; between 0 and {self.frames} frames")
        if self.workers < 2:
            raise InputError(f"workers: {self.workers}; at least 2 to compare with 1")


def run(settings: Settings, show: OnStage) -> dict[str, Any]:
    """Collect in turns with one worker and with several.

    A worker has one thread for rendering and one for torch, and so one core.

    Args:
        settings: see there.
        show: called often.

    Returns:
        Settings, frames per second of every turn and their medians, and the ratio.
    """
    rates: dict[int, list[float]] = {1: [], settings.workers: []}
    for turn in range(settings.repeats):
        for count, found in rates.items():
            stage = f"turn {turn + 1}, {count} workers"
            found.append(_rate(settings, count, stage, show))
    one, several = (statistics.median(rates[n]) for n in (1, settings.workers))
    return {
        "settings": asdict(settings),
        "wanted": WANTED,
        "frames_per_second": {str(count): found for count, found in rates.items()},
        "median": {"1": one, str(settings.workers): several},
        "ratio": several / one,
    }


def _rate(settings: Settings, count: int, stage: str, show: OnStage) -> float:
    """Collect into a folder that is thrown away; returns frames per second."""
    site = PlaceSite(settings.environment, bundled_place(), Weather(spp=settings.spp))
    wanted = CollectSettings(frames=settings.frames, shard=settings.shard)
    times = {}

    def note(done: int, total: int) -> None:
        times[done] = time.monotonic()
        show(stage, done, total, "frames")

    with tempfile.TemporaryDirectory() as folder:
        routes = load_routes(site.place.routes)
        collect(site, routes, CLONING, wanted, folder, Processes(count), note)
    seconds = times[settings.frames] - times[settings.warm]
    return (settings.frames - settings.warm) / seconds
