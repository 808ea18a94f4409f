"""``python -m bench quality``: attacks in fields of several qualities."""

from __future__ import annotations

import itertools
import shlex
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import tyro

SCENES = Path(__file__).parents[2] / "scenes"
FIELD = "intersection/field.safetensors"
_ONE_LOOK = {"textures": 1, "deployment_textures": 1}


@dataclass(frozen=True)
class BenchQuality:
    """Make Table 2's attacks in fields of fewer steps, and drive past them elsewhere.

    Renders the bundled intersection as for its field, fits fields with fewer steps by
    the same command, makes the attacks of scenes/table2.toml in each and in the bundled
    one (100 %), and gives all to one transfer, which draws the curve. FOLDER gets
    views, fields, quality.toml, sweep and transfer; the same command goes on.
    """

    folder: tyro.conf.Positional[Path]
    """Of all results; made if missing."""
    steps: tuple[int, ...] = (120, 600, 2400)
    """Of the fits: 1, 5 and 20 % of the bundled field's."""
    seeds: tuple[int, ...] = (1, 2, 3, 4, 5)
    """Of the attacks, and of their places; those of Table 2."""
    starts: int = 4
    """Drives past each attack in the transfer, from unseen starts."""
    workers: int | None = None
    """Processes; one a core by default."""
    check: bool = False
    """Only tell commands and cells, and time one attack."""

    def run(self) -> int:
        """Do what is not done yet."""
        from mi_nerfattack.errors import InputError
        from mi_nerfattack.io import files

        if min(self.steps, default=0) < 1 or len(set(self.steps)) < len(self.steps):
            raise InputError(f"--steps: {self.steps}; at least one number, each once")
        files.make_folder(self.folder / "fields")
        folder = self.folder.resolve()
        if self.check:
            return self._check(folder)
        for output, words in self._fits(folder):
            if not output.exists():
                run_command(words)
        grid = folder / "quality.toml"
        files.write_text(grid, self._grid(folder))
        workers = [] if self.workers is None else ["--workers", str(self.workers)]
        run_command(["sweep", str(grid), "-o", str(folder / "sweep"), *workers])
        cells = [str(path) for path in self._cells(grid, folder / "sweep")]
        words = ["transfer", *cells, "-o", str(folder / "transfer"), *workers]
        words += ["--environments", "surrogate", "mitsuba", "--conditions", "day"]
        words += ["--cases", "no_object", "attack", "--starts", str(self.starts)]
        run_command(words)
        return 0

    def _fits(self, folder: Path) -> list[tuple[Path, list[str]]]:
        """Return each file to make, and the command: those of the bundled field."""
        from mi_nerfattack.io import files

        manifest = files.read_json(SCENES / "manifest.json")
        capture, fit = _commands(manifest["files"][FIELD]["command"])
        views = folder / "views"
        capture = [str(SCENES.parent / w) if w[:7] == "scenes/" else w for w in capture]
        capture[capture.index("-o") + 1] = str(views)
        found = [(views / "transforms.json", capture)]
        for steps in self.steps:
            words, output = [*fit], _field(folder, steps)
            words[1] = str(views)
            words[words.index("-o") + 1] = str(output)
            words[words.index("--steps") + 1] = str(steps)
            found.append((output, words))
        return found

    def _grid(self, folder: Path) -> str:
        """Return the grid: that of Table 2, its method in each field.

        The transfer drives by itself: what else than search a run does is cut short.
        """
        import tomlkit

        from mi_nerfattack.io import files

        grid = tomlkit.parse(files.read_text(SCENES / "table2.toml")).unwrap()
        [method] = grid.pop("methods")
        named = {f"steps_{n}": str(_field(folder, n)) for n in self.steps}
        named["bundled"] = f"bundled:{FIELD}"
        search = method["set"] | {"baseline": _ONE_LOOK}
        search["drive"] |= {"runs": 1}
        methods = [
            {"name": name, "set": search | {"scene": {"field": file}}}
            for name, file in named.items()
        ]
        return tomlkit.dumps(grid | {"seeds": list(self.seeds), "methods": methods})

    def _cells(self, grid: Path, sweep: Path) -> list[Path]:
        from mi_nerfattack import variant
        from mi_nerfattack.experiment.sweep.cell import folder_of
        from mi_nerfattack.experiment.sweep.grid import load_cells

        variant.ensure()  # places are drawn in the scene
        return [folder_of(sweep, cell) for cell in load_cells(grid)]

    def _check(self, folder: Path) -> int:
        """Tell what would be done, and what one attack costs."""
        import tomlkit

        from mi_nerfattack.io import files

        for output, words in self._fits(folder):
            done = "there" if output.exists() else shlex.join(["mi-nerfattack", *words])
            print(f"{output}: {done}")
        one = tomlkit.parse(self._grid(folder)).unwrap()
        fields, routes = len(one["methods"]), len(one["routes"])
        print(
            f"{routes} routes x {len(self.seeds)} places x {fields} fields: "
            f"{routes * len(self.seeds) * fields} attacks, and "
            f"{self.starts} drives past each in two environments; one of them:"
        )
        one |= {"routes": one["routes"][:1], "seeds": [self.seeds[0]]}
        one["methods"] = [m for m in one["methods"] if m["name"] == "bundled"]
        grid = folder / "check.toml"
        files.write_text(grid, tomlkit.dumps(one))
        run_command(["sweep", str(grid), "-o", str(folder / "sweep"), "--check"])
        return 0


def _field(folder: Path, steps: int) -> Path:
    return folder / "fields" / f"{steps}.safetensors"


def _commands(line: str) -> list[list[str]]:
    """Return the arguments of each command of a line joined by ``&&``."""
    words = shlex.split(line)
    groups = itertools.groupby(words, lambda word: word == "&&")
    return [list(group)[1:] for joins, group in groups if not joins]


def run_command(words: Sequence[str]) -> None:
    """Run ``mi-nerfattack`` in a process of its own, and end with its code if it fails.

    Raises:
        SystemExit: it failed.
    """
    command = [sys.executable, "-m", "mi_nerfattack.cli", *words]
    print("$", shlex.join(["mi-nerfattack", *words]), flush=True)
    if code := subprocess.run(command, check=False).returncode:
        raise SystemExit(code if code > 0 else 1)
