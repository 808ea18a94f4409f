"""``python -m bench phone FOLDER``: a made phone video through the whole chain."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro

from mi_nerfattack.commands.shared.result import Result

_SCALE, _PSNR_DB, _CORRELATION = 0.01, 26.0, 0.7


@dataclass(frozen=True)
class BenchPhone:
    """Film the bundled room as by hand, reconstruct it from the film, and compare.

    The phone is carried through the room, looks across, sways, trembles and rolls; its
    pictures are blurred by their shutter and differ in exposure. Five printed markers
    lie on the floor. `capture` and `fit` get the film alone. FOLDER keeps what is done:
    light, frames, film.mp4, posed, fields; the same command goes on. With --attack the
    bundled room's policy drives in the field, which takes the bundled field's place in
    scenes/room.toml, the cube is attacked there, and pasted into films of drives. Exit
    code 1 unless the scale is within 1 %, held-out frames have 26 dB by their own
    exposure, and what the cube changes in the steering correlates by 0.7 or more
    between films and surrogate.
    """

    folder: tyro.conf.Positional[Path]
    """Of all results; made if missing. For other options of the film, another."""
    seconds: float = 60.0
    """Of the film."""
    fps: float = 10.0
    """Frames a second."""
    rays: int = 8
    """Through each pixel, over the time that the shutter is open."""
    steps: int = 3000
    """Of the fit."""
    attack: bool = False
    """Drive, attack and overlay, too; some tens of minutes more."""
    runs: int = 8
    """Drives of the card, without objects and past one."""
    seed: int = 0
    """Of the walk, and of all random choices."""
    json: bool = False
    """Print one line of JSON in place of lines."""

    def run(self) -> Result:
        """Do what is not done yet, and compare."""
        from bench.phone.chain import capture, fit
        from bench.phone.film import shoot
        from bench.phone.walk import Walk
        from mi_nerfattack import variant
        from mi_nerfattack.commands.shared.options import check_positive
        from mi_nerfattack.commands.shared.progress import StageBars
        from mi_nerfattack.io import files

        variant.ensure()
        check_positive(self, "seconds", "fps", "rays", "steps", "runs")
        folder = files.make_folder(self.folder)
        with StageBars() as bars:
            shoot(
                folder,
                Walk(self.seconds, self.seed),
                self.fps,
                self.rays,
                lambda stage, done, total: bars.show(
                    stage, done, total, f"{done} of {total}"
                ),
            )
        found: dict[str, Any] = capture(folder, self.seed) | fit(folder, self.steps)
        if self.attack:
            found |= self._attack(folder)

        def show() -> None:
            for name, value in found.items():
                print(f"{name}: {value:.5g}")
            if self.attack:
                print(f"{folder / 'card.json'}, {folder / 'run'}: card and attack")

        good = abs(found["scale_error"]) <= _SCALE
        good = good and found["psnr_exposed_db"] >= _PSNR_DB
        good = good and found.get("correlation", 1) >= _CORRELATION
        return Result(found, show, int(not good))

    def _attack(self, folder: Path) -> dict[str, Any]:
        from bench.phone.attack import attack, card, overlay, write_scenario

        field = folder / f"field-{self.steps}.safetensors"
        scenario = write_scenario(folder, field)
        card(folder, scenario, self.runs)
        attack(folder, scenario)
        return overlay(folder)
