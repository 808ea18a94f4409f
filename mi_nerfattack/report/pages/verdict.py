"""Whether a field is good enough to test a policy in, by stated criteria.

Held-out views judge a fit, and frames along the routes a field that has a scene. The
criteria are the same, and the frames decide, because a policy sees them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from mi_nerfattack.fit.scores import HAZY, SOLID, ViewScore, least, mean

MIN_PSNR_DB = 24.0  # mean over views
MIN_WORST_DB = 18.0  # of any view
MAX_GAP_DB = 5.0  # fitted less held-out views
MAX_HAZY = 0.10  # share of rays, mean over views
MAX_HOLES = 0.005  # share of known surfaces, mean over views
MAX_DEPTH_M = 0.1  # median error along a route, near the camera
MIN_VIEWS = 3  # from which on a mean is worth something


@dataclass(frozen=True)
class Subject:
    """The words of a verdict for one kind of field: a scene, a route or an object.

    Attributes:
        use: what the field must be good enough for.
        views: name of the views that judge the field.
        reach: from where it is good enough, according to the views.
        few: advice where there are few views.
        blurred: where the mean PSNR is low.
        worst: where one view is bad.
        fog: where many rays are hazy.
        holes: where light comes through known surfaces.
        learnt: where the fitted rays are much better than the held-out ones.
        depth: where surfaces are nearer or farther than in the scene.
    """

    use: str
    views: str
    reach: str
    few: str
    blurred: str
    worst: str
    fog: str
    holes: str
    learnt: str = ""
    depth: str = ""


SCENE = Subject(
    use="to test a policy in",
    views="held-out views",
    reach="near the cameras and from heights and headings like theirs. Where there is "
    "a scene to deploy in, 'mi-nerfattack render compare' decides.",
    few="Take more images: every 8th is held out, and so few say little.",
    blurred="Fit for longer, or check poses, intrinsics and blurred images.",
    worst="Look at the worst views: add images where they were taken, and leave out "
    "images with a wrong pose, blur, or things that moved.",
    fog="Fog or thin floaters: add depth or views from other sides, or narrow the "
    "bounds; depths and occlusion by objects are unsure until then.",
    holes="Light comes through surfaces: fit for longer, add images that show them, "
    "and check that the depth belongs to the images.",
    learnt="The field has learnt images, not the scene: add images between the "
    "present ones, refine the poses, or take a smaller network.",
)
_RECAPTURE = "Capture more views where the frames are worst, and fit for longer."
ROUTE = Subject(
    use=SCENE.use,
    views="frames",
    reach="with the driving camera along the routes. This decides, and not the "
    "held-out views of the fit, because a policy sees these frames.",
    few="Take frames nearer to each other (--every-m).",
    blurred=_RECAPTURE,
    worst=_RECAPTURE,
    fog=SCENE.fog,
    holes=_RECAPTURE,
    depth=_RECAPTURE,
)
OBJECT = Subject(
    use="as an object to attack",
    views="held-out views",
    reach="seen from where these views lie, and not from nearer than a voxel can show.",
    few="Give more views (--views for a mesh): every 8th is held out, and so few say "
    "little.",
    blurred="Fit for longer (--steps) or with a finer grid (--resolution 128); of a "
    "folder, check that all images show the object at rest in one light.",
    worst="Look at the worst views: parts thinner than a voxel need a finer grid "
    "(--resolution 128); of a folder, leave out images that show something else.",
    fog="The surface is not solid: fit for longer (--steps) or with a finer grid "
    "(--resolution 128); what is transparent stays so.",
    holes="The surface has holes: fit for longer (--steps) or with a finer grid "
    "(--resolution 128).",
    learnt="The field has learnt views, not the object: give more views (--views for a "
    "mesh).",
)


@dataclass(frozen=True)
class Criterion:
    """One thing that was measured and what it should be.

    Attributes:
        figure: what was measured, as one word.
        name: what was measured, with its unit.
        value: as measured.
        limit: of the value.
        at_least: whether the limit is the least good value, or else the greatest.
        advice: what helps if it is not met.
        subject: words for the kind of field that was measured.
    """

    figure: str
    name: str
    value: float
    limit: float
    at_least: bool
    advice: str
    subject: Subject

    @property
    def met(self) -> bool:
        """Whether the value lies on the good side of the limit."""
        if self.at_least:
            return self.value >= self.limit
        return self.value <= self.limit


def pooled_db(psnr_db: Sequence[float]) -> float:
    """Return the PSNR of the mean squared error over views with these PSNRs."""
    error = float(np.mean(10 ** (-0.1 * np.asarray(psnr_db, np.float64))))
    return float("inf") if error == 0 else -10 * float(np.log10(error))


def judge(
    scores: Sequence[ViewScore],
    fitted_db: float | None = None,
    subject: Subject = SCENE,
    depth_m: float = float("nan"),
) -> list[Criterion]:
    """Judge a field by views of it.

    Args:
        scores: of the views, at least one.
        fitted_db: PSNR of the rays fitted to, at the end of the fit; None if unknown.
        subject: words for the kind of field.
        depth_m: median error of the depth near the camera, metres; NaN if unknown.
    """
    above = partial(Criterion, at_least=True, subject=subject)
    below = partial(Criterion, at_least=False, subject=subject)
    mean_db, least_db = mean(scores, "psnr_db"), least(scores, "psnr_db")
    name = f"mean PSNR of {subject.views} (dB)"
    least_name = f"least PSNR of {subject.views} (dB)"
    hazy_name = f"share of rays with an opacity from {HAZY[0]:g} to {HAZY[1]:g}"
    hazy = mean(scores, "hazy")
    criteria = [
        above("views", subject.views, len(scores), limit=MIN_VIEWS, advice=subject.few),
        above("psnr_db", name, mean_db, limit=MIN_PSNR_DB, advice=subject.blurred),
        above(
            "psnr_min_db",
            least_name,
            least_db,
            limit=MIN_WORST_DB,
            advice=subject.worst,
        ),
        below("hazy", hazy_name, hazy, limit=MAX_HAZY, advice=subject.fog),
    ]
    if not np.isnan(holes := mean(scores, "holes")):
        name = f"share of known surfaces with an opacity below {SOLID:g}"
        criteria.append(
            below("holes", name, holes, limit=MAX_HOLES, advice=subject.holes)
        )
    if not np.isnan(depth_m):
        name = "median error of the depth near the camera (m)"
        criteria.append(
            below(
                "depth_median_m",
                name,
                depth_m,
                limit=MAX_DEPTH_M,
                advice=subject.depth,
            )
        )
    if fitted_db is not None:
        pooled = pooled_db([score.psnr_db for score in scores])
        gap = 0.0 if pooled == fitted_db else fitted_db - pooled  # both may be infinite
        name = "PSNR of fitted rays less that of held-out ones (dB)"
        criteria.append(
            below("gap_db", name, gap, limit=MAX_GAP_DB, advice=subject.learnt)
        )
    return criteria


def verdict(criteria: Sequence[Criterion]) -> str:
    """Say in words what criteria, at least one, come to."""
    subject = criteria[0].subject
    failed = [item for item in criteria if not item.met]
    if not failed:
        return f"Good enough {subject.use}, as far as these views tell: {subject.reach}"
    names = "; ".join(item.name for item in failed)
    advice = " ".join(dict.fromkeys(item.advice for item in failed))
    return f"Not good enough {subject.use}: {names}. {advice}"
