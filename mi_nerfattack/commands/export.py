"""``mi-nerfattack export``: an object as a mesh, as pictures, on paper."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from mi_nerfattack.commands.shared.box_options import BoxOptions
from mi_nerfattack.commands.shared.result import Result

if TYPE_CHECKING:
    from mi_nerfattack.fields.grid import GridField


@dataclass(frozen=True)
class Export:
    """Write an object's field as a coloured mesh (glTF) or as six pictures (PNG).

    A run folder of attack holds its attacked objects as fields, objects/ID.safetensors.
    Colours are radiance: reflectance times the light that the object was captured in.
    The attacked cube of a run folder is also put on paper (--print, to cut, fold and
    glue) and on a monitor (--monitor), at its physical size.
    """

    field: tyro.conf.Positional[Path]
    """Field of an object (.safetensors), as asset and attack write them; with --print
    and --monitor a run folder of attack."""
    output: Annotated[Path | None, tyro.conf.arg(aliases=["-o"])] = None
    """FILE.glb for a mesh; a folder for px.png, nx.png ... nz.png and faces.json."""
    mesh: Path | None = None
    """Colour the triangles of this mesh, which the field was fitted to, in place of
    the surface of the field; give the size and axes that were given to asset."""
    height_m: float | None = None
    """Of --mesh: scale to this height, metres."""
    longest_m: float | None = None
    """Of --mesh: scale the longest edge of the bounding box to this, metres."""
    up: Literal["x", "y", "z", "-x", "-y", "-z"] | None = None
    """Of --mesh: axis that points up."""
    turn_deg: float = 0.0
    """Of --mesh: turn about the vertical."""
    pixels_per_m: float | None = None
    """Of the pictures; 256 pixels along the longest edge by default."""
    json: bool = False
    """End with one line of JSON in place of the sentences."""
    box: Annotated[BoxOptions, tyro.conf.arg(name="")] = BoxOptions()

    def run(self) -> Result:
        """Read, sample the surface or look at the sides, and write."""
        from mi_nerfattack import variant
        from mi_nerfattack.errors import InputError
        from mi_nerfattack.fields.io import load_grid
        from mi_nerfattack.io import files

        if self.box.is_asked:
            return self._write_box()
        if self.output is None:
            raise InputError("give -o, or, for a run folder, --print or --monitor")
        if self.box != BoxOptions():
            raise InputError(
                "--object, --size-mm and the options after them: are for --print and "
                "--monitor"
            )
        output, suffix = self.output, self.output.suffix.lower()
        if suffix not in (".glb", ""):
            raise InputError(f"{output}: give FILE.glb or a folder's name")
        self._refuse_unused(output)
        variant.ensure()
        grid = load_grid(self.field)
        if suffix == "":
            return self._write_faces(grid, output)
        files.check_writable(output)
        return self._write_mesh(grid, output)

    def _write_box(self) -> Result:
        from mi_nerfattack import variant
        from mi_nerfattack.commands.shared.progress import StageBars
        from mi_nerfattack.errors import InputError

        if self.output is not None:
            raise InputError(
                f"-o {self.output}: --print and --monitor name their own files; give "
                "-o by itself, with the field of an object"
            )
        options = {"mesh": self.mesh, "pixels-per-m": self.pixels_per_m}
        for name, value in (options | self._mesh_options()).items():
            if value is not None:
                raise InputError(f"--{name}: is for -o, not for --print and --monitor")
        variant.ensure()
        with StageBars() as bars:
            found = self.box.write(self.field, bars.counter("printing", "page "))
        document = {kind: figures for kind, (figures, _) in found.items()}
        told = [sentence for _, sentence in found.values()]
        return Result(document, lambda: print(*told, sep="\n"))

    def _write_mesh(self, grid: GridField, output: Path) -> Result:
        from mi_nerfattack.capture.mesh.gltf_writer import write_glb
        from mi_nerfattack.capture.mesh.surface import field_surface, painted_mesh
        from mi_nerfattack.capture.object_views import Placement

        if self.mesh is None:
            mesh = field_surface(grid)
        else:
            placement = Placement(self.height_m, self.longest_m, self.up, self.turn_deg)
            mesh = painted_mesh(grid, placement.mesh(self.mesh))
        write_glb(output, mesh)
        counts = {"triangles": len(mesh.faces), "vertices": len(mesh.vertices)}
        told = "Wrote {}: {} triangles, {} vertices".format(output, *counts.values())
        return Result({"output": str(output), **counts}, lambda: print(told))

    def _write_faces(self, grid: GridField, output: Path) -> Result:
        from mi_nerfattack.capture.mesh.cube_faces import render_faces, write_faces
        from mi_nerfattack.errors import InputError

        if output.is_file():
            raise InputError(f"{output}: is a file; give a folder's name")
        faces = render_faces(grid, self.pixels_per_m)
        write_faces(output, faces)
        size_m = (faces.upper - faces.lower).tolist()
        edges = " x ".join(f"{edge:.3f}" for edge in size_m)
        told = (
            f"Wrote {output}: 6 pictures of a box of {edges} m, "
            f"{faces.pixels_per_m:.0f} pixels a metre"
        )
        figures = {"size_m": size_m, "pixels_per_m": float(faces.pixels_per_m)}
        return Result({"output": str(output), **figures}, lambda: print(told))

    def _refuse_unused(self, output: Path) -> None:
        """Raise InputError for an option that the kind of output has no use for."""
        from mi_nerfattack.errors import InputError

        if not output.suffix and self.mesh is not None:
            raise InputError(f"--mesh: is for FILE.glb, not for {output}")
        if output.suffix and self.pixels_per_m is not None:
            raise InputError(f"--pixels-per-m: is for pictures, not for {output}")
        for name, value in self._mesh_options().items():
            if value is not None and self.mesh is None:
                raise InputError(f"--{name}: needs --mesh")

    def _mesh_options(self) -> dict[str, object]:
        """Return the options that only --mesh has a use for, None if not given."""
        return {
            "height-m": self.height_m,
            "longest-m": self.longest_m,
            "up": self.up,
            "turn-deg": self.turn_deg or None,
        }
