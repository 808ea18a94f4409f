"""A face of a box on a monitor, at its physical size: a picture and a page."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from PIL import Image

from mi_nerfattack.backend.colour import srgb_to_linear_numpy
from mi_nerfattack.capture.posed_images import resize_area
from mi_nerfattack.errors import InputError
from mi_nerfattack.props.net import MM
from mi_nerfattack.report.pages.elements import address, render

_MAX_PX = 16384


@dataclass(frozen=True)
class Screen:
    """A monitor; its density follows from size and pixels.

    Args:
        width_px, height_px: device pixels.
        diagonal_in: of what shows a picture, inches.
        aspect: width over height, metres by metres.
        gamma: exponent of its curve, or None for that of sRGB, which most follow.

    Raises:
        InputError: a number is out of range.
    """

    width_px: int = 2560
    height_px: int = 1440
    diagonal_in: float = 27.0
    aspect: float = 16 / 9
    gamma: float | None = None

    def __post_init__(self) -> None:
        if not (0 < self.width_px <= _MAX_PX and 0 < self.height_px <= _MAX_PX):
            size = f"{self.width_px}x{self.height_px}"
            raise InputError(f"--pixels: {size}; allowed are 1 to {_MAX_PX} an edge")
        for name, value in (
            ("diagonal-in", self.diagonal_in),
            ("aspect", self.aspect),
            ("gamma", 1.0 if self.gamma is None else self.gamma),
        ):
            if not 0 < value < math.inf:
                raise InputError(f"--{name}: {value}; must be positive and finite")

    @property
    def size_mm(self) -> tuple[float, float]:
        """Width and height."""
        height = self.diagonal_in * MM / math.hypot(self.aspect, 1)
        return self.aspect * height, height

    @property
    def px_per_mm(self) -> tuple[float, float]:
        """Density across and down."""
        width, height = self.size_mm
        return self.width_px / width, self.height_px / height


def screen_image(
    screen: Screen,
    face: np.ndarray,
    size_mm: tuple[float, float],
    background: tuple[int, int, int] = (0, 0, 0),
    longest_mm: float | None = None,
) -> np.ndarray:
    """Put a picture in the middle of a screen, at its size.

    Args:
        screen: the monitor.
        face: (h, w, 3), uint8 sRGB.
        size_mm: width and height that it is to have on the monitor.
        background: of the rest, as sent to the monitor.
        longest_mm: longest edge of the box that it is a face of, by which a message
            says what fits; that of the face by default.

    Returns:
        (height, width, 3), uint8, as sent to the monitor: sRGB, or of its gamma.

    Raises:
        InputError: it is larger than the screen, has no pixel, or a level of the
            background is out of range.
    """
    for edge_mm, most in zip(size_mm, screen.size_mm, strict=True):
        if not 0 < edge_mm <= most:
            wide, high = screen.size_mm
            share = min(wide / size_mm[0], high / size_mm[1])
            edge = math.floor(10 * share * (longest_mm or max(size_mm))) / 10
            raise InputError(
                f"--size-mm: the face is {size_mm[0]:.1f} x {size_mm[1]:.1f} mm, "
                f"the screen {wide:.1f} x {high:.1f} mm; give at most {edge:.1f} "
                "mm, of the box's longest edge, or a larger monitor (--diagonal-in)"
            )
    check_levels(background)
    width, height = (
        max(1, round(edge * density))
        for edge, density in zip(size_mm, screen.px_per_mm, strict=True)
    )
    shown = levels_sent(_resized(face, width, height), screen.gamma)
    image = np.empty((screen.height_px, screen.width_px, 3), np.uint8)
    image[:] = background
    top, left = (screen.height_px - height) // 2, (screen.width_px - width) // 2
    image[top : top + height, left : left + width] = shown
    return image


def check_levels(background: tuple[int, int, int]) -> None:
    """Raise InputError unless a background is of levels from 0 to 255."""
    if not all(0 <= level <= 255 for level in background):
        raise InputError(f"--background: {background}; three levels from 0 to 255")


def levels_sent(image: np.ndarray, gamma: float | None) -> np.ndarray:
    """Return what a picture, uint8 sRGB, is sent as to a monitor.

    Args:
        image: of any shape.
        gamma: exponent of the monitor's curve; None for that of sRGB.
    """
    if gamma is None:
        return image
    linear = srgb_to_linear_numpy(np.arange(256) / 255)
    return np.round(255 * linear ** (1 / gamma)).astype(np.uint8)[image]


def screen_page(image: np.ndarray, title: str) -> str:
    """Return a page of HTML that shows a picture pixel by pixel on a whole screen.

    It needs no other file. It says so on the screen as long as the browser's pixels are
    not the monitor's, or its window is not as large as the picture.

    Args:
        image: (height, width, 3), uint8, as sent to the monitor.
        title: of the page.
    """
    height, width = image.shape[:2]
    return render(
        "monitor.html.j2",
        title=title,
        width=width,
        height=height,
        background="#" + image[0, 0].tobytes().hex(),
        picture=address(Image.fromarray(image), "PNG"),
    )


def _resized(face: np.ndarray, width: int, height: int) -> np.ndarray:
    """Reduce by areas in linear light, or enlarge without steps."""
    if width <= face.shape[1] and height <= face.shape[0]:
        return resize_area(face, width, height)
    size = width, height
    return np.asarray(Image.fromarray(face).resize(size, Image.Resampling.BICUBIC))
