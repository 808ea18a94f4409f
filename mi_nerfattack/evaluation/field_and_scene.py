"""Compare a scene's field with the scene itself along its routes.

An attack is optimised in the field, the surrogate, and must hold in the path-traced
scene, the deployment: it can only where the two look alike.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import Field

from mi_nerfattack.backend.colour import linear_to_srgb_numpy
from mi_nerfattack.fields.base import AbstractField
from mi_nerfattack.fit.scores import SOLID, FieldRenderer, Rendering, compare
from mi_nerfattack.ranges import Positive, Whole, checked
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
    seed: Whole = 0
    worst: Whole = 2


@dataclass(frozen=True)
class Station:
    """Agreement of one frame.

    Attributes:
        arc_m: arc length along the route.
        psnr_db: of sRGB values in [0, 1], field against path-traced frame.
        ceiling_db: PSNR that the noise of the path-traced frame alone would leave.
        ssim: as in `evaluation.ViewScore`.
        depth_median_m, depth_p90_m: quantiles of |z_field - z_scene| over the near
            rays; infinite where the field shows nothing, NaN without near rays.
        wrong: share of rays that the field stops (opacity of at least 0.5) and the
            scene does not, or the other way round.
        hazy: see `evaluation.Rendering.hazy`.
        holes: see `FieldRenderer.holes`.
    """

    arc_m: float
    psnr_db: float
    ceiling_db: float
    ssim: float
    depth_median_m: float
    depth_p90_m: float
    wrong: float
    hazy: float
    holes: float


@dataclass(frozen=True, eq=False)
class ComparedFrame:
    """A frame as both show it.

    Attributes:
        station: its agreement.
        field: the field's frame.
        image: (height, width, 3), float32 sRGB, path-traced.
        depth: (height, width), metres along the ray, infinite in the sky.
    """

    station: Station
    field: Rendering
    image: np.ndarray
    depth: np.ndarray


@dataclass(frozen=True, eq=False)
class RouteComparison:
    """Agreement along one route.

    Attributes:
        name: of the route.
        length_m: of the route.
        stations: in order of arc length.
        depth_median_m, depth_p90_m: quantiles of |z_field - z_scene| over all near
            rays of the route; infinite where the field shows nothing, NaN without
            near rays.
        depth_median_relative, depth_p90_relative: the same of |z_field / z_scene - 1|.
        near: share of near rays.
        worst: frames of least PSNR, worst first.
    """

    name: str
    length_m: float
    stations: tuple[Station, ...]
    depth_median_m: float
    depth_p90_m: float
    depth_median_relative: float
    depth_p90_relative: float
    near: float
    worst: tuple[ComparedFrame, ...]

    def mean(self, name: str) -> float:
        """Return the mean of a number over the stations; NaN ones do not count."""
        values = np.array([getattr(station, name) for station in self.stations])
        known = values[~np.isnan(values)]
        return float(np.mean(known)) if known.size else float("nan")

    def least(self, name: str) -> float:
        """Return the least value of a number over the stations."""
        return float(min(getattr(station, name) for station in self.stations))


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

    The field's frames are those that an attack sees: one ray through the centre of
    each pixel. The scene's are path-traced, filtered over the pixel, each from two
    halves of the samples whose difference tells the noise.

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
    eyes = _Eyes(surrogate, load_scene(scene_path), options)
    arcs = [_stations(route.length, options.spacing_m) for route in routes]
    total, done, result = sum(map(len, arcs)), 0, []
    for route, stops in zip(routes, arcs, strict=True):
        tally = _Tally(route, options)
        for arc in stops:
            tally.add(eyes.frame(route, float(arc), done))
            done += 1
            progress(done, total)
        result.append(tally.result())
    return Comparison(tuple(result), options, time.perf_counter() - started)


def _stations(length: float, spacing: float) -> np.ndarray:
    """Return arc lengths from 0 to the end, `spacing` apart or a little less."""
    return np.linspace(0, length, int(np.ceil(length / spacing - 1e-9)) + 1)


class _Eyes:
    """The field and the scene from the same poses."""

    def __init__(
        self, surrogate: AbstractField, scene: object, options: CompareOptions
    ) -> None:
        self.options = options
        self._field = FieldRenderer(surrogate)
        self._scene = ViewRenderer(scene, options.camera)

    def frame(self, route: Route, arc: float, index: int) -> ComparedFrame:
        options = self.options
        state = route.pose_at(arc, options.lateral_m)
        pose = mount_matrix(state, options.mount)[0]
        seeds = np.random.SeedSequence([options.seed, index]).generate_state(2)
        spp = -(-options.spp // 2)
        views = [self._scene.render(pose, spp, int(seed)) for seed in seeds]
        image = linear_to_srgb_numpy(0.5 * (views[0].rgb + views[1].rgb))
        halves = [linear_to_srgb_numpy(view.rgb).astype(np.float64) for view in views]
        noise = float(np.mean((halves[0] - halves[1]) ** 2)) / 4  # of their mean
        shown, depth = self._field.render(options.camera, pose), views[0].depth
        errors = depth_errors(shown.depth, depth, options.near_m)[0]
        psnr, ssim = compare(shown.image, image)
        station = Station(
            arc,
            psnr,
            -10 * float(np.log10(noise)) if noise > 0 else float("inf"),
            ssim,
            quantile(errors, 0.5),
            quantile(errors, 0.9),
            float(np.mean((shown.opacity >= SOLID) != np.isfinite(depth))),
            shown.hazy,
            self._field.holes(shown, options.camera, pose, depth),
        )
        return ComparedFrame(station, shown, image, depth)


class _Tally:
    """What is kept of the frames of a route."""

    def __init__(self, route: Route, options: CompareOptions) -> None:
        self.route, self.options = route, options
        self.stations: list[Station] = []
        self.worst: list[ComparedFrame] = []
        self.errors: list[np.ndarray] = []
        self.relative: list[np.ndarray] = []

    def add(self, frame: ComparedFrame) -> None:
        self.stations.append(frame.station)
        frames = sorted([*self.worst, frame], key=lambda item: item.station.psnr_db)
        self.worst = frames[: self.options.worst]
        near_m = self.options.near_m
        error, relative = depth_errors(frame.field.depth, frame.depth, near_m)
        self.errors.append(error)
        self.relative.append(relative)

    def result(self) -> RouteComparison:
        error, relative = np.concatenate(self.errors), np.concatenate(self.relative)
        camera = self.options.camera
        rays = len(self.stations) * camera.width * camera.height
        return RouteComparison(
            self.route.name,
            self.route.length,
            tuple(self.stations),
            quantile(error, 0.5),
            quantile(error, 0.9),
            quantile(relative, 0.5),
            quantile(relative, 0.9),
            len(error) / rays,
            tuple(self.worst),
        )


def depth_errors(
    shown: np.ndarray, depth: np.ndarray, near_m: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return |z - z_scene| and |z / z_scene - 1| of the rays nearer than `near_m`.

    Args:
        shown: the field's depth, any shape, metres; infinite where it shows nothing,
            and so is then the error.
        depth: the scene's depth, of the same shape.
        near_m: metres.
    """
    near = depth < near_m
    wanted = depth[near].astype(np.float64)
    error = np.abs(shown[near] - wanted)
    return error, error / wanted


def quantile(values: np.ndarray | Sequence[float], share: float) -> float:
    """Return a quantile of values that may be infinite; NaN if there are none."""
    if len(values) == 0:
        return float("nan")
    return float(np.quantile(values, share, method="inverted_cdf"))
