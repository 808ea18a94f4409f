r"""3D Gaussian splats as a layer of a depth composite.

Let splat i have the centre c, standard deviations s and rotation R. Along a ray o + t w
the splat has its peak at the distance t_i where
``m(t) = |diag(1/s) R^T (o + t w - c)|`` is least. Its opacity there is
``a_i = min(opacity_i exp(-m(t_i)^2 / 2), 0.9999)``; it is left out where
``m(t_i) > 3``. Splats are laid over each other in the order of t_i, as if each were a
thin sheet there: ``I = sum_i c_i a_i prod_{j<i} (1 - a_j)``. The opacity is this sum
with 1 instead of c_i, and the depth moment is this sum with t_i instead of c_i. Splats
whose peak lies behind the origin or beyond the end of the ray are not seen; a splat
that contains the origin is seen. The colour c_i is the splat's colour in the direction
from the origin to the centre, as in the training of splats.

A march rasterises: rays are sorted into small cells of directions (`charts`), splats
into the cells in which they may be seen (`pairs`), and a ray blends the list of its
cell front to back. What it sees of a splat is exact, for any lens. So is the order, but
where a list has more than `blend.WINDOW` hits of the ray between a splat and its place.

Trainers compare with sRGB images, so that colours are sRGB: they are summed up in
sRGB, and the sum is decoded once, ``a decode(I / a)``, into premultiplied linear
radiance. Opaque rays show what the trainer's viewer shows; through others, what lies
behind shines in linear light.

Source: Kerbl et al. 2023, eq. 3 and section 6; Moenne-Loccoz et al. 2024, sections 4.1
to 4.3; Radl et al. 2024 ("StopThePop"), section 4.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_nerfattack.backend.arrays import put, upload
from mi_nerfattack.errors import InputError
from mi_nerfattack.fields.base import flat_parameter
from mi_nerfattack.fields.splats import Splats
from mi_nerfattack.render.backdrop import AbstractBackdrop
from mi_nerfattack.render.camera.pose import Pose
from mi_nerfattack.render.march import RayGradient, private_gradients
from mi_nerfattack.render.rays import March, Rays, pick_rays, put_rays
from mi_nerfattack.render.splatting.blend import blend, by_cell, replay
from mi_nerfattack.render.splatting.charts import Sorted, sort_rays
from mi_nerfattack.render.splatting.pairs import (
    Lists,
    Near,
    Shapes,
    gather_fours,
    list_splats,
    turn,
)

_THINNEST = 1e-4  # standard deviation, of the splat's largest


class SplatBackground(AbstractBackdrop):
    """Splats at a pose in the world.

    A splat thinner than a ten-thousandth of its width gets this thickness. The cost of
    a march has three parts. It tests each splat for each origin of rays, sorts the
    pairs of cells and splats, and follows the list of its cell for each ray until the
    ray ends.

    Args:
        splats: from :func:`.load_splats`.
        pose: the file's frame to the world, with the metres per unit of the file as
            its scale; identity by default.
    """

    def __init__(self, splats: Splats, pose: Pose | None = None) -> None:
        self.name: str = splats.source
        self.pose: Pose = pose or Pose.identity()
        placed = _in_world(splats, self.pose)
        order = _near_each_other(placed[0])
        self._shapes = Shapes(*(part[order] for part in placed))
        self._degree = splats.degree
        self._order = upload(mi.UInt32, order)
        #: (3 k n,) and (n,), in the order of the file; see `Splats`.
        self.harmonics: mi.Float = upload(mi.Float, splats.harmonics)
        self.opacity: mi.Float = upload(mi.Float, splats.opacities)
        self._count = len(order)
        self.update()
        rotation = np.asarray(self.pose.rotation, np.float32)
        self._columns = [mi.Vector3f(*map(float, rotation[:, i])) for i in range(3)]
        dr.make_opaque(self._columns)

    @property
    def has_gradients(self) -> bool:
        """Whether derivatives by harmonics or opacities are asked for."""
        with dr.resume_grad():  # derivative passes ask while gradients are suspended
            return any(map(dr.grad_enabled, self.parameters().values()))

    def parameters(self) -> dict[str, mi.Float]:
        """Return harmonics and opacities by name, in the order of the file."""
        return {"harmonics": self.harmonics, "opacity": self.opacity}

    def update(self) -> None:
        """Take harmonics and opacities that were changed.

        Raises:
            InputError: another number of them, or one that is not allowed.
        """
        terms = 3 * (self._degree + 1) ** 2
        with dr.suspend_grad():
            for (name, value), per_splat in zip(
                self.parameters().items(), (terms, 1), strict=True
            ):
                shape = self._count, per_splat
                flat_parameter(value, shape, f"{self.name}: {name} of splats")
            if not dr.all((self.opacity >= 0) & (self.opacity <= 1)):
                raise InputError(
                    f"{self.name}: opacity must be within 0 and 1; use dr.clip"
                )
            # As they are read: splats that are seen at once lie together
            stride = terms + -terms % 4
            place = dr.arange(mi.UInt32, stride * self._count)
            row = place // stride
            term = place - row * stride
            source = terms * dr.gather(mi.UInt32, self._order, row) + term
            self._packed = dr.gather(mi.Float, self.harmonics, source, term < terms)
            self._opacities = dr.gather(mi.Float, self.opacity, self._order)
            dr.eval(self._packed, self._opacities)

    def state(self) -> list[Any]:
        """See ``AbstractBackdrop.state``."""
        arrays = [self._columns, self._packed, self._opacities]
        return [self, *self._shapes.arrays(), *arrays]

    def march(self, rays: Rays, stop: float) -> March:
        """See ``AbstractBackdrop.march``; evaluated when it returns."""
        with dr.suspend_grad():
            rays, where, lists = self._list(rays)
            if lists is None:
                return March.zeros(dr.width(rays.direction))
            shades = self._shade(lists.near, lists.near.ahead)
            dr.eval(shades)
            blended = blend(by_cell(rays, where, lists), lists, shades, stop)
            result = put_rays(blended, where.order, dr.width(where.order))
            dr.eval(result)
            return result

    def derivative(
        self,
        mode: dr.ADMode,
        rays: Rays,
        primal: March,
        cotangent: March,
        stop: float,
        with_rays: bool = False,
    ) -> tuple[March, RayGradient]:
        """See ``AbstractBackdrop.derivative``.

        The ends of splats, at three standard deviations, count as constants, as does
        the order.
        """
        count = dr.width(rays.direction)
        none = March.zeros(count), RayGradient()
        with dr.suspend_grad():
            rays, where, lists = self._list(rays)
            if lists is None:
                return none
            charts = where.charts
            with dr.resume_grad():
                # Shades by parameters, and by what the views come from
                moved = dr.zeros(mi.Vector3f, dr.width(charts.size))
                if with_rays:
                    dr.enable_grad(moved)
                near = lists.near
                ahead = near.ahead - dr.gather(mi.Vector3f, moved, near.chart)
                attached = self._shade(near, ahead, packed=not self.has_gradients)
                shades = mi.Float(dr.detach(attached))
                dr.enable_grad(shades)
                if mode == dr.ADMode.Forward:
                    dr.set_grad(shades, dr.forward_to(attached))
            lines = by_cell(rays, where, lists)
            fixed = pick_rays([primal, cotangent], where.order)
            with private_gradients():
                tangent, by_rays = replay(
                    mode, lines, lists, shades, *fixed, stop=stop, with_rays=with_rays
                )
                dr.eval(tangent, by_rays)
            if mode == dr.ADMode.Forward:
                return put_rays(tangent, where.order, dr.width(where.order)), none[1]
            with dr.resume_grad():
                by_shades = dr.grad(shades)
                flags = dr.ADFlag.Default | dr.ADFlag.AllowNoGrad  # of degree 0
                dr.backward_from(dr.sum(attached * by_shades), flags=flags)
                by_origin = dr.grad(moved)
            result = RayGradient(*(dr.zeros(mi.Vector3f, count) for _ in range(2)))
            if with_rays:
                put(result, RayGradient(*by_rays), where.order)
                each = by_origin / mi.Float(dr.maximum(charts.rays, 1))
                result.origin += dr.gather(mi.Vector3f, each, where.chart)
            return none[0], result

    def _list(self, rays: Rays) -> tuple[Rays, Sorted, Lists | None]:
        """Return rays as they are marched, where they are, and what they may meet.

        Raises:
            InputError: it is part of what Dr.Jit records; see `splat_background`.
        """
        if dr.flag(dr.JitFlag.FreezingScope) or dr.flag(dr.JitFlag.SymbolicScope):
            raise InputError(
                f"{self.name}: how many splats are seen is known frame by frame, so "
                "that neither drjit.freeze nor a loop can record them; render each "
                "frame as it is"
            )
        rays = _proper(rays)
        where = sort_rays(rays.origin, rays.direction)
        return rays, where, list_splats(self._shapes, where)

    def _shade(self, near: Near, ahead: mi.Vector3f, packed: bool = True) -> mi.Float:
        """Return colours, sRGB, not negative, and opacities of splats, (4 k,).

        Args:
            near: k splats.
            ahead: (3, k), from where they are seen to their centres.
            packed: read the copies, which are faster and have no derivatives.
        """
        ahead = dr.normalize(ahead)
        basis = dr.sh_eval(turn(self._columns, ahead), self._degree)
        count = 3 * len(basis)
        if packed:
            values = gather_fours(self._packed, near.splat, count)
            opacity = dr.gather(mi.Float, self._opacities, near.splat)
        else:
            splat = dr.gather(mi.UInt32, self._order, near.splat)
            values = [
                dr.gather(mi.Float, self.harmonics, count * splat + k)
                for k in range(count)
            ]
            opacity = dr.gather(mi.Float, self.opacity, splat)
        colour = mi.Color3f(0.5)
        for k, value in enumerate(basis):
            colour += value * mi.Color3f(*values[3 * k : 3 * k + 3])
        return dr.ravel(mi.Vector4f(*dr.maximum(colour, 0), opacity))


def _proper(rays: Rays) -> Rays:
    """Return rays without gains; what has no direction is masked."""
    origin, direction = mi.Point3f(rays.origin), mi.Vector3f(rays.direction)
    size = dr.squared_norm(direction)
    fine = (size > 0) & (size < dr.inf) & dr.all(dr.isfinite(origin))
    origin = dr.select(fine, origin, 0)
    direction = dr.select(fine, direction, mi.Vector3f(1, 0, 0))
    return Rays(origin, direction, rays.t_max, active=rays.active & fine)


def _in_world(splats: Splats, pose: Pose) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return centres and scales (n, 3), and rotations (n, 3, 3), axes to the world."""
    from scipy.spatial.transform import Rotation

    turn = Rotation.from_matrix(np.asarray(pose.rotation))
    rotation = turn * Rotation.from_quat(splats.quaternions[:, [1, 2, 3, 0]])
    centers = pose.scale * turn.apply(splats.centers) + pose.translation
    scales = pose.scale * splats.scales.astype(np.float64)
    scales = np.maximum(scales, _THINNEST * scales.max(1, keepdims=True))
    return centers, scales, rotation.as_matrix()


def _near_each_other(centers: np.ndarray) -> np.ndarray:
    """Return the order of points (n, 3) along a space-filling curve (Morton 1966).

    What is seen at once then lies together in memory.
    """
    size = max(float(np.ptp(centers, axis=0).max()), 1e-30)
    cells = ((centers - centers.min(0)) / size * (2**21 - 1)).astype(np.uint64)
    code = np.zeros(len(centers), np.uint64)
    for bit in range(21):
        for axis in range(3):
            one = (cells[:, axis] >> np.uint64(bit)) & np.uint64(1)
            code |= one << np.uint64(3 * bit + axis)
    return np.argsort(code, kind="stable")
