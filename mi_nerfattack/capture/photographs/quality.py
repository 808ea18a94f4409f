"""What each photograph gave to a reconstruction, and which to take again."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from mi_nerfattack.capture.colmap.reconstruct import Structure
from mi_nerfattack.capture.coverage import FAR_DEG, view_gaps
from mi_nerfattack.capture.photographs.frames import measure_sharpness
from mi_nerfattack.io import files

_SMALL_PX = 800  # longer edge at which sharpness is measured
_NEIGHBOURS = 5  # on either side, by name, that sharpness is compared with
_BLURRED = 0.3  # of the neighbours' median sharpness
_ALONE_DEG = 2 * FAR_DEG
_FEW_FEATURES, _FEW_POINTS = 200, 50
FEW_PLACED = 0.8
"""Share of placed photographs below which a set deserves advice."""


@dataclass(frozen=True)
class Quality:
    """What one photograph gave.

    Attributes:
        name: of the photograph.
        placed: whether it has a pose.
        features: found in it.
        points: of the reconstruction that it shows; 0 if it was not placed.
        error_px: mean reprojection error of these; None if it was not placed.
        sharpness: variance of the Laplacian by the median of its neighbours'.
        gap_deg: how far the next view of the same is, see `view_gaps`; None if it was
            not placed.
    """

    name: str
    placed: bool
    features: int
    points: int
    error_px: float | None
    sharpness: float
    gap_deg: float | None = None

    def faults(self) -> list[str]:
        """Say why to take it again; nothing if it is good."""
        return [
            text
            for text, is_so in (
                ("not placed", not self.placed),
                (
                    f"blurred ({self.sharpness:.2f} of its neighbours' sharpness)",
                    self.sharpness < _BLURRED,
                ),
                (f"few features ({self.features})", self.features < _FEW_FEATURES),
                (
                    f"few points ({self.points})",
                    self.placed and self.points < _FEW_POINTS,
                ),
                (
                    f"alone, {self.gap_deg or 0:.0f} degrees from the next view: "
                    "take more beside it",
                    self.gap_deg is not None and self.gap_deg > _ALONE_DEG,
                ),
            )
            if is_so
        ]


def assess(
    folder: Path, names: Sequence[str], structure: Structure
) -> tuple[Quality, ...]:
    """Tell what photographs gave to a reconstruction.

    Args:
        folder: of the photographs.
        names: of all of them, in order.
        structure: what came of them.
    """
    sharpness = np.array([_sharpness_of(folder / name) for name in names])
    gaps = view_gaps(
        structure.cameras, structure.camera_to_world, structure.points
    ).tolist()
    of_each = zip(structure.points_seen, structure.errors_px, gaps, strict=True)
    measures = dict(zip(structure.names, of_each, strict=True))
    result = []
    for i, name in enumerate(names):
        near = sharpness[max(0, i - _NEIGHBOURS) : i + _NEIGHBOURS + 1]
        median = float(np.median(near))
        points, error, gap = measures.get(name, (0, None, None))
        relative = float(sharpness[i]) / median if median > 0 else 1.0
        features = structure.features.get(name, 0)
        result.append(
            Quality(
                name=name,
                placed=name in measures,
                features=features,
                points=points,
                error_px=error,
                sharpness=relative,
                gap_deg=gap,
            )
        )
    return tuple(result)


def _sharpness_of(path: Path) -> float:
    image = Image.fromarray(files.read_image(path)[..., :3]).convert("L")
    image.thumbnail((_SMALL_PX, _SMALL_PX))
    return measure_sharpness(np.asarray(image))


def retake(qualities: Sequence[Quality]) -> dict[str, str]:
    """Return the photographs to take again, with why."""
    faults = {quality.name: quality.faults() for quality in qualities}
    return {name: ", ".join(why) for name, why in faults.items() if why}


def median_gap(qualities: Sequence[Quality]) -> float | None:
    """Return the median gap of the photographs that were placed, degrees."""
    gaps = [quality.gap_deg for quality in qualities if quality.gap_deg is not None]
    return float(np.median(gaps)) if gaps else None


def quality_table(
    structure: Structure, qualities: Sequence[Quality], scale: Mapping[str, Any]
) -> dict[str, Any]:
    """Return what `capture.json` holds."""
    placed = sum(quality.placed for quality in qualities)
    return {
        "photographs": len(qualities),
        "placed": placed,
        "placed_share": placed / len(qualities),
        "reprojection_error_px": structure.error_px,
        "cameras": len(set(structure.cameras)),
        "points": len(structure.points),
        "gap_deg": median_gap(qualities),
        "scale": dict(scale),
        "retake": retake(qualities),
        "frames": [asdict(quality) for quality in qualities],
    }
