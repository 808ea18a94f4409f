"""A drive as one HTML file, which opens without this package and any server."""

from __future__ import annotations

import html
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from mi_nerfattack.experiment.view.frames import NOWHERE, FrameSource
from mi_nerfattack.experiment.view.scene import Contents, RunScene, first_look
from mi_nerfattack.experiment.view.server import LOOPBACK, serving
from mi_nerfattack.experiment.view.viewer import describe
from mi_nerfattack.io import files

_TITLE = "<title>Viser</title>"


def write_view(
    path: Path,
    contents: Contents,
    on_frame: Callable[[int, int], None] = lambda done, total: None,
) -> None:
    """Write the scene, and one drive as it goes on, each frame before its camera.

    Cost: what `FrameSource` tells, for all frames, each twice with an attack.

    Args:
        path: HTML file.
        contents: what is shown; looks of other drives than its own are left out.
        on_frame: told how many frames are done, of how many.

    Raises:
        InputError: the drive's environment cannot be opened.
        SetupError: viser cannot be imported.
    """
    viewed, drive = contents.viewed, contents.drive
    case, frames = drive.case, FrameSource(viewed)
    own = [
        replace(shape, looks={k: v for k, v in shape.looks.items() if k == case})
        for shape in contents.shapes
    ]
    total = len(drive.controls) + 1
    with serving(LOOPBACK, 0) as server:
        scene = RunScene(server.scene, replace(contents, shapes=own))
        scene.show(case, viewed.poses(case, NOWHERE))
        eye, target = first_look(viewed, drive)
        server.initial_camera.position, server.initial_camera.look_at = eye, target
        recording = server.get_scene_serializer()
        try:
            for step, pose in enumerate(viewed.cameras(drive)):
                seen = frames.see(drive, step)
                apart = frames.difference(drive, step, seen, NOWHERE)
                scene.look_from(pose, seen)
                scene.tell(describe(viewed, drive, step), apart)
                recording.insert_sleep(viewed.world.scenario.vehicle.dt_s)
                on_frame(step + 1, total)
        finally:
            frames.close()
        page = recording.as_html()
    name = f"{viewed.world.scenario.name}: {drive.environment}, {drive.case}"
    page = page.replace(_TITLE, f"<title>{html.escape(name)}</title>", 1)
    files.write_text(path, page)
