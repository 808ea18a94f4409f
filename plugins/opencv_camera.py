"""The sensor `opencv_camera`."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_nerfattack.errors import InputError
from mi_nerfattack.plugins.properties import Mask
from mi_nerfattack.render.camera.distortion import (
    bend,
    direction,
    distort,
    jacobian,
    unbend,
    undistort,
)
from mi_nerfattack.render.camera.intrinsics import Camera

_PINHOLE = ("fx", "fy", "cx", "cy")
_LENS = {False: ("k1", "k2", "p1", "p2"), True: ("k1", "k2", "k3", "k4")}


class OpencvCamera(mi.Sensor):
    r"""
    .. _sensor-opencv_camera:

    Pinhole camera or fisheye with OpenCV's lens distortion (:monosp:`opencv_camera`)
    ---------------------------------------------------------------------------------

    .. pluginparameters::
     :extra-rows: 13

     * - fx
       - |float|
       - Focal length, pixels
       - |exposed|, |differentiable|, |discontinuous|

     * - fy
       - |float|
       - Focal length along the columns, pixels. (Default: ``fx``)
       - |exposed|, |differentiable|, |discontinuous|

     * - cx, cy
       - |float|
       - Principal point in the full film, pixels. (Default: its centre)
       - |exposed|, |differentiable|, |discontinuous|

     * - k1, k2
       - |float|
       - Radial distortion. (Default: 0)
       - |exposed|, |differentiable|, |discontinuous|

     * - p1, p2
       - |float|
       - Tangential distortion, of a pinhole camera alone. (Default: 0)
       - |exposed|, |differentiable|, |discontinuous|

     * - k3, k4
       - |float|
       - More radial distortion, of a fisheye alone, exposed as ``k1``. (Default: 0)

     * - fisheye
       - |bool|
       - Whether ``k1`` to ``k4`` are those of OpenCV's fisheye. (Default: false)

     * - to_world
       - |transform|
       - Rotation and translation, camera to world, metres. (Default: identity)
       - |exposed|, |differentiable|, |discontinuous|

     * - near_clip, far_clip
       - |float|
       - Rays start and end at these distances along z, metres; of a fisheye, along
         the ray. (Default: 1e-2, 1e4)
       - |exposed|

     * - shutter_open
       - |float|
       - Time at which the shutter opens, as of ``perspective``. (Default: 0)
       - |exposed|

     * - shutter_close
       - |float|
       - Time at which it closes, as of ``perspective``. (Default: 0)

     * - srf
       - |spectrum|
       - Sensor response of spectral variants, as of ``perspective``. (Default: none)

     * - (Nested plugin)
       - |film|, |sampler|, |medium|
       - As of ``perspective``
       - |exposed|

     * - shutter_open_time
       - |float|
       - How long the shutter is open
       - |exposed|

    A point :math:`(X, Y, Z)` of the camera's frame (Mitsuba's: x to the left, y up, z
    forward) is seen at the pixel :math:`u = f_x x' + c_x,\ v = f_y y' + c_y`, where
    :math:`(x', y')` is the distorted position of :math:`(-X, -Y) / Z`:

    .. math::

        x' = x (1 + k_1 r^2 + k_2 r^4) + 2 p_1 x y + p_2 (r^2 + 2 x^2), \quad
        y' = y (1 + k_1 r^2 + k_2 r^4) + p_1 (r^2 + 2 y^2) + 2 p_2 x y.

    A fisheye sees a point at the angle :math:`\theta` from the axis, which may be more
    than 90 degrees, at a distance from the principal point of

    .. math::

        \theta (1 + k_1 \theta^2 + k_2 \theta^4 + k_3 \theta^6 + k_4 \theta^8)

    focal lengths. Rays follow from eight Newton steps. Pixels count from the top-left
    corner of the full film, so the centre of the first pixel is (0.5, 0.5), as in
    COLMAP. OpenCV counts from the centre of the first pixel: add 0.5 to its principal
    point.

    Other values need no other kernel, unless the first distortion coefficient becomes
    other than zero.

    .. tabs::
        .. code-tab:: xml

            <sensor type="opencv_camera">
                <float name="fx" value="250"/>
                <float name="fy" value="252"/>
                <float name="k1" value="-0.1"/>
                <transform name="to_world">
                    <lookat origin="3, 1, 1.5" target="0, 0, 0" up="0, 0, 1"/>
                </transform>
                <film type="hdrfilm">
                    <integer name="width" value="320"/>
                    <integer name="height" value="240"/>
                </film>
            </sensor>

        .. code-tab:: python

            {
                "type": "opencv_camera",
                "fx": 250.0,
                "fy": 252.0,
                "k1": -0.1,
                "to_world": mi.ScalarTransform4f().look_at(
                    [3, 1, 1.5], [0, 0, 0], [0, 0, 1]
                ),
                "film": {"type": "hdrfilm", "width": 320, "height": 240},
            }

    Differentiable with respect to the intrinsics and ``to_world``, as far as the
    integrator is. Limits: no aperture; a distortion that cannot be inverted in the
    whole film (and in the filter's border, where that is sampled) is refused.
    """

    def __init__(self, props: mi.Properties) -> None:
        super().__init__(props)
        width, height = self.film().size()
        fx = props["fx"]
        values = [fx, props.get("fy", fx), props.get("cx", 0.5 * width)]
        values.append(props.get("cy", 0.5 * height))
        self.is_fisheye = bool(props.get("fisheye", False))
        lens = _LENS[self.is_fisheye]
        values += [props.get(name, 0.0) for name in lens]
        for name in {*_LENS[not self.is_fisheye]}.difference(lens):
            if props.get(name, 0.0):
                raise InputError(
                    f"{name}: not of this lens; fisheye: {self.is_fisheye}"
                )
        self.intrinsics = {
            name: mi.Float(value)
            for name, value in zip((*_PINHOLE, *lens), values, strict=True)
        }
        self.near_clip = mi.Float(props.get("near_clip", 1e-2))
        self.far_clip = mi.Float(props.get("far_clip", 1e4))
        self.m_needs_sample_3 = False
        self.parameters_changed()

    def traverse(self, cb: mi.TraversalCallback) -> None:
        """Expose intrinsics, clip distances and pose."""
        super().traverse(cb)
        fixed = mi.ParamFlags.NonDifferentiable
        moves = mi.ParamFlags.Differentiable | mi.ParamFlags.Discontinuous
        for name, value in self.intrinsics.items():
            cb.put(name, value, moves)
        cb.put("near_clip", self.near_clip, fixed)
        cb.put("far_clip", self.far_clip, fixed)
        cb.put("to_world", self.m_to_world, moves)

    def parameters_changed(self, keys: Sequence[str] = ()) -> None:
        """Check what changed and hand it to kernels as opaque values."""
        super().parameters_changed(keys)
        if not keys or "to_world" in keys:
            _check_rigid(self.m_to_world)
        if not keys or "near_clip" in keys or "far_clip" in keys:
            _check_clip(self.near_clip, self.far_clip)
        if not keys or not {"to_world", "near_clip", "far_clip"}.issuperset(keys):
            self._film_or_lens_changed()
        dr.make_opaque(self.m_to_world, self.near_clip, self.far_clip, self.intrinsics)

    def _film_or_lens_changed(self) -> None:
        film = self.film()
        # Where the film samples its border, rays start beyond the image.
        border = film.rfilter().border_size() if film.sample_border() else 0
        width, height = (int(v) + 2 * border for v in film.size())
        values = {k: float(dr.detach(v)[0]) for k, v in self.intrinsics.items()}
        values |= {name: values[name] + border for name in ("cx", "cy")}
        camera = Camera(width, height, **values, is_fisheye=self.is_fisheye)
        self.is_distorted = camera.is_distorted
        self._crop_size = mi.Vector2f(film.crop_size())
        self._crop_offset = mi.Vector2f(film.crop_offset())
        dr.make_opaque(self._crop_size, self._crop_offset)

    def sample_ray(
        self,
        time: mi.Float,
        sample1: mi.Float,
        sample2: mi.Point2f,
        sample3: mi.Point2f,
        active: Mask = True,
    ) -> tuple[mi.Ray3f, Any]:
        """Make the ray through a position in the crop window."""
        del sample3
        towards = self._unproject(self._position(mi.Point2f(sample2)))
        return self._ray(mi.Ray3f(), towards, time, sample1, active)

    def sample_ray_differential(
        self,
        time: mi.Float,
        sample1: mi.Float,
        sample2: mi.Point2f,
        sample3: mi.Point2f,
        active: Mask = True,
    ) -> tuple[mi.RayDifferential3f, Any]:
        """Make the ray and, to first order, those of the next pixels."""
        del sample3
        position = self._position(mi.Point2f(sample2))
        towards = self._unproject(position)
        ray, weight = self._ray(mi.RayDifferential3f(), towards, time, sample1, active)
        lens = self.intrinsics
        step_x, step_y = dr.rcp(lens["fx"]), dr.rcp(lens["fy"])
        ray.o_x = ray.o_y = ray.o
        if self.is_fisheye:  # where the plane z = 1 has no tangent
            ahead = [mi.Point2f(step_x, 0), mi.Point2f(0, step_y)]
            next_x, next_y = (self._unproject(position + step) for step in ahead)
        else:
            x, y = towards.x, towards.y
            by_u, by_v = (step_x, mi.Float(0)), (mi.Float(0), step_y)
            if self.is_distorted:
                xx, xy, yy, determinant = jacobian(x, y, *self._distortion())
                by_u = (yy * step_x / determinant, -xy * step_x / determinant)
                by_v = (-xy * step_y / determinant, xx * step_y / determinant)
            next_x, next_y = (mi.Vector3f(x + b[0], y + b[1], 1) for b in (by_u, by_v))
        ray.d_x, ray.d_y = self._direction(next_x), self._direction(next_y)
        ray.has_differentials = True
        return ray, weight

    def sample_direction(
        self, it: mi.Interaction3f, sample: mi.Point2f, active: Mask = True
    ) -> tuple[mi.DirectionSample3f, Any]:
        """Connect points to the camera; ``uv`` is in pixels of the crop window."""
        del sample
        local = self.m_to_world.inverse() @ mi.Point3f(it.p)
        distance = dr.norm(local)
        if self.is_fisheye:
            along = distance
            position, density = self._project_fisheye(local)
        else:
            along = local.z
            z = dr.select(local.z > 0, local.z, 1)
            position, density = self._project(-local.x / z, -local.y / z)
            # On the plane z = 1, solid angle is area times the cosine's cube.
            density *= (distance / z) ** 3
        visible = mi.Bool(active) & (along >= self.near_clip)
        visible &= (along <= self.far_clip) & (density > 0)
        visible &= dr.all((position >= 0) & (position <= self._crop_size))
        ds = dr.zeros(mi.DirectionSample3f, dr.width(local))
        ds.uv = position
        ds.p = self.m_to_world.translation()
        ds.n = self.m_to_world @ mi.Normal3f(0, 0, 1)
        ds.d = (ds.p - it.p) / distance
        ds.dist = distance
        ds.pdf = dr.select(visible, mi.Float(1), 0)
        return ds, mi.Spectrum(dr.select(visible, density / distance**2, 0))

    def bbox(self) -> mi.ScalarBoundingBox3f:
        """Return the box that holds nothing but the pinhole."""
        pinhole = [float(v[0]) for v in dr.detach(self.m_to_world.translation())]
        return mi.ScalarBoundingBox3f(mi.ScalarPoint3f(pinhole))

    def _ray(
        self, ray: Any, towards: mi.Vector3f, time: Any, sample1: Any, active: Any
    ) -> tuple[Any, Any]:
        nothing = dr.zeros(mi.SurfaceInteraction3f)
        ray.wavelengths, weight = self.sample_wavelengths(nothing, sample1, active)
        ray.time = time
        ray.d = self._direction(towards)
        secant = mi.Float(1) if self.is_fisheye else dr.norm(towards)
        near = self.near_clip * secant
        ray.o = self.m_to_world.translation() + near * ray.d
        ray.maxt = self.far_clip * secant - near
        return ray, weight

    def _direction(self, towards: mi.Vector3f) -> mi.Vector3f:
        """Turn OpenCV's axes, whatever the length, into the world's, of length 1."""
        local = mi.Vector3f(-towards.x, -towards.y, towards.z)
        return self.m_to_world @ dr.normalize(local)

    def _distortion(self) -> tuple[mi.Float, ...]:
        return tuple(self.intrinsics[name] for name in _LENS[self.is_fisheye])

    def _position(self, sample: mi.Point2f) -> mi.Point2f:
        """Map the crop window's [0, 1]^2 to the distorted plane z = 1."""
        lens = self.intrinsics
        pixel = sample * self._crop_size + self._crop_offset
        return mi.Point2f(
            (pixel.x - lens["cx"]) / lens["fx"], (pixel.y - lens["cy"]) / lens["fy"]
        )

    def _unproject(self, position: mi.Point2f) -> mi.Vector3f:
        """Map the distorted plane to directions, OpenCV's axes; z = 1 of a pinhole."""
        x, y = position
        if self.is_fisheye:
            return mi.Vector3f(*direction(x, y, *self._distortion()))
        if self.is_distorted:
            x, y = undistort(x, y, *self._distortion())
        return mi.Vector3f(x, y, 1)

    def _project_fisheye(self, local: mi.Point3f) -> tuple[mi.Point2f, mi.Float]:
        """Map points to pixels of the crop window; the density is by solid angle."""
        lens, distortion = self.intrinsics, self._distortion()
        across = dr.sqrt(local.x * local.x + local.y * local.y + 1e-20)
        angle = dr.atan2(across, local.z)
        radius, slope = bend(angle, *distortion)
        sine = dr.maximum(dr.sin(angle), 1e-10)  # as small as the radius, in the middle
        density = lens["fx"] * lens["fy"] / dr.prod(self._crop_size)
        density *= radius / sine * slope
        back = dr.abs(unbend(radius, *distortion) - angle)
        density = dr.select(
            back * dr.maximum(lens["fx"], lens["fy"]) < 1e-2, density, 0
        )
        u, v = -local.x / across * radius, -local.y / across * radius
        pixel = mi.Point2f(u * lens["fx"] + lens["cx"], v * lens["fy"] + lens["cy"])
        return pixel - self._crop_offset, density

    def _project(self, x: mi.Float, y: mi.Float) -> tuple[mi.Point2f, mi.Float]:
        """Map the plane z = 1 to pixels of the crop window.

        Returns:
            the position, and the density of uniform samples of the window per area of
            the plane; zero where the distortion folds the plane over the image.
        """
        lens = self.intrinsics
        density = lens["fx"] * lens["fy"] / dr.prod(self._crop_size)
        u, v = x, y
        if self.is_distorted:
            distortion = self._distortion()
            u, v = distort(x, y, *distortion)
            back_x, back_y = undistort(u, v, *distortion)
            pixels = dr.maximum(
                dr.abs(back_x - x) * lens["fx"], dr.abs(back_y - y) * lens["fy"]
            )
            stretch = jacobian(x, y, *distortion)[3]
            density = dr.select(pixels < 1e-2, density * stretch, 0)
        pixel = mi.Point2f(u * lens["fx"] + lens["cx"], v * lens["fy"] + lens["cy"])
        return pixel - self._crop_offset, density

    def to_string(self) -> str:
        """Describe the checked parameters."""
        values = ", ".join(
            f"{name}={dr.detach(value)[0]:g}" for name, value in self.intrinsics.items()
        )
        return f"OpencvCamera[{values}, film={self.film()}]"


def _check_rigid(to_world: Any) -> None:
    matrix = np.array(dr.detach(to_world.matrix), np.float64).reshape(4, 4)
    linear = matrix[:3, :3]
    if not np.allclose(linear.T @ linear, np.eye(3), atol=1e-4):
        raise InputError(
            f"to_world: {matrix[:3].tolist()}; opencv_camera takes rotation and "
            "translation"
        )


def _check_clip(near: mi.Float, far: mi.Float) -> None:
    if not 0 < near[0] < far[0]:
        raise InputError(
            f"near_clip, far_clip: {near[0]:g}, {far[0]:g}; expected 0 < near < far"
        )


mi.register_sensor("opencv_camera", lambda props: OpencvCamera(props))
