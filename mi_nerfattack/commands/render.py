"""``mi-nerfattack render``: a frame or a camera path of any Mitsuba scene."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar, Literal

import tyro

from mi_nerfattack.commands.shared.options import Settings
from mi_nerfattack.commands.shared.terminal import Result

if TYPE_CHECKING:
    import numpy as np

    from mi_nerfattack.render.pathtrace.frames import FrameRenderer
    from mi_nerfattack.render.pathtrace.sequence import Shot


@dataclass(frozen=True)
class _Render:
    """What frames and paths have in common."""

    scene: tyro.conf.Positional[str]
    """Scene file (.xml), or bundled:FILE."""
    output: Path
    """What is written."""
    sensor: int = 0
    """Which of the scene's sensors, from 0."""
    spp: int | None = None
    """Samples per pixel; the scene's by default."""
    seed: int = 0
    """Of the samples; frame i of a path has SEED + i."""
    size: tuple[int, int] | None = None
    """Width and height in pixels, in place of the film's."""
    precision: Literal["half", "float"] = "half"
    """Of colour and opacity in .exr; everything else is float."""
    settings: Settings = ()
    """Set a <default> of the scene: relit=true."""
    json: bool = False
    """End with one line of JSON in place of the sentences."""

    def _renderer(self) -> FrameRenderer:
        from mi_nerfattack.render.pathtrace.frames import FrameRenderer
        from mi_nerfattack.scenes import resolve

        return FrameRenderer(
            resolve(self.scene),
            self.sensor,
            self.spp,
            parameters=self._parameters(),
            size_px=self.size,
        )

    def _parameters(self) -> dict[str, str]:
        from mi_nerfattack.errors import InputError
        from mi_nerfattack.io.overrides import split_setting

        result: dict[str, str] = {}
        for setting in self.settings:
            name, value = split_setting(setting)
            if name in result:
                raise InputError(f"--set {setting}: {name} is set twice; set it once")
            result[name] = value
        return result


@dataclass(frozen=True)
class RenderFrame(_Render):
    """Render one frame: .exr (all channels, linear) or .png (colour, sRGB)."""

    def run(self) -> Result:
        """Render and write."""
        from mi_nerfattack import variant
        from mi_nerfattack.errors import InputError
        from mi_nerfattack.io import files

        if self.output.suffix.lower() not in (".exr", ".png"):
            raise InputError(
                f"{self.output}: one frame is written as .exr or .png; for .mp4 or a "
                "folder of frames use 'mi-nerfattack render path'"
            )
        files.check_writable(self.output)
        variant.ensure()
        return self._write(self._renderer())

    def _write(self, renderer: FrameRenderer) -> Result:
        from mi_nerfattack.render.pathtrace.frames import write_frame

        start = time.monotonic()
        frame = renderer.render(seed=self.seed)
        write_frame(self.output, frame, self.precision)
        (width, height), spp = renderer.size_px, frame.metadata["spp"]
        seconds = time.monotonic() - start
        channels = frame.channels if self.output.suffix.lower() == ".exr" else ()
        document = {
            "output": str(self.output),
            "size_px": [width, height],
            "spp": int(spp),
            "seconds": seconds,
            "channels": [*channels],
        }

        def show() -> None:
            print(
                f"Wrote {self.output}: {width} x {height} px, {spp} samples per "
                f"pixel, {seconds:.1f} s"
            )
            if channels:
                print(f"  channels {' '.join(channels)}")

        return Result(document, show)


@dataclass(frozen=True)
class RenderPath(_Render):
    """Render a camera path: a video (.mp4), or a folder of frame_0000.exr and so on.

    The same command continues where it was stopped.
    """

    continues: ClassVar[bool] = True
    anew: ClassVar[tuple[str, ...]] = ("--force",)

    path: Path | None = None
    """Camera path: transforms.json (OpenGL camera to world, images not needed)."""
    route: str | None = None
    """Camera path: drive this route of --routes-file at its speed."""
    routes_file: Path | None = None
    """Routes file (.json), or bundled:FILE."""
    mount: tuple[float, float, float] = (1.4, 0.5, 6.0)
    """Camera's height and place ahead (metres), pitch down (degrees), of --route."""
    fps: float = 25.0
    """Frames per second of .mp4 and of --route."""
    force: bool = False
    """Render frames that are there again, whatever they show."""

    def run(self) -> Result:
        """Render and write."""
        from mi_nerfattack import variant
        from mi_nerfattack.render.pathtrace.sequence import Shot

        self._check()
        variant.ensure()
        poses = self._poses()
        renderer = self._renderer()
        shot = Shot(
            renderer, poses, self.seed, precision=self.precision, anew=self.force
        )
        return self._write(shot)

    def _check(self) -> None:
        from mi_nerfattack.errors import InputError
        from mi_nerfattack.extras import require
        from mi_nerfattack.io import files

        suffix = self.output.suffix.lower()
        if (self.path is None) == (self.route is None):
            raise InputError("--path, --route: give one of both, a camera path")
        if (self.route is None) != (self.routes_file is None):
            raise InputError("--route, --routes-file: one without the other; give both")
        if suffix in (".exr", ".png"):
            raise InputError(
                f"{self.output}: one image cannot hold a camera path; give .mp4, or "
                "the name of a folder"
            )
        if suffix not in ("", ".mp4") and not self.output.is_dir():
            raise InputError(
                f"{self.output}: unknown suffix {suffix!r}; give .mp4, or the name "
                "of a folder"
            )
        if suffix == ".mp4":
            require(f"{self.output}: a video", "av")
        check = files.check_writable if suffix == ".mp4" else files.check_folder
        check(self.output)

    def _poses(self) -> np.ndarray:
        from mi_nerfattack.capture.camera_path import read_path, route_path
        from mi_nerfattack.render.camera.intrinsics import CameraMount
        from mi_nerfattack.scenes import resolve
        from mi_nerfattack.vehicle.route.route import Route

        if self.path is not None:
            return read_path(self.path)
        assert self.route is not None and self.routes_file is not None
        route = Route.from_file(resolve(str(self.routes_file)), self.route)
        return route_path(route, CameraMount(*self.mount), self.fps)

    def _write(self, shot: Shot) -> Result:
        from mi_nerfattack.commands.shared.progress import StageBars
        from mi_nerfattack.render.pathtrace.sequence import (
            render_folder,
            render_video,
            working_folder,
        )

        is_video = self.output.suffix.lower() == ".mp4"
        folder = working_folder(self.output) if is_video else self.output
        count, written = len(shot.camera_to_world), 0
        with StageBars() as bars:

            def show(done: int, total: int, resumed: bool) -> None:
                nonlocal written
                written = done
                bars.show("rendering", done, total, f"{done}/{total}", resumed)

            try:
                if is_video:
                    size = render_video(shot, self.output, self.fps, progress=show)
                else:
                    size = shot.renderer.size_px
                    render_folder(shot, folder, show)
            except BaseException:
                if written:
                    bars.say(
                        f"{written} of {count} frames are in {folder}; the same "
                        "command continues"
                    )
                raise
        width, height = shot.renderer.size_px
        lines = [f"Wrote {self.output}: {count} frames, {size[0]} x {size[1]} px"]
        if size != (width, height):
            lines.append(
                f"  the frames have {width} x {height} px; the last column or row is "
                "repeated, since H.264 (yuv420p) needs even sizes"
            )
        figures = {"frames": count, "size_px": [*size]}
        document = {"output": str(self.output), **figures}
        return Result(document, lambda: print(*lines, sep="\n"))
