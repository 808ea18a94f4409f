"""``mi-nerfattack report``: one page of what runs came to."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from mi_nerfattack.commands.shared.result import Result


@dataclass(frozen=True)
class Report:
    """Write one HTML page of results, which needs no network and no other file.

    Figures with flags first, drives from above, damage against cost, the matrix of
    transfers, what the policy sees, frame by frame, the objects from all around, when
    and where the failure is made, versions, checksums, and the command that makes each
    row again.
    """

    folders: Annotated[
        tyro.conf.Positional[tuple[Path, ...]], tyro.conf.arg(metavar="FOLDER...")
    ]
    """Finished run folders of attack, folders of sweep and transfer, and files
    NAME-retrain.json of retrain, any of them together."""
    output: Annotated[Path, tyro.conf.arg(aliases=["-o"])]
    """HTML file to write."""
    title: str | None = None
    """Of the page; made of names of what it shows by default."""
    json: bool = False
    """End with one line of JSON in place of the sentence."""

    def run(self) -> Result:
        """Read, render the objects and write."""
        from tempfile import TemporaryDirectory

        from mi_nerfattack import variant
        from mi_nerfattack.commands.shared.progress import StageBars
        from mi_nerfattack.errors import InputError
        from mi_nerfattack.experiment.page.folders import read_folders
        from mi_nerfattack.experiment.page.write import write_page
        from mi_nerfattack.io import files

        if self.output.suffix.lower() not in (".html", ".htm"):
            raise InputError(f"--output: {self.output}; name an .html file")
        files.check_writable(self.output)
        variant.ensure()
        with StageBars() as bars, TemporaryDirectory() as scratch:

            def say(label: str) -> None:
                bars.say(f"reading {label}")

            parts = read_folders(self.folders, Path(scratch), say)
            write_page(self.output, parts, Path(scratch), self.title)
        path, size = self.output.resolve(), self.output.stat().st_size
        told = f"Written: {path} ({size / 1e6:.1f} MB)"
        return Result({"output": str(path), "bytes": size}, lambda: print(told))
