"""Pictures that a reader scrubs through: side by side, by a slider, on a page."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from markupsafe import Markup
from PIL import Image

from mi_nerfattack.report.pages.elements import address

#: Largest width of a picture; wider ones are made smaller.
WIDTH_PX = 336
QUALITY = 70  # of WebP
_MOST_PX = 16_383  # of an edge, in WebP


@dataclass(frozen=True)
class Pane:
    """One of the pictures that change together.

    Attributes:
        title: above it.
        alt: what is to be seen, for those who cannot see it.
        sheet: address of one image that holds all pictures, below each other.
        width: of a picture, pixels.
        height: likewise.
        labels: a line a picture.
    """

    title: str
    alt: str
    sheet: Markup
    width: int
    height: int
    labels: tuple[str, ...]


@dataclass(frozen=True)
class Scrubber:
    """Panes of as many pictures each, beside each other.

    Attributes:
        title: of them all.
        panes: at least one.
        start: index of the picture that is shown first.
        period_s: seconds that a picture is shown for when they play.
    """

    title: str
    panes: tuple[Pane, ...]
    start: int
    period_s: float

    @property
    def count(self) -> int:
        """Pictures of a pane."""
        return len(self.panes[0].labels)

    @property
    def size_kb(self) -> int:
        """Of all pictures, on the page."""
        return round(sum(len(pane.sheet) for pane in self.panes) / 1000)


def make_pane(
    title: str, alt: str, images: Sequence[np.ndarray], labels: Sequence[str]
) -> Pane:
    """Lay pictures below each other in one image.

    Args:
        title: of the pane.
        alt: what is to be seen.
        images: sRGB, (height, width, 3), uint8, of one size; at least one. Those wider
            than `WIDTH_PX`, or too tall to lie in one image, are made smaller.
        labels: a line an image.
    """
    height, width = images[0].shape[:2]
    scale = min(1.0, WIDTH_PX / width, _MOST_PX // len(images) / height)
    size = max(1, int(width * scale)), max(1, int(height * scale))
    sheet = Image.new("RGB", (size[0], size[1] * len(images)))
    for number, image in enumerate(images):
        shown = Image.fromarray(image[..., :3])
        if shown.size != size:
            shown = shown.resize(size, Image.Resampling.LANCZOS)
        sheet.paste(shown, (0, size[1] * number))
    return Pane(title, alt, address(sheet, quality=QUALITY), *size, tuple(labels))
