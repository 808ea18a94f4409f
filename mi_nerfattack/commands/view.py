"""``mi-nerfattack view``: a run in the browser."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import tyro


@dataclass(frozen=True)
class View:
    """Show a finished run in the browser, until Ctrl-C.

    The place as points, the objects as the attack left them, all drives, and at any
    time of a drive the frame that the policy saw, with where the attack acts, rendered
    when it is asked for. Objects can be moved, and are rendered again.
    """

    run_folder: tyro.conf.Positional[Path]
    """Finished run folder of attack."""
    drive: str | None = None
    """Shown first: ENVIRONMENT: CASE, as "deployment: attack"; past the attack in the
    surrogate by default."""
    host: str = "127.0.0.1"
    """Name or address to listen at. Whoever gets there sees the run, and moves its
    objects: this computer alone, by default."""
    port: int = 8080
    """TCP port to listen at; 0 for any that is free."""
    open: bool = False
    """Open it in the browser of this computer."""

    def run(self) -> int:
        """Read, listen, and render."""
        import webbrowser

        from mi_nerfattack import variant
        from mi_nerfattack.commands.shared.progress import StageBars
        from mi_nerfattack.experiment.view.points import scene_cloud
        from mi_nerfattack.experiment.view.run import read_viewed
        from mi_nerfattack.experiment.view.scene import object_shapes
        from mi_nerfattack.experiment.view.server import serving
        from mi_nerfattack.experiment.view.viewer import Viewer

        variant.ensure()
        with serving(self.host, self.port) as server:
            with StageBars() as bars:
                bars.say(f"reading {self.run_folder}")
                viewed = read_viewed(self.run_folder)
                drive = viewed.drive(self.drive)
                look = bars.counter("looking around", "frame ")
                cloud = scene_cloud(viewed.world, drive.states, look)
                viewer = Viewer(server, viewed, cloud, object_shapes(viewed), drive)
            name = f"[{self.host}]" if ":" in self.host else self.host
            address = f"http://{name}:{server.get_port()}"
            print(f"Showing {self.run_folder} at {address}; Ctrl-C ends", flush=True)
            if self.open:
                webbrowser.open(address)
            try:
                viewer.run()
            except KeyboardInterrupt:
                print("Ended", flush=True)
        return 0
