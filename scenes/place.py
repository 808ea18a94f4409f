"""Files of a place: the scene for stock Mitsuba, its meshes, images and routes."""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from .mesh import MeshBuilder
from .paint import write_png

_SHAPE = """    <shape type="ply" id="{name}">
        <string name="filename" value="meshes/{name}.ply"/>
        <bsdf type="twosided">
            <bsdf type="diffuse">
                <texture type="bitmap" name="reflectance">
                    <string name="filename" value="textures/{name}.png"/>
                    <string name="wrap_mode" value="{wrap}"/>
                </texture>
            </bsdf>
        </bsdf>
    </shape>
"""

_SCENE = """<!-- {title} -->
<scene version="3.0.0">
    <default name="spp" value="16"/>
    <default name="width" value="600"/>
    <default name="height" value="400"/>

    <integrator type="path">
        <integer name="max_depth" value="4"/>
        <integer name="rr_depth" value="{rr_depth}"/>
    </integrator>

    <sensor type="perspective" id="overview">
        <float name="fov" value="{fov}"/>
        <transform name="to_world">
            <lookat {lookat}/>
        </transform>
        <sampler type="independent">
            <integer name="sample_count" value="$spp"/>
        </sampler>
        <film type="hdrfilm">
            <integer name="width" value="$width"/>
            <integer name="height" value="$height"/>
            <rfilter type="box"/>
        </film>
    </sensor>

{lights}{shapes}</scene>
"""

_SUN_AND_SKY = """    <emitter type="sunsky" id="sky">
        <vector name="sun_direction" value="{direction}"/>
        <float name="turbidity" value="4"/>
        <float name="sun_scale" value="2.5"/>
        <float name="sky_scale" value="3.0"/>
    </emitter>

"""


def sun_and_sky(direction: str) -> str:
    """Return an emitter of a clear day.

    Args:
        direction: to the sun: three numbers with commas between them.
    """
    return _SUN_AND_SKY.format(direction=direction)


def scene_xml(
    title: str,
    *,
    fov: str,
    lookat: str,
    lights: str,
    wraps: dict[str, str],
    rr_depth: int = 2,
) -> str:
    """Return a scene with an overview sensor and one textured shape for each mesh.

    Args:
        title: comment in the first line.
        fov: of the sensor, degrees.
        lookat: attributes origin, target and up of the sensor.
        lights: XML of the emitters, four spaces indented.
        wraps: wrap mode of the image of each mesh, by the name of the mesh.
        rr_depth: from which the integrator ends paths at random.
    """
    shapes = "".join(
        _SHAPE.format(name=name, wrap=wrap) for name, wrap in wraps.items()
    )
    return _SCENE.format(
        title=title,
        fov=fov,
        lookat=lookat,
        lights=lights,
        shapes=shapes,
        rr_depth=rr_depth,
    )


def write_place(
    folder: Path,
    *,
    meshes: dict[str, MeshBuilder],
    images: dict[str, np.ndarray],
    scene: str,
    routes: dict[str, dict[str, Any]],
) -> list[Path]:
    """Write scene.xml, routes.json, meshes and textures; return the files written.

    Args:
        folder: made if needed.
        meshes: by name; NAME becomes meshes/NAME.ply.
        images: (h, w, 3), sRGB in [0, 1]; NAME becomes textures/NAME.png.
        scene: XML.
        routes: as routes.json holds them.
    """
    files = []
    (folder / "meshes").mkdir(parents=True, exist_ok=True)
    (folder / "textures").mkdir(exist_ok=True)
    for name, mesh in meshes.items():
        files.append(folder / "meshes" / f"{name}.ply")
        mesh.write_ply(files[-1])
    for name, image in images.items():
        files.append(folder / "textures" / f"{name}.png")
        write_png(files[-1], image)
    texts = {"scene.xml": scene, "routes.json": json.dumps(routes, indent=1) + "\n"}
    for name, text in texts.items():
        files.append(folder / name)
        files[-1].write_text(text, encoding="utf-8")
    return files


def route_entry(
    points: np.ndarray, *, goal: int, lane_width: float, speed: float
) -> dict[str, Any]:
    """Return a route as routes.json holds it.

    Args:
        points: (n, 2), the lane's centre, metres.
        goal: number of the manoeuvre.
        lane_width: metres.
        speed: m/s.
    """
    return {
        "goal": goal,
        "lane_width_m": lane_width,
        "speed_ms": speed,
        "points_m": [[round(v, 6) + 0.0 for v in p] for p in points.tolist()],
    }


def main(
    doc: str | None,
    build: Callable[[Path, int], list[Path]],
    seed: int,
    folder: Path | None = None,
) -> None:
    """Parse the arguments of a build, build, and print the files.

    Args:
        doc: docstring of the script.
        build: writes the files of a place into a folder with a seed.
        seed: default of `--seed`.
        folder: default of `--out`; `--out` is required without one.
    """
    parser = argparse.ArgumentParser(description=doc)
    parser.add_argument("--seed", type=int, default=seed)
    parser.add_argument(
        "-o", "--out", type=Path, default=folder, required=folder is None
    )
    arguments = parser.parse_args()
    for path in build(arguments.out, arguments.seed):
        print(path)
