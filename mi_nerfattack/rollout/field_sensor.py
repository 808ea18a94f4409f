"""The surrogate simulator's camera: fields, differentiable in all their parameters."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_nerfattack.backend.freeze import freeze_method
from mi_nerfattack.errors import InputError
from mi_nerfattack.fields.grid import GridField
from mi_nerfattack.fields.vertex_colours import start_gradient
from mi_nerfattack.render.backdrop import Layer
from mi_nerfattack.render.camera.intrinsics import (
    Camera,
    CameraMount,
    generate_rays,
    mount_pose,
    ray_lengths,
)
from mi_nerfattack.render.composite import (
    AbstractComposite,
    DepthComposite,
    Seen,
    Task,
    TaskQueue,
)
from mi_nerfattack.render.march import STOP
from mi_nerfattack.render.posed import PosedField
from mi_nerfattack.render.rays import March, Rays
from mi_nerfattack.render.surroundings import ATTACHED, Clip, Ends, Surroundings
from mi_nerfattack.rollout.offset import offset_gradient, offset_pose, wrench_of
from mi_nerfattack.rollout.sensor import AbstractDifferentiableSensor, Observation


class FieldSensor(AbstractDifferentiableSensor):
    """Camera in a scene with objects: the surrogate simulator.

    One ray a pixel through its centre, up to the first surface; behind all fields is
    what the surroundings show there, or the background of the first layer. All fields
    are marched for all vehicles together.

    Cost of an observation: one march. Cost of a product: one march derivative over
    the rays that meet an object (over all rays of the objects for their poses, over
    all rays and fields when attached).

    Args:
        scene: the scene's field in the world, or a backdrop; that one needs the depth
            composite, and has no attached derivatives. Or any number of them.
        objects: fields with textures, posed in the world; may be empty.
        camera: intrinsics.
        mount: pose on the vehicle.
        jitter_seed: seed of per-ray sample positions, renewed each step and replayed
            by products; None places samples at the middle of their intervals.
        stop: transmittance at which rays end.
        composite: how fields become one colour; `DepthComposite` by default.
        surroundings: surfaces and lights among and behind the fields; with them there
            are no attached derivatives.
        clip: rays start at its near distance.
    """

    def __init__(
        self,
        scene: Layer | Sequence[Layer],
        objects: list[PosedField],
        camera: Camera,
        mount: CameraMount | None = None,
        jitter_seed: int | None = None,
        stop: float = STOP,
        composite: AbstractComposite | None = None,
        surroundings: Surroundings | None = None,
        clip: Clip | None = None,
    ) -> None:
        for posed in objects:
            if not isinstance(posed.field, GridField):
                raise TypeError(f"objects: {posed.field.kind}; grid fields are needed")
        if len({id(posed.field) for posed in objects}) < len(objects):
            raise ValueError(
                "objects: two of them share a field, and so a texture; load it twice"
            )
        self.scene: tuple[Layer, ...] = (
            tuple(scene) if isinstance(scene, Sequence) else (scene,)
        )
        self.objects: list[PosedField] = list(objects)
        self.camera = camera
        self.mount: CameraMount = mount or CameraMount()
        self.jitter_seed, self.stop = jitter_seed, stop
        self.composite: AbstractComposite = composite or DepthComposite()
        self.composite.check(self._fields)
        self.surroundings, self.clip = surroundings, clip or Clip()
        near = self.clip.near_m * ray_lengths(camera).ravel()
        self._near = mi.Float(near.tolist()) if self.clip.near_m else None
        self.renders: int = 0
        self._wrenches: list[Any] | None = None
        # Tracing these in Python takes longer than running them.
        self._ahead = self.composite.ahead(self.scene[0], stop) if self.scene else None
        self._frozen_make_rays = freeze_method(self._make_rays, self._state)
        self._frozen_render = freeze_method(self._render, self._state)
        self._frozen_restore = freeze_method(self._restore, self._state)
        self._frozen_cotangent = freeze_method(self._cotangent, self._state)
        self._tasks = TaskQueue(freeze_method(self._accumulate, self._state))
        self._frozen_by_rays = freeze_method(self._by_rays, self._state)

    def __repr__(self) -> str:
        camera, objects = self.camera, len(self.objects)
        size, name = f"{camera.width}x{camera.height}", type(self.composite).__name__
        return f"FieldSensor({size}, objects: {objects}, {name})"

    def showing(
        self, objects: list[PosedField], scene: Layer | None = None
    ) -> FieldSensor:
        """Return a camera like this one that shows other objects, or another scene."""
        view = self.camera, self.mount, self.jitter_seed, self.stop, self.composite
        more = self.surroundings, self.clip
        return FieldSensor(scene or self.scene, objects, *view, *more)

    def observe(self, state: Any, step: int) -> Observation:
        """Render the composite; see :meth:`AbstractSensor.observe`."""
        count = dr.width(state)
        self.renders += count
        key = dr.opaque(mi.UInt32, step)
        ends = self._look_around(state, key)
        if self._ahead is None:
            pixels, *found = self._frozen_render(_pose(state), key, ends, count)
            return Observation(self._tensor(pixels, count), *found, ends=ends)
        rays = self._frozen_make_rays(_pose(state), key, ends, count)
        first = [self._ahead.march(rays, self.camera.width)]
        return self.restore(state, step, first if ends is None else (first, ends))

    def keep(self, observation: Observation) -> Any:
        """Keep the layers, 20 bytes a pixel each, and 20 more of exact composites.

        With surroundings, 16 more for where rays end, and what is there.
        """
        assert observation.seen is not None
        kept, ends = self.composite.keep(observation.seen), observation.ends
        return kept if ends is None else (kept, ends)

    def restore(self, state: Any, step: int, kept: Any) -> Observation:
        """Lay the layers that were kept over each other; march those that were not."""
        count = dr.width(state)
        key = dr.opaque(mi.UInt32, step)
        layers, ends = kept if isinstance(kept, tuple) else (kept, None)
        pixels, *found = self._frozen_restore(_pose(state), key, layers, ends, count)
        return Observation(self._tensor(pixels, count), *found, ends=ends)

    def behind(self, observation: Observation) -> mi.Color3f:
        """Return what is seen behind all fields, (3, n), linear."""
        assert observation.rays is not None
        return self._behind(observation.rays.direction, observation.ends)

    def _look_around(self, state: Any, step: mi.UInt32) -> Ends | None:
        if self.surroundings is None:
            return None
        rays = self._frozen_make_rays(_pose(state), step, None, dr.width(state))
        sky = self._behind(rays.direction, None)
        return self.surroundings.see(rays, step, sky)

    def _render(
        self, state: Any, step: mi.UInt32, ends: Ends | None, count: int
    ) -> tuple[mi.Color3f, Seen, Rays]:
        rays = self._make_rays(state, step, ends, count)
        seen = self.composite.render(self._fields, rays, self.stop)
        return self._develop(seen.total, rays.direction, ends), seen, rays

    def _restore(
        self, state: Any, step: mi.UInt32, kept: Any, ends: Ends | None, count: int
    ) -> tuple[mi.Color3f, Seen, Rays]:
        rays = self._make_rays(state, step, ends, count)
        seen = self.composite.restore(self._fields, rays, kept, self.stop)
        return self._develop(seen.total, rays.direction, ends), seen, rays

    def vjp(
        self, observation: Observation, state: Any, d_image: Any, attached: bool
    ) -> Any:
        """See :meth:`AbstractDifferentiableSensor.vjp`."""
        rays, seen = observation.rays, observation.seen
        assert rays is not None and seen is not None
        if attached and observation.ends is not None:
            raise InputError(f"attached: {ATTACHED}")
        cotangent, d_direction = self._frozen_cotangent(
            seen.total, rays.direction, observation.ends, d_image.array
        )
        if attached or self._wrenches is not None:
            first = 0 if attached else len(self.scene)
            d_rays, wrenches = self._frozen_by_rays(rays, seen, cotangent, first)
        else:
            d_rays = wrenches = None
            whole = Seen(cotangent)
            for task in self.composite.tasks(self._fields, rays, seen, whole):
                self._tasks.add(task)
        if wrenches is not None and self._wrenches is not None:
            pairs = zip(self._wrenches, wrenches, strict=True)
            self._wrenches = [
                [a + b for a, b in zip(*pair, strict=True)] for pair in pairs
            ]
        dr.eval([dr.grad(field.packed) for field in self.fields], self._wrenches)
        return self._by_state(state, d_rays, d_direction) if attached else None

    def _cotangent(
        self,
        total: March,
        direction: mi.Vector3f,
        ends: Ends | None,
        d_image: mi.Float,
    ) -> tuple[March, mi.Vector3f]:
        """Differentiate by the composite and, for the sky, by the direction."""
        total, direction = total.copy(), mi.Vector3f(direction)
        dr.enable_grad(total, direction)
        pixels = self._develop(total, direction, ends)
        index = 3 * dr.arange(mi.UInt32, dr.width(pixels))
        weights = [dr.gather(mi.Float, d_image, index + c) for c in range(3)]
        dr.backward_from(dr.dot(pixels, mi.Color3f(*weights)))
        return dr.grad(total), dr.grad(direction)

    def _accumulate(self, task: Task) -> None:
        posed = [self._fields[k] for k in task.fields]
        self.composite.accumulate(posed, task, self.stop)

    def _by_rays(
        self, rays: Rays, seen: Seen, cotangent: March, first: int
    ) -> tuple[Any, list[Any]]:
        """Differentiate layers from `first` on: their sum if it is 0, and wrenches."""
        layers = range(first, len(self._fields))
        found = self.composite.backward_rays(
            self._fields, rays, seen, Seen(cotangent), self.stop, layers
        )
        pairs = zip(self.objects, found[len(self.scene) - first :], strict=True)
        wrenches = [wrench_of(posed, rays, by_rays) for posed, by_rays in pairs]
        if first:
            return None, wrenches
        d_origin = sum((part.origin for part in found), mi.Vector3f(0))
        d_direction = sum((part.direction for part in found), mi.Vector3f(0))
        return (d_origin, d_direction), wrenches

    def _state(self, *arguments: Any) -> list[Any]:
        """Return what frozen functions read or depend on beside their arguments."""
        # Recordings hold literals of one image's size; a task has none.
        sizes = [dr.width(x) for x in arguments if not isinstance(x, Task)]
        view = [self.camera, self.mount, self.jitter_seed, self._near]
        state = [posed.state() for posed in self._fields]
        return [self.composite, self.stop, view, sizes, state]

    def start_gradient(self, poses: bool = False) -> None:
        """Make every object's packed grid a fresh leaf with gradient zero."""
        self._tasks.clear()
        for field in self.fields:
            start_gradient(field)
        double = dr.float64_array_t(mi.Float)
        zeros = [[dr.opaque(double, 0) for _ in range(6)] for _ in self.objects]
        self._wrenches = zeros if poses else None

    def texture_gradients(self) -> list[Any]:
        """Return the accumulated gradient of each texture, (n_vertices, 3)."""
        self._tasks.finish()
        return [field.texture_gradient(dr.grad(field.packed)) for field in self.fields]

    def textures(self) -> list[Any]:
        """See :meth:`AbstractDifferentiableSensor.textures`."""
        return [field.texture for field in self.fields]

    def set_textures(self, textures: list[Any]) -> None:
        """See :meth:`AbstractDifferentiableSensor.set_textures`."""
        for field, texture in zip(self.fields, textures, strict=True):
            field.set_parameter("texture", texture)

    def offsets(self) -> np.ndarray:
        """See :meth:`AbstractDifferentiableSensor.offsets`."""
        return np.array([posed.offset for posed in self.objects]).reshape(-1, 6)

    def set_offsets(self, offsets: np.ndarray) -> None:
        """See :meth:`AbstractDifferentiableSensor.set_offsets`."""
        offsets = np.asarray(offsets, np.float64)
        if offsets.shape != (len(self.objects), 6) or not np.isfinite(offsets).all():
            raise ValueError(
                f"offsets: shape {offsets.shape}; expected finite "
                f"({len(self.objects)}, 6)"
            )
        for posed, offset in zip(self.objects, offsets, strict=True):
            posed.move(*offset_pose(posed.pose, offset))
            posed.offset = offset.copy()

    def offset_gradients(self) -> np.ndarray:
        """See :meth:`AbstractDifferentiableSensor.offset_gradients`."""
        assert self._wrenches is not None, "start_gradient(poses=True) comes before"
        wrenches = [[float(x[0]) for x in wrench] for wrench in self._wrenches]
        pairs = zip(np.array(wrenches).reshape(-1, 6), self.offsets(), strict=True)
        return np.array([offset_gradient(*pair) for pair in pairs]).reshape(-1, 6)

    def _make_rays(
        self, state: Any, step: mi.UInt32, ends: Ends | None, count: int
    ) -> Rays:
        origin, direction = self._rays(state, count)
        jitter = self._jitter(step, dr.width(direction))
        far = dr.opaque(mi.Float, dr.inf) if ends is None else ends.t_max
        active = dr.opaque(mi.Bool, True)
        return Rays(origin, direction, far, jitter, active)

    def _rays(self, state: Any, count: int) -> tuple[mi.Point3f, mi.Vector3f]:
        mount = self.mount
        origin, columns = mount_pose(
            (mi.Float(state[0]), mi.Float(state[1]), mi.Float(state[2])),
            mount.height_m,
            mount.forward_m,
            mount.pitch_deg,
        )
        dr.eval(origin, columns)
        origin, direction = generate_rays(self.camera, origin, columns, count)
        if self._near is not None:
            index = dr.arange(mi.UInt32, dr.width(direction)) % dr.width(self._near)
            origin += dr.gather(mi.Float, self._near, index) * direction
        return origin, direction

    def _jitter(self, step: mi.UInt32, count: int) -> mi.Float:
        if self.jitter_seed is None:
            return dr.opaque(mi.Float, 0.5)
        seed = dr.opaque(mi.UInt32, self.jitter_seed)
        key = mi.sample_tea_32(seed, step)[0]
        return mi.Float(mi.sample_tea_float32(key, dr.arange(mi.UInt32, count)))

    @property
    def fields(self) -> list[GridField]:
        """The objects' fields; __init__ checks their kind."""
        return [posed.field for posed in self.objects]  # pyright: ignore[reportReturnType]

    @property
    def _fields(self) -> list[Layer]:
        return [*self.scene, *self.objects]

    def _behind(self, direction: mi.Vector3f, ends: Ends | None) -> mi.Color3f:
        if ends is not None:
            return ends.radiance
        none = dr.zeros(mi.Color3f, dr.width(direction))
        return self._fields[0].background(direction) if self._fields else none

    def _develop(
        self, total: March, direction: mi.Vector3f, ends: Ends | None
    ) -> mi.Color3f:
        behind = self._behind(direction, ends)
        return dr.linear_to_srgb(total.radiance + (1 - total.opacity) * behind)

    def _tensor(self, pixels: mi.Color3f, count: int) -> mi.TensorXf:
        shape = (count, self.camera.height, self.camera.width, 3)
        return mi.TensorXf(dr.ravel(pixels), shape)

    def _by_state(self, state: Any, d_rays: Any, d_direction: Any) -> Any:
        """Differentiate the rays, and what they see, by the state."""
        d_origin, by_direction = d_rays
        d_direction += by_direction
        dr.eval(d_origin, d_direction)
        leaf = _pose(state)
        dr.enable_grad(leaf)
        origin, direction = self._rays(leaf, dr.width(leaf))
        dr.backward_from(dr.dot(origin, d_origin) + dr.dot(direction, d_direction))
        result = dr.grad(leaf)
        dr.eval(result)
        return result


def _pose(state: Any) -> Any:
    """Return the rows px, py, theta of a state, (3, n), detached."""
    kind = dr.float64_array_t(mi.Vector3f)
    return kind(*[dr.detach(state[i]) for i in range(3)])
