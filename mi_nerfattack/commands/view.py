"""``mi-nerfattack view``: a run in the browser."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import tyro

if TYPE_CHECKING:
    from mi_nerfattack.commands.shared.progress import StageBars
    from mi_nerfattack.experiment.view.scene import Contents


@dataclass(frozen=True)
class View:
    """Show a finished run in the browser, until Ctrl-C.

    The scene shows the place as points, the objects as the attack left them, and all
    drives. At any time of a drive it shows the frame that the policy saw and where the
    attack acts, rendered on request. You can move the objects, and they are rendered
    again.
    """

    run_folder: tyro.conf.Positional[Path]
    """Finished run folder of attack."""
    output: Path | None = None
    """Write one HTML file, which opens by itself, and end: the scene, with one drive
    that plays."""
    drive: str | None = None
    """Shown first, or written: ENVIRONMENT: CASE, as "mitsuba: attack"; by default the
    attack in the surrogate."""
    host: str = "127.0.0.1"
    """Name or address to listen at. Whoever gets there sees the run and moves its
    objects: this computer alone by default."""
    port: int = 8080
    """TCP port to listen at; 0 for any that is free."""
    open: bool = False
    """Open it in the browser of this computer."""

    def run(self) -> int:
        """Show it, or write the file."""
        from mi_nerfattack import variant

        variant.ensure()
        if self.output is None:
            self._serve()
        else:
            self._write(self.output)
        return 0

    def _serve(self) -> None:
        """Render what the browser asks for, until Ctrl-C."""
        import webbrowser

        from mi_nerfattack.commands.shared.progress import StageBars
        from mi_nerfattack.experiment.view.page import serving
        from mi_nerfattack.experiment.view.viewer import Viewer
        from mi_nerfattack.io.network import Endpoint

        with serving(self.host, self.port) as server:
            with StageBars() as bars:
                viewer = Viewer(server, self._read(bars))
            address = f"http://{Endpoint(self.host, server.get_port())}"
            print(f"Showing {self.run_folder} at {address}; Ctrl-C ends", flush=True)
            if self.open:
                webbrowser.open(address)
            try:
                viewer.run()
            except KeyboardInterrupt:
                print("Ended", flush=True)

    def _write(self, output: Path) -> None:
        from mi_nerfattack.commands.shared.options import check_suffix
        from mi_nerfattack.commands.shared.progress import StageBars
        from mi_nerfattack.experiment.view.page import write_view
        from mi_nerfattack.io import files

        check_suffix(output, ".html", ".htm")
        files.check_writable(output)
        with StageBars() as bars:
            write_view(output, self._read(bars), bars.counter("frames", "frame "))
        size = output.stat().st_size / 1e6
        print(f"Written: {output.resolve()} ({size:.1f} MB)")

    def _read(self, bars: StageBars) -> Contents:
        from mi_nerfattack.experiment.view.scene import read_contents
        from mi_nerfattack.extras import load_extra

        load_extra("viser", "the viewer")
        bars.say(f"reading {self.run_folder}")
        look = bars.counter("looking around", "frame ")
        return read_contents(self.run_folder, self.drive, look)
