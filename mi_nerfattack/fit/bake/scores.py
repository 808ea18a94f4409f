"""How well bricks show what the field shows that they were baked from."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from mi_nerfattack.fit.scores import (
    SOLID,
    FieldRenderer,
    Rendering,
    ViewScore,
    keep_worst,
)
from mi_nerfattack.render.camera.intrinsics import Camera, CameraMount, mount_matrix
from mi_nerfattack.render.posed import PosedField
from mi_nerfattack.vehicle.route.route import Route

LATERALS = (-2 / 7, 0.0, 2 / 7)  # in widths of a lane: 1 m of 3.5 m
_SPACING = 8 / 7  # in widths of a lane: 4 m
_SURE = 0.9  # opacity from which depths are compared


def score_bake(
    scene: PosedField,
    baked: PosedField,
    routes: Sequence[Route],
    camera: Camera,
    mount: CameraMount | None = None,
    spacing_m: float | None = None,
    keep: int = 4,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> list[ViewScore]:
    """Compare bricks with their field, on the routes and to the left and right.

    The views to the left and right are 1 m off the route where a lane is 3.5 m wide,
    and in proportion for other lanes.

    Args:
        scene: the field at its pose in the routes' frame.
        baked: the bricks at their pose in the same frame.
        routes: at least one.
        camera: intrinsics.
        mount: of the camera on the vehicle; None for the default mount.
        spacing_m: arc length between two views, about; None for 8/7 of a lane.
        keep: views of least PSNR whose pictures are kept.
        progress: called with (views done, all) after each.

    Returns:
        a score for each view, route by route. Its depths are compared where field and
        bricks are nearly opaque.
    """
    field, bricks = FieldRenderer(scene), FieldRenderer(baked)
    places = [
        (route, float(arc), lateral * route.lane_width_m)
        for route in routes
        for arc in _arcs(route, spacing_m or _SPACING * route.lane_width_m)
        for lateral in LATERALS
    ]
    views: list[ViewScore] = []
    for route, arc, lateral in places:
        pose = mount_matrix(route.pose_at(arc, lateral), mount or CameraMount())[0]
        expected = field.render(camera, pose)
        depth = np.where(expected.opacity > SOLID, expected.depth, np.inf)
        name = f"{route.name}, {arc:.1f} m, {lateral:+.2g} m beside"
        view = bricks.score(name, camera, pose, expected=expected.image, depth=depth)
        assert view.pictures is not None
        view = replace(
            view,
            route=route.name,
            arc_m=arc,
            lateral_m=lateral,
            depth_median_m=_depth_difference(expected, view.pictures.shown),
        )
        views = keep_worst([*views, view], keep)
        progress(len(views), len(places))
    return views


def _arcs(route: Route, spacing_m: float) -> np.ndarray:
    count = 2 + int(route.length / spacing_m)
    return np.linspace(0, route.length, count, endpoint=not route.closed)


def _depth_difference(expected: Rendering, shown: Rendering) -> float:
    both = (expected.opacity >= _SURE) & (shown.opacity >= _SURE)
    if not both.any():
        return float("nan")
    return float(np.median(np.abs(expected.depth[both] - shown.depth[both])))
