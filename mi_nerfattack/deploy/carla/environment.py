"""A town of CARLA as a deployment environment, objects pasted by depth."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from mi_nerfattack.deploy.carla.cameras import CarlaCameras, read_pose
from mi_nerfattack.deploy.carla.conventions import (
    body_from_carla,
    body_to_carla,
    field_of_view_deg,
)
from mi_nerfattack.deploy.carla.drivers import (
    Axles,
    KinematicDriver,
    read_axles,
    road_height,
)
from mi_nerfattack.deploy.carla.session import CarlaServer, CarlaSession, load_client
from mi_nerfattack.deploy.environment import AbstractEnvironment, CameraFrame
from mi_nerfattack.deploy.vehicle import Controls, checked_control, checked_pose
from mi_nerfattack.deploy.views.paste import Paster
from mi_nerfattack.errors import InputError
from mi_nerfattack.render.camera.intrinsics import (
    Camera,
    CameraMount,
    camera_to_body,
    planar_body,
)
from mi_nerfattack.render.camera.rig import Rig
from mi_nerfattack.vehicle.route.route import Route

VEHICLE = "vehicle.tesla.model3"
_DROP_M = 0.3  # above the road, so that nothing collides when it is spawned
_SETTLE_S = 1.5  # the car falls onto its springs and the camera's exposure settles


class CarlaEnvironment(AbstractEnvironment):
    """A vehicle with a camera in a running CARLA server.

    From the first call on, the server is in synchronous mode with one tick per period.
    `close` and every error give the server back. Each reset spawns vehicle and cameras
    again. Objects are pasted by depth (appendix B.3).

    Args:
        server: where it runs, its town and weather.
        camera: intrinsics: no distortion, square pixels, centred.
        mount: the camera's pose, relative to the point of the driver's state.
        driver: what moves the vehicle.
        period: seconds between two images, at most 0.16.
        vehicle: blueprint.
        axles: of the vehicle; None reads them from the server.
        attributes: of the colour camera, by CARLA's names.
        api: the module `carla`; None imports it.

    Raises:
        InputError: the client is not installed, no server answers within the time
            limit, versions differ, the town or weather is unknown, or CARLA has no
            such camera.
    """

    name = "carla"

    def __init__(
        self,
        server: CarlaServer,
        camera: Camera,
        mount: CameraMount,
        driver: KinematicDriver,
        period: float = 0.1,
        vehicle: str = VEHICLE,
        axles: Axles | None = None,
        attributes: Mapping[str, str] | None = None,
        api: Any = None,
    ) -> None:
        field_of_view_deg(camera)
        self.camera, self.period, self.driver = camera, period, driver
        self.rig = Rig.of_one(camera, mount)
        self.max_control = driver.max_control
        self.control_unit = driver.control_unit
        self.more_controls = driver.more_controls
        self._vehicle, self._axles = vehicle, axles
        self._attributes = dict(attributes or {})
        self._mount = camera_to_body(mount)
        self._paster = Paster(camera, ())
        self._cameras: CarlaCameras | None = None
        self._actor: Any = None
        self.session = CarlaSession(
            server, period, load_client() if api is None else api
        )

    def reset(
        self, route: Route, pose: np.ndarray | None = None, seed: int = 0
    ) -> CameraFrame:
        """Spawn vehicle and cameras; nothing is random, so `seed` has no effect."""
        del seed
        start = checked_pose(route.pose_at(0.0) if pose is None else pose)
        with self.session.guarded("put the vehicle on the road"):
            self._cameras = None
            self.session.clear()
            axles, height = self._spawn(start)
            reference = self.driver.vehicle.reference
            body_to_camera = axles.body_to_world(np.eye(4), reference) @ self._mount
            self._cameras = CarlaCameras(
                self.session,
                self.camera,
                self._actor,
                body_to_camera=body_to_camera,
                attributes=self._attributes,
            )
            frame, speed = 0, route.speed_ms
            self.driver.begin(
                self.session, self._actor, axles, pose=start, speed=speed, height=height
            )
            for _ in range(max(1, round(_SETTLE_S / self.period))):
                frame = self.session.tick()
            camera_frame = self._observe(frame)
        return self._paster.paste(camera_frame)

    def step(self, control: Controls) -> CameraFrame:
        """Drive one period."""
        if self._cameras is None:
            raise InputError("environment 'carla': step comes after reset")
        checked_control(control, self.control_names)
        with self.session.guarded("drive on"):
            self.driver.apply(control)
            camera_frame = self._observe(self.session.tick())
        return self._paster.paste(camera_frame)

    @property
    def state(self) -> np.ndarray:
        """State (m,) of the model; x, y and heading come first."""
        if self._cameras is None:
            raise InputError("environment 'carla': it has a state only after reset")
        return self.driver.vehicle.state

    @property
    def speed(self) -> float:
        """Speed of the model."""
        return self.driver.vehicle.speed

    def show(self, objects: Sequence[Any]) -> None:
        """Paste fields by depth."""
        self._paster = Paster(self.camera, objects)

    def close(self) -> None:
        """Give the server back; see `CarlaSession.close`."""
        self._cameras = None
        self.session.close()

    def _spawn(self, start: np.ndarray) -> tuple[Axles, float]:
        """Spawn the vehicle with its reference point at a pose, standing.

        Returns:
            its axles, and the height of the road there: of the lane nearest to z = 0.
        """
        session, reference = self.session, self.driver.vehicle.reference
        body = planar_body(start)
        known = self._axles
        pose = body if known is None else known.actor_to_world(body, reference)
        height = road_height(session, pose)
        pose[2, 3] = height + _DROP_M
        role = {"role_name": "hero"}
        self._actor = session.spawn(self._vehicle, body_to_carla(pose), role)
        if known is not None:
            return known, height
        session.tick()
        measured = body_from_carla(read_pose(self._actor.get_transform()))
        axles = read_axles(self._actor, measured)
        pose = axles.actor_to_world(body, reference)
        pose[2, 3] = height
        height = road_height(session, pose)
        pose[2, 3] = height + _DROP_M
        self._actor.set_transform(session.transform(body_to_carla(pose)))
        return axles, height

    def _observe(self, frame: int) -> CameraFrame:
        if self.session.world.get_snapshot().find(self._actor.id) is None:
            raise InputError(
                f"{self._vehicle}: it is gone from the world; let no other client "
                "destroy it"
            )
        assert self._cameras is not None
        return self._cameras.read(frame)
