"""A found scenario as OpenSCENARIO 1.2: route, car, start, and the objects as glTF."""

from __future__ import annotations

from dataclasses import replace
from datetime import datetime, timezone
from pathlib import Path
from typing import Any
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

import numpy as np
from scipy.spatial.transform import Rotation

from mi_nerfattack.capture.mesh.gltf_writer import write_glb
from mi_nerfattack.capture.mesh.surface import field_surface
from mi_nerfattack.deploy.car import Car
from mi_nerfattack.drives.store import read_drives
from mi_nerfattack.experiment.run_folder import DRIVES, object_path
from mi_nerfattack.experiment.transfer.found import FoundAttack, read_found
from mi_nerfattack.fields.io import load_grid
from mi_nerfattack.io import files
from mi_nerfattack.props.attacked import placed
from mi_nerfattack.render.camera.pose import Pose
from mi_nerfattack.rollout.drive import ATTACK
from mi_nerfattack.scenario.deployment import SURROGATE
from mi_nerfattack.vehicle.route.route import Route

_MS2 = 10.0  # acceleration that the standard asks for, and no policy reaches


def write_openscenario(run: Path, folder: Path) -> list[Path]:
    """Write a finished attack as `scenario.xosc`, `route.xodr` and `OBJECT.glb`.

    The car starts where the drive past the attack began that left the lane most, and
    gets the route to follow. World, metres and angles are the run's.

    Args:
        run: folder of `mi-nerfattack attack`.
        folder: made where it is missing; files of these names are replaced.

    Returns:
        The files, `scenario.xosc` first.

    Raises:
        InputError: the folder holds no finished attack, or an object is nowhere opaque.
    """
    (attack,) = read_found([run])
    poses, _ = placed(attack)
    files.make_folder(folder)
    written, objects = [folder / "scenario.xosc", folder / "route.xodr"], []
    for item, pose, offset in zip(
        attack.scenario.objects, poses, attack.offsets, strict=True
    ):
        mesh = field_surface(load_grid(object_path(run, item.id)))
        mesh = replace(mesh, vertices=pose.scale * mesh.vertices)
        written.append(folder / f"{item.id}.glb")
        write_glb(written[-1], mesh)
        objects.append((item.id, pose.moved(offset), mesh.vertices))
    _write(written[0], _scenario(attack, objects))
    _write(written[1], _road(attack.route))
    return written


def _node(tag: str, *children: Element, **attributes: Any) -> Element:
    text = {key: f"{value}" for key, value in attributes.items()}
    element = Element(tag, text)
    element.extend(children)
    return element


def _write(path: Path, root: Element) -> None:
    ElementTree.indent(root)
    files.write_bytes(path, ElementTree.tostring(root, "utf-8", xml_declaration=True))


def _scenario(
    attack: FoundAttack, objects: list[tuple[str, Pose, np.ndarray]]
) -> Element:
    """Return the document; objects are id, pose and vertices (n, 3) in metres."""
    scenario, route = attack.scenario, attack.route
    start, car = _worst_start(attack), scenario.vehicle.car()
    # The origin of a vehicle in OpenSCENARIO is the middle of its rear axle.
    axle = start - car.reference * np.array([np.cos(start[2]), np.sin(start[2]), 0])
    entities = [_node("ScenarioObject", _car(car, route), name="ego")]
    actions = [_ego(axle, route)]
    for name, pose, vertices in objects:
        low, high = vertices.min(0), vertices.max(0)
        body = _node(
            "MiscObject",
            _box((low + high) / 2, high - low),
            _node("Properties"),
            name=name,
            mass=0,
            miscObjectCategory="obstacle",
            model3d=f"{name}.glb",
        )
        entities.append(_node("ScenarioObject", body, name=name))
        heading, pitch, roll = Rotation.from_matrix(pose.rotation).as_euler("ZYX")
        where = _world(*pose.translation, h=heading, p=pitch, r=roll)
        actions.append(_node("Private", _teleport(where), entityRef=name))
    end_s = attack.horizon * scenario.vehicle.dt_s
    time = _node("SimulationTimeCondition", value=end_s, rule="greaterThan")
    over = _node(
        "Condition",
        _node("ByValueCondition", time),
        name="end of the drive",
        delay=0,
        conditionEdge="none",
    )
    return _node(
        "OpenSCENARIO",
        _node(
            "FileHeader",
            author="mi-nerfattack",
            date=datetime.now(timezone.utc).isoformat(timespec="seconds"),
            description=f"{scenario.name}, run {attack.label}, {attack.digest[:16]}",
            revMajor=1,
            revMinor=2,
        ),
        _node("ParameterDeclarations"),
        _node("CatalogLocations"),
        _node("RoadNetwork", _node("LogicFile", filepath="route.xodr")),
        _node("Entities", *entities),
        _node(
            "Storyboard",
            _node("Init", _node("Actions", *actions)),
            _node("StopTrigger", _node("ConditionGroup", over)),
        ),
    )


def _worst_start(attack: FoundAttack) -> np.ndarray:
    """Return x, y and heading of the start whose drive left the lane most."""
    drives = [
        drive
        for drive in read_drives(attack.folder / DRIVES)
        if (drive.environment, drive.case) == (SURROGATE, ATTACK)
    ]
    if not drives:
        return attack.route.pose_at(attack.scenario.drive.start_m)
    return max(drives, key=lambda drive: np.abs(drive.cross_track_m).max()).poses[0]


def _ego(start: np.ndarray, route: Route) -> Element:
    x, y, heading = start
    points = [_world(*point) for point in route.points]
    path = [
        _node("Waypoint", _node("Position", point), routeStrategy="shortest")
        for point in points
    ]
    follow = _node("Route", *path, name=route.name, closed=str(route.closed).lower())
    return _node(
        "Private",
        _teleport(_world(x, y, h=heading)),
        _node(
            "PrivateAction",
            _node(
                "LongitudinalAction",
                _node(
                    "SpeedAction",
                    _node(
                        "SpeedActionDynamics",
                        dynamicsShape="step",
                        dynamicsDimension="time",
                        value=0,
                    ),
                    _node(
                        "SpeedActionTarget",
                        _node("AbsoluteTargetSpeed", value=route.speed_ms),
                    ),
                ),
            ),
        ),
        _node(
            "PrivateAction", _node("RoutingAction", _node("AssignRouteAction", follow))
        ),
        entityRef="ego",
    )


def _car(car: Car, route: Route) -> Element:
    height = car.length / 3
    centre = np.array([car.wheelbase / 2, 0, height / 2])
    axle = {
        "wheelDiameter": 2 * car.wheel_radius,
        "trackWidth": car.track,
        "positionZ": car.wheel_radius,
    }
    return _node(
        "Vehicle",
        _box(centre, np.array([car.length, car.width, height])),
        _node(
            "Performance",
            maxSpeed=2 * route.speed_ms,
            maxAcceleration=_MS2,
            maxDeceleration=_MS2,
        ),
        _node(
            "Axles",
            _node(
                "FrontAxle", maxSteering=car.max_steer, positionX=car.wheelbase, **axle
            ),
            _node("RearAxle", maxSteering=0, positionX=0, **axle),
        ),
        _node("Properties"),
        name="ego",
        vehicleCategory="car",
        mass=car.mass,
    )


def _box(centre: np.ndarray, size: np.ndarray) -> Element:
    x, y, z = centre
    length, width, height = size
    return _node(
        "BoundingBox",
        _node("Center", x=x, y=y, z=z),
        _node("Dimensions", length=length, width=width, height=height),
    )


def _world(
    x: float, y: float, z: float = 0, h: float = 0, p: float = 0, r: float = 0
) -> Element:
    return _node("WorldPosition", x=x, y=y, z=z, h=h, p=p, r=r)


def _teleport(where: Element) -> Element:
    return _node("PrivateAction", _node("TeleportAction", _node("Position", where)))


def _road(route: Route) -> Element:
    """Return OpenDRIVE of one road, whose lane has its centre on the route."""
    low, high = route.points.min(0), route.points.max(0)
    begins = np.append(0.0, np.cumsum(route.edge_lengths)[:-1])
    lines = [
        _node(
            "geometry", _node("line"), s=s, x=x, y=y, hdg=np.arctan2(dy, dx), length=n
        )
        for s, (x, y), (dx, dy), n in zip(
            begins, route.points, route.edges, route.edge_lengths, strict=False
        )
    ]
    flat, width = {"b": 0, "c": 0, "d": 0}, route.lane_width_m
    lane = _node(
        "lane",
        _node("width", sOffset=0, a=width, **flat),
        id=-1,
        type="driving",
        level="false",
    )
    return _node(
        "OpenDRIVE",
        _node(
            "header",
            revMajor=1,
            revMinor=7,
            name=route.name,
            north=high[1],
            south=low[1],
            east=high[0],
            west=low[0],
        ),
        _node(
            "road",
            _node("planView", *lines),
            _node(
                "lanes",
                _node("laneOffset", s=0, a=width / 2, **flat),
                _node(
                    "laneSection",
                    _node("center", _node("lane", id=0, type="none", level="false")),
                    _node("right", lane),
                    s=0,
                ),
            ),
            name=route.name,
            length=route.length,
            id=1,
            junction=-1,
        ),
    )
