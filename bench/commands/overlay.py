"""``python -m bench overlay``: how long the overlay of a box takes a frame."""

from __future__ import annotations

import time
from dataclasses import dataclass

from mi_nerfattack.commands.shared.result import Result


@dataclass(frozen=True)
class BenchOverlay:
    """Time Overlay.apply on one core, at 366x188, over poses around a cube.

    All poses look at the cube from 1.2 to 8 edges away, through a distorted lens.
    Prints milliseconds, keyed and pasted. Exit code 1 unless the median is below 5 ms
    and the 99th percentile below 10 ms.
    """

    poses: int = 1000
    """Frames."""
    json: bool = False
    """Print one line of JSON in place of lines."""

    def run(self) -> Result:
        """Measure and print."""
        import cv2
        import numpy as np

        from mi_nerfattack import variant
        from mi_nerfattack.render.camera.intrinsics import Camera, look_at
        from mi_nerfattack.render.camera.pose import Pose
        from mi_nerfattack.robot.attacked import FACES, TEXTURE_PX, AttackedBox
        from mi_nerfattack.robot.overlay import Overlay

        variant.ensure()
        cv2.setNumThreads(1)
        rng = np.random.default_rng(0)
        size = TEXTURE_PX, TEXTURE_PX, 3
        images = {face: rng.integers(0, 256, size, np.uint8) for face in FACES}
        half = np.full(3, 0.5)
        box = AttackedBox("cube", "", "", -half, half, Pose.identity(), images)
        camera = Camera(366, 188, 190.0, 190.0, 183.0, 94.0, -0.2, 0.03)
        away = rng.normal(size=(self.poses, 3))
        away *= rng.uniform(1.2, 8, (self.poses, 1)) / np.linalg.norm(
            away, axis=1, keepdims=True
        )
        found = {}
        frame = np.full((188, 366, 3), (50, 170, 70), np.uint8)
        for name, keyed in (("keyed", True), ("pasted", False)):
            overlay, spent = Overlay(box, camera, keyed), []
            for eye in away:
                pose = look_at(eye, np.zeros(3))
                start = time.perf_counter()
                overlay.apply(frame, pose)
                spent.append(1e3 * (time.perf_counter() - start))
            median, most = np.quantile(spent, [0.5, 0.99]).round(2).tolist()
            found[name] = {"median_ms": median, "p99_ms": most}
        good = [v["median_ms"] < 5 and v["p99_ms"] < 10 for v in found.values()]

        def show() -> None:
            for name, times in found.items():
                print(f"{name}: {times['median_ms']} ms, 99 % {times['p99_ms']} ms")

        return Result(found, show, int(not all(good)))
