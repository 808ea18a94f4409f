"""``mi-nerfattack report``: one page of what runs came to."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from mi_nerfattack.commands.shared.terminal import Result


@dataclass(frozen=True)
class Report:
    """Write one HTML page of results, which needs no network and no other file.

    If OUTPUT ends with .md, the command writes the figures of one sweep or transfer
    between two marks of that page, and their tables into files next to it. It keeps all
    other text of the page.

    The page shows figures with flags first, then drives from above, damage against cost
    and the matrix of transfers. It shows the frames that the policy sees, the objects
    from all around, and when and where the failure is made. It also lists versions,
    checksums, and the command that makes each row again.
    """

    folders: Annotated[
        tyro.conf.Positional[tuple[Path, ...]], tyro.conf.arg(metavar="FOLDER...")
    ]
    """Finished run folders of attack, folders of sweep and transfer, and files
    NAME-retrain.json of retrain, any of them together."""
    output: Path
    """HTML file to write, or Markdown file."""
    tuning: Path | None = None
    """For .md: folder of the sweep that settings of the methods were chosen by."""
    title: str | None = None
    """Of the page; made of names of what it shows by default."""
    json: bool = False

    def run(self) -> Result:
        """Read, render the objects and write."""
        from tempfile import TemporaryDirectory

        from mi_nerfattack import variant
        from mi_nerfattack.commands.shared.options import check_suffix
        from mi_nerfattack.commands.shared.progress import StageBars
        from mi_nerfattack.errors import InputError
        from mi_nerfattack.experiment.page.markdown import write_markdown
        from mi_nerfattack.experiment.page.write import read_folders, write_page
        from mi_nerfattack.io import files

        check_suffix(self.output, ".html", ".htm", ".md")
        files.check_writable(self.output)
        if self.output.suffix.lower() == ".md":
            if len(self.folders) != 1:
                raise InputError("FOLDER: pages of Markdown are of one each")
            write_markdown(self.output, self.folders[0], self.tuning)
            return self._written()
        if self.tuning is not None:
            raise InputError("--tuning: is for pages of Markdown; leave it out")
        variant.ensure()
        with StageBars() as bars, TemporaryDirectory() as scratch:

            def say(label: str) -> None:
                bars.say(f"reading {label}")

            contents = read_folders(self.folders, Path(scratch), say)
            write_page(self.output, contents, Path(scratch), title=self.title)
        return self._written()

    def _written(self) -> Result:
        path, size = self.output.resolve(), self.output.stat().st_size
        amount = f"{size / 1e6:.1f} MB" if size > 1e6 else f"{size / 1e3:.1f} kB"
        message = f"Written: {path} ({amount})"
        return Result({"output": str(path), "bytes": size}, lambda: print(message))
