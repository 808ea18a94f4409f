"""The sensor of a Mitsuba scene on a vehicle."""

from __future__ import annotations

import math
from copy import copy
from functools import cache
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_nerfattack.errors import InputError
from mi_nerfattack.render.camera.conventions import from_mitsuba, mitsuba_sensor_dict
from mi_nerfattack.render.camera.intrinsics import Camera, CameraMount
from mi_nerfattack.render.camera.lens import mount_pose
from mi_nerfattack.render.camera.rig import camera_seed
from mi_nerfattack.render.lighting.shading import LightMaps
from mi_nerfattack.render.posed import PosedField
from mi_nerfattack.render.rays import Gain
from mi_nerfattack.rollout.variation import Variation


class SceneCamera:
    """Rays of a scene's sensor from vehicles, and images of their radiance.

    Rays go through the places in pixels, and on the aperture, that the sensor's own
    sampler draws for an image; they are the same for all drives. What the integrator
    draws depends on the drive's number, too. So a drive is the same in any batch.

    Args:
        sensor: lens, clip distances, film size and samples per pixel count; its pose
            does not.
        mount: pose on the vehicle.
        seed: of all random numbers, renewed each control period.
        centred: let rays go through the middles of n x n squares of a pixel.
        first: number of the first drive of a batch.
        variation: of the mount from drive to drive.

    Raises:
        InputError: `centred`, and a number of samples that is no square.
    """

    def __init__(
        self,
        sensor: Any,
        mount: CameraMount,
        seed: int,
        centred: bool,
        first: int = 0,
        variation: Variation | None = None,
    ) -> None:
        self.sensor: Any = sensor
        self.mount: CameraMount = mount
        self.seed: int = seed
        self.centred, self.first = centred, first
        self.variation: Variation | None = variation
        self._forget()
        if centred and math.isqrt(self.spp) ** 2 != self.spp:
            raise InputError(
                f"samples per pixel: {self.spp}; rays through the middles of squares "
                "need 1, 4, 9, ..."
            )

    def _forget(self) -> None:
        self._mounts: dict[int, tuple[Any, Any]] = {}  # by the number of drives
        self._lights: dict[int, mi.Color3f] = {}
        self._rows: dict[tuple[int, int], mi.UInt32] = {}  # of objects' light maps

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of an image, pixels."""
        width, height = map(int, self.sensor.film().crop_size())
        return width, height

    @property
    def spp(self) -> int:
        """Samples per pixel."""
        return self.sensor.sampler().sample_count()

    @property
    def per_image(self) -> int:
        """Rays of an image."""
        width, height = self.size
        return width * height * self.spp

    def rays(
        self, pose: Any, count: int, step: int
    ) -> tuple[mi.Sampler, mi.Ray3f, Any]:
        """Make rays, vehicle by vehicle, row by row, sample by sample.

        Args:
            pose: (3, count): px, py (metres), theta (radians); differentiable.
            count: of vehicles.
            step: index of the control period.

        Returns:
            the sampler after the camera's draws, the rays, and their weights.
        """
        width, height = self.size
        sampler, within, aperture = self._draw(count, step)
        # A ray of the scene's own sensor, through a place in its pixel
        index = dr.arange(mi.UInt32, count * self.per_image) // self.spp
        vehicle = index // (width * height)
        pixel = index - vehicle * (width * height)
        row = pixel // width
        place = mi.Vector2f(pixel - row * width, row) + within
        with dr.suspend_grad():
            ray, weight = self.sensor.sample_ray_differential(
                time=self.sensor.shutter_open(),
                sample1=0,
                sample2=mi.Point2f(place / mi.ScalarVector2f(width, height)),
                sample3=aperture,
            )
            to_local = self.sensor.world_transform().inverse()
            o, d = to_local @ ray.o, to_local @ ray.d
        # Mitsuba's cameras look along +z with x to the left and y up
        origin, columns = self._place(pose)
        right, down, forward = (dr.gather(mi.Vector3f, c, vehicle) for c in columns)
        moved = mi.Ray3f(ray)  # without differentials, which are the scene sensor's
        moved.o = dr.gather(mi.Point3f, origin, vehicle) + (
            o.z * forward - o.x * right - o.y * down
        )
        moved.d = d.z * forward - d.x * right - d.y * down
        return sampler, moved, weight

    def sampler(self, count: int, step: int) -> mi.Sampler:
        """Return the sampler that :meth:`rays` gives, as it was then."""
        return self._draw(count, step)[0]

    def _draw(self, count: int, step: int) -> tuple[mi.Sampler, Any, mi.Point2f]:
        """Return a sampler, places in pixels (2, n) from 0 to 1, and on apertures."""
        # The integrator's numbers: a stream for each ray of each drive
        rays = self.per_image
        seed, period = dr.opaque(mi.UInt32, self.seed), dr.opaque(mi.UInt32, step)
        sampler = keyed_sampler(seed, period, self.first * rays, count=count * rays)
        lens = self.sensor.needs_aperture_sample()
        if self.centred and not lens:
            return sampler, self._centres(count * rays), mi.Point2f(0)
        # Places in pixels and on the aperture, alike in all drives of the batch
        own = self.sensor.sampler().clone()
        own.set_samples_per_wavefront(self.spp)
        own.seed(mi.sample_tea_32(seed, period)[0], rays)
        within = self._centres(rays) if self.centred else own.next_2d()
        aperture = own.next_2d() if lens else mi.Point2f(dr.zeros(mi.Float, rays))
        dr.eval(within, aperture)
        ray = dr.arange(mi.UInt32, count * rays) % rays
        within, aperture = (dr.gather(mi.Point2f, x, ray) for x in (within, aperture))
        return sampler, within, aperture

    def changed(self, **attributes: Any) -> SceneCamera:
        """Return this camera with another mount, or with other draws."""
        result = copy(self)
        vars(result).update(attributes)
        result._forget()
        return result

    def another(self, camera: Camera, mount: CameraMount, index: int) -> SceneCamera:
        """Return another camera of the same vehicle.

        It has the same clip distances, samples per pixel and draws; its random numbers
        are others.

        Args:
            camera: intrinsics.
            mount: pose on the vehicle.
            index: of the camera among all, this one being the first.
        """
        own = mi.traverse(self.sensor)
        clip = {k: np.array(own[k]).item() for k in ("near_clip", "far_clip")}
        described = mitsuba_sensor_dict(camera, np.eye(4), self.spp)
        return self.changed(
            sensor=mi.load_dict(described | clip),
            mount=mount,
            seed=camera_seed(self.seed, index),
        )

    @property
    def intrinsics(self) -> Camera:
        """The lens, for other environments.

        Raises:
            InputError: the sensor is no pinhole camera, or its film is cropped.
        """
        name = self.sensor.id()
        if self.sensor.needs_aperture_sample():
            raise InputError(f"sensor {name!r}: has an aperture; use perspective")
        lens, _ = from_mitsuba(self.sensor)
        if self.size != (lens.width, lens.height):
            raise InputError(
                f"sensor {name!r}: its film has a crop window; remove crop_* from it"
            )
        return lens

    def gain(self, item: PosedField, count: int) -> Gain:
        """Return the light on an object, ray by ray, as the variation draws it.

        Args:
            item: with its `LightMaps`, where the variation draws suns.
            count: of vehicles.
        """
        assert self.variation is not None  # else nobody asks
        # Factors of the light, drawn once for each size of a batch
        if count not in self._lights:
            drawn = self.variation.draws(self.first, count).light
            light = mi.Color3f(*(mi.Float(channel.tolist()) for channel in drawn))
            dr.make_opaque(light)
            self._lights[count] = light
        drive = self._drives(count)
        colour = dr.gather(mi.Color3f, self._lights[count], drive)
        if self.variation.sun is None:
            return Gain(colour)
        key = count, id(item)
        if key not in self._rows:
            suns = self.variation.suns(self.first, count)
            assert isinstance(item.light_maps, LightMaps)
            # An attack that turns the object turns its light, too
            rows = mi.UInt32(item.light_maps.rows(suns, item.pose.rotation))
            dr.make_opaque(rows)
            self._rows[key] = rows
        return Gain(colour, dr.gather(mi.UInt32, self._rows[key], drive))

    def eye(self, pose: Any, count: int) -> mi.Point3f:
        """Return where the eye of each ray of :meth:`rays` is, (3, n)."""
        origin, _ = self._place(pose)
        return dr.gather(mi.Point3f, origin, self._drives(count))

    def nearest(self, distances: mi.Float) -> mi.Float:
        """Return the least of the samples (n spp,) of each pixel."""
        return dr.block_reduce(dr.ReduceOp.Min, distances, self.spp)

    def _place(self, pose: Any) -> tuple[mi.Point3f, Any]:
        """Return the cameras' positions, and the columns of their rotations."""
        state = mi.Float(pose[0]), mi.Float(pose[1]), mi.Float(pose[2])
        height, pitch = self._mount(dr.width(pose))
        mount = self.mount
        ahead, left, yaw = mount.forward_m, mount.left_m, mount.yaw_deg
        placement = mount_pose(
            state,
            height_m=height,
            forward_m=ahead,
            pitch_deg=pitch,
            left_m=left,
            yaw_deg=yaw,
        )
        dr.eval(placement)
        return placement

    def _drives(self, count: int) -> mi.UInt32:
        """Return the row of the batch that each ray belongs to, (n,)."""
        return dr.arange(mi.UInt32, count * self.per_image) // self.per_image

    def _mount(self, count: int) -> tuple[Any, Any]:
        """Return heights, metres, and pitches, degrees: one for all, or of each."""
        mount = self.mount
        if self.variation is None or not self.variation.of_mount:
            return mount.height_m, mount.pitch_deg
        if count not in self._mounts:
            drawn = self.variation.draws(self.first, count)
            height = mi.Float((mount.height_m * drawn.height).tolist())
            pitch = mi.Float((mount.pitch_deg + drawn.pitch_deg).tolist())
            dr.make_opaque(height, pitch)
            self._mounts[count] = height, pitch
        return self._mounts[count]

    def _centres(self, total: int) -> mi.Point2f:
        """Return the middles of the squares of pixels, (2, total)."""
        side = math.isqrt(self.spp)
        sample = dr.arange(mi.UInt32, total) % self.spp
        row = sample // side
        return mi.Point2f(sample - row * side + 0.5, row + 0.5) / side

    def pixels(self, colour: Any) -> mi.Color3f:
        """Average the samples of each pixel, as linear RGB."""
        return self.average(mi.Color3f(colour))

    def average(self, values: Any) -> Any:
        """Average the samples (..., n spp) of each pixel."""
        spp = self.spp
        if spp == 1:
            return values
        channels = values if dr.depth_v(values) > 1 else [values]
        return type(values)(*[dr.block_sum(mi.Float(x), spp) / spp for x in channels])

    def spread(self, d_linear: mi.Color3f) -> Any:
        """Transpose of :meth:`pixels`."""
        spp = self.spp
        if spp > 1:
            index = dr.arange(mi.UInt32, dr.width(d_linear) * spp) // spp
            d_linear = dr.gather(mi.Color3f, d_linear, index) / spp
        return mi.Spectrum(d_linear)


def sensor_of(scene: mi.Scene, index: int) -> mi.Sensor:
    """Return a scene's sensor by its index; InputError where there is none."""
    count = len(scene.sensors())
    if not 0 <= index < count:
        raise InputError(f"sensor: {index}; the scene has {count}, from 0 on")
    return scene.sensors()[index]


def pose_of(state: Any) -> Any:
    """Return the rows px, py, theta of a state, (3, n), detached."""
    kind = dr.float64_array_t(mi.Vector3f)
    return kind(*[dr.detach(state[i]) for i in range(3)])


def keyed_sampler(
    seed: mi.UInt32, step: mi.UInt32, first: int, count: int
) -> mi.Sampler:
    """Make a sampler of independent numbers for an integrator.

    Args:
        seed: of all.
        step: index of the control period.
        first: number of the first ray among those of all drives.
        count: of rays.
    """
    ray = dr.arange(mi.UInt32, count) + dr.opaque(mi.UInt32, first)
    # the second word: places in pixels are drawn by the first
    state, stream = mi.sample_tea_32(mi.sample_tea_32(seed, step)[1], ray)
    # with arguments, the constructor would add the index of the ray
    random = mi.PCG32()  # pyright: ignore[reportCallIssue]
    random.seed(mi.UInt64(state), mi.UInt64(stream))
    return _type(mi.variant())(random)


@cache
def _type(variant: str | None) -> Any:
    del variant  # Mitsuba's class follows from it

    class KeyedSampler(mi.Sampler):
        """Numbers of `mi.PCG32`, as those of Mitsuba's `independent`."""

        def __init__(self, random: Any) -> None:
            super().__init__(mi.Properties("independent"))
            self.random = random

        def clone(self) -> KeyedSampler:
            return KeyedSampler(mi.PCG32(self.random))  # pyright: ignore

        def next_1d(self, active: Any = True) -> mi.Float:
            return self.random.next_float32(mi.Bool(active))

        def next_2d(self, active: Any = True) -> mi.Point2f:
            x = self.next_1d(active)
            return mi.Point2f(x, self.next_1d(active))

        def schedule_state(self) -> None:
            dr.schedule(self.random)

        def wavefront_size(self) -> int:
            return dr.width(self.random)

    return KeyedSampler
