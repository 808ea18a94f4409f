"""What charts share: width, fonts, colours, and writing them as PNG files."""

from __future__ import annotations

import io
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import matplotlib
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from mi_nerfattack.io import files

WIDTH_PX = 1200
DPI = 150
BLUE, ORANGE, GREY = "#0072B2", "#D55E00", "#7f7f7f"  # Okabe and Ito 2008

RC: Any = {
    "font.family": "DejaVu Sans",
    "font.size": 9,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "savefig.facecolor": "white",
}


@contextmanager
def chart(path: str | Path, height_in: float) -> Iterator[Figure]:
    """Give a figure of the common width to draw in, and write it as PNG, atomically.

    Args:
        path: PNG file.
        height_in: height, inches of 150 pixels.
    """
    with matplotlib.rc_context(RC):
        figure = Figure((WIDTH_PX / DPI, height_in), DPI, layout="constrained")
        yield figure
        save(path, figure)


def save(path: str | Path, figure: Figure) -> None:
    """Write a figure as PNG, atomically; equal figures give equal bytes."""
    buffer = io.BytesIO()
    FigureCanvasAgg(figure).print_png(buffer, metadata={"Software": None})
    files.write_bytes(path, buffer.getvalue())
