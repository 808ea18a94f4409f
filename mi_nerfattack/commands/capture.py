"""``mi-nerfattack capture``: posed images of a scene, of photographs or of a video."""

from __future__ import annotations

import shlex
import tempfile
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Literal

import tyro

from mi_nerfattack.commands.shared.options import check_empty, check_positive
from mi_nerfattack.commands.shared.terminal import Result
from mi_nerfattack.errors import InputError

_SHOWN = 10  # photographs to take again; capture.json lists all

if TYPE_CHECKING:
    from mi_nerfattack.capture.colmap.reconstruct import StageCallback
    from mi_nerfattack.capture.photographs.estimate import PoseEstimate, PoseOptions
    from mi_nerfattack.capture.photographs.markers import Markers
    from mi_nerfattack.commands.shared.progress import StageBars

Written = tuple[Path, dict[str, Any], Callable[[], object]]
"""Path of transforms.json, figures for programs, and what prints them."""


@dataclass(frozen=True)
class _Capture(ABC):
    """Arguments that all captures have."""

    source: tyro.conf.Positional[Path]
    """What is captured."""
    output: Path
    """New or empty folder for transforms.json, images, depth or points."""
    seed: int = 0
    """Seed of all random numbers."""
    json: bool = False

    def run(self) -> Result:
        """Render or estimate, and write."""
        from mi_nerfattack.commands.shared.progress import StageBars
        from mi_nerfattack.io import locks

        is_begun = self._is_begun()
        if not is_begun:
            check_empty(self.output)
        remedy = None if is_begun else "choose another"
        with locks.claimed(self.output, remedy), StageBars() as bars:
            locks.remove_partial(self.output)
            path, document, show = self._write(bars)

        def tell() -> None:
            show()
            folder = shlex.quote(str(path.parent))
            print(
                "Fit a field to them, in 15 minutes; hours give a sharper one, see "
                f"fit:\n  mi-nerfattack fit {folder} -o FIELD.safetensors --network "
                "small --budget-minutes 15"
            )

        return Result({"transforms": str(path), **document}, tell)

    def _is_begun(self) -> bool:
        return False

    @abstractmethod
    def _write(self, bars: StageBars) -> Written:
        """Write everything."""


@dataclass(frozen=True, kw_only=True)
class CaptureScene(_Capture):
    """Render a Mitsuba scene, with depth, from where a drive may look at it.

    The same command continues where it was stopped.
    """

    continues: ClassVar[bool] = True

    source: tyro.conf.Positional[Path]
    """Scene file (.xml)."""
    routes_file: Path
    """Routes file (.json); all its routes are used."""
    views: int = 256
    """Number of views."""
    size: tuple[int, int] = (320, 160)
    """Width and height of a view, pixels."""
    fov_deg: float = 90.0
    """Horizontal field of view."""
    mount: tuple[float, float, float] = (1.4, 0.5, 6.0)
    """Camera's height and place ahead (metres), pitch down (degrees)."""
    spp: int = 16
    """Samples per pixel."""

    def _is_begun(self) -> bool:
        from mi_nerfattack.capture.scene import is_begun

        return is_begun(self.output)

    def _write(self, bars: StageBars) -> Written:
        from mi_nerfattack import variant
        from mi_nerfattack.capture.scene import capture_scene
        from mi_nerfattack.render.camera.intrinsics import CameraMount, from_fov
        from mi_nerfattack.report.plots.place import routes_picture
        from mi_nerfattack.vehicle.route.route import load_routes

        check_positive(self, "views", "spp")
        variant.ensure()
        camera, mount = from_fov(*self.size, self.fov_deg), CameraMount(*self.mount)
        path = capture_scene(
            self.source,
            self.routes_file,
            self.output,
            n=self.views,
            camera=camera,
            spp=self.spp,
            seed=self.seed,
            progress=bars.counter("rendering views"),
            mount=mount,
        )
        show = bars.counter("drawing the place")
        show(0, 1)
        picture = path.parent / "place.png"
        routes = load_routes(self.routes_file)
        routes_picture(picture, self.source, routes, camera=camera, mount=mount)
        show(1, 1)
        bars.say(f"{picture}: scene, routes and lanes from above; look at it first")
        message = f"Wrote {self.views} views to {path.parent}"
        return path, {"views": self.views}, lambda: print(message)


@dataclass(frozen=True)
class _Estimate(_Capture):
    """Arguments of poses by structure from motion on the CPU."""

    matching: Literal["exhaustive", "sequential"] = "exhaustive"
    """Compare all images, or each with its neighbours."""
    lens: Literal[
        "SIMPLE_PINHOLE",
        "PINHOLE",
        "SIMPLE_RADIAL",
        "RADIAL",
        "OPENCV",
        "OPENCV_FISHEYE",
    ] = "OPENCV"
    """Camera model of COLMAP."""
    long_edge: int = 1600
    """Look for features at most at this size, pixels."""
    metres_per_unit: float | None = None
    """Multiply all lengths by this. It, --distance, --marker-m and --camera-poses give
    the scale; give one."""
    distance: tuple[str, str, float] | None = None
    """Two photographs, and the metres between their places."""
    marker_m: float | None = None
    """Edge of the black square of printed markers, metres."""
    marker_family: str = "apriltag_36h11"
    """Their family: apriltag_36h11, 4x4_50, 6x6_250, ... of OpenCV."""
    markers_flat: bool = False
    """All markers lie on the ground, which becomes z = 0."""
    camera_poses: Path | None = None
    """Poses of a body on the camera, by motion capture, by names of photographs or
    times of a video."""
    masks: Path | None = None
    """PNG, black where images show no part of the still scene; or, of photographs, a
    folder with NAME.jpg.png for some."""

    def _write(self, bars: StageBars) -> Written:
        from mi_nerfattack.capture.photographs.quality import quality_table, retake
        from mi_nerfattack.report.plots.fit import write_cameras_above

        def progress(stage: str, done: int, total: int) -> None:
            bars.show(stage, done, total, f"{done} of {total}")

        result = self._estimate(self._options(), progress)
        picture = result.path.with_name("cameras.png")
        write_cameras_above(picture, result.structure, set(retake(result.qualities)))
        table = quality_table(result.structure, result.qualities, asdict(result.scale))
        document = table | {"farthest": result.farthest, "distance": result.distance}
        return result.path, document, lambda: _tell(result, picture)

    @abstractmethod
    def _estimate(self, options: PoseOptions, progress: StageCallback) -> PoseEstimate:
        """Estimate and write poses."""

    def _options(self) -> PoseOptions:
        from mi_nerfattack.capture.photographs.alignment import Distance
        from mi_nerfattack.capture.photographs.estimate import PoseOptions

        return PoseOptions(
            matching=self.matching,
            lens=self.lens,
            long_edge_px=self.long_edge,
            metres_per_unit=self.metres_per_unit,
            distance=None if self.distance is None else Distance(*self.distance),
            markers=self._markers(),
            masks=self.masks,
            seed=self.seed,
        )

    def _tracked(
        self, options: PoseOptions, times: dict[str, float] | None = None
    ) -> PoseOptions:
        """Add the tracker's poses, if there are any."""
        from mi_nerfattack.capture.photographs.tracked import read_tracked

        if self.camera_poses is None:
            return options
        return replace(options, tracked=read_tracked(self.camera_poses, times))

    def _markers(self) -> Markers | None:
        from mi_nerfattack.capture.photographs.markers import Markers

        if self.marker_m is None:
            if self.markers_flat or self.marker_family != type(self).marker_family:
                raise InputError(
                    "--marker-family, --markers-flat: need --marker-m, their edge"
                )
            return None
        return Markers(self.marker_m, self.marker_family, self.markers_flat)


@dataclass(frozen=True)
class CapturePhotographs(_Estimate):
    """Estimate the poses of photographs that show one still scene.

    They may come from several cameras, each with three or more at a focal length and
    held one way. z points up if they were held level on average.
    """

    source: tyro.conf.Positional[Path]
    """Folder of JPEG, PNG, WebP or HEIC photographs."""

    def _estimate(self, options: PoseOptions, progress: StageCallback) -> PoseEstimate:
        from mi_nerfattack.capture.photographs.estimate import estimate_poses

        options = self._tracked(options)
        return estimate_poses(self.source, self.output, options, progress=progress)


@dataclass(frozen=True)
class CaptureVideo(_Estimate):
    """Estimate the poses of frames of a video that shows one still scene.

    It takes sharp frames between which the camera moved. z points up if the camera was
    held level on average.
    """

    source: tyro.conf.Positional[Path]
    """Video file."""
    matching: Literal["exhaustive", "sequential"] = "sequential"
    """Compare each frame with its neighbours, or all."""
    most_frames: int = 150
    """Most frames that are taken."""
    baseline: float = 0.05
    """Motion of the picture between two frames, in shares of its longer edge."""

    def _estimate(self, options: PoseOptions, progress: StageCallback) -> PoseEstimate:
        from mi_nerfattack.capture.photographs.estimate import estimate_poses
        from mi_nerfattack.capture.photographs.frames import (
            FrameOptions,
            extract_frames,
        )

        if self.masks is not None and self.masks.is_dir():
            raise InputError(
                f"--masks: {self.masks} is a folder; give one PNG for all frames of a "
                "video, or extract its frames first and give their folder"
            )
        with tempfile.TemporaryDirectory() as folder:
            chosen = FrameOptions(self.most_frames, self.baseline)
            self._tracked(options, {})  # what is wrong with it, before a film is read
            times = extract_frames(self.source, Path(folder), chosen, progress=progress)
            options = self._tracked(options, times)
            return estimate_poses(folder, self.output, options, progress=progress)


def _tell(result: PoseEstimate, picture: Path) -> None:
    from mi_nerfattack.capture.coverage import FAR_DEG
    from mi_nerfattack.capture.photographs.quality import (
        FEW_PLACED,
        median_gap,
        retake,
    )

    total = len(result.placed) + len(result.left_out)
    print(
        f"Placed {len(result.placed)} of {total} photographs, mean reprojection "
        f"error {result.error_px:.2f} px; wrote {result.path}"
    )
    if len(result.placed) < FEW_PLACED * total:
        print(
            "Few were placed: take more between those far apart, each part of the "
            "scene in three or more, with texture, sharp, of nothing that moves."
        )
    gap = median_gap(result.qualities)
    if gap is not None and gap > FAR_DEG:
        print(
            f"They stand {gap:.0f} degrees apart, as seen from what they show: a "
            f"field needs {FAR_DEG:.0f} or less. Take more between them."
        )
    again = retake(result.qualities)
    for name, why in list(again.items())[:_SHOWN]:
        print(f"Take again: {name}, {why}")
    if len(again) > _SHOWN:
        print(f"and {len(again) - _SHOWN} more")
    table = picture.with_name("capture.json")
    print(f"{picture}: the cameras from above; {table}: what each photograph gave")
    scale = result.scale
    if scale.spread is not None:
        print(
            f"Scale by {len(scale.markers)} markers, whose edges differ by "
            f"{100 * scale.spread:.2f} % (standard deviation)."
        )
    if (fit := scale.tracked) is not None:
        print(
            f"Scale and world by motion capture of {fit.photographs} photographs, "
            f"which differ by {1e3 * fit.residual_m:.1f} mm and "
            f"{fit.residual_deg:.2f} degrees (root mean square)."
        )
    unit = "m" if scale.metres_per_unit is not None else "units"
    apart = f"{result.distance:.4g} {unit}"
    print(f"{' and '.join(result.farthest)} were taken {apart} apart.")
    if scale.metres_per_unit is None:
        print(
            "The unit is arbitrary: measure this distance in metres and give its "
            f"quotient by {result.distance:.4g} as --metres-per-unit, or put "
            "printed markers into the scene (--marker-m)."
        )
