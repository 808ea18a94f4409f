"""Compare a scene's field with the scene itself along its routes.

An attack is optimised in the field, the surrogate, and must hold in the path-traced
scene, the deployment: it can only where the two look alike.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import Field

from mi_nerfattack.backend.colour import linear_to_srgb_numpy
from mi_nerfattack.fields.base import AbstractField
from mi_nerfattack.fit.scores import (
    SOLID,
    FieldRenderer,
    ViewScore,
    keep_worst,
    least,
    mean,
)
from mi_nerfattack.ranges import Natural, Positive, checked
from mi_nerfattack.render.camera.intrinsics import (
    Camera,
    CameraMount,
    from_fov,
    mount_matrix,
)
from mi_nerfattack.render.pathtrace.load import load_scene
from mi_nerfattack.render.pathtrace.views import ViewRenderer
from mi_nerfattack.vehicle.route.route import Route, load_routes


def drive_camera() -> Camera:
    """Return the default camera of a scenario: 200 x 66 px, 90 degrees wide."""
    return from_fov(200, 66, 90.0)


@dataclass(frozen=True)
@checked()
class CompareOptions:
    """Where and how the two are compared.

    Attributes:
        camera: intrinsics of the driving camera.
        mount: its pose on the vehicle.
        spacing_m: arc length between two stations, metres.
        lateral_m: offset of the stations to the left of the route, metres.
        spp: samples per pixel of the path-traced frames, at least 2.
        near_m: depth is compared on rays that meet the scene nearer than this.
        seed: of the samples.
        worst: number of frames of least PSNR that are kept for each route.
    """

    camera: Camera = field(default_factory=drive_camera)
    mount: CameraMount = field(default_factory=CameraMount)
    spacing_m: Positive = 2.0
    lateral_m: float = 0.0
    spp: Annotated[int, Field(ge=2)] = 64
    near_m: Positive = 15.0
    seed: Natural = 0
    worst: Natural = 2


@dataclass(frozen=True, eq=False)
class RouteComparison:
    """Agreement along one route.

    Attributes:
        name: of the route.
        length_m: of the route.
        stations: in order of arc length; depth is compared on the near rays.
        depth_median_m, depth_p90_m: quantiles of |z_field - z_scene| over all near
            rays of the route; infinite where the field shows nothing, NaN without
            near rays.
        depth_median_relative, depth_p90_relative: the same of |z_field / z_scene - 1|.
        near: share of near rays.
    """

    name: str
    length_m: float
    stations: tuple[ViewScore, ...]
    depth_median_m: float
    depth_p90_m: float
    depth_median_relative: float
    depth_p90_relative: float
    near: float

    def mean(self, name: str) -> float:
        """Return the mean of a figure over the stations that have it."""
        return mean(self.stations, name)

    def least(self, name: str) -> float:
        """Return the least value of a figure over the stations."""
        return least(self.stations, name)


@dataclass(frozen=True, eq=False)
class Comparison:
    """Agreement of a field and a scene.

    Attributes:
        routes: one entry for each route.
        options: as given.
        wall_s: of the comparison.
    """

    routes: tuple[RouteComparison, ...]
    options: CompareOptions
    wall_s: float


def compare_with_scene(
    surrogate: AbstractField,
    scene_path: str | Path,
    routes_path: str | Path,
    options: CompareOptions | None = None,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> Comparison:
    """Compare a field with a Mitsuba scene from where a vehicle looks.

    The field's frames are the frames that an attack renders: one ray through the centre
    of each pixel. The scene's frames are path-traced and filtered over the pixel. The
    samples of each frame form two halves, whose difference measures the noise.

    Args:
        surrogate: field in the world's frame, metres.
        scene_path: Mitsuba XML.
        routes_path: routes file; all its routes are compared.
        options: None for the defaults.
        progress: called with (frames done, all frames) after each frame.

    Raises:
        InputError: a file is missing or wrong.
    """
    started = time.perf_counter()
    options = options or CompareOptions()
    routes = load_routes(routes_path)
    eyes = _Eyes(
        FieldRenderer(surrogate),
        ViewRenderer(load_scene(scene_path), options.camera),
        options,
    )
    arcs = [_stations(route, options.spacing_m) for route in routes]
    total, done, result = sum(map(len, arcs)), 0, []
    for route, stops in zip(routes, arcs, strict=True):
        stations: list[ViewScore] = []
        errors: list[np.ndarray] = []
        for arc in stops:
            station, error = eyes.compare(route, float(arc), done)
            stations = keep_worst([*stations, station], options.worst)
            errors.append(error)
            done += 1
            progress(done, total)
        result.append(_along(route, stations, np.hstack(errors), camera=options.camera))
    return Comparison(tuple(result), options, time.perf_counter() - started)


def _stations(route: Route, spacing: float) -> np.ndarray:
    """Return arc lengths from 0 to the end, `spacing` apart or a little less.

    The end of a closed route is its start, and is left out.
    """
    count = int(np.ceil(route.length / spacing - 1e-9))
    arcs = np.linspace(0, route.length, count + 1)
    return arcs[:-1] if route.closed else arcs


@dataclass(frozen=True)
class _Eyes:
    """The field and the scene from the same poses."""

    field: FieldRenderer
    scene: ViewRenderer
    options: CompareOptions

    def compare(
        self, route: Route, arc: float, index: int
    ) -> tuple[ViewScore, np.ndarray]:
        """Return the score of a station, and its `depth_errors`."""
        options = self.options
        state = route.pose_at(arc, options.lateral_m)
        pose = mount_matrix(state, options.mount)[0]
        seeds = np.random.SeedSequence([options.seed, index]).generate_state(2)
        spp = -(-options.spp // 2)
        views = [self.scene.render(pose, spp, int(seed)) for seed in seeds]
        image = linear_to_srgb_numpy(0.5 * (views[0].rgb + views[1].rgb))
        halves = [linear_to_srgb_numpy(view.rgb).astype(np.float64) for view in views]
        noise = float(np.mean((halves[0] - halves[1]) ** 2)) / 4  # of their mean
        name, depth = f"at {arc:.1f} m", views[0].depth
        score = self.field.score(
            name, options.camera, pose, expected=image, depth=depth
        )
        assert score.pictures is not None
        shown = score.pictures.shown
        errors = depth_errors(shown.depth, depth, options.near_m)
        station = replace(
            score,
            route=route.name,
            arc_m=arc,
            lateral_m=options.lateral_m,
            ceiling_db=-10 * float(np.log10(noise)) if noise > 0 else float("inf"),
            depth_median_m=quantile(errors[0], 0.5),
            depth_p90_m=quantile(errors[0], 0.9),
            wrong=float(np.mean((shown.opacity >= SOLID) != np.isfinite(depth))),
        )
        return station, errors


def _along(
    route: Route, stations: Sequence[ViewScore], errors: np.ndarray, camera: Camera
) -> RouteComparison:
    error, relative = errors
    return RouteComparison(
        name=route.name,
        length_m=route.length,
        stations=tuple(stations),
        depth_median_m=quantile(error, 0.5),
        depth_p90_m=quantile(error, 0.9),
        depth_median_relative=quantile(relative, 0.5),
        depth_p90_relative=quantile(relative, 0.9),
        near=len(error) / (len(stations) * camera.width * camera.height),
    )


def depth_errors(shown: np.ndarray, depth: np.ndarray, near_m: float) -> np.ndarray:
    """Return |z - z_scene| and |z / z_scene - 1| of the rays nearer than `near_m`.

    Args:
        shown: the field's depth, any shape, metres; infinite where it shows nothing,
            and so is then the error.
        depth: the scene's depth, of the same shape.
        near_m: metres.
    """
    near = depth < near_m
    expected = depth[near].astype(np.float64)
    error = np.abs(shown[near] - expected)
    return np.stack([error, error / expected])


def quantile(values: np.ndarray | Sequence[float], share: float) -> float:
    """Return a quantile of values that may be infinite; NaN if there are none."""
    if len(values) == 0:
        return float("nan")
    return float(np.quantile(values, share, method="inverted_cdf"))
