"""The cameras of a vehicle, whose images lie side by side in one frame.

All that handles frames (films, batches, derivatives, recordings) handles one image. A
policy takes it apart again, by :meth:`Rig.split`. Needs NumPy alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from mi_nerfattack.errors import InputError
from mi_nerfattack.render.camera.intrinsics import Camera, CameraMount

#: What the only camera is called where nothing names it.
ONLY = "camera"


@dataclass(frozen=True)
class Layout:
    """Images side by side in a frame, the first one at the left.

    The frame is as high as the highest of them; below the others it is black.

    Attributes:
        sizes: width and height of each image, pixels.
    """

    sizes: tuple[tuple[int, int], ...]

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of the frame, pixels."""
        widths, heights = zip(*self.sizes, strict=True)
        return sum(widths), max(heights)

    @property
    def columns(self) -> tuple[slice, ...]:
        """The columns of each image."""
        ends = np.cumsum([width for width, _ in self.sizes]).tolist()
        widths = (width for width, _ in self.sizes)
        return tuple(slice(b - w, b) for w, b in zip(widths, ends, strict=True))

    def split(self, frame: Any) -> list[Any]:
        """Return the images of a frame, by slices alone: derivatives pass.

        Args:
            frame: array of NumPy, or tensor of PyTorch or Dr.Jit, (..., height, width,
                channels).

        Raises:
            InputError: the frame has another size.
        """
        width, height = self.size
        if tuple(frame.shape[-3:-1]) != (height, width):
            raise InputError(
                f"frame: {frame.shape[-2]} x {frame.shape[-3]} px; the cameras' images "
                f"side by side have {width} x {height} px"
            )
        if len(self.sizes) == 1:
            return [frame]
        rows = (slice(high) for _, high in self.sizes)
        pairs = zip(rows, self.columns, strict=True)
        return [frame[..., row, column, :] for row, column in pairs]

    def join(self, images: Sequence[np.ndarray], below: float = 0) -> np.ndarray:
        """Lay images (..., height, width, channels) side by side.

        Args:
            images: of all cameras.
            below: value under those that are lower than the frame.
        """
        if len(images) == 1:
            return images[0]
        first, (width, height) = images[0], self.size
        shape = (*first.shape[:-3], height, width, first.shape[-1])
        frame = np.full(shape, below, first.dtype)
        for image, column in zip(images, self.columns, strict=True):
            frame[..., : image.shape[-3], column, :] = image
        return frame


@dataclass(frozen=True)
class Rig:
    """The cameras of a vehicle.

    Args:
        names: of the cameras, each another one.
        cameras: intrinsics of each.
        mounts: where each sits on the vehicle.

    Raises:
        InputError: there is no camera, their numbers differ, or a name comes twice.
    """

    names: tuple[str, ...]
    cameras: tuple[Camera, ...]
    mounts: tuple[CameraMount, ...]

    def __post_init__(self) -> None:
        counts = {len(self.names), len(self.cameras), len(self.mounts)}
        if counts & {0} or len(counts) > 1:
            raise InputError(
                f"rig: {len(self.names)} names, {len(self.cameras)} cameras and "
                f"{len(self.mounts)} mounts; one of each for every camera"
            )
        if len(set(self.names)) < len(self.names):
            raise InputError(f"rig: cameras {', '.join(self.names)}; names must differ")

    @classmethod
    def of_one(cls, camera: Camera, mount: CameraMount, name: str = ONLY) -> Rig:
        """Return the rig of one camera."""
        return cls((name,), (camera,), (mount,))

    @property
    def layout(self) -> Layout:
        """How the images lie in a frame."""
        return Layout(tuple((each.width, each.height) for each in self.cameras))

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of a frame, pixels."""
        return self.layout.size

    @property
    def columns(self) -> dict[str, slice]:
        """The columns of each image in a frame, by name."""
        return dict(zip(self.names, self.layout.columns, strict=True))

    @property
    def views(self) -> dict[str, tuple[slice, slice]]:
        """Rows and columns of each named image; none of an only camera without name."""
        if self.names == (ONLY,):
            return {}
        rows = (slice(0, camera.height) for camera in self.cameras)
        places = zip(rows, self.layout.columns, strict=True)
        return dict(zip(self.names, places, strict=True))

    def split(self, frame: Any) -> dict[str, Any]:
        """Return the images of a frame by name, see `Layout`; slices alone."""
        return dict(zip(self.names, self.layout.split(frame), strict=True))

    def join(self, images: dict[str, np.ndarray], below: float = 0) -> np.ndarray:
        """Lay images by name side by side, with `below` under lower ones."""
        return self.layout.join([images[name] for name in self.names], below)

    @property
    def others(self) -> Rig | None:
        """All cameras but the first; None where it is alone."""
        if len(self.names) == 1:
            return None
        return Rig(self.names[1:], self.cameras[1:], self.mounts[1:])

    def __add__(self, other: Rig) -> Rig:
        """Return the cameras of both."""
        return Rig(
            self.names + other.names,
            self.cameras + other.cameras,
            self.mounts + other.mounts,
        )

    def on(self, mounts: Sequence[CameraMount]) -> Rig:
        """Return the same cameras at other places on the vehicle."""
        return replace(self, mounts=tuple(mounts))

    def require_one(self, where: str, remedy: str) -> None:
        """Raise InputError where only one camera can be taken.

        Args:
            where: what takes one.
            remedy: what to do.
        """
        if len(self.names) > 1:
            raise InputError(
                f"{where}: takes one camera, and the vehicle has {len(self.names)} "
                f"({', '.join(self.names)}); {remedy}"
            )

    def described(self) -> list[dict[str, Any]]:
        """Return all cameras as JSON, for what a result depends on."""
        return [
            {"name": name, "camera": dict(vars(camera)), "mount": mount.described()}
            for name, camera, mount in zip(
                self.names, self.cameras, self.mounts, strict=True
            )
        ]


def camera_seed(seed: int, index: int) -> int:
    """Return the seed of one of the cameras: the first one's is the seed itself.

    Args:
        seed: of all cameras.
        index: of the camera, from 0.

    Returns:
        a number of 32 bits, for all but the first.
    """
    if index == 0:
        return seed
    return int(np.random.SeedSequence([seed, index]).generate_state(1)[0])
