"""How well bricks show what the field shows that they were baked from."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from mi_nerfattack.fit.scores import FieldRenderer, Rendering, compare
from mi_nerfattack.render.camera.intrinsics import Camera, CameraMount, mount_matrix
from mi_nerfattack.render.posed import PosedField
from mi_nerfattack.vehicle.route.route import Route

LATERALS = (-2 / 7, 0.0, 2 / 7)  # in widths of a lane: 1 m of 3.5 m
_SPACING = 8 / 7  # likewise: 4 m
_SURE = 0.9  # opacity from which depths are compared


@dataclass(frozen=True, eq=False)
class BakedView:
    """One view of both.

    Attributes:
        route: name.
        arc_m: arc length along the route.
        lateral_m: offset to its left.
        psnr_db: of sRGB values in [0, 1], bricks against field.
        ssim: as in `scores.ViewScore`.
        depth_m: median difference of depths where both are nearly opaque, metres; NaN
            where they nowhere are.
        pictures: what the field and the bricks show; kept for the worst views alone.
    """

    route: str
    arc_m: float
    lateral_m: float
    psnr_db: float
    ssim: float
    depth_m: float
    pictures: tuple[Rendering, Rendering] | None = None


def score_bake(
    scene: PosedField,
    baked: PosedField,
    routes: Sequence[Route],
    camera: Camera,
    mount: CameraMount | None = None,
    spacing_m: float | None = None,
    keep: int = 4,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> list[BakedView]:
    """Compare bricks with their field on the routes and beside, on either side.

    Beside is 1 m where a lane is 3.5 m wide, and in proportion.

    Args:
        scene: the field at its pose in the routes' frame.
        baked: the bricks at theirs.
        routes: at least one.
        camera: intrinsics.
        mount: of the camera on the vehicle; None for the default mount.
        spacing_m: arc length between two views, about; None for 4 m, likewise.
        keep: views of least PSNR whose pictures are kept.
        progress: called with (views done, all) after each.

    Returns:
        a score a view, route by route.
    """
    eyes = FieldRenderer(scene), FieldRenderer(baked)
    places = [
        (route, float(arc), lateral * route.lane_width_m)
        for route in routes
        for arc in _arcs(route, spacing_m or _SPACING * route.lane_width_m)
        for lateral in LATERALS
    ]
    views: list[BakedView] = []
    for route, arc, lateral in places:
        pose = mount_matrix(route.pose_at(arc, lateral), mount or CameraMount())[0]
        wanted, shown = (eye.render(camera, pose) for eye in eyes)
        scores = compare(shown.image, wanted.image)
        depth = _depth_difference(wanted, shown)
        where = route.name, arc, lateral
        views.append(BakedView(*where, *scores, depth, (wanted, shown)))
        kept = [view for view in views if view.pictures is not None]
        if len(kept) > keep:
            best = max(kept, key=lambda view: view.psnr_db)
            views[views.index(best)] = replace(best, pictures=None)
        progress(len(views), len(places))
    return views


def _arcs(route: Route, spacing_m: float) -> np.ndarray:
    count = 2 + int(route.length / spacing_m)
    return np.linspace(0, route.length, count, endpoint=not route.closed)


def _depth_difference(wanted: Rendering, shown: Rendering) -> float:
    both = (wanted.opacity >= _SURE) & (shown.opacity >= _SURE)
    if not both.any():
        return float("nan")
    return float(np.median(np.abs(wanted.depth[both] - shown.depth[both])))
