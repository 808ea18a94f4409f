"""An attacked box on a monitor, as a tracked camera would see it there."""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from http.server import BaseHTTPRequestHandler
from typing import Any

import numpy as np
from PIL import Image

from mi_nerfattack.car.devices import (
    AbstractTracker,
    DeviceLostError,
    TrackedPose,
)
from mi_nerfattack.io.network import Endpoint, HttpServer
from mi_nerfattack.props.attacked import AttackedBox
from mi_nerfattack.props.monitor import Screen, levels_sent
from mi_nerfattack.report.pages.elements import address, render

#: A camera whose pose is older than this, seconds, is told of as lost.
STALE_S = 0.5
_POLL_S = 0.002  # trackers send every 2 to 20 ms


@dataclass(frozen=True, eq=False)
class StandingScreen:
    """A monitor in the world.

    Attributes:
        screen: its size and pixels.
        middle: (3,), of the picture, metres.
        right, down: (3,), unit vectors of the picture's axes.
    """

    screen: Screen
    middle: np.ndarray
    right: np.ndarray
    down: np.ndarray

    @classmethod
    def on_face(cls, screen: Screen, box: AttackedBox, face: str) -> StandingScreen:
        """Stand where a face of the box is: in its plane, middle on middle."""
        corner, across, down = box.plane(face)
        right, below = (v / np.linalg.norm(v) for v in (across, down))
        return cls(screen, corner + (across + down) / 2, right, below)

    @classmethod
    def upright(
        cls, screen: Screen, middle: np.ndarray, heading: float
    ) -> StandingScreen:
        """Stand upright.

        Args:
            screen: its size and pixels.
            middle: (3,), metres.
            heading: of the way it faces, radians from the world's x axis.
        """
        right = np.array([-np.sin(heading), np.cos(heading), 0.0])
        return cls(screen, np.asarray(middle, float), right, np.array([0.0, 0.0, -1.0]))

    def rays(self, eye: np.ndarray) -> np.ndarray:
        """Return the matrix (3, 3) from pixels (x, y, 1) to rays from an eye (3,).

        x and y are from the picture's top left corner.
        """
        across, down = 1e3 * np.array(self.screen.px_per_mm)  # pixels a metre
        half = np.array([self.screen.width_px, self.screen.height_px]) / 2
        steps = self.right / across, self.down / down
        corner = self.middle - half[0] * steps[0] - half[1] * steps[1]
        return np.stack([*steps, corner - eye], axis=1)


def seen_faces(
    standing: StandingScreen, box: AttackedBox, eye: np.ndarray
) -> dict[str, np.ndarray]:
    """Return where faces of the box belong on the monitor, for one eye.

    Args:
        standing: the monitor.
        box: in the same frame of the world.
        eye: (3,), of the camera, metres.

    Returns:
        by the names of the faces that are seen: matrices (3, 3). A matrix maps
        (u, v, 1), from 0 to 1 across and down the face's picture, to pixels (x, y, 1)
        times a number that is positive in front of the eye. Faces that are seen never
        hide each other. Empty for an eye behind the monitor.
    """
    facing = np.cross(standing.down, standing.right)
    if (eye - standing.middle) @ facing <= 0:
        return {}
    to_pixels, matrices = np.linalg.inv(standing.rays(eye)), {}
    for face in box.faces:
        corner, across, down = box.plane(face)
        if (eye - corner) @ np.cross(down, across) > 0:
            matrices[face] = to_pixels @ np.stack([across, down, corner - eye], axis=1)
    return matrices


def follow_page(
    standing: StandingScreen,
    box: AttackedBox,
    background: tuple[int, int, int] = (0, 0, 0),
) -> str:
    """Return the page that shows the box; it asks its server where faces belong.

    Args:
        standing: the monitor.
        box: of it, the pictures.
        background: of the rest, as sent to the monitor, 0 to 255.
    """
    screen, pictures = standing.screen, {}
    for face, image in box.images.items():
        sent = Image.fromarray(levels_sent(image, screen.gamma))
        pictures[face] = (*sent.size, address(sent, "PNG"))
    return render(
        "monitor.html.j2",
        title=f"{box.name}, run {box.run}, digest {box.digest[:16]}",
        width=screen.width_px,
        height=screen.height_px,
        background="#" + bytes(background).hex(),
        picture=None,
        pictures=pictures,
    )


class FollowServer:
    """Serves the page, and to it where faces belong each time that the camera moved.

    Args:
        endpoint: where it listens.
        page: see `follow_page`.
        standing: the monitor.
        box: what it shows.
        tracker: of the camera's vehicle.
        body: the tracker's name of the vehicle.
        camera: (3,), of the camera in the body's frame, metres.
        say: called with a line when the camera is lost, and when it is found again.

    Raises:
        InputError: it cannot listen there.
    """

    def __init__(
        self,
        endpoint: Endpoint,
        page: str,
        standing: StandingScreen,
        box: AttackedBox,
        tracker: AbstractTracker,
        body: str,
        camera: np.ndarray,
        say: Callable[[str], None],
    ) -> None:
        self._standing, self._box, self._say = standing, box, say
        self._tracker, self._body, self._camera = tracker, body, camera
        self._closed = threading.Event()
        self._lost = False
        self._server = HttpServer(endpoint, self._handler(page))
        # from now on, for `close` waits for its end
        threading.Thread(target=self._server.serve_forever, daemon=True).start()

    @property
    def address(self) -> str:
        """Of the page, for a browser."""
        host, port = self._server.server_address[:2]
        return f"http://{Endpoint(str(host), int(port))}/"

    def run(self) -> None:
        """Tell of the camera until `close`, or until the tracker's end.

        Raises:
            DeviceLostError: no more poses will come.
        """
        while not self._closed.wait(STALE_S / 5):
            self._tell(self._tracker.newest(self._body))

    def close(self) -> None:
        """Stop listening; more than once does no harm."""
        if not self._closed.is_set():
            self._closed.set()
            self._server.shutdown()
            self._server.close()

    def _tell(self, pose: TrackedPose | None) -> None:
        lost = pose is None or time.monotonic() - pose.time_s > STALE_S
        if lost and not self._lost:
            self._say(
                f"Lost: {self._tracker.explain(self._body)}; the picture stands still"
            )
        elif self._lost and not lost:
            self._say(f"{self._body} is seen again")
        self._lost = lost

    def _events(self) -> Iterator[bytes]:
        """Yield an event for each new pose, and a remark while there is none."""
        index, sent = None, time.monotonic()
        while not self._closed.is_set():
            try:
                pose = self._tracker.newest(self._body)
            except DeviceLostError:  # which `run` tells of
                return
            now = time.monotonic()
            if pose is not None and pose.index != index:
                index, sent = pose.index, now
                eye = pose.body_to_world[:3, :3] @ self._camera
                eye += pose.body_to_world[:3, 3]
                faces = seen_faces(self._standing, self._box, eye)
                data = {face: matrix.ravel().tolist() for face, matrix in faces.items()}
                yield f"data: {json.dumps(data)}\n\n".encode()
            elif now - sent > 1.0:  # so that a browser that left is noticed
                sent = now
                yield b": no new pose\n\n"
            time.sleep(_POLL_S)

    def _handler(self, page: str) -> type[BaseHTTPRequestHandler]:
        server = self

        class Handler(BaseHTTPRequestHandler):
            def do_GET(self) -> None:
                kinds = {"/": "text/html; charset=utf-8", "/eye": "text/event-stream"}
                if self.path not in kinds:
                    self.send_error(404)
                    return
                self.send_response(200)
                self.send_header("Content-Type", kinds[self.path])
                self.send_header("Cache-Control", "no-store")
                self.end_headers()
                events = [page.encode()] if self.path == "/" else server._events()
                try:
                    for event in events:
                        self.wfile.write(event)
                        self.wfile.flush()
                except ConnectionError:  # the browser left
                    return

            def log_message(self, format: str, *args: Any) -> None:
                """Say nothing of requests."""

        return Handler
