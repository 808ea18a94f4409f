"""How fast the policies' camera is rendered: one vehicle's, and many at a time."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from typing import Any

import drjit as dr
import mitsuba as mi

from bench.attack.drive import MOUNT, Job
from bench.render.sides import STOP
from mi_nerfattack import variant
from mi_nerfattack.deploy.surrogate.scene import field_sensor
from mi_nerfattack.fields import load_field, load_grid
from mi_nerfattack.render.posed import PosedField
from mi_nerfattack.rollout.scene_sensor import SceneSensor
from mi_nerfattack.scenes import bundled
from mi_nerfattack.vehicle.state import to_state

Progress = Callable[[str, int, int, str], None]


def run(
    size: tuple[int, int], batches: tuple[int, ...], repeats: int, progress: Progress
) -> dict[str, Any]:
    """Render the drive of `bench attack` at its start, composite of scene and object.

    Args:
        size: width and height of a frame, pixels.
        batches: vehicles, whose frames are rendered together.
        repeats: of each measurement; the median counts.
        progress: called with stage, batches done, all batches and a remark.

    Returns:
        a row a batch: frames a second, and Dr.Jit's memory at most; and the latency of
        one frame, from a state to an image in main memory.
    """
    document: dict[str, Any] = {"variant": variant.ensure(), "size_px": [*size]}
    sensor = _sensor(Job(*size, 1, 1))
    one = to_state(Job(*size, 1, 1).initial())
    sensor.observe(one, 0).image.numpy()  # compiles
    latencies = [
        _seconds(lambda: sensor.observe(one, 0).image.numpy()) for _ in range(repeats)
    ]
    document["latency_ms"] = 1e3 * statistics.median(latencies)
    document["batches"] = []
    for done, count in enumerate(batches):
        progress("frames", done, len(batches), f"{count} at a time")
        state = to_state(Job(*size, count, 1).initial())
        document["batches"].append(_row(sensor, state, repeats))
    progress("frames", len(batches), len(batches), "")
    return document


def _sensor(job: Job) -> SceneSensor:
    scene = PosedField(load_field(bundled("intersection/field.safetensors")))
    hydrant = load_grid(bundled("hydrant/field.safetensors"))
    items = [PosedField(hydrant, pose) for pose in job.object_poses()]
    return field_sensor(scene, items, job.camera, MOUNT, stop=STOP)


def _row(sensor: SceneSensor, state: Any, repeats: int) -> dict[str, float]:
    sensor.observe(state, 0)
    dr.sync_thread()
    dr.flush_malloc_cache()
    dr.detail.malloc_clear_statistics()
    seconds = [_seconds(lambda: sensor.observe(state, 0)) for _ in range(repeats)]
    count, median = dr.width(state), statistics.median(seconds)
    peak = dr.detail.malloc_watermark(dr.backend_v(mi.Float))
    return {
        "frames": count,
        "batch_ms": 1e3 * median,
        "frames_per_s": count / median,
        "drjit_peak_memory_mb": peak / 1e6,
    }


def _seconds(action: Callable[[], Any]) -> float:
    dr.sync_thread()
    start = time.perf_counter()
    action()
    dr.sync_thread()
    return time.perf_counter() - start
