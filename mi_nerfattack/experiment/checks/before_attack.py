"""Checks that find, before an attack begins, why its result would be worthless."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np

from mi_nerfattack.deploy.environment import CameraFrame
from mi_nerfattack.deploy.views.above import PixelRays
from mi_nerfattack.experiment.checks.standing import (
    lane_findings,
    meeting_findings,
    scene_findings,
    solids_of,
)
from mi_nerfattack.fields.grid import GridField
from mi_nerfattack.render.camera.intrinsics import Camera
from mi_nerfattack.render.pathtrace.ground import (
    arc_lengths,
    ground_findings,
    stretches,
    wall_findings,
)
from mi_nerfattack.render.pathtrace.load import load_scene
from mi_nerfattack.render.posed import PosedField
from mi_nerfattack.report.pages.verdict import MIN_PSNR_DB
from mi_nerfattack.rollout.drive import OWN, Drive, departure_limit
from mi_nerfattack.scenario.deployment import SURROGATE
from mi_nerfattack.scenario.world import World
from mi_nerfattack.vehicle.dynamics import to_state
from mi_nerfattack.vehicle.route.route import Route

#: Share by which depths of surrogate and deployment may differ in the middle.
DEPTHS = 0.15

_SPEEDS = 0.01  # share by which the speeds of route and vehicle may differ
_STANDING_M = 0.5  # what is higher above z = 0 is no ground
_FARTHEST_M = 80.0
_FEWEST = 100  # pixels, of which something is said


def driven_arc(world: World) -> np.ndarray:
    """Return places (n,) along the part of the route that is driven, metres."""
    scenario = world.scenario
    return arc_lengths(*scenario.drive.stretch(world.route, scenario.vehicle.dt_s))


def scene_field(world: World) -> PosedField | None:
    """Return the field of the scene; None where it has another surrogate."""
    objects = world.surrogate.objects
    layers = [item for item in world.surrogate.layers if item not in objects]
    layer = layers[0] if len(layers) == 1 else None
    return layer if isinstance(layer, PosedField) else None


def fit_findings(world: World) -> Iterator[str]:
    """Doubt a field of the scene whose fit, says its file, was not good enough.

    Fields of other programs have no figures of a fit.
    """
    if (posed := scene_field(world)) is None:
        return
    psnr_db = float(posed.field.info.get("fit.psnr_heldout_db", "nan"))
    if psnr_db < MIN_PSNR_DB:
        yield (
            f"blurred field: {world.scenario.scene.field} shows its held-out views "
            f"with {psnr_db:.1f} dB on average, and {MIN_PSNR_DB:g} dB are good enough "
            "to test a policy in; an attack may exploit errors of the field; fit for "
            "longer, or to more views"
        )


def box_findings(world: World) -> Iterator[str]:
    """Tell of a route that leaves the box of the surrogate's field."""
    if (posed := scene_field(world)) is None:
        return
    arc = driven_arc(world)
    points = world.route.pose_at(arc)[:, :2]
    field, pose = posed.field, posed.placed
    inside = np.column_stack(
        [points, np.full(len(points), world.surrogate.mount.height_m)]
    )
    local = pose.to_local(inside)
    out = np.any((local < field.lower) | (local > field.upper), axis=1)
    if out.any():
        size = pose.scale * (field.upper - field.lower)
        place = world.scenario.scene
        yield (
            f"the camera leaves the box of {place.field or place.surrogate}, of "
            f"{size[0]:.1f} x {size[1]:.1f} x {size[2]:.1f} m, "
            f"{stretches(arc, out)} of route {world.route.name!r}: nothing is shown "
            "there; give a field of this place, or its scene.to_world"
        )


def likeness_findings(
    camera: Camera, surrogate: CameraFrame, deployment: CameraFrame, label: str
) -> Iterator[str]:
    """Tell of two worlds whose standing things are at other distances.

    Args:
        camera: of both frames.
        surrogate: its frame.
        deployment: another's, from the same pose.
        label: of the deployment.
    """
    pose = deployment.camera_to_world
    upwards = PixelRays(camera).at(pose).direction.z.numpy()
    ours, theirs = surrogate.depth, deployment.depth
    with np.errstate(invalid="ignore"):
        height = pose[2, 3] + theirs * upwards.reshape(theirs.shape)
        standing = height > _STANDING_M
    mask = standing & np.isfinite(ours) & (theirs < _FARTHEST_M)
    if mask.sum() < _FEWEST:
        return
    change = float(np.median(np.abs(np.log(ours[mask] / theirs[mask]))))
    if change > np.log1p(DEPTHS):
        yield (
            f"surrogate and {label} do not show one place: at the start, half of what "
            f"stands there is {100 * np.expm1(change):.0f} % or more nearer or farther "
            f"in one than in the other ({np.median(ours[mask]):.1f} and "
            f"{np.median(theirs[mask]):.1f} m in the middle); compare their pictures, "
            "and correct the field's scene.to_world"
        )


#: A pixel shows an object where its texture can change the value by so much of 1; it
#: is in view where such pixels are this share of a picture, in this share of pictures.
CHANGE, PIXELS, PICTURES = 0.1, 0.001, 0.05
#: Returns the drive in an environment with the look of a case and from a start.
One = Callable[[str, str, int], Drive]

_MOST_PICTURES = 20
_RAW = 10.0  # a raw colour whose sigmoid is 1, whatever the levels
_OVER_M = 1.0  # beyond the end of a route, since starts are scattered
_MESHES = ("mitsuba", "mujoco", "mujoco_gl")  # environments of the scene's meshes


def first_findings(world: World, one: One) -> Iterator[str]:
    """Check the geometry and one drive in each environment.

    The checks are:

    - scene and field lie beneath the route;
    - the objects are next to the lane, on the ground, in the open and apart;
    - with original textures, the policy keeps its lane from the first start in every
      environment;
    - the policy does not reach the end of the route;
    - every object is in view.

    Args:
        world: with textures and places of objects as the scenario says.
        one: makes the drives, or reads finished drives.

    Yields:
        one sentence per finding: the problem, its place, and the remedy.
    """
    yield from route_findings(world)
    yield from place_findings(world)  # which may be why a drive leaves the lane
    first = one(SURROGATE, OWN, 0)
    yield from departure_findings(world, [first])
    for label in world.deployments:
        if not world.is_open_loop(label):
            yield from departure_findings(world, [one(label, OWN, 0)])
    yield from view_findings(world, first)
    yield from horizon_findings(world, first)


def further_findings(world: World, one: One) -> Iterator[str]:
    """Check that the policy keeps its lane from the other starts of the surrogate.

    Args and Yields: as :func:`first_findings`.
    """
    starts = range(1, len(world.initial))
    yield from departure_findings(world, [one(SURROGATE, OWN, k) for k in starts])


def departure_findings(world: World, drives: list[Drive]) -> Iterator[str]:
    """Tell of drives that leave the lane though nothing is attacked."""
    width = world.scenario.vehicle.width_m
    limit = departure_limit(world.route.lane_width_m, width)
    left = [drive for drive in drives if drive.departed(limit).any()]
    if not left:
        return
    worst = max(left, key=lambda drive: drive.distance_m.max())
    step = int(worst.departed(limit).argmax())
    x, y = worst.states[1 + step, :2]
    runs = ", ".join(str(drive.run) for drive in left)
    yield (
        f"the policy leaves its lane before anything is attacked: in "
        f"{worst.environment}, run {runs}, objects in their own textures, it comes to "
        f"{worst.distance_m.max():.2f} m from the lane's centre, and beyond "
        f"{limit:.2f} m after {worst.time_s[step]:.1f} s at ({x:.1f}, {y:.1f}) m; give "
        "a policy that keeps it, or another route, start or object; if it keeps its "
        "lane elsewhere, compare the order of its goals, policy.preprocess, the camera "
        "and the sign of its control with its training"
    )


def speed_findings(world: World) -> Iterator[str]:
    """Tell of a vehicle that is faster or slower than the routes file says."""
    scenario, dynamics = world.scenario, world.motion.dynamics
    scene, drive, period = scenario.scene, scenario.drive, scenario.vehicle.dt_s
    if not dynamics.has_speed:
        return
    route = Route.from_file(scene.routes.file, scene.route)
    state = to_state(dynamics.extend(world.initial[:1]))
    speed = float(dynamics.speed_of(state)[0])
    if np.isclose(speed, route.speed_ms, rtol=_SPEEDS):
        return
    horizon, expected = world.horizon, drive.steps(route, period)
    yield (
        f"the vehicle starts at {speed:.3g} m/s, and {scene.routes} gives route "
        f"{route.name!r} {route.speed_ms:.3g} m/s: a drive has {horizon} control "
        f"periods and about {horizon * speed * period:.1f} m, and at the route's speed "
        f"{expected} control periods and {expected * route.speed_ms * period:.1f} m; "
        "give both the same speed, unless you want the difference"
    )


def unit_findings(world: World) -> Iterator[str]:
    """Tell of units that nothing says, so that nothing compares them."""
    scenario = world.scenario
    units = {"policy": scenario.policy.unit(), "vehicle": scenario.vehicle.unit}
    missing = [f"{name}.control_unit" for name, unit in units.items() if unit is None]
    if missing:
        yield (
            f"{' and '.join(missing)}: missing, so nothing compares the control of the "
            'policy with the control of the vehicle; give "rad/s" (heading rate), '
            '"rad" (steering angle) or "other"'
        )


def period_findings(world: World) -> Iterator[str]:
    """Tell of another control period than the policy was trained with."""
    policy, period = world.scenario.policy, world.scenario.vehicle.dt_s
    if policy.period_s is not None and not np.isclose(policy.period_s, period):
        yield (
            f"vehicle.dt_s: {period:g} s; {policy.source} was trained with "
            f"{policy.period_s:g} s between two images: give vehicle.dt_s = "
            f"{policy.period_s:g}, or policy.stride and policy.frame_stride of the "
            "same times"
        )


def horizon_findings(world: World, first: Drive) -> Iterator[str]:
    """Tell of a horizon that an open route is too short for."""
    route = world.route
    if route.closed:
        return
    over = route.project_numpy(first.states[1:]).arc_length - route.length
    if over[-1] > _OVER_M:
        step = int((over > 0).argmax())
        yield (
            f"the drive of {len(over)} steps ends {over[-1]:.1f} m beyond route "
            f"{route.name!r} of {route.length:.1f} m, whose end is passed after "
            f"{first.time_s[step]:.1f} s; lower drive.horizon to {max(step, 1)}, leave "
            "it and length_m out, or take a longer route"
        )


def view_findings(world: World, first: Drive) -> Iterator[str]:
    """Tell of objects whose texture shows in too few pictures of a drive."""
    steps = np.arange(len(first.controls))
    steps = steps[:: -(-len(steps) // _MOST_PICTURES)]
    needed = int(np.ceil(PICTURES * len(steps)))
    original = world.appearance()
    try:
        for k, item in enumerate(world.scenario.objects):
            visible, most = 0, 0.0
            for step in steps:
                own = world.fields[k : k + 1]
                share = changeable_share(world, own, first.poses[step], step=int(step))
                visible, most = visible + (share >= PIXELS), max(most, share)
                if visible == needed:
                    break
            else:
                yield (
                    f"{item.id} is not in view: along the drive of "
                    f"{first.time_s[-1]:.1f} s its texture changes at most "
                    f"{100 * most:.2f} % of the pixels, in {visible} of {len(steps)} "
                    f"pictures {100 * PIXELS:g} % or more, and {needed} are needed; "
                    "move it into view, or the start towards it"
                )
    finally:
        world.show(original)


def changeable_share(
    world: World, fields: Sequence[GridField], pose: np.ndarray, step: int
) -> float:
    """Return the share of the first camera's pixels that textures can change.

    Args:
        world: of the attack; the fields keep another texture.
        fields: of the objects.
        pose: (3,) of the vehicle.
        step: control period, of the rays.
    """
    sensor, state = world.surrogate.through(0), to_state(pose[None])
    images = []
    for raw in (_RAW, -_RAW):
        for field in fields:
            texture = np.full((field.n_vertices, 3), raw, np.float32)
            field.set_parameter("texture", texture)
        images.append(sensor.observe(state, step).image.numpy())
    change = np.abs(images[0] - images[1]).max(-1)
    return float((change >= CHANGE).mean())


def route_findings(world: World) -> Iterator[str]:
    """Tell of a route that is not on the ground of scene and field."""
    yield from box_findings(world)
    if (scene := mesh_scene(world)) is not None:
        file = world.scenario.scene.deployment.file
        for findings in (ground_findings, wall_findings):
            yield from findings(world.route, driven_arc(world), scene, file.name)


def place_findings(world: World) -> Iterator[str]:
    """Tell of objects that stand where none can be driven past."""
    scenario = world.scenario
    names = [item.id for item in scenario.objects]
    objects = dict(zip(names, world.surrogate.objects, strict=True))
    solids = solids_of(objects)
    freedom = scenario.attack.freedom.build()
    yield from lane_findings(
        solids, world.route, scenario.vehicle.width_m, freedom=freedom
    )
    yield from meeting_findings(solids)
    if (scene := mesh_scene(world)) is not None:
        name = scenario.scene.deployment.file.name
        yield from scene_findings(solids, world.route, scene, name=name)


def mesh_scene(world: World) -> Any:
    """Load the scene that deployments show the surfaces of; None without these."""
    if any(item.environment in _MESHES for item in world.deployments.values()):
        return load_scene(world.scenario.scene.deployment.file)
    return None
