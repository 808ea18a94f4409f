"""What `field_integrator` keeps of a ray, and how it samples the nested integrator."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import drjit as dr
import mitsuba as mi

from mi_nerfattack.backend.arrays import differentiates_rays
from mi_nerfattack.errors import InputError
from mi_nerfattack.plugins.properties import background
from mi_nerfattack.render.composite import Marches
from mi_nerfattack.render.lighting import spectrum
from mi_nerfattack.render.rays import Gain, March, Rays


@dataclass
class State:
    """What the primal pass of a ray hands to its derivatives.

    Attributes:
        marches: of the fields, along the ray.
        gains: light on the fields, as of `Rays`.
        behind: (channels, n), what the nested integrator sees; None without a nested
            integrator.
        valid: (n,), whether the nested integrator meets anything; None without one.
        aovs: AOVs of the nested integrator.
        inner: state of the nested integrator.
    """

    marches: Marches
    gains: list[Gain] = field(default_factory=list)
    behind: Any = None
    valid: Any = None
    aovs: list[mi.Float] = field(default_factory=list)
    inner: Any = None

    def copy(self) -> State:
        """Return the same with no derivatives attached to what is seen."""
        behind = None if self.behind is None else dr.detach(self.behind)
        return replace(self, marches=self.marches.copy(), behind=behind)


def sample_nested(
    integrator: Any,
    mode: dr.ADMode,
    scene: mi.Scene,
    sampler: mi.Sampler,
    ray: mi.Ray3f,
    active: mi.Bool,
    δL: Any = None,
    state_in: Any = None,
) -> tuple[Any, ...]:
    """Sample another integrator, whichever of Mitsuba's two interfaces it has."""
    if not differentiates_rays(integrator):
        ray = mi.RayDifferential3f(ray)
        return integrator.sample(scene, sampler, ray, active=active)
    return integrator.sample(
        mode=mode,
        scene=scene,
        sampler=sampler,
        ray=ray,
        depth=mi.UInt32(0),
        δL=δL,
        δaovs=None,
        state_in=state_in,
        active=active,
    )


def look(
    integrator: Any,
    scene: mi.Scene,
    sampler: mi.Sampler,
    ray: mi.Ray3f,
    rays: Rays,
    frozen: bool,
) -> State:
    """March the fields of a `field_integrator`, and see what lies behind them.

    Args:
        integrator: its fields and nested integrator.
        scene: that is rendered.
        sampler: of random numbers.
        ray: n rays.
        rays: the same, as far as fields are concerned.
        frozen: replay recordings; where nothing is being recorded.
    """
    light = integrator.relighting
    if light is not None:
        light_gains = light.gains(scene, sampler, integrator.posed, rays)
        ray_gains = rays.gains or [Gain()] * len(light_gains)
        pairs = zip(light_gains, ray_gains, strict=True)
        rays.gains = [Gain(colour * gain.colour, gain.row) for colour, gain in pairs]
    if frozen:
        dr.make_opaque(rays)
        marches = integrator.frozen.render(rays)
    else:
        marches = integrator.composite.render(integrator.posed, rays, integrator.stop)
    if integrator.behind is None:
        return State(marches, rays.gains)
    behind, valid, aovs, *inner = sample_nested(
        integrator.behind,
        dr.ADMode.Primal,
        scene,
        sampler=sampler,
        ray=ray,
        active=rays.active,
    )
    if light is not None:
        shadow = light.behind(
            scene, sampler, integrator.posed, ray=ray, active=rays.active
        )
        behind *= spectrum.reflectance(shadow, ray.wavelengths)
    return State(marches, rays.gains, behind, valid, list(aovs), *inner)


class Sampled(dr.CustomOp):
    """Samples of a `field_integrator` inside `moment`, which Dr.Jit differentiates."""

    def eval(
        self, integrator: Any, call: dict[str, Any], parameters: list[Any]
    ) -> tuple[Any, mi.Bool, list[mi.Float]]:
        """Sample rays with ``call``; ``parameters`` have gradients enabled."""
        del parameters
        # The backward pass replays the random numbers of this pass
        self.integrator = integrator
        self.call = {**call, "sampler": call["sampler"].clone()}
        with dr.suspend_grad():
            *outputs, self.state = integrator.sample(dr.ADMode.Primal, **call)
        return outputs[0], outputs[1], outputs[2]

    def backward(self) -> None:
        """Accumulate the gradients of the parameters."""
        δL, _, δaovs = self.grad_out()
        dr.make_opaque(δL)  # `prb` refuses a literal 0
        mode, scene = dr.ADMode.Backward, self.call["scene"]
        with self.integrator.differentiating(scene, mode), dr.suspend_grad():
            arguments = {"δL": δL, "δaovs": δaovs, "state_in": self.state}
            self.integrator.sample(mode, **self.call, **arguments)

    def forward(self) -> None:
        """Raise InputError."""
        raise InputError(
            "field_integrator: has no derivative in forward mode inside another "
            "integrator; use dr.backward"
        )


def lay_over(
    integrator: Any, total: March, rays: Rays, behind: Any, ray: mi.Ray3f
) -> Any:
    """Lay fields over what is behind them, as a spectrum; differentiable."""
    passed = 1 - total.opacity
    if behind is not None:
        return spectrum.emission(total.radiance, ray.wavelengths) + passed * behind
    sky = background(integrator.volumes, rays.direction) & (rays.t_max == dr.inf)
    return spectrum.emission(total.radiance + passed * sky, ray.wavelengths)


def push_forward(
    integrator: Any,
    scene: mi.Scene,
    sampler: mi.Sampler,
    ray: mi.Ray3f,
    rays: Rays,
    state: State,
) -> tuple[Any, Any]:
    """Return the tangents of the colour and of the integrator's `splats`.

    Raises:
        InputError: channels of single fields, which have no tangents in this composite.
    """
    composite = integrator.composite
    tangent = composite.forward(
        integrator.posed, rays, primal=state.marches, stop=integrator.stop
    )
    if len(tangent.layers) < len(integrator.channels.ids):
        raise InputError(
            "composite interleaved: the shares of single fields have no tangents; "
            "set composite to depth, or aovs to false"
        )
    t_behind = None
    if integrator.differentiates_behind:
        nested, mode = integrator.behind, dr.ADMode.Forward
        t_behind, *_ = sample_nested(
            nested,
            mode,
            scene,
            sampler=sampler,
            ray=ray,
            active=rays.active,
            state_in=state.inner,
        )
    with dr.resume_grad():
        leaf = state.copy()
        dr.enable_grad(leaf.marches, leaf.behind)
        dr.set_grad(leaf.marches.total, tangent.total)
        for layer, part in zip(leaf.marches.layers, tangent.layers, strict=False):
            dr.set_grad(layer, part)
        if t_behind is not None:
            dr.set_grad(leaf.behind, t_behind)
        colour = lay_over(
            integrator, leaf.marches.total, rays, behind=leaf.behind, ray=ray
        )
        outputs = colour, *integrator.splats(leaf)
        flags = dr.ADFlag.ClearEdges | dr.ADFlag.AllowNoGrad
        colour, alpha, aovs = dr.forward_to(outputs, flags=flags)
    return colour, (alpha, aovs)


@dataclass(frozen=True)
class FieldChannels:
    """The channels that an image of fields has after its colour.

    Attributes:
        ids: of the fields; none for no channels.
    """

    ids: tuple[str, ...]

    def names(self) -> list[str]:
        """Name the channels of an image."""
        layers = [f"{name}.{c}" for name in self.ids for c in "RGBAZ"]
        return ["opacity", "depth", *layers] if self.ids else []

    def film_names(self) -> list[str]:
        """Name those of the film, which averages: depths times opacities."""
        moments = {depth: moment for depth, _, moment in self._depths()}
        return [moments.get(name, name) for name in self.names()]

    def of_film(self, marches: Marches) -> list[mi.Float]:
        """Return the film's channels of rays, (n,) each."""
        return self._list(marches, [m.moment for m in (marches.total, *marches.layers)])

    def of_sample(self, marches: Marches) -> list[mi.Float]:
        """Return the image's channels of rays, (n,) each; depth 0 of nothing."""
        members = marches.total, *marches.layers
        depths = [dr.select(m.opacity > 0, m.depth, 0) for m in members]
        return self._list(marches, depths)

    def develop(self, image: mi.TensorXf, after: int) -> mi.TensorXf:
        """Divide moments by opacities; infinite where there is nothing.

        Args:
            image: of the film; differentiable.
            after: number of channels that come after the fields'.
        """
        names = self.names()
        height, width, count = image.shape
        first = count - after - len(names)
        index = dr.arange(mi.UInt32, height * width * count)
        channel = index % count
        values = mi.Float(image.array)
        for depth, opacity, _ in self._depths():
            is_depth = channel == first + names.index(depth)
            back = names.index(depth) - names.index(opacity)
            weight = dr.gather(mi.Float, image.array, index - mi.Int32(back), is_depth)
            mean = values / dr.select(weight > 0, weight, 1)
            values = dr.select(is_depth, dr.select(weight > 0, mean, dr.inf), values)
        return mi.TensorXf(values, image.shape)

    def _depths(self) -> list[tuple[str, str, str]]:
        """Name each depth, its opacity, and its moment."""
        layers = [(f"{name}.Z", f"{name}.A", f"{name}.moment") for name in self.ids]
        return [("depth", "opacity", "moment"), *layers] if self.ids else []

    def _list(self, marches: Marches, depths: list[mi.Float]) -> list[mi.Float]:
        if not self.ids:
            return []
        channels = [marches.total.opacity, depths[0]]
        for layer, depth in zip(marches.layers, depths[1:], strict=True):
            channels += [*layer.radiance, layer.opacity, depth]
        return channels
