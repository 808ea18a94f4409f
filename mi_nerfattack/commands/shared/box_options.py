"""Options of ``export``: an attacked box on paper or on a monitor."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from mi_nerfattack.commands.shared.options import given
from mi_nerfattack.errors import InputError

if TYPE_CHECKING:
    from mi_nerfattack.robot.attacked import AttackedBox
    from mi_nerfattack.robot.monitor import Screen

Told = tuple[dict[str, Any], str]
"""What was written, for programs and as a sentence."""


@dataclass(frozen=True)
class BoxOptions:
    """How an attacked box leaves the computer."""

    print: Path | None = None
    """FILE.pdf: the six faces of an attacked box of a run folder, as a net to fold."""
    monitor: Path | None = None
    """FILE.png or FILE.html: one face of it, for a monitor, at its physical size."""
    object: str | None = None
    """Of --print and --monitor: id of the box; the only one by default."""
    size_mm: float | None = None
    """Of --print and --monitor: longest edge; as large as in the run by default."""
    paper: Literal["a4", "a3", "letter"] = "a4"
    """Of --print: several pages, if the net is larger."""
    dpi: int = 300
    """Of --print: pixels an inch."""
    face: Literal["front", "right", "back", "left", "top", "bottom"] | None = None
    """Of --monitor: as the box itself is turned, front towards -y; the one that the
    run's drives saw most by default."""
    diagonal_in: float = 27.0
    """Of --monitor: inches."""
    aspect: str = "16:9"
    """Of --monitor: width to height, WIDTH:HEIGHT."""
    pixels: str = "2560x1440"
    """Of --monitor: WIDTHxHEIGHT."""
    background: tuple[int, int, int] = (0, 0, 0)
    """Of --monitor: around the face, 0 to 255."""
    gamma: float | None = None
    """Of --monitor: exponent of its curve; that of sRGB by default."""

    @property
    def is_asked(self) -> bool:
        """Whether there is anything to write."""
        return self.print is not None or self.monitor is not None

    def write(self, run: Path, on_page: Callable[[int, int], None]) -> dict[str, Told]:
        """Check, read the box and write what is asked for; return what to tell of each.

        Raises:
            InputError: an option or file that cannot be used.
        """
        from mi_nerfattack.io import files
        from mi_nerfattack.robot.attacked import read_box, seen_most

        screen = self._checked()
        for path in (self.print, self.monitor):
            if path is not None:
                files.check_writable(path)
        box, views = read_box(run, self.object)
        show = None
        if self.monitor is not None:
            face = self.face or seen_most(box, views)
            show = self._shown(self.monitor, box, face, screen)
        told = {}
        if self.print is not None:  # checks by itself before it writes
            told["print"] = self._print(self.print, box, on_page)
        if show is not None:
            told["monitor"] = show()
        return told

    def _checked(self) -> Screen:
        """Refuse wrong names and numbers before anything is read."""
        for needed, names in _NEEDED.items():
            if getattr(self, needed) is None and (option := given(self, names)):
                raise InputError(f"{option}: needs --{needed}")
        if self.print is not None and self.print.suffix.lower() != ".pdf":
            raise InputError(f"--print: {self.print}; give FILE.pdf")
        if self.monitor is not None and self.monitor.suffix.lower() not in _SHOWN:
            raise InputError(f"--monitor: {self.monitor}; give FILE.png or FILE.html")
        return make_screen(self.aspect, self.pixels, self.diagonal_in, self.gamma)

    def _print(
        self, path: Path, box: AttackedBox, on_page: Callable[[int, int], None]
    ) -> Told:
        from mi_nerfattack.robot.paper import write_net

        edges = box.edges_mm(self.size_mm)
        count = write_net(path, box, edges, self.paper, self.dpi, on_page)
        size = " x ".join(f"{edge:.1f}" for edge in edges)
        pages = "page" if count == 1 else "pages"
        told = f"Wrote {path}: net of {box.name}, {size} mm, {count} {pages}"
        figures = {"edges_mm": edges.tolist(), "pages": count}
        return {"output": str(path), "box": box.name, **figures}, told

    def _shown(
        self, path: Path, box: AttackedBox, face: str, screen: Screen
    ) -> Callable[[], Told]:
        """Make the picture; return what writes it and says so."""
        from mi_nerfattack.io import files
        from mi_nerfattack.robot.monitor import screen_image, screen_page
        from mi_nerfattack.robot.net import MM, Net

        edges = box.edges_mm(self.size_mm)
        spot = Net(edges).faces[face]
        size = spot.width, spot.height
        longest = float(edges.max())
        image = screen_image(screen, box.images[face], size, self.background, longest)

        def write() -> Told:
            if path.suffix.lower() == ".png":
                files.write_image(path, image)
            else:
                about = f"{box.name}, {face}, run {box.run}, digest {box.digest[:16]}"
                files.write_text(path, screen_page(image, about))
            dpi = float(MM * screen.px_per_mm[0])
            figures = {"size_mm": [*map(float, size)], "pixels_per_inch": dpi}
            return {
                "output": str(path),
                "box": box.name,
                "face": face,
                **figures,
            }, (
                f"Wrote {path}: {face} of {box.name}, {size[0]:.1f} x {size[1]:.1f} mm "
                f"on {self.pixels} pixels, {dpi:.1f} an inch"
            )

        return write


_SHOWN = (".png", ".html")
_NEEDED = {
    "print": ("paper", "dpi"),
    "monitor": ("face", "diagonal_in", "aspect", "pixels", "background", "gamma"),
}


def make_screen(
    aspect: str, pixels: str, diagonal_in: float, gamma: float | None
) -> Screen:
    """Return the monitor that options describe.

    Raises:
        InputError: one is out of range, or no two numbers.
    """
    from mi_nerfattack.robot.monitor import Screen

    across, down = _pair("--aspect", aspect, ":")
    width, height = map(round, _pair("--pixels", pixels, "x"))
    return Screen(width, height, diagonal_in, across / down, gamma)


def _pair(name: str, text: str, mark: str) -> tuple[float, float]:
    """Read two positive numbers with a mark between them."""
    try:
        first, second = map(float, text.lower().split(mark))
    except ValueError as err:
        raise InputError(f"{name}: {text!r}; two numbers, as in 16{mark}9") from err
    if not (0 < first < 1e6 and 0 < second < 1e6):
        raise InputError(f"{name}: {text}; must be positive")
    return first, second
