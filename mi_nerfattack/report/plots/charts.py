"""What charts share: width, fonts, colours, and writing them to files."""

from __future__ import annotations

import io
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import matplotlib
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from mi_nerfattack.errors import InputError
from mi_nerfattack.io import files

#: Environment variable with formats in which charts are written next to the PNG files.
VARIABLE = "MI_NERFATTACK_PLOTS"
#: Formats with the metadata that would differ between equal charts.
_VECTOR = {"pdf": "CreationDate", "svg": "Date"}
WIDTH_PX = 1200
DPI = 150
#: After Okabe and Ito 2008.
BLUE, ORANGE, GREEN, PINK = "#0072B2", "#D55E00", "#009E73", "#CC79A7"
YELLOW, SKY, GREY = "#E69F00", "#56B4E9", "#7f7f7f"
PALETTE = BLUE, ORANGE, GREEN, PINK, YELLOW, SKY

RC: Any = {
    "font.family": "DejaVu Sans",
    "font.size": 9,
    "axes.titlelocation": "left",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "savefig.facecolor": "white",
    "pdf.fonttype": 42,  # TrueType, as journals ask
    "svg.hashsalt": "mi_nerfattack",  # equal charts are equal files
}


@contextmanager
def chart(path: str | Path, height_in: float) -> Iterator[Figure]:
    """Give a figure of the common width to draw in, and write it as PNG, atomically.

    Args:
        path: PNG file.
        height_in: height, inches of 150 pixels.
    """
    with blank((WIDTH_PX / DPI, height_in), DPI) as figure:
        yield figure
        save(path, figure)


@contextmanager
def blank(size_in: tuple[float, float], dpi: float) -> Iterator[Figure]:
    """Give a figure to draw in; it is not written."""
    with matplotlib.rc_context(RC):
        yield Figure(size_in, dpi, layout="constrained")


def save(path: str | Path, figure: Figure) -> None:
    """Write a figure as PNG, and in the formats of `VARIABLE`, atomically.

    Raises:
        InputError: the variable names another format.
    """
    files.write_bytes(path, png(figure))
    for suffix in os.environ.get(VARIABLE, "").lower().replace(",", " ").split():
        if suffix not in _VECTOR:
            raise InputError(f"{VARIABLE}: {suffix!r}; must be pdf, svg, or both")
        buffer = io.BytesIO()
        figure.savefig(buffer, format=suffix, metadata={_VECTOR[suffix]: None})
        files.write_bytes(Path(path).with_suffix(f".{suffix}"), buffer.getvalue())


def png(figure: Figure) -> bytes:
    """Return a figure as a PNG file; equal figures give equal bytes."""
    buffer = io.BytesIO()
    FigureCanvasAgg(figure).print_png(buffer, metadata={"Software": None})
    return buffer.getvalue()
