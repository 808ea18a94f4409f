"""A drive as one HTML file, which opens without any server, or from one of ours."""

from __future__ import annotations

import html
import io
import socket
from collections.abc import Callable, Iterator
from contextlib import contextmanager, redirect_stdout
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from mi_nerfattack.errors import InputError
from mi_nerfattack.experiment.view.frames import NOWHERE, FrameSource
from mi_nerfattack.experiment.view.scene import Contents, RunScene, first_look
from mi_nerfattack.experiment.view.viewer import describe
from mi_nerfattack.extras import load_extra
from mi_nerfattack.io import files

if TYPE_CHECKING:
    import viser


LOOPBACK = "127.0.0.1"


@contextmanager
def serving(host: str, port: int) -> Iterator[viser.ViserServer]:
    """Serve an empty scene.

    Args:
        host: name or address to listen at.
        port: 0 for any that is free; `get_port` of the server returns it.

    Raises:
        InputError: nothing can listen there, as where something else does.
        SetupError: viser cannot be imported.
    """
    module = load_extra("viser", "the viewer")
    _check_free(host, port)
    with _quiet():
        server = module.ViserServer(host, port, verbose=False)
    try:
        if port not in (0, server.get_port()):  # taken meanwhile: it takes the next
            raise _taken(host, port, "in use")
        # The browser's button would open the scene to the world.
        server.request_share_url = lambda verbose=True: None
        server.gui.configure_theme(
            control_width="large", show_logo=False, show_share_button=False
        )
        yield server
    finally:
        with _quiet():
            server.stop()


def _check_free(host: str, port: int) -> None:
    """Listen as the server will, which waits for ever where it cannot."""
    try:
        for family, kind, proto, _, address in socket.getaddrinfo(
            host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE
        ):
            with socket.socket(family, kind, proto) as tried:
                tried.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
                tried.bind(address)
                tried.listen()
    except (OSError, OverflowError, UnicodeError) as err:
        raise _taken(host, port, getattr(err, "strerror", None) or str(err)) from err


def _taken(host: str, port: int, cause: str) -> InputError:
    return InputError(
        f"--host {host} --port {port}: cannot listen there ({cause}); give another "
        f"port, 0 for one that is free, and an address of this computer ({LOOPBACK})"
    )


def _quiet() -> redirect_stdout[io.StringIO]:
    """Keep what viser prints to itself; the command tells where it listens."""
    return redirect_stdout(io.StringIO())


_TITLE = "<title>Viser</title>"


def write_view(
    path: Path,
    contents: Contents,
    on_frame: Callable[[int, int], None] = lambda done, total: None,
) -> None:
    """Write the scene, and one drive as it goes on, each frame before its camera.

    Cost: all frames at the cost that `FrameSource` states, twice with an attack.

    Args:
        path: HTML file.
        contents: what is shown; textures of other drives are left out.
        on_frame: called with frames done and all frames.

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
                image = frames.see(drive, step)
                apart = frames.difference(drive, step, image, moved=NOWHERE)
                scene.look_from(pose, image)
                scene.tell(describe(viewed, drive, step), apart)
                recording.insert_sleep(viewed.world.scenario.vehicle.dt_s)
                on_frame(step + 1, total)
        finally:
            frames.close()
        page = recording.as_html()
    name = f"{viewed.world.scenario.name}: {drive.environment}, {drive.case}"
    page = page.replace(_TITLE, f"<title>{html.escape(name)}</title>", 1)
    files.write_text(path, page)
