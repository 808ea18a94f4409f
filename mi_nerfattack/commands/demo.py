"""``mi-nerfattack demo``: the main job on bundled input."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import tyro

from mi_nerfattack.commands.asset import AssetMesh
from mi_nerfattack.commands.shared.options import Settings
from mi_nerfattack.commands.shared.terminal import Result


@dataclass(frozen=True)
class Demo:
    """Attack the bundled policy at the bundled intersection.

    Takes about ten minutes on two slow cores, and opens nothing but files.
    """

    object: tyro.conf.Positional[Path | None] = None
    """Attack this object instead of the bundled hydrant: a mesh (glTF, OBJ, PLY), which
    is fitted first, or a grid field file made by asset."""
    output: Path | None = None
    """Run folder, new or of an interrupted demo; runs/demo-DATE-TIME by default."""
    settings: Settings = ()
    """Set a key of the bundled scenario: seed=1."""
    height_m: float = 0.75
    """Height of a mesh, metres; the scene shows it 3.3 times as tall."""
    resolution: Literal[64, 128] = 64
    """Finest level of the grid that is fitted to a mesh."""
    anyway: bool = False
    """Attack although the object would prove nothing; see attack."""
    json: bool = False
    """End with one line of JSON, the content of metrics.json, instead of the table."""

    @property
    def continues(self) -> bool:
        """Whether the same command finds what this one left."""
        return self.output is not None

    def run(self) -> Result:
        """Run the bundled scenario."""
        from mi_nerfattack.commands.attack import run_scenario
        from mi_nerfattack.scenes import bundled

        stamp = time.strftime("%Y%m%d-%H%M%S")
        output = self.output or Path("runs") / f"demo-{stamp}"
        return run_scenario(
            bundled("demo.toml"),
            output,
            lambda: self._object_field(output),
            anyway=self.anyway,
            settings=self.settings,
        )

    def _object_field(self, output: Path) -> Path | None:
        """Return the field file of the object, fitting a mesh beside the run folder.

        A demo that goes on takes the field that it began with.
        """
        from mi_nerfattack import variant
        from mi_nerfattack.capture.object_views import Placement
        from mi_nerfattack.io import files

        if self.object is None or self.object.suffix == ".safetensors":
            return self.object
        field = output.parent / f"{output.name}-object.safetensors"
        record = field.with_suffix(".json")
        variant.ensure()
        mesh = Placement(self.height_m).mesh(self.object)
        source = {"mesh": mesh.digest, "resolution": self.resolution}
        if field.exists() and record.exists():
            if files.read_json(record) == {**source, "field": files.sha256(field)}:
                return field
        AssetMesh(
            source=self.object,
            output=field,
            height_m=self.height_m,
            resolution=self.resolution,
        ).run().show()
        files.write_json(record, {**source, "field": files.sha256(field)})
        return field
