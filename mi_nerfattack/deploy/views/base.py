"""The interface of what renders a vehicle's camera images."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Any

import numpy as np

from mi_nerfattack.deploy.environment import CameraFrame
from mi_nerfattack.render.camera.intrinsics import Camera


class AbstractView(ABC):
    """Camera in a static world, moved from image to image.

    Attributes:
        camera: intrinsics.
    """

    camera: Camera

    @abstractmethod
    def render(self, camera_to_world: np.ndarray, seed: int) -> CameraFrame:
        """Render one frame.

        Args:
            camera_to_world: (4, 4), OpenCV axes, metres.
            seed: of the samples, in [0, 2^32).
        """

    @abstractmethod
    def show(self, objects: Sequence[Any]) -> None:
        """Show radiance fields in place of those shown before.

        Args:
            objects: PosedField each; may be empty.
        """

    @abstractmethod
    def close(self) -> None:
        """Let go of what a window or a process holds."""
