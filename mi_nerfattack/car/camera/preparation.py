"""What is done to a camera's frames before anybody sees them."""

from __future__ import annotations

from abc import ABC, abstractmethod

import numpy as np

from mi_nerfattack.errors import InputError
from mi_nerfattack.render.camera.intrinsics import Camera


class AbstractPreparation(ABC):
    """Makes the frames that a policy knows of those that a device gives.

    Attributes:
        camera: intrinsics of what is made.
        source_px: width and height of a device's frames.
    """

    camera: Camera
    source_px: tuple[int, int]

    @abstractmethod
    def apply(self, image: np.ndarray) -> np.ndarray:
        """Return what is made of a frame.

        Args:
            image: (height, width, 3), uint8 sRGB, of `source_px`.

        Returns:
            (camera.height, camera.width, 3), uint8 sRGB.
        """


class AsTheyCome(AbstractPreparation):
    """Leaves frames as they are.

    Args:
        camera: intrinsics of the device's frames.
    """

    def __init__(self, camera: Camera) -> None:
        self.camera, self.source_px = camera, (camera.width, camera.height)

    def apply(self, image: np.ndarray) -> np.ndarray:
        """Return the frame itself."""
        return image


def check_size(
    where: str, width: int, height: int, prepare: AbstractPreparation
) -> None:
    """Raise InputError, with `where`, if a device gives frames of another size."""
    if (width, height) != prepare.source_px:
        expected = " x ".join(map(str, prepare.source_px))
        raise InputError(
            f"{where}: frames of {width} x {height} px; needs {expected} px"
        )
