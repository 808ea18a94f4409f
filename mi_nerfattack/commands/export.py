"""``mi-nerfattack export``: objects, routes and scenarios for other programs."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import tyro

from mi_nerfattack.commands.monitor import ScreenOptions
from mi_nerfattack.commands.shared.options import check_suffix
from mi_nerfattack.commands.shared.terminal import Result
from mi_nerfattack.errors import InputError


@dataclass(frozen=True)
class ExportMesh:
    """Write an object's field as a coloured mesh (glTF).

    Colours are radiance: reflectance times the light that the object was captured in.
    With --mesh, give the size and axes that were given to asset.
    """

    field: tyro.conf.Positional[Path]
    """Field of an object (.safetensors), of asset or in a run folder's objects."""
    output: Path
    """File to write (.glb)."""
    mesh: Path | None = None
    """Colour the triangles of this mesh, which the field was fitted to, instead of the
    surface of the field."""
    height_m: float | None = None
    """Scale the mesh to this height, metres."""
    longest_m: float | None = None
    """Scale the longest edge of its bounding box to this, metres."""
    up: Literal["x", "y", "z", "-x", "-y", "-z"] | None = None
    """Axis of the mesh that points up."""
    turn_deg: float = 0.0
    """Turn the mesh about the vertical."""
    json: bool = False

    def run(self) -> Result:
        """Read, sample the surface and write."""
        from mi_nerfattack import variant
        from mi_nerfattack.capture.mesh.gltf_writer import write_glb
        from mi_nerfattack.capture.mesh.surface import field_surface, painted_mesh
        from mi_nerfattack.capture.object_views import Placement
        from mi_nerfattack.fields.io import load_grid
        from mi_nerfattack.io import files

        output = self.output
        check_suffix(output, ".glb")
        files.check_writable(output)
        placement = Placement(
            self.height_m, self.longest_m, self.up, turn_deg=self.turn_deg
        )
        if self.mesh is None and placement != Placement():
            raise InputError(
                "--height-m, --longest-m, --up, --turn-deg: place a mesh; give --mesh"
            )
        variant.ensure()
        grid = load_grid(self.field)
        if self.mesh is None:
            mesh = field_surface(grid)
        else:
            mesh = painted_mesh(grid, placement.mesh(self.mesh))
        write_glb(output, mesh)
        counts = {"triangles": len(mesh.faces), "vertices": len(mesh.vertices)}
        message = "Wrote {}: {} triangles, {} vertices".format(output, *counts.values())
        return Result({"output": str(output), **counts}, lambda: print(message))


@dataclass(frozen=True)
class ExportFaces:
    """Write six pictures of an object's field, as of the faces of a box."""

    field: tyro.conf.Positional[Path]
    """Field of an object (.safetensors), of asset or in a run folder's objects."""
    output: Path
    """Folder for px.png, nx.png ... nz.png and faces.json."""
    pixels_per_m: float | None = None
    """Pixels per metre; 256 along the longest edge by default."""
    json: bool = False

    def run(self) -> Result:
        """Read, look at the sides and write."""
        from mi_nerfattack import variant
        from mi_nerfattack.capture.mesh.cube_faces import render_faces, write_faces
        from mi_nerfattack.fields.io import load_grid
        from mi_nerfattack.io import files

        output = self.output
        if output.is_file() or (output.suffix and not output.is_dir()):
            raise InputError(
                f"{output}: is the name of a file; give a folder's name without a "
                "suffix, or make the folder before"
            )
        files.check_folder(output)
        variant.ensure()
        faces = render_faces(load_grid(self.field), self.pixels_per_m)
        write_faces(output, faces)
        size_m = (faces.upper - faces.lower).tolist()
        edges = " x ".join(f"{edge:.3f}" for edge in size_m)
        message = (
            f"Wrote {output}: 6 pictures of a box of {edges} m, "
            f"{faces.pixels_per_m:.0f} pixels a metre"
        )
        figures = {"size_m": size_m, "pixels_per_m": float(faces.pixels_per_m)}
        return Result({"output": str(output), **figures}, lambda: print(message))


@dataclass(frozen=True)
class ExportPrint:
    """Write the attacked box of a run as a net on paper, to cut, fold and glue.

    A billboard or patch is one sheet, without tabs.
    """

    run_folder: tyro.conf.Positional[Path]
    output: Path
    """File to write (.pdf)."""
    box: str | None = None
    """Id of the box; the only one by default."""
    size_mm: float | None = None
    """Longest edge; as large as in the run by default."""
    paper: Literal["a4", "a3", "letter"] = "a4"
    """Paper; a net that is larger gets several pages."""
    dpi: int = 300
    """Pixels per inch."""
    json: bool = False

    def run(self) -> Result:
        """Read the box and write its net."""
        from mi_nerfattack import variant
        from mi_nerfattack.commands.shared.progress import StageBars
        from mi_nerfattack.io import files
        from mi_nerfattack.props.attacked import read_box
        from mi_nerfattack.props.paper import write_net

        path = self.output
        check_suffix(path, ".pdf")
        files.check_writable(path)
        variant.ensure()
        with StageBars() as bars:
            box, _ = read_box(self.run_folder, self.box)
            edges, counter = (
                box.edges_mm(self.size_mm),
                bars.counter("printing", "page "),
            )
            count = write_net(
                path, box, edges, paper=self.paper, dpi=self.dpi, on_page=counter
            )
        size = " x ".join(f"{edge:.1f}" for edge in edges)
        pages = "page" if count == 1 else "pages"
        what = "net" if box.sheet is None else "sheet"
        message = f"Wrote {path}: {what} of {box.name}, {size} mm, {count} {pages}"
        figures = {"edges_mm": edges.tolist(), "pages": count}
        document = {"output": str(path), "box": box.name, **figures}
        return Result(document, lambda: print(message))


@dataclass(frozen=True, kw_only=True)
class ExportScreen(ScreenOptions):
    """Write a face of the attacked box of a run for a monitor, at its physical size."""

    output: Path
    """File to write (.png or .html)."""
    size_mm: float | None = None
    """Longest edge; as large as in the run by default."""
    json: bool = False

    def run(self) -> Result:
        """Read the box and write the picture."""
        from mi_nerfattack import variant
        from mi_nerfattack.io import files
        from mi_nerfattack.props.attacked import read_box, seen_most
        from mi_nerfattack.props.monitor import screen_image, screen_page
        from mi_nerfattack.props.net import MM, Net

        path, screen = self.output, self._make_screen()
        check_suffix(path, ".png", ".html")
        files.check_writable(path)
        variant.ensure()
        box, views = read_box(self.run_folder, self.box)
        box.check_face(self.face)
        face = self.face or seen_most(box, views)
        edges = box.edges_mm(self.size_mm)
        spot = Net(edges, box.sheet).faces[face]
        size, longest = (spot.width, spot.height), float(edges.max())
        image = screen_image(
            screen,
            box.images[face],
            size,
            background=self.background,
            longest_mm=longest,
        )
        if path.suffix.lower() == ".png":
            files.write_image(path, image)
        else:
            caption = f"{box.name}, {face}, run {box.run}, digest {box.digest[:16]}"
            files.write_text(path, screen_page(image, caption))
        dpi = float(MM * screen.px_per_mm[0])
        message = (
            f"Wrote {path}: {face} of {box.name}, {size[0]:.1f} x {size[1]:.1f} mm "
            f"on {self.pixels} pixels, {dpi:.1f} an inch"
        )
        document = {
            "output": str(path),
            "box": box.name,
            "face": face,
            "size_mm": [*map(float, size)],
            "pixels_per_inch": dpi,
        }
        return Result(document, lambda: print(message))


@dataclass(frozen=True, kw_only=True)
class ExportRoutes:
    """Write routes of the CARLA leaderboard as a routes file.

    Each route follows the lanes of its town from position to position; needs CARLA's
    client, but no server.
    """

    routes_xml: tyro.conf.Positional[Path]
    """Routes of the leaderboard (.xml)."""
    map: Path
    """OpenDRIVE map of the town (TOWN.xodr), of CARLA's folder Maps/OpenDrive."""
    output: Path
    """File to write (.json)."""
    routes: tuple[str, ...] = ()
    """Ids of routes; all of the town by default."""
    speed_ms: float = 5.0
    """Nominal speed of the routes."""
    json: bool = False

    def run(self) -> Result:
        """Follow the lanes and write."""
        from mi_nerfattack.deploy.carla.route import town_routes
        from mi_nerfattack.deploy.carla.session import load_client
        from mi_nerfattack.io import files

        check_suffix(self.output, ".json")
        files.check_writable(self.output)
        api = load_client()
        try:
            town_map = api.Map(self.map.stem, files.read_text(self.map))
        except RuntimeError as error:
            raise InputError(f"{self.map}: not an OpenDRIVE map ({error})") from error
        routes = town_routes(
            self.routes_xml, town_map, api, names=self.routes, speed_ms=self.speed_ms
        )
        files.write_json(
            self.output, {route.name: route.document() for route in routes}
        )
        message = f"Wrote {self.output}: {len(routes)} routes of {self.map.stem}"
        document = {"output": str(self.output), "routes": [r.name for r in routes]}
        return Result(document, lambda: print(message))


@dataclass(frozen=True)
class ExportOpenscenario:
    """Write a found scenario as OpenSCENARIO 1.2, with the objects as glTF.

    The folder has scenario.xosc, the route's lane as OpenDRIVE (route.xodr) and one
    .glb per object.
    """

    run_folder: tyro.conf.Positional[Path]
    output: Path
    """Folder to write."""
    json: bool = False

    def run(self) -> Result:
        """Read the run and write."""
        from mi_nerfattack import variant
        from mi_nerfattack.io import files
        from mi_nerfattack.props.openscenario import write_openscenario

        files.check_folder(self.output)
        variant.ensure()
        written = write_openscenario(self.run_folder, self.output)
        names = [path.name for path in written]
        message = f"Wrote {self.output}: {', '.join(names)}"
        return Result(
            {"output": str(self.output), "files": names}, lambda: print(message)
        )
