"""``mi-nerfattack car overlay``: an attacked box in what a real camera recorded."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import tyro

from mi_nerfattack.commands.shared.options import check_empty
from mi_nerfattack.commands.shared.terminal import Result

if TYPE_CHECKING:
    import numpy as np

    from mi_nerfattack.deploy.replay.recording import AbstractRecording
    from mi_nerfattack.props.overlay import Overlay


@dataclass(frozen=True)
class OverlayCommand:
    """Show the attacked cube of a run in a recorded drive, where a green target stands.

    Things before the target also hide the cube. The poses are those of the recording,
    in metres and in the run's frame of the world.
    """

    recording: tyro.conf.Positional[Path]
    """Video with a pose file of the same name next to it, folder of images with
    transforms.json, poses.csv or poses.toml, or .mcap log, as for replays."""
    run_folder: tyro.conf.Positional[Path]
    output: Path
    """FILE.mp4, or a new or empty folder for PNG images."""
    box: str | None = None
    """Id of the box; the only one by default."""
    paste: bool = False
    """Show it by its pose alone, with no green target; what the recording's depth, if
    it has any, says is nearer stays before it."""
    topics: tuple[str, ...] = ()
    """Topics of a log: image=/front camera_pose=/pose vehicle_pose=/odom
    calibration=/info."""
    json: bool = False

    def run(self) -> Result:
        """Read, project and write."""
        from contextlib import closing, nullcontext

        import numpy as np

        from mi_nerfattack import variant
        from mi_nerfattack.commands.shared.progress import StageBars
        from mi_nerfattack.deploy.replay.environment import open_recording
        from mi_nerfattack.deploy.replay.mcap import McapTopics
        from mi_nerfattack.io import files, locks
        from mi_nerfattack.io.video import check_fps, write_video
        from mi_nerfattack.props.attacked import read_box
        from mi_nerfattack.props.overlay import Overlay

        is_video = self._check_output()
        variant.ensure()
        box, views = read_box(self.run_folder, self.box)
        topics = McapTopics.parse(self.topics)
        recording = open_recording(
            self.recording,
            views.camera,
            views.mount,
            period=views.period,
            topics=topics,
        )
        alone = (
            nullcontext() if is_video else locks.claimed(self.output, "choose another")
        )
        with closing(recording), alone, StageBars() as bars:
            for remark in recording.remarks:
                bars.say(f"{self.recording}: {remark}")
            overlay = Overlay(box, recording.camera, keyed=not self.paste)
            times = recording.track.times
            on_frame = bars.counter("overlaying", "frame ")
            frames = self._frames(recording, overlay, on_frame)
            if is_video:
                steps = np.diff(times) if len(times) > 1 else views.period
                fps = 1 / float(np.median(steps))
                check_fps(fps)
                write_video(self.output, frames, fps)
            else:
                for index, frame in enumerate(frames):
                    files.write_image(self.output / f"{index:05d}.png", frame)
        message = f"Wrote {self.output}: {len(times)} frames with {box.name}"
        figures = {"frames": len(times), "object": box.name}
        return Result({"output": str(self.output), **figures}, lambda: print(message))

    def _check_output(self) -> bool:
        """Refuse what would replace anything recorded; return whether it is a video."""
        from mi_nerfattack.errors import InputError
        from mi_nerfattack.io import files

        path, output = self.output, self.output.resolve()
        is_video = path.suffix.lower() == ".mp4"
        if path.suffix and not is_video:
            raise InputError(f"-o: {path}; give FILE.mp4 or a folder's name")
        if self.recording.resolve() in (output, *output.parents):
            raise InputError(f"-o: {path}; is the recording or in it, choose another")
        if is_video:
            files.check_writable(path)
            return True
        check_empty(path)
        return False

    def _frames(
        self,
        recording: AbstractRecording,
        overlay: Overlay,
        on_frame: Callable[[int, int], None],
    ) -> Iterator[np.ndarray]:
        poses = recording.track.camera_to_world
        for index, pose in enumerate(poses):
            depth = recording.depth(index) if self.paste else None
            yield overlay.apply(recording.image(index), pose, depth)
            on_frame(index + 1, len(poses))
