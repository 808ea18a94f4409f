"""``mi-nerfattack car monitor``: an attacked box on a monitor that has a tracker."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from mi_nerfattack.commands.shared.box_options import make_screen
from mi_nerfattack.commands.shared.terminal import say

if TYPE_CHECKING:
    from mi_nerfattack.robot.attacked import AttackedBox, Views
    from mi_nerfattack.robot.follow import StandingScreen
    from mi_nerfattack.robot.monitor import Screen


@dataclass(frozen=True)
class Monitor:
    """Show the attacked cube of a run on a monitor as the car's camera would see it.

    Serves a page, which draws the cube's faces anew with each pose of the tracker: to
    the camera, the cube stands where the attack left it. Until Ctrl-C.
    """

    run_folder: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="RUN")]
    """Folder of a finished run of attack."""
    tracker: str
    """vicon:HOST[:PORT], this computer's address in the tracker's network,
    motioncapture:KIND:HOST, or replay:FILE."""
    tracker_sender: str | None = None
    """Address of VICON's computer, by default that of the first that sends."""
    rotation: Literal["euler", "rotation-vector"] = "euler"
    """VICON's convention."""
    body: str = "racecar"
    """The tracker's name of the car; its frame as for drive. The camera sits on it as
    the run's scenario says."""
    object: str | None = None
    """Id of the box; the only one by default."""
    face: Literal["front", "right", "back", "left", "top", "bottom"] | None = None
    """The monitor stands where this face of the box is, middle on middle; the one that
    the run's drives saw most by default."""
    screen: tuple[float, float, float, float] | None = None
    """The monitor stands elsewhere, upright: X Y Z of the picture's middle, metres, and
    the direction that it faces, degrees from the x axis."""
    diagonal_in: float = 27.0
    """Inches."""
    aspect: str = "16:9"
    """Width to height, WIDTH:HEIGHT."""
    pixels: str = "2560x1440"
    """WIDTHxHEIGHT."""
    background: tuple[int, int, int] = (0, 0, 0)
    """Around the box, 0 to 255."""
    gamma: float | None = None
    """Exponent of the monitor's curve; that of sRGB by default."""
    listen: str = "127.0.0.1:8000"
    """HOST:PORT of the page; other computers reach it by this one's address alone."""

    def run(self) -> int:
        """Read the box, follow, and serve."""
        from contextlib import closing

        from mi_nerfattack import variant
        from mi_nerfattack.render.camera.intrinsics import camera_to_body
        from mi_nerfattack.robot.attacked import read_box
        from mi_nerfattack.robot.follow import FollowServer, follow_page
        from mi_nerfattack.robot.monitor import check_levels
        from mi_nerfattack.robot.remote.sealed import Endpoint
        from mi_nerfattack.robot.tracker.open import open_tracker

        screen = make_screen(self.aspect, self.pixels, self.diagonal_in, self.gamma)
        check_levels(self.background)
        endpoint = Endpoint.parse(self.listen)
        variant.ensure()
        box, views = read_box(self.run_folder, self.object)
        standing = self._standing(screen, box, views)
        page = follow_page(standing, box, self.background)
        camera = camera_to_body(views.mount)[:3, 3]
        tracker = open_tracker(
            self.tracker, views.mount, self.rotation, self.tracker_sender
        )

        with closing(tracker):
            server = FollowServer(
                endpoint, page, standing, box, tracker, self.body, camera, say
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
        from mi_nerfattack.robot.attacked import seen_most
        from mi_nerfattack.robot.follow import StandingScreen

        if self.screen is None:
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
