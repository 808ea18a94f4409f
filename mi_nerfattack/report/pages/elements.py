"""HTML pages from the templates of this folder, their parts and their pictures."""

from __future__ import annotations

import base64
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup
from PIL import Image

from mi_nerfattack.io import files
from mi_nerfattack.rollout.drive import ATTACK, NO_OBJECT, RANDOM

_EXACT_BYTES = 200_000  # on a page, of an image whose pixels are kept as they are
_QUALITY = 85  # of larger ones
#: Largest width of a picture; wider ones are made smaller.
WIDTH_PX = 336
SHEET_QUALITY = 70  # of WebP
_MOST_PX = 16_383  # of an edge, in WebP


def render(template: str, **values: Any) -> str:
    """Fill in a template; every value is escaped.

    Args:
        template: ``NAME.html.j2`` in the folder `templates`.
        values: all that it names.
    """
    return _HTML.get_template(template).render(values)


def address(image: Image.Image, kind: str = "WEBP", **options: Any) -> Markup:
    """Return the address of an image that holds it, a `data:` URI.

    Args:
        image: sRGB.
        kind: of Pillow's formats.
        options: of its writer.
    """
    buffer = io.BytesIO()
    image.save(buffer, kind, **options)
    data = base64.b64encode(buffer.getvalue()).decode("ascii")
    return Markup(f"data:image/{kind.lower()};base64,{data}")


def _embedded(path: str | Path) -> Markup:
    """Return the attributes of `img` that show a file.

    Its pixels are exact, unless that takes too much room.
    """
    image = Image.fromarray(files.read_image(path))
    source = address(image, lossless=True, quality=60, method=3)
    if len(source) > _EXACT_BYTES:
        source = address(image, quality=_QUALITY)
    size = 'width="{0}" height="{1}" style="--w: {0}" src="{2}"'
    return Markup(size).format(*image.size, source)


@dataclass(frozen=True)
class Pane:
    """One of several panes whose pictures change together.

    Attributes:
        title: above the pictures.
        alt: describes the pictures to readers who cannot see them.
        sheet: address of one image that holds all pictures, below each other.
        width: of a picture, pixels.
        height: of a picture, pixels.
        labels: one line per picture.
    """

    title: str
    alt: str
    sheet: Markup
    width: int
    height: int
    labels: tuple[str, ...]


@dataclass(frozen=True)
class Scrubber:
    """Panes next to each other, each with the same number of pictures.

    Attributes:
        title: above all panes.
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
    return Pane(
        title,
        alt,
        address(sheet, quality=SHEET_QUALITY),
        width=size[0],
        height=size[1],
        labels=tuple(labels),
    )


_HTML = Environment(
    loader=PackageLoader("mi_nerfattack.report.pages"),
    autoescape=True,
    undefined=StrictUndefined,
    trim_blocks=True,
    lstrip_blocks=True,
    keep_trailing_newline=True,
)
_HTML.filters["embedded"] = _embedded


#: Cases that stand beside each other.
SHOWN_CASES = (NO_OBJECT, RANDOM, ATTACK)
#: Sections of a page that have pictures of each run, with what the folder may lack.
ABOVE, COST, FRAMES, TEXTURES, WHEN = "above", "cost", "seen", "textures", "when"


@dataclass(frozen=True, eq=False)
class RunPart:
    """A finished run, as a page shows it.

    Attributes:
        label: name of the run, different from the names of other runs.
        document: as of `metrics.metrics_document`, with all that follows.
        scenario: the scenario file as run.
        made_with: version of each program by its name.
        digests: SHA-256 of files by their keys.
        repeat: the command that makes the run again.
        pictures: image files by title, by section.
        scrubbers: by section.
        missing: by section, why it is empty, and which command fills it.
    """

    label: str
    document: Mapping[str, Any]
    scenario: str
    made_with: Mapping[str, str]
    digests: Mapping[str, str]
    repeat: str
    pictures: Mapping[str, Mapping[str, Path]]
    scrubbers: Mapping[str, Sequence[Scrubber]]
    missing: Mapping[str, str]


@dataclass(frozen=True, eq=False)
class SweepPart:
    """A sweep.

    Attributes:
        label: name of the sweep, different from the names of other sweeps.
        document: as of `sweep.summary.summarise`.
        attacks: one row per cell and environment: labels, figures by case, and the
            command that repeats the cell.
        shown: one cell per route and method, the cell of middle damage.
        pictures: image files by title.
        notes: what is missing, and which command makes it.
    """

    label: str
    document: Mapping[str, Any]
    attacks: Sequence[dict[str, Any]]
    shown: Sequence[RunPart]
    pictures: Mapping[str, Path]
    notes: Sequence[str]


@dataclass(frozen=True, eq=False)
class TransferPart:
    """A transfer.

    Attributes:
        label: name of the transfer, different from the names of other transfers.
        document: whole, as of `transfer.figures.make_document`.
        quality: plot against the quality of surrogates, None without.
    """

    label: str
    document: Mapping[str, Any]
    quality: Path | None


@dataclass(frozen=True, eq=False)
class RetrainPart:
    """A retraining.

    Attributes:
        label: name of the retraining, different from the names of other retrainings.
        document: with `table`, of `retrain.compare.table_rows`.
    """

    label: str
    document: Mapping[str, Any]


@dataclass(frozen=True, eq=False)
class PageContents:
    """All that a page shows.

    Attributes:
        runs: that the user names one by one, not through a sweep.
        sweeps: that the user names.
        transfers: that the user names.
        retrainings: that the user names.
        damage: plots of several attacks by title.
    """

    runs: Sequence[RunPart] = ()
    sweeps: Sequence[SweepPart] = ()
    transfers: Sequence[TransferPart] = ()
    retrainings: Sequence[RetrainPart] = ()
    damage: Mapping[str, Path] = field(default_factory=dict)

    @property
    def shown(self) -> list[RunPart]:
        """Runs of which there are pictures: all that were named, some of each sweep."""
        return [*self.runs, *(run for sweep in self.sweeps for run in sweep.shown)]
