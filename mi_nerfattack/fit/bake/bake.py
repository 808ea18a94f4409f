"""Bake a fitted scene into bricks, which are faster to march."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy.spatial import KDTree

from mi_nerfattack.capture.scene import drive_poses
from mi_nerfattack.errors import InputError
from mi_nerfattack.fields.bricks import (
    FINEST,
    MOST_VERTICES,
    BrickField,
    Codes,
    brick_starts,
    pack_word,
    unpack_word,
    vertex_count,
)
from mi_nerfattack.fields.ngp import NGPField
from mi_nerfattack.fields.occupancy import Occupancy
from mi_nerfattack.fit.pruning import dense_octants
from mi_nerfattack.ranges import Count, Natural, Positive, Seed, checked
from mi_nerfattack.render.camera.intrinsics import Camera, CameraMount
from mi_nerfattack.render.camera.lens import generate_rays, pose_arrays
from mi_nerfattack.render.march import STOP
from mi_nerfattack.render.posed import PosedField
from mi_nerfattack.render.rays import Rays
from mi_nerfattack.render.walk import Segment, Walk
from mi_nerfattack.vehicle.route.route import Route

#: Between the places on routes that distances are measured from, in widths of a lane:
#: 1 m where it is 3.5 m wide.
_SPACING = 2 / 7
_RAYS_AT_ONCE = 1 << 21  # whose memory is little beside that of the vertices
_FAINT = 1e-3  # sum of weights below which a vertex is hardly moved
_WORDS_BAKING = 7  # of a vertex: before, after, and five sums


@dataclass(frozen=True)
@checked()
class BakeOptions:
    """How fine bricks are, and how they are refined.

    Attributes:
        cone: edge of a brick's parts over the distance to the nearest route, at most;
            as long as 8 parts along the brick's edge are enough.
        passes: over all rays of `views` new poses.
        views: poses of a pass, scattered along the routes by `capture.drive_poses`.
        seed: of poses, and of the samples on their rays.
    """

    cone: Positive = 1 / 64
    passes: Natural = 4
    views: Count = 100
    seed: Seed = 0


@dataclass(frozen=True, eq=False)
class BakePlan:
    """Which bricks a field needs.

    Attributes:
        occupancy: the cells that have one.
        subdivisions: (bricks,), 1, 2, 4 or 8.
        nearest: (bricks, 2), the place on a route that is nearest, metres.
    """

    occupancy: Occupancy
    subdivisions: np.ndarray
    nearest: np.ndarray

    @property
    def file_mb(self) -> float:
        """Size of the vertices, MB."""
        return 4 * vertex_count(self.subdivisions) / 1e6

    @property
    def peak_mb(self) -> float:
        """Memory that baking takes in addition to the field, MB."""
        return _WORDS_BAKING * self.file_mb


def plan_bricks(
    scene: PosedField, routes: Sequence[Route], options: BakeOptions | None = None
) -> BakePlan:
    """Find the bricks of a field, before any memory is taken for them.

    Args:
        scene: an :class:`NGPField` at its pose in the routes' frame.
        routes: at least one.
        options: None for the defaults.

    Raises:
        InputError: the field is no `NGPField`, or no cell of it has density.
    """
    options, field, pose = options or BakeOptions(), _ngp(scene), scene.pose
    octants = field.occupancy.octants
    if octants is None:
        octants = dense_octants(field)
    cells = field.window.cells
    if not cells.any():
        raise InputError("bake: the field is empty; fit it again")
    size = (field.upper - field.lower) / cells.shape
    centre = pose.apply(field.lower + (np.argwhere(cells) + 0.5) * size)
    places = np.concatenate([_places(route) for route in routes])
    distance, index = KDTree(places).query(centre[:, :2])
    divisions = pose.scale * size.max() / (options.cone * np.maximum(distance, 1e-6))
    subdivisions = 2 ** np.ceil(np.log2(np.clip(divisions, 1, FINEST))).astype(int)
    subdivisions[octants[cells] == 0] = 1  # hardly ever looked at
    if (count := vertex_count(subdivisions)) > MOST_VERTICES:
        raise InputError(
            f"cone: {options.cone:g}; bricks would have {count} vertices, at most "
            f"{MOST_VERTICES} are possible, give a larger one"
        )
    occupancy = Occupancy(cells, octants)
    return BakePlan(occupancy, subdivisions.astype(np.uint8), places[index])


def bake(
    scene: PosedField,
    routes: Sequence[Route],
    camera: Camera,
    mount: CameraMount | None = None,
    options: BakeOptions | None = None,
    plan: BakePlan | None = None,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> BrickField:
    """Bake a field into bricks, as cameras along routes see it.

    Vertices begin with the field's density, and with the field's colour as seen from
    the nearest place on a route. Then the baking marches rays from poses along the
    routes through the field. At each sample it corrects the eight vertices around by
    the difference of field and bricks, in proportion to the weight that the sample has
    in its pixel. So vertices off the surfaces get the colours that the surfaces need,
    and views are averaged.

    Args:
        scene: an :class:`NGPField` at its pose in the routes' frame.
        routes: at least one.
        camera: of the poses.
        mount: of the camera on the vehicle; None for the default mount.
        options: None for the defaults.
        plan: from :func:`plan_bricks`, of the same arguments; found when left out.
        progress: called with (passes done, all) before the first and after each.

    Source: Hedman et al. 2021 (baking); the refinement is Richardson's iteration on the
    samples' least squares, each row divided by its sum.
    """
    options, mount = options or BakeOptions(), mount or CameraMount()
    plan, field = plan or plan_bricks(scene, routes, options), _ngp(scene)
    codes = Codes.of(field.step_m)
    with dr.suspend_grad():
        baked = BrickField(
            field.lower,
            field.upper,
            occupancy=plan.occupancy,
            subdivisions=plan.subdivisions,
            vertices=_first_vertices(scene, plan, codes, height_m=mount.height_m),
            codes=codes,
            sky=field.tensors()["sky"],
            step_m=field.step_m,
            cone=field.cone,
            info={**field.info, **_provenance(options)},
        )
        progress(0, options.passes)
        for step in range(options.passes):
            poses = drive_poses(
                routes, options.views, _seed(options, step), mount=mount
            )
            _refine(baked, scene, camera, poses=poses, options=options, step=step)
            progress(step + 1, options.passes)
    return baked


def _ngp(scene: PosedField) -> NGPField:
    if not isinstance(scene.field, NGPField):
        raise InputError(
            f"bake: the field is a {scene.field.kind}; only an ngp_field is baked, as "
            "fit writes it"
        )
    return scene.field


def _seed(options: BakeOptions, step: int, draw: int = 0) -> int:
    """Return the seed of a draw of a pass: 0 for its poses, 1 + k from image k on."""
    key = np.random.SeedSequence([options.seed, step, draw])
    return int(key.generate_state(1, np.uint64)[0])


def _provenance(options: BakeOptions) -> dict[str, str]:
    return {f"provenance.bake_{key}": repr(v) for key, v in asdict(options).items()}


def _places(route: Route) -> np.ndarray:
    spacing = _SPACING * route.lane_width_m
    arcs = np.linspace(0, route.length, 2 + int(route.length / spacing))
    return route.pose_at(arcs)[:, :2]


def _first_vertices(
    scene: PosedField, plan: BakePlan, codes: Codes, height_m: float
) -> np.ndarray:
    """Return what vertices (m,) begin with, as words."""
    field, pose = _ngp(scene), scene.pose
    cells = np.argwhere(plan.occupancy.cells)
    starts = brick_starts(plan.subdivisions)
    count, starts = int(starts[-1]), starts[:-1].astype(np.uint32)
    size = (field.upper - field.lower) / plan.occupancy.shape
    eyes = np.hstack([plan.nearest, np.full((len(cells), 1), height_m)])
    heading = pose.apply(field.lower + (cells + 0.5) * size) - eyes
    heading = heading @ pose.rotation  # into the field's frame
    heading /= np.maximum(np.linalg.norm(heading, axis=1, keepdims=True), 1e-9)
    words = dr.zeros(mi.UInt32, count)
    for n in np.unique(plan.subdivisions):
        some = plan.subdivisions == n
        corner = mi.Point3f((field.lower + cells[some] * size).T.astype(np.float32))
        towards = mi.Vector3f(heading[some].T.astype(np.float32))
        start, edge = mi.UInt32(starts[some]), mi.UInt32(int(n) + 1)
        scale = mi.Vector3f(*map(float, size / float(n)))
        dr.make_opaque(corner, towards, start, edge, scale)
        vertex = dr.arange(mi.UInt32, int(some.sum()) * (int(n) + 1) ** 3)
        brick, inner = vertex // edge**3, vertex % edge**3
        place = inner // edge**2, inner // edge % edge, inner % edge
        point = dr.gather(mi.Point3f, corner, brick)
        point += mi.Vector3f(*map(mi.Float, place)) * scale
        direction = dr.gather(mi.Vector3f, towards, brick)
        density, radiance = field.eval_everywhere(point, direction, mi.Bool(True))
        word = pack_word(codes.numbers(density, radiance))
        dr.scatter(words, word, dr.gather(mi.UInt32, start, brick) + inner)
        dr.eval(words)
    return words.numpy()


def _rays(camera: Camera, poses: np.ndarray, seed: int) -> Rays:
    """Return the rays of all poses, with samples at random in their intervals."""
    origin, direction = generate_rays(camera, *pose_arrays(poses), len(poses))
    jitter = dr.rng(seed=seed).random(mi.Float, dr.width(direction))
    rays = Rays(origin, direction, jitter=mi.Float(jitter))
    dr.make_opaque(rays)
    return rays


def _refine(
    baked: BrickField,
    posed: PosedField,
    camera: Camera,
    poses: np.ndarray,
    options: BakeOptions,
    step: int,
) -> None:
    """Move vertices towards what the field has at the samples of views' rays."""
    sums = [dr.zeros(mi.Float, dr.width(baked.vertices)) for _ in range(5)]
    at_once = max(1, _RAYS_AT_ONCE // (camera.width * camera.height))
    for start in range(0, len(poses), at_once):
        seed = _seed(options, step, 1 + start)
        rays = _rays(camera, poses[start : start + at_once], seed)
        walk, active = Walk.start(posed, rays)
        heading = dr.normalize(posed.turn(rays.direction))
        dr.eval(
            _add_differences(
                baked, posed, walk, active=active, heading=heading, sums=sums
            ),
            sums,
        )
    *moves, weight = sums
    rate = dr.rcp(dr.maximum(weight, _FAINT))
    pairs = zip(unpack_word(baked.vertices), moves, strict=True)
    baked.vertices = pack_word([now + rate * move for now, move in pairs])
    dr.make_opaque(baked.vertices)
    dr.sync_thread()  # progress tells of what is done


@dr.syntax
def _add_differences(
    baked: BrickField,
    posed: PosedField,
    walk: Walk,
    active: mi.Bool,
    heading: mi.Vector3f,
    sums: list[mi.Float],
) -> mi.Float:
    """Add weighted differences of the samples to four sums, weights to the fifth."""
    depth = mi.Float(0)
    while active:
        walk, segment = walk.next([posed], active)
        active = segment.active
        depth = _add_sample(
            baked, posed, walk, segment=segment, heading=heading, depth=depth, sums=sums
        )
        active &= dr.exp(-depth) > STOP
    return depth


def _add_sample(
    baked: BrickField,
    posed: PosedField,
    walk: Walk,
    segment: Segment,
    heading: mi.Vector3f,
    depth: mi.Float,
    sums: list[mi.Float],
) -> mi.Float:
    field, point = posed.field, walk.paths[0].at(segment.t)
    unit = field.unit(point)
    density, radiance = field.eval_everywhere(point, heading, segment.active)
    (step,) = segment.depths(
        [posed.in_world(density * field.window(unit, segment.active))]
    )
    weight = dr.exp(-depth) * (1 - dr.exp(-step))
    corners = baked.corners(unit, segment.active)
    field_numbers = baked.codes.numbers(density, radiance)
    baked_numbers = baked.interpolate(corners, segment.active)
    changes = [a - b for a, b in zip(field_numbers, baked_numbers, strict=True)]
    for vertex, share in corners:
        for total, change in zip(sums, [*changes, mi.Float(1)], strict=True):
            part = weight * share * change
            dr.scatter_reduce(dr.ReduceOp.Add, total, part, vertex, segment.active)
    return depth + step
