"""The sensor of a Mitsuba scene on a vehicle."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi

from mi_nerfattack.render.camera.intrinsics import CameraMount, mount_pose


class SceneCamera:
    """Rays of a scene's sensor from vehicles, and images of their radiance.

    Args:
        sensor: lens, clip distances, film size and samples per pixel count; its pose
            does not.
        mount: pose on the vehicle.
        seed: of all random numbers, renewed each control period.
    """

    def __init__(self, sensor: Any, mount: CameraMount, seed: int) -> None:
        self.sensor, self.mount, self.seed = sensor, mount, seed

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of an image, pixels."""
        width, height = map(int, self.sensor.film().crop_size())
        return width, height

    @property
    def spp(self) -> int:
        """Samples per pixel."""
        return self.sensor.sampler().sample_count()

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
        sampler = self.sensor.sampler().clone()
        spp = self.spp
        sampler.set_samples_per_wavefront(spp)
        total = count * width * height * spp
        key = mi.sample_tea_32(
            dr.opaque(mi.UInt32, self.seed), dr.opaque(mi.UInt32, step)
        )[0]
        sampler.seed(key, total)
        # A ray of the scene's own sensor, through a random place in its pixel
        index = dr.arange(mi.UInt32, total) // spp
        vehicle = index // (width * height)
        pixel = index - vehicle * (width * height)
        row = pixel // width
        place = mi.Vector2f(pixel - row * width, row) + sampler.next_2d()
        aperture = mi.Point2f(0)
        if self.sensor.needs_aperture_sample():
            aperture = sampler.next_2d()
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
        origin, columns = mount_pose(
            (mi.Float(pose[0]), mi.Float(pose[1]), mi.Float(pose[2])),
            self.mount.height_m,
            self.mount.forward_m,
            self.mount.pitch_deg,
        )
        dr.eval(origin, columns)
        right, down, forward = (dr.gather(mi.Vector3f, c, vehicle) for c in columns)
        moved = mi.Ray3f(ray)  # without differentials, which are the scene sensor's
        moved.o = dr.gather(mi.Point3f, origin, vehicle) + (
            o.z * forward - o.x * right - o.y * down
        )
        moved.d = d.z * forward - d.x * right - d.y * down
        return sampler, moved, weight

    def pixels(self, colour: Any) -> mi.Color3f:
        """Average the samples of each pixel, as linear RGB."""
        spp = self.spp
        rgb = mi.Color3f(colour.x) if mi.is_monochromatic else mi.Color3f(colour)
        if spp == 1:
            return rgb
        return mi.Color3f(*[dr.block_sum(mi.Float(c), spp) / spp for c in rgb])

    def spread(self, d_linear: mi.Color3f) -> Any:
        """Transpose of :meth:`pixels`."""
        spp = self.spp
        if spp > 1:
            index = dr.arange(mi.UInt32, dr.width(d_linear) * spp) // spp
            d_linear = dr.gather(mi.Color3f, d_linear, index) / spp
        return mi.Spectrum(dr.sum(d_linear) if mi.is_monochromatic else d_linear)
