"""Whether a fitted field is good enough to test a policy in, by stated criteria."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mi_nerfattack.capture.evaluation import HAZY, ViewScore

MIN_PSNR_DB = 24.0  # mean over held-out views
MIN_WORST_DB = 18.0  # of any held-out view
MAX_GAP_DB = 5.0  # fitted less held-out views
MAX_HAZY = 0.10  # share of rays, mean over held-out views
MIN_VIEWS = 3  # held-out views that a mean is worth something from


@dataclass(frozen=True)
class Criterion:
    """One thing that was measured and what it should be.

    Attributes:
        name: what was measured, with its unit.
        value: as measured.
        limit: of the value.
        at_least: whether the limit is the least good value, or else the greatest.
        advice: what helps if it is not met.
    """

    name: str
    value: float
    limit: float
    at_least: bool
    advice: str

    @property
    def met(self) -> bool:
        """Whether the value lies on the good side of the limit."""
        if self.at_least:
            return self.value >= self.limit
        return self.value <= self.limit


def pooled_db(psnr_db: Sequence[float]) -> float:
    """Return the PSNR of the mean of the squared errors that PSNRs stand for."""
    error = float(np.mean(10 ** (-0.1 * np.asarray(psnr_db, np.float64))))
    return float("inf") if error == 0 else -10 * float(np.log10(error))


def judge(
    scores: Sequence[ViewScore], fitted_db: float | None = None
) -> list[Criterion]:
    """Judge a fit by its held-out views.

    Args:
        scores: of the held-out views, at least one.
        fitted_db: PSNR of the rays fitted to, at the end of the fit; None if unknown.
    """
    gap = [] if fitted_db is None else [_gap(scores, fitted_db)]
    return [*_criteria(scores), *gap]


def _gap(scores: Sequence[ViewScore], fitted_db: float) -> Criterion:
    pooled = pooled_db([score.psnr_db for score in scores])
    return Criterion(
        "PSNR of fitted rays less that of held-out ones (dB)",
        0.0 if pooled == fitted_db else fitted_db - pooled,  # both may be infinite
        MAX_GAP_DB,
        False,
        "The field has learnt images, not the place: add images between the "
        "present ones, refine the poses, or take a smaller network.",
    )


def _criteria(scores: Sequence[ViewScore]) -> list[Criterion]:
    psnr = [score.psnr_db for score in scores]
    return [
        Criterion(
            "held-out views",
            len(scores),
            MIN_VIEWS,
            True,
            "Take more images: every 8th is held out, and so few say little.",
        ),
        Criterion(
            "mean PSNR of held-out views (dB)",
            float(np.mean(psnr)),
            MIN_PSNR_DB,
            True,
            "Fit for longer, or check poses, intrinsics and blurred images.",
        ),
        Criterion(
            "PSNR of the worst held-out view (dB)",
            float(min(psnr)),
            MIN_WORST_DB,
            True,
            "Look at the worst views: add images where they were taken, and leave "
            "out images with a wrong pose, blur, or things that moved.",
        ),
        Criterion(
            f"share of rays with an opacity from {HAZY[0]:g} to {HAZY[1]:g}",
            float(np.mean([score.hazy for score in scores])),
            MAX_HAZY,
            False,
            "Fog or thin floaters: add depth or views from other sides, or narrow the "
            "bounds; depths and occlusion by objects are unsure until then.",
        ),
    ]


def verdict(criteria: Sequence[Criterion]) -> str:
    """Say in words what the criteria come to."""
    failed = [item for item in criteria if not item.met]
    if not failed:
        return (
            "Good enough to test a policy in, as far as these views tell: near the "
            "cameras and from heights and headings like theirs. Where there is a "
            "scene to deploy in, compare with it along the routes too."
        )
    names = "; ".join(item.name for item in failed)
    advice = " ".join(item.advice for item in failed)
    return f"Not good enough to test a policy in: {names}. {advice}"
