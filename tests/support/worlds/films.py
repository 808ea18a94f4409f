"""Scene files of a few pixels, camera paths and routes, for tests of rendering."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
from support.worlds import fields as small

from mi_nerfattack.fields import save_field

WIDTH, HEIGHT = 17, 13
DENSITY, RAW_COLOUR = 0.7, 0.3
NEAR = 0.03
EYE = np.array([3.0, 0.0, 0.0])
BOX = '<rfilter type="box"/>'
PATH = '<integrator type="path"><integer name="max_depth" value="2"/></integrator>'


def ball(y: float, z: float, rgb: str) -> str:
    return (
        f'<shape type="sphere"><point name="center" x="0" y="{y}" z="{z}"/>'
        '<float name="radius" value="0.25"/><emitter type="area">'
        f'<rgb name="radiance" value="{rgb}"/></emitter></shape>'
    )


# red up and to the left as seen from EYE, green down and to the right
BALLS = ball(-0.6, 0.45, "1,0,0") + ball(0.6, -0.45, "0,1,0")


def sensor(film: str = BOX, eye: str = "3,0,0", fov: float = 40) -> str:
    """Write a camera that looks at the origin with +z up."""
    return (
        f'<sensor type="perspective" id="eye{eye[0]}">'
        f'<float name="fov" value="{fov}"/><float name="near_clip" value="{NEAR}"/>'
        '<transform name="to_world">'
        f'<lookat origin="{eye}" target="0,0,0" up="0,0,1"/></transform>'
        '<sampler type="independent"><integer name="sample_count" value="$spp"/>'
        f'</sampler><film type="hdrfilm"><integer name="width" value="{WIDTH}"/>'
        f'<integer name="height" value="{HEIGHT}"/>{film}</film></sensor>'
    )


def write_scene(folder: Path, body: str, name: str = "scene.xml") -> Path:
    """Write a scene whose parameter spp is 1."""
    path = folder / name
    spp = '<default name="spp" value="1"/>'
    path.write_text(f'<scene version="3.0.0">{spp}{body}</scene>')
    return path


def write_balls(folder: Path, integrator: str = PATH, film: str = BOX) -> Path:
    return write_scene(folder, integrator + sensor(film) + BALLS)


def write_lens(folder: Path) -> Path:
    """Write the balls before a camera with distortion, which moves as well."""
    fov = '<float name="fov" value="40"/>'
    lens = '<float name="fx" value="20"/><float name="k1" value="-0.1"/>'
    camera = sensor().replace("perspective", "opencv_camera").replace(fov, lens)
    return write_scene(folder, PATH + camera + BALLS)


def write_slab(
    folder: Path, film: str = BOX, fov: float = 5, inside: str = "", objects: str = ""
) -> Path:
    """Write a homogeneous box [-1, 1]^3 in front of the camera.

    The film nests `film`, the integrator `inside` too, and the scene `objects`.
    """
    save_field(folder / "box.safetensors", small.homogeneous(DENSITY, RAW_COLOUR))
    integrator = (
        '<integrator type="field_integrator"><float name="stop" value="0"/>'
        '<volume type="grid_field" id="box"><string name="filename" '
        f'value="box.safetensors"/></volume>{inside}</integrator>'
    )
    return write_scene(folder, integrator + sensor(film, fov=fov) + objects)


def opengl_pose(eye: np.ndarray) -> np.ndarray:
    """Return camera-to-world of a camera in the plane z = 0 that looks at the origin.

    Columns: right, up, against the view, position.
    """
    back = eye / np.linalg.norm(eye)
    right = np.array([-back[1], back[0], 0.0])
    matrix = np.eye(4)
    matrix[:3] = np.stack([right, [0, 0, 1], back, eye], axis=1)
    return matrix


def write_path(folder: Path, count: int = 3, name: str = "transforms.json") -> Path:
    """Write poses on half a circle around the origin; the first is the sensor's."""
    angles = np.linspace(0, np.pi, count)
    eyes = 3 * np.stack([np.cos(angles), np.sin(angles), 0 * angles], axis=1)
    frames = [{"transform_matrix": opengl_pose(eye).tolist()} for eye in eyes]
    path = folder / name
    path.write_text(json.dumps({"camera_angle_x": 0.7, "frames": frames}))
    return path


def write_route(folder: Path) -> Path:
    """Write a straight route of 2 m at 4 m/s along +y, at x = 5."""
    route = {"goal": 0, "lane_width_m": 3.0, "speed_ms": 4.0}
    route["points_m"] = [[5.0, -1.0], [5.0, 0.0], [5.0, 1.0]]
    path = folder / "routes.json"
    path.write_text(json.dumps({"straight": route}))
    return path
