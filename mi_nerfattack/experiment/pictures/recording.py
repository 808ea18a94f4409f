"""Frames of a drive as files: EXR with layers, and a recording that can be replayed."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from mi_nerfattack.capture.transforms import write_poses
from mi_nerfattack.deploy.environment import CameraFrame
from mi_nerfattack.io import exr, files
from mi_nerfattack.render.camera.intrinsics import Camera

_OURS = re.compile(r"[0-9]{4,}(_input)?\.(exr|png)|transforms\.json|depth\.safetensors")


class FrameFolder:
    """A folder that frames are written to, each as ``STEP.exr`` and ``STEP.png``.

    With ``transforms.json`` and ``depth.safetensors``, which :meth:`finish` writes, it
    is a recording for the environment `replay`. What an earlier run left is removed.

    Args:
        path: of the folder; made.
        camera: intrinsics of all frames.
    """

    def __init__(self, path: Path, camera: Camera) -> None:
        self.path, self.camera = files.make_folder(path), camera
        for found in list(self.path.iterdir()):
            if _OURS.fullmatch(found.name):
                found.unlink()
        self._names: list[str] = []
        self._times: list[float] = []
        self._poses: list[np.ndarray] = []
        self._depths: list[np.ndarray] = []

    def add(
        self,
        step: int,
        time_s: float,
        frame: CameraFrame,
        layers: Mapping[str, np.ndarray],
        metadata: Mapping[str, str],
        half: bool,
    ) -> None:
        """Write one frame; later ones come later.

        Args:
            step: control periods before it.
            time_s: seconds, likewise.
            frame: as it was seen.
            layers: for the EXR file. Those that are called ``input.K`` and have a size
                of their own go to ``STEP_input.exr``.
            metadata: of the EXR files.
            half: colour and opacity in half precision.
        """
        name = f"{step:04d}"
        files.write_image(self.path / f"{name}.png", frame.image)
        size = frame.depth.shape
        fitting = {key: a for key, a in layers.items() if a.shape[:2] == size}
        others = {key: a for key, a in layers.items() if key not in fitting}
        exr.write_layers(self.path / f"{name}.exr", fitting, metadata, half)
        if others:
            exr.write_layers(self.path / f"{name}_input.exr", others, metadata, half)
        self._names.append(f"{name}.png")
        self._times.append(time_s)
        self._poses.append(frame.camera_to_world)
        self._depths.append(frame.depth)

    def finish(self) -> None:
        """Write what makes a recording of the frames, poses and times last."""
        depth = np.stack(self._depths).astype(np.float32)
        files.write_safetensors(self.path / "depth.safetensors", {"depth": depth}, {})
        write_poses(
            self.path / "transforms.json",
            self._names,
            self.camera,
            np.stack(self._poses),
            {"units": "metre", "depth_file": "depth.safetensors"},
            self._times,
        )
