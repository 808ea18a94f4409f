"""``mi-nerfattack car monitor``: an attacked box on a monitor that has a tracker."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import tyro

from mi_nerfattack.commands.shared.terminal import say
from mi_nerfattack.errors import InputError

if TYPE_CHECKING:
    from mi_nerfattack.props.attacked import AttackedBox, Views
    from mi_nerfattack.props.follow import StandingScreen
    from mi_nerfattack.props.monitor import Screen


@dataclass(frozen=True, kw_only=True)
class ScreenOptions:
    """The box, and the monitor that shows it."""

    run_folder: tyro.conf.Positional[Path]
    box: str | None = None
    """Id of the box; the only one by default."""
    face: Literal["front", "right", "back", "left", "top", "bottom"] | None = None
    """Face of the box, front towards -y; the one seen most by default."""
    diagonal_in: float = 27.0
    """Diagonal of the monitor, inches."""
    aspect: str = "16:9"
    """Its width to height, WIDTH:HEIGHT."""
    pixels: str = "2560x1440"
    """Its pixels, WIDTHxHEIGHT."""
    background: tuple[int, int, int] = (0, 0, 0)
    """Colour around the box, 0 to 255."""
    gamma: float | None = None
    """Exponent of the monitor's curve; that of sRGB by default."""

    def _make_screen(self) -> Screen:
        """Return the monitor; InputError where its numbers are wrong."""
        from mi_nerfattack.props.monitor import Screen, check_levels

        across, down = _pair("--aspect", self.aspect, ":")
        width, height = map(round, _pair("--pixels", self.pixels, "x"))
        check_levels(self.background)
        return Screen(
            width, height, self.diagonal_in, aspect=across / down, gamma=self.gamma
        )


def _pair(name: str, text: str, mark: str) -> tuple[float, float]:
    """Read two positive numbers with a mark between them."""
    try:
        first, second = map(float, text.lower().split(mark))
    except ValueError as err:
        raise InputError(f"{name}: {text!r}; two numbers, as in 16{mark}9") from err
    if not (0 < first < 1e6 and 0 < second < 1e6):
        raise InputError(f"{name}: {text}; must be positive")
    return first, second


@dataclass(frozen=True, kw_only=True)
class Monitor(ScreenOptions):
    """Show the attacked cube of a run on a monitor as the car's camera would see it.

    Serves a page, which draws the cube's faces again with each pose of the tracker: to
    the camera, the cube stands where the attack left it. Until Ctrl-C.
    """

    tracker: str
    """vicon:HOST[:PORT], motioncapture:KIND:HOST, or replay:FILE. The host of VICON is
    this computer's address in the tracker's network."""
    tracker_sender: str | None = None
    """Address of VICON's computer; that of the first that sends by default."""
    rotation: Literal["euler", "rotation-vector"] = "euler"
    """VICON's convention."""
    body: str = "racecar"
    """The tracker's name of the car, with the camera as in the run's scenario."""
    screen: tuple[float, float, float, float] | None = None
    """Middle of an upright picture, X Y Z, metres, and the direction that it faces,
    degrees from the x axis; the middle of --face by default."""
    listen: str = "127.0.0.1:8000"
    """HOST:PORT of the page; 0.0.0.0 for other computers."""

    def run(self) -> int:
        """Read the box, follow, and serve."""
        from contextlib import closing

        from mi_nerfattack import variant
        from mi_nerfattack.car.tracker.open import open_tracker
        from mi_nerfattack.io.network import Endpoint
        from mi_nerfattack.props.attacked import read_box
        from mi_nerfattack.props.follow import FollowServer, follow_page
        from mi_nerfattack.render.camera.intrinsics import camera_to_body

        screen = self._make_screen()
        endpoint = Endpoint.parse(self.listen)
        variant.ensure()
        box, views = read_box(self.run_folder, self.box)
        standing = self._standing(screen, box, views)
        page = follow_page(standing, box, self.background)
        camera = camera_to_body(views.mount)[:3, 3]
        tracker = open_tracker(
            self.tracker, views.mount, self.rotation, sender=self.tracker_sender
        )

        with closing(tracker):
            server = FollowServer(
                endpoint,
                page,
                standing,
                box=box,
                tracker=tracker,
                body=self.body,
                camera=camera,
                say=say,
            )
            with closing(server):
                say(f"{server.address}: open it on the monitor, F for full screen")
                try:
                    server.run()
                except KeyboardInterrupt:
                    say("Ended")
        return 0

    def _standing(
        self, screen: Screen, box: AttackedBox, views: Views
    ) -> StandingScreen:
        import numpy as np

        from mi_nerfattack.errors import InputError
        from mi_nerfattack.props.attacked import seen_most
        from mi_nerfattack.props.follow import StandingScreen

        if self.screen is None:
            box.check_face(self.face)
            face = self.face or seen_most(box, views)
            return StandingScreen.on_face(screen, box, face)
        if self.face is not None:
            raise InputError(
                "--screen: says where the monitor stands; leave out --face"
            )
        *middle, heading = self.screen
        if not np.isfinite(self.screen).all():
            raise InputError(f"--screen: {self.screen}; must be finite")
        return StandingScreen.upright(screen, np.array(middle), np.deg2rad(heading))
