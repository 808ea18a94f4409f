"""``mi-nerfattack upgrade``: a scenario or grid of an older form, in that of today."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import tyro


@dataclass(frozen=True)
class Upgrade:
    """Rewrite a scenario or a grid of an older version in place, comments kept."""

    file: tyro.conf.Positional[Path]
    """SCENARIO.toml or GRID.toml."""

    def run(self) -> int:
        """Rewrite the file, and say whether it changed."""
        from mi_nerfattack.io import files
        from mi_nerfattack.scenario.upgrade import upgraded_text

        text = files.read_text(self.file)
        new = upgraded_text(self.file, text)
        if new != text:
            files.write_text(self.file, new)
        outcome = "is of the form of today" if new == text else "rewritten"
        print(f"{self.file}: {outcome}")
        return 0
