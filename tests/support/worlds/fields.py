"""Fields that march in milliseconds, with float64 references that share no code."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_nerfattack.fields import (
    AbstractField,
    BrickField,
    GridField,
    GridLayout,
    NGPField,
    NGPLayout,
    Occupancy,
    save_field,
)
from mi_nerfattack.fields.bricks import Codes, vertex_count
from mi_nerfattack.render.camera.pose import Pose
from mi_nerfattack.render.posed import PosedField
from mi_nerfattack.render.rays import March, Rays

ONES = np.ones(3)
SMALL = GridLayout(levels=3, base_resolution=4, max_resolution=12)


def level_vertices(field: GridField, level: int) -> tuple[int, int, float]:
    """Return a level's first vertex, its vertices an edge, and its cells a unit."""
    scale = field.encoding._level_scale(level)
    return field.encoding.level_offset(level), field.encoding._resolution(scale), scale


def vertices(field: GridField) -> np.ndarray:
    """Return the place of every vertex, (n_vertices, 3), metres; padding is zero.

    Where a level's scale is not whole, its last vertices lie outside of the box.
    """
    result = np.zeros((field.n_vertices, 3))
    for level in range(field.layout.levels):
        start, n, scale = level_vertices(field, level)
        z, y, x = np.meshgrid(*[np.arange(n) / scale] * 3, indexing="ij")
        unit = np.stack([x, y, z], -1).reshape(-1, 3)
        extent = field.upper - field.lower
        result[start : start + n**3] = field.lower + unit * extent
    return result


def filled(field: GridField, density: object, texture: object = 0.0) -> GridField:
    """Set raw densities and colours, a number or one of each vertex."""
    count = field.n_vertices
    raw, colours = np.asarray(density, np.float32), np.asarray(texture, np.float32)
    field.set_parameter("density", np.broadcast_to(raw, count).copy())
    field.set_parameter("texture", np.broadcast_to(colours, (count, 3)).copy())
    return field


def homogeneous(density: float = 0.7, raw_colour: float = 0.3) -> GridField:
    field = GridField(GridLayout(2, 4, 8), -ONES, ONES, step_m=0.01)
    return filled(field, np.log(density) / 2, raw_colour / 2)


def empty_border(field: AbstractField, count: int = 16) -> None:
    """Make the border of a field empty, as that of fitted ones is."""
    cells = np.zeros((count,) * 3, bool)
    cells[1:-1, 1:-1, 1:-1] = True
    field.occupy(Occupancy(cells))


def blob(rng: np.random.Generator, peak: float = 2.0, step_m: float = 0.04):
    """Make a coloured blob in [-1, 1]^3 whose density vanishes at the border."""
    field = GridField(SMALL, -ONES, ONES, step_m=step_m)
    squared = (vertices(field) ** 2).sum(1)
    colour = rng.normal(0, 0.7, (field.n_vertices, 3))
    return filled(field, (peak - 14 * squared) / SMALL.levels, colour)


def speck(centre: tuple[float, float, float] = (0.4, 0.4, 0.4)) -> GridField:
    """Make a dense cube of half-edge 0.2 in a box that is empty to the last bit."""
    field = GridField(GridLayout(1, 16, 16), -ONES, ONES, step_m=0.03)
    near = (np.abs(vertices(field) - np.array(centre)) < 0.2).all(1)
    raw = np.where(near, 2.0, -60.0).astype(np.float32)
    field.set_parameter("density", raw)
    return field


def small_ngp(seed: int = 0, cone: float = 0.0) -> NGPField:
    """Make an NGP in [-1, 1]^3 with parameters far from their initialisation."""
    layout = NGPLayout(4, 2, 10, 4, 16, 16)
    field = NGPField(
        layout, -ONES, ONES, step_m=0.08, cone=cone, sky_shape=(4, 8), seed=seed
    )
    rng = np.random.default_rng(seed)
    for name, value in field.parameters().items():
        spread = 1.0 if name in ("table", "sky") else 0.5
        fresh = rng.normal(0, spread, dr.width(value)).astype(np.float32)
        field.set_parameter(name, type(value)(fresh))
    return field


def small_bricks(rng: np.random.Generator) -> BrickField:
    """Make bricks of all sizes in some cells of [-1, 1]^3, with arbitrary vertices."""
    cells = rng.random((6, 5, 4)) < 0.6
    octants = rng.integers(0, 256, cells.shape, np.uint8)
    divided = rng.choice(np.array([1, 2, 4, 8], np.uint8), cells.sum())
    words = rng.integers(0, 1 << 32, vertex_count(divided), np.uint32)
    sky = rng.normal(size=(4, 8, 3)).astype(np.float32)
    contents = Occupancy(cells, octants), divided, words, Codes(-2.0, 3.0), sky
    return BrickField(-ONES, ONES, *contents, step_m=0.08, cone=1 / 64)


def sigmoid_to_linear(raw: np.ndarray) -> np.ndarray:
    """Decode raw colours as field files define them, in float64."""
    value = 1 / (1 + np.exp(-raw))
    return np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)


def eval_grid(field: GridField, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Interpolate a grid field in float64: density (n,), zero outside, and radiance."""
    raw = field.packed.numpy().astype(np.float64).reshape(-1, 4)
    unit = (points - field.lower) / (field.upper - field.lower)
    inside = ((unit >= 0) & (unit <= 1)).all(1)
    total = np.zeros((len(points), 4))
    for level in range(field.layout.levels):
        start, n, scale = level_vertices(field, level)
        place = np.clip(unit, 0, 1) * scale
        cell = np.minimum(np.floor(place).astype(int), n - 2)
        part = place - cell
        for corner in range(8):
            bit = np.array([(corner >> axis) & 1 for axis in range(3)])
            weight = np.where(bit, part, 1 - part).prod(1)
            x, y, z = (cell + bit).T
            total += weight[:, None] * raw[start + x + n * (y + n * z)]
    density = field.density_scale * np.exp(np.minimum(total[:, 0], 15))
    return density * inside, sigmoid_to_linear(total[:, 1:])


def evaluate(
    field, points: np.ndarray, direction=(0, 0, 1)
) -> tuple[np.ndarray, np.ndarray]:
    point = mi.Point3f(np.ascontiguousarray(points.T, np.float32))
    towards = mi.Vector3f(*map(float, direction))
    density, radiance = field.eval(point, towards, mi.Bool(True))
    return density.numpy(), radiance.numpy().T


def reference_march(
    field: GridField,
    pose: Pose,
    origin: np.ndarray,
    direction: np.ndarray,
    t_max: float,
    samples: int = 4000,
) -> tuple[np.ndarray, float, float]:
    """Integrate radiance, opacity and moment of a ray by the midpoint rule, float64."""
    dt = t_max / samples
    t = (np.arange(samples) + 0.5) * dt
    world = origin + t[:, None] * direction
    local = (world - pose.translation) @ pose.rotation / pose.scale
    density, radiance = eval_grid(field, local)
    through = np.exp(-np.concatenate([[0], np.cumsum(density / pose.scale * dt)]))
    weight = through[:-1] - through[1:]
    moment = float((weight * t).sum())
    return weight @ radiance, 1 - float(through[-1]), moment


def fan(
    rng: np.random.Generator, count: int = 32
) -> tuple[mi.Point3f, mi.Vector3f, np.ndarray, np.ndarray]:
    """Make rays from x = -3 towards the box, for Dr.Jit and as (n, 3) float64."""
    aim = rng.uniform(-0.5, 0.5, (count, 3)) * [0, 1, 1]
    origin = np.tile([-3.0, 0.1, 0.2], (count, 1)).astype(np.float32)
    direction = aim - origin
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    direction = direction.astype(np.float32)
    o, d = mi.Point3f(origin.T.copy()), mi.Vector3f(direction.T.copy())
    dr.make_opaque(o, d)
    return o, d, origin.astype(np.float64), direction.astype(np.float64)


def random_march(rng: np.random.Generator, count: int) -> March:
    return March(
        mi.Color3f(rng.normal(size=(3, count)).astype(np.float32)),
        mi.Float(rng.normal(size=count).astype(np.float32)),
        mi.Float(rng.normal(size=count).astype(np.float32)),
    )


def pairing(a: March, b: March) -> float:
    colour = (a.radiance.numpy().astype(float) * b.radiance.numpy()).sum()
    opacity = (a.opacity.numpy().astype(float) * b.opacity.numpy()).sum()
    return float(colour + opacity + (a.moment.numpy().astype(float) * b.moment).sum())


def arguments(
    posed: PosedField,
    origin: mi.Point3f,
    direction: mi.Vector3f,
    t_max: float = 10.0,
    jitter: float = 0.5,
) -> tuple[PosedField, Rays]:
    numbers = [mi.Float(t_max), mi.Float(jitter)]
    dr.make_opaque(numbers)
    return posed, Rays(origin, direction, *numbers)


def half_occupied() -> tuple[GridField, mi.Point3f, mi.Vector3f]:
    """Make [-1, 1]^3, occupied below z = 0, and three rays along -z.

    With steps of 0.25 m the first, from z = 1, meets 4 samples, the second, from
    within, 2, and the third, beside the box, none.
    """
    cells = np.zeros((8, 8, 8), bool)
    cells[:, :, :4] = True
    field = GridField(
        GridLayout(1, 4, 4), -ONES, ONES, occupancy=Occupancy(cells), step_m=0.25
    )
    origin = mi.Point3f([0, 0, 3], [0, 0, 0], [1, -0.5, 1])
    return field, origin, mi.Vector3f([0, 0, 0], [0, 0, 0], [-1, -1, -1])


def first_rays(scene: mi.Scene) -> mi.Ray3f:
    """Return the rays that a scene's film traces with one sample a pixel and seed 0."""
    (sensor,) = scene.sensors()
    width, height = map(int, sensor.film().size())
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(0, width * height)
    pixel = dr.arange(mi.UInt32, width * height)
    corner = mi.Vector2f(pixel % width, pixel // width)
    place = (corner + sampler.next_2d()) / mi.Vector2f(width, height)
    return sensor.sample_ray(0, 0, place, mi.Point2f(0.5))[0]


def T() -> Any:
    return mi.ScalarTransform4f()


def write_blob(folder: Path, rng: np.random.Generator) -> dict[str, Any]:
    """Write a blob in [-1, 1]^3, its border empty, and describe it as a volume."""
    path, field = folder / "blob.safetensors", blob(rng, step_m=0.05)
    empty_border(field)
    save_field(path, field)
    return {"type": "grid_field", "id": "blob", "filename": str(path)}


def load(
    nested: dict[str, Any],
    objects: dict[str, Any] | None = None,
    *,
    eye: Any = (-3.0, 0.2, 0.6),
    target: Any = (0.0, 0.0, 0.0),
    fov: float = 50,
    **film: Any,
) -> mi.Scene:
    """Load a scene with fields before the camera.

    Args:
        nested: of the integrator, or another integrator.
        objects: objects of the scene, or others in their place.
        eye: place of the camera, metres.
        target: place that the camera looks at, metres.
        fov: horizontal field of view, degrees.
        film: properties that differ.
    """
    size = {"width": 12, "height": 8, "rfilter": {"type": "box"}}
    if film.get("type") != "specfilm":
        pixels = "luminance" if mi.is_monochromatic else "rgb"
        film = {"type": "hdrfilm", "pixel_format": pixels, **film}
    sensor = {
        "type": "perspective",
        "id": "camera",
        "fov": fov,
        "to_world": T().look_at(list(eye), list(target), [0, 0, 1]),
        "film": {**size, **film},
        "sampler": {"type": "independent", "sample_count": 4},
    }
    integrator = {"type": "field_integrator", "id": "fields", "stop": 0.0, **nested}
    if nested.get("type", "field_integrator") != "field_integrator":
        integrator = nested
    scene = {"type": "scene", "i": integrator, "camera": sensor, **(objects or {})}
    return mi.load_dict(scene, parallel=False)
