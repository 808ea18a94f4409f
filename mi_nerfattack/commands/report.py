"""``mi-nerfattack report``: one page of what runs came to."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro


@dataclass(frozen=True)
class Report:
    """Write one HTML page of finished runs, which needs no network and no other file.

    Figures with flags first, drives from above, damage against cost, what the policy
    sees, frame by frame, the objects from all around, when and where the failure is
    made, versions, checksums, and the command that makes each run again.
    """

    folders: Annotated[
        tyro.conf.Positional[tuple[Path, ...]], tyro.conf.arg(metavar="FOLDER...")
    ]
    """Run folders of attack."""
    output: Annotated[Path, tyro.conf.arg(aliases=["-o"])]
    """HTML file to write."""
    title: str | None = None
    """Of the page; made of the runs' names by default."""

    def run(self) -> int:
        """Read, render the objects and write."""
        from mi_nerfattack import variant
        from mi_nerfattack.errors import InputError
        from mi_nerfattack.experiment.page.folders import read_folders
        from mi_nerfattack.experiment.page.write import write_page
        from mi_nerfattack.io import files

        if self.output.suffix.lower() not in (".html", ".htm"):
            raise InputError(f"--output: {self.output}; name an .html file")
        files.check_writable(self.output)
        variant.ensure()
        write_page(self.output, read_folders(self.folders), self.title)
        size = self.output.stat().st_size / 1e6
        print(f"Written: {self.output.resolve()} ({size:.1f} MB)")
        return 0
