"""``mi-nerfattack capture``: posed images of a scene, of photographs or of a video."""

from __future__ import annotations

import shlex
import tempfile
from collections.abc import Callable
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from mi_nerfattack.commands.shared.options import check_empty, given
from mi_nerfattack.commands.shared.result import Result
from mi_nerfattack.errors import InputError

_SHOWN = 10  # photographs to take again; capture.json lists all

if TYPE_CHECKING:
    from mi_nerfattack.capture.photographs.estimate import PoseEstimate, PoseOptions
    from mi_nerfattack.capture.photographs.markers import Markers
    from mi_nerfattack.commands.shared.progress import StageBars


@dataclass(frozen=True)
class SceneArguments:
    """Views of a Mitsuba scene."""

    routes: Path | None = None
    """Routes file (.json), needed; all its routes are used."""
    views: int = 256
    """Number of views."""
    width: int = 320
    """Of a view, pixels."""
    height: int = 160
    """Of a view, pixels."""
    fov_deg: float = 90.0
    """Horizontal field of view."""
    height_m: float = 1.4
    """Of the car's camera above the road, metres."""
    forward_m: float = 0.5
    """Of the car's camera before what its routes are of, metres."""
    pitch_deg: float = 6.0
    """Of the car's camera, downwards."""
    spp: int = 16
    """Samples per pixel."""

    def write(self, scene: Path, output: Path, seed: int, bars: StageBars) -> Path:
        """Render and write; return the path of the `transforms.json`."""
        from mi_nerfattack import variant
        from mi_nerfattack.capture.scene import capture_scene
        from mi_nerfattack.render.camera.intrinsics import CameraMount, from_fov
        from mi_nerfattack.report.plots.place import routes_picture
        from mi_nerfattack.vehicle.route.route import load_routes

        variant.ensure()
        if self.routes is None:
            raise InputError("--routes: missing; give the routes file of the scene")
        for name in ("views", "width", "height", "spp"):
            if getattr(self, name) < 1:
                raise InputError(f"--{name}: {getattr(self, name)}; at least 1")
        camera = from_fov(self.width, self.height, self.fov_deg)
        mount = CameraMount(self.height_m, self.forward_m, self.pitch_deg)
        path = capture_scene(
            scene,
            self.routes,
            output,
            self.views,
            camera,
            self.spp,
            seed,
            bars.counter("rendering views"),
            mount,
        )
        show = bars.counter("drawing the place")
        show(0, 1)
        picture = path.parent / "place.png"
        routes_picture(picture, scene, load_routes(self.routes), camera, mount)
        show(1, 1)
        bars.say(f"{picture}: scene, routes and lanes from above; look at it first")
        return path


@dataclass(frozen=True)
class PhotographArguments:
    """Poses of photographs and videos, by structure from motion on the CPU."""

    matching: Literal["exhaustive", "sequential"] | None = None
    """Compare all photographs, or each with its neighbours, as by default frames of a
    video."""
    lens: Literal["SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV"] = (
        "OPENCV"
    )
    """Camera model of COLMAP."""
    long_edge: int = 1600
    """Look for features at most at this size, pixels; the images keep theirs."""
    frames: int = 150
    """Of a video, at most."""
    baseline: float = 0.05
    """How far the picture moves between two frames of a video, in shares of its longer
    edge."""
    metres_per_unit: float | None = None
    """Multiply all lengths by this. This, the next two and --camera-poses tell the
    scale; give one."""
    distance: tuple[str, str, float] | None = None
    """Two photographs, and the metres between the places where they were taken."""
    marker_m: float | None = None
    """Edge of the black square of printed markers in the scene, metres; of a ChArUco
    board, that of its markers."""
    marker_family: str = "apriltag_36h11"
    """Of the markers: apriltag_36h11, 4x4_50, 6x6_250, ... as OpenCV has them."""
    markers_flat: bool = False
    """All markers lie on the ground, which becomes z = 0."""
    camera_poses: Path | None = None
    """Pose file of a body on the camera, by motion capture, whose world is taken over:
    with the photographs' names, or a video's times from its start."""
    masks: Path | None = None
    """PNG, black where all images show what is no part of the still scene, as a car's
    bonnet; or, of photographs, a folder with such a NAME.jpg.png for some."""

    def write(
        self, source: Path, output: Path, seed: int, bars: StageBars
    ) -> PoseEstimate:
        """Estimate and write poses."""
        from mi_nerfattack.capture.photographs.alignment import Distance
        from mi_nerfattack.capture.photographs.estimate import (
            PoseOptions,
            estimate_poses,
        )
        from mi_nerfattack.capture.photographs.frames import (
            FrameOptions,
            extract_frames,
        )

        def show(stage: str, done: int, total: int) -> None:
            bars.show(stage, done, total, f"{done} of {total}")

        is_video = not source.is_dir()
        usual = "sequential" if is_video else "exhaustive"
        options = PoseOptions(
            self.matching or usual,
            self.lens,
            self.long_edge,
            self.metres_per_unit,
            None if self.distance is None else Distance(*self.distance),
            self._markers(),
            masks=self.masks,
            seed=seed,
        )
        if not is_video:
            if option := given(self, ("frames", "baseline")):
                raise InputError(f"{option}: not for {source}, which is no video")
            options = self._tracked(options)
            return estimate_poses(source, output, options, show)
        if self.masks is not None and self.masks.is_dir():
            raise InputError(
                f"--masks: {self.masks} is a folder; give one PNG for all frames of a "
                "video, or extract its frames first and give their folder"
            )
        with tempfile.TemporaryDirectory() as folder:
            chosen = FrameOptions(self.frames, self.baseline)
            self._tracked(options, {})  # what is wrong with it, before a film is read
            times = extract_frames(source, Path(folder), chosen, show)
            options = self._tracked(options, times)
            return estimate_poses(folder, output, options, show)

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
            if option := given(self, ("markers_flat", "marker_family")):
                raise InputError(f"{option}: needs the markers' edge, --marker-m")
            return None
        return Markers(self.marker_m, self.marker_family, self.markers_flat)

    def document(self, result: PoseEstimate) -> dict[str, Any]:
        """Return what `capture.json` holds, and who stood farthest apart."""
        from mi_nerfattack.capture.photographs.quality import quality_table

        table = quality_table(result.found, result.qualities, asdict(result.scale))
        return table | {"farthest": result.farthest, "distance": result.distance}

    def tell(self, result: PoseEstimate, picture: Path) -> None:
        """Print what was found."""
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


@dataclass(frozen=True)
class Capture:
    """Make posed images to fit a field to: of a scene, of photographs, or of a video.

    A Mitsuba scene is rendered with depth from where a drive along its routes may look
    at it.

    Photographs and videos show one still scene from different places; their poses are
    estimated. Photographs may come from several cameras, each with three or more at a
    focal length and held one way. z points up if they were held level on average.
    """

    source: tyro.conf.Positional[Path]
    """Scene (.xml), folder of JPEG, PNG or WebP photographs, or video."""
    output: Annotated[Path, tyro.conf.arg(aliases=["-o"])]
    """Folder, new or empty, for transforms.json and images, with depth or sparse
    points."""
    seed: int = 0
    """Of all random numbers."""
    json: bool = False
    """End with one line of JSON in place of the sentences."""
    scene: Annotated[SceneArguments, tyro.conf.OmitArgPrefixes] = field(
        default_factory=SceneArguments
    )
    photographs: Annotated[PhotographArguments, tyro.conf.OmitArgPrefixes] = field(
        default_factory=PhotographArguments
    )

    def run(self) -> Result:
        """Render or estimate, and write."""
        from mi_nerfattack.commands.shared.progress import StageBars
        from mi_nerfattack.io import locks

        is_scene = self.source.suffix.lower() == ".xml"
        other = self.photographs if is_scene else self.scene
        if option := given(other, vars(other)):
            kind = "a scene" if is_scene else "no scene (.xml)"
            raise InputError(
                f"{option}: not for {self.source}, which is {kind}; leave it out"
            )
        check_empty(self.output)
        with locks.claimed(self.output, "choose another"), StageBars() as bars:
            if is_scene:
                path = self.scene.write(self.source, self.output, self.seed, bars)
                document, show = self._views(path)
            else:
                found = self.photographs.write(
                    self.source, self.output, self.seed, bars
                )
                path = found.path
                document, show = self._photographs(found)

        def tell() -> None:
            show()
            folder = shlex.quote(str(path.parent))
            print(
                "Fit a field to them, in 15 minutes; hours give a sharper one, see "
                f"fit:\n  mi-nerfattack fit {folder} -o FIELD.safetensors --network "
                "small --budget-minutes 15"
            )

        return Result({"transforms": str(path), **document}, tell)

    def _views(self, path: Path) -> tuple[dict[str, Any], Callable[[], None]]:
        count = self.scene.views
        return {"views": count}, lambda: print(f"Wrote {count} views to {path.parent}")

    def _photographs(
        self, found: PoseEstimate
    ) -> tuple[dict[str, Any], Callable[[], None]]:
        """Draw the cameras; return what was found, and what prints it."""
        from mi_nerfattack.capture.photographs.quality import retake
        from mi_nerfattack.report.plots.fit import write_cameras_above

        picture = found.path.with_name("cameras.png")
        write_cameras_above(picture, found.found, set(retake(found.qualities)))
        options = self.photographs
        return options.document(found), lambda: options.tell(found, picture)
