"""Where to drive, and under which conditions."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.stats import truncnorm

from mi_nerfattack.deploy.built_in import BuiltInObject
from mi_nerfattack.deploy.car import CAR, SMALL_CAR, SMALL_CAR_MOUNT, Car
from mi_nerfattack.deploy.vehicle import Motion
from mi_nerfattack.errors import InputError
from mi_nerfattack.ranges import Count, Finite, NonNegative, Seconds, Share, checked
from mi_nerfattack.render.camera.intrinsics import Camera, CameraMount, from_fov
from mi_nerfattack.render.camera.pose import Pose
from mi_nerfattack.render.camera.rig import ONLY, Rig
from mi_nerfattack.render.pathtrace.load import DAYLIGHT
from mi_nerfattack.vehicle.route.route import Route


@dataclass(frozen=True)
@checked("Scatter")
class Scatter:
    """Deviations of vehicles from the lane centre, normal and cut.

    Args:
        lateral_sd_m, lateral_max_m: offset to the left, metres; 0 for none.
        heading_sd, heading_max: angle to the route, radians; 0 for none.
        close_share: share of the vehicles whose deviations are a fifth of the drawn.
    """

    lateral_sd_m: NonNegative = 0.5
    lateral_max_m: NonNegative = 1.5
    heading_sd: NonNegative = 0.12
    heading_max: NonNegative = 0.4
    close_share: Share = 0.4

    def states(
        self, route: Route, arc: np.ndarray, rng: np.random.Generator
    ) -> np.ndarray:
        """Draw states (n, 3) at arc lengths (n,), metres."""
        count = len(arc)
        factor = np.where(rng.uniform(size=count) < self.close_share, 0.2, 1.0)
        lateral = cut_normal(self.lateral_sd_m, self.lateral_max_m, count, rng=rng)
        heading = cut_normal(self.heading_sd, self.heading_max, count, rng=rng)
        states = route.pose_at(arc, factor * lateral)
        # the route's own heading jumps at the vertices of the polyline
        states[:, 2] = route.heading_at(arc) + factor * heading
        return states


def cut_normal(
    sd: float, largest: float, count: int, rng: np.random.Generator
) -> np.ndarray:
    """Draw (count,) normal numbers of standard deviation `sd` within +-largest."""
    if sd == 0 or largest == 0:
        return np.zeros(count)
    cut = largest / sd
    return sd * np.asarray(truncnorm.rvs(-cut, cut, size=count, random_state=rng))


@dataclass(frozen=True)
@checked("place")
class Place:
    """Files of a scene in its forms, and what drives there.

    Args:
        scene: Mitsuba XML.
        field: the scene's field, of the surrogate; None where there is none.
        field_pose: field to world; None where they are the same.
        routes: JSON.
        objects: grid fields that may stand at the roadside.
        camera: of the vehicle; the first one, if it has several.
        mount: where the camera sits on it.
        period: seconds between two images.
        car: what drives.
        motion: how, where an environment has no physics; the car's kinematic model by
            default.
        recording: of `replay`: a folder, a video or a log.
        topics: of such a log, "NAME=/topic", see `McapTopics`.
        server: of `carla`: "HOST:PORT" or "HOST:PORT/TOWN".
        camera_name: of the first camera.
        others: cameras besides it, to the right of it in a frame; None for none.
    """

    scene: Path
    field: Path | None
    routes: Path
    objects: tuple[Path, ...]
    camera: Camera
    mount: CameraMount
    period: Seconds = 0.1
    car: Car = CAR
    motion: Motion | None = None
    recording: Path | None = None
    topics: tuple[str, ...] = ()
    server: str = "127.0.0.1:2000"
    field_pose: Pose | None = None
    camera_name: str = ONLY
    others: Rig | None = None

    @property
    def rig(self) -> Rig:
        """All cameras of the vehicle."""
        rig = Rig.of_one(self.camera, self.mount, self.camera_name)
        return rig if self.others is None else rig + self.others

    def with_rig(self, rig: Rig) -> Place:
        """Return the place with other cameras on the vehicle."""
        return replace(
            self,
            camera=rig.cameras[0],
            mount=rig.mounts[0],
            camera_name=rig.names[0],
            others=rig.others,
        )


@dataclass(frozen=True)
@checked()
class Conditions:
    """What changes between drives at one place.

    Args:
        sky: time of day, key of `DAYLIGHT`: "day" (the file's), "morning", "noon",
            "evening", "overcast".
        exposure_ev: of the camera, in powers of two.
        blur_px: standard deviation of the camera's Gaussian blur, pixels.
        noise_sd: standard deviation of its noise, of sRGB values in [0, 1].
        spp: samples per pixel of path-traced images.
        built_in: objects with geometry, lit and shadowed by the environment.
    """

    sky: str = "day"
    exposure_ev: Finite = 0.0
    spp: Count = 16
    built_in: tuple[BuiltInObject, ...] = ()
    blur_px: NonNegative = 0.0
    noise_sd: NonNegative = 0.0

    def __post_init__(self) -> None:
        if self.sky not in DAYLIGHT:
            raise InputError(f"sky: {self.sky!r}; one of {', '.join(DAYLIGHT)}")


def bundled_place(name: str = "intersection") -> Place:
    """Return a bundled scene with its routes, objects and car.

    Args:
        name: "intersection", with the full-size car and a hydrant; or "room", with the
            small car on its square track and a cube.
    """
    from mi_nerfattack.scenes import bundled

    if name not in _CARS:
        raise InputError(f"place: {name!r}; one of {', '.join(_CARS)}")
    car, mount, thing = _CARS[name]
    return Place(
        scene=bundled(f"{name}/scene.xml"),
        field=bundled(f"{name}/field.safetensors"),
        routes=bundled(f"{name}/routes.json"),
        objects=(bundled(f"{thing}/field.safetensors"),),
        camera=from_fov(200, 66, 90.0),
        mount=mount,
        car=car,
    )


#: Cars of the bundled places, where their cameras are, and what stands there.
_CARS = {
    "intersection": (CAR, CameraMount(), "hydrant"),
    "room": (SMALL_CAR, SMALL_CAR_MOUNT, "cube"),
}
