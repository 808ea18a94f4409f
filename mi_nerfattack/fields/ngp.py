"""Neural graphics primitive: hash grid, density network and colour network."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

import drjit as dr
import drjit.nn as nn
import mitsuba as mi
import numpy as np
from drjit.hashgrid import HashGridEncoding

from mi_nerfattack.backend.arrays import upload
from mi_nerfattack.errors import InputError
from mi_nerfattack.fields.base import (
    AbstractField,
    activate,
    box_metadata,
    check_box,
    check_finite,
    check_positive,
    check_sky,
    flat_parameter,
    sky_colour,
)
from mi_nerfattack.fields.levels import lay_out_levels, level_growth
from mi_nerfattack.fields.occupancy import Occupancy

GEOMETRY_FEATURES = 16
SH_ORDER = 3


@dataclass(frozen=True)
class NGPLayout:
    """Architecture of an NGP.

    Attributes:
        levels: of the hash grid.
        features: values a vertex and level.
        log2_table: binary logarithm of the vertices a level.
        base_resolution: vertices along an edge of the coarsest level.
        max_resolution: vertices along an edge of the finest level.
        width: of the hidden layers of both networks.
    """

    levels: int = 16
    features: int = 2
    log2_table: int = 19
    base_resolution: int = 16
    max_resolution: int = 2048
    width: int = 64

    def __post_init__(self) -> None:
        limits = {
            "levels": (1, 32),
            "log2_table": (8, 24),
            "base_resolution": (2, 1024),
            "max_resolution": (self.base_resolution, 65536),
            "width": (8, 256),
        }
        for name, (low, high) in limits.items():
            if not low <= getattr(self, name) <= high:
                raise InputError(
                    f"{name}: {getattr(self, name)}; allowed are {low} to {high}"
                )
        if self.features not in (2, 4, 8):
            raise InputError(f"features: {self.features}; allowed are 2, 4 and 8")
        if self.n_params >= 1 << 32:
            raise InputError(
                f"log2_table: {self.log2_table}, with {self.levels} levels of "
                f"{self.features} features, gives {self.n_params} values; fewer than "
                "2^32 are allowed"
            )

    @staticmethod
    def small() -> NGPLayout:
        """Return 10 levels of 2^17 with width 32, for machines without a GPU."""
        return NGPLayout(levels=10, log2_table=17, width=32)

    @property
    def growth(self) -> float:
        """Factor between the resolutions of neighbouring levels."""
        return level_growth(self.levels, self.base_resolution, self.max_resolution)

    @property
    def n_params(self) -> int:
        """Number of values in the hash grid's table."""
        _, n_vertices = lay_out_levels(
            self.levels,
            self.base_resolution,
            self.max_resolution,
            features=self.features,
            most=2**self.log2_table,
        )
        return self.features * n_vertices

    def check(self, tensors: Mapping[str, np.ndarray]) -> None:
        """Raise InputError unless the tensors of a file have this layout's shapes.

        Raises:
            KeyError: one is missing.
        """
        width, inputs = self.width, GEOMETRY_FEATURES + (SH_ORDER + 1) ** 2
        shapes = {
            "table": (self.n_params,),
            "density_net.0": (width, self.levels * self.features),
            "density_net.1": (GEOMETRY_FEATURES, width),
            "colour_net.0": (width, inputs),
            "colour_net.1": (width, width),
            "colour_net.2": (3, width),
        }
        for name, shape in shapes.items():
            if tensors[name].shape != shape:
                raise InputError(
                    f"{name}: shape {tensors[name].shape}; expected {shape} by the "
                    "layout of the header; the file is damaged, make or copy it again"
                )
        check_sky(tensors["sky"])


class NGPField(AbstractField):
    """Instant-NGP radiance field with view-dependent colour.

    ``h = density_net(hash(x))``, ``density = density_scale * exp(h_0)`` and
    ``L = srgb_to_linear(sigmoid(colour_net(h, SH_3(w))))``. Behind the field lies
    a latitude-longitude image of raw colours (the sky), bilinearly interpolated.

    Networks use Dr.Jit's cooperative vectors: float32 on LLVM, float16 on CUDA.

    Args:
        layout: the architecture.
        lower: (3,) of the bounding box, metres.
        upper: (3,) of the bounding box, metres.
        tensors: ``table``, ``density_net.I``, ``colour_net.I``, ``sky`` as written
            by :meth:`tensors`; initialised from `seed` when left out.
        occupancy: where density may be; everywhere when left out.
        step_m: marching step near the camera, metres.
        cone: growth of the step with distance.
        sky_shape: (height, width) of the background image when initialised.
        seed: of the initialisation.
        info: free metadata that is kept in the file.

    Source: Mueller et al. 2022, section 4 and 5.4.
    """

    kind = "ngp_field"
    has_sky = True
    sh_order = SH_ORDER

    def __init__(
        self,
        layout: NGPLayout,
        lower: np.ndarray,
        upper: np.ndarray,
        tensors: dict[str, np.ndarray] | None = None,
        occupancy: Occupancy | None = None,
        step_m: float = 0.05,
        cone: float = 1 / 128,
        sky_shape: tuple[int, int] = (32, 64),
        seed: int = 0,
        info: dict[str, str] | None = None,
    ) -> None:
        self.layout = layout
        self.lower: np.ndarray = np.asarray(lower, np.float64)
        self.upper: np.ndarray = np.asarray(upper, np.float64)
        check_box(self.lower, self.upper)
        self.density_scale: float = 1.0 / float((self.upper - self.lower).max())
        self.step_m: float = float(step_m)
        self.cone: float = float(cone)
        check_positive("step_m", self.step_m)
        if not 0 <= self.cone <= 1:
            raise InputError(f"cone: {self.cone}; allowed is 0 to 1")
        self.info: dict[str, str] = dict(info or {})
        if tensors is not None:
            layout.check(tensors)
        self.occupy(occupancy or Occupancy.full())
        rng = dr.rng(seed=seed)
        self.encoding: HashGridEncoding = HashGridEncoding(
            mi.Float,
            3,
            n_levels=layout.levels,
            n_features_per_level=layout.features,
            hashmap_size=2**layout.log2_table,
            base_resolution=layout.base_resolution,
            per_level_scale=layout.growth,
            align_corners=True,
            rng=rng,
        )
        self._modules = _networks(layout, rng)
        self.sky_shape = sky_shape
        self.sky = dr.zeros(mi.Float, sky_shape[0] * sky_shape[1] * 3)
        if tensors is not None:
            self._load(tensors)
        self.density_net, self.colour_net = [
            nn.pack(module, layout="training") for module in self._modules
        ]
        dr.make_opaque(self.sky, self.encoding.data)

    def _load(self, tensors: dict[str, np.ndarray]) -> None:
        self.encoding.data = flat_parameter(
            tensors["table"], (self.encoding.n_params,), "table"
        )
        bound = float(np.abs(tensors["table"]).max())
        for prefix, module in zip(NETWORK_NAMES, self._modules, strict=True):
            bound = max(bound, 2.0)  # harmonics of the view, beside what was before
            for index, key in enumerate(module):
                name = f"{prefix}.{index}"
                value = np.asarray(tensors[name])
                bound = _bound(name, value, bound)
                module[key] = type(module[key])(value.astype(np.float32))
        sky = tensors["sky"]
        self.sky_shape = (sky.shape[0], sky.shape[1])
        self.sky = upload(mi.Float, sky)

    def eval_everywhere(
        self, point: mi.Point3f, direction: mi.Vector3f, active: mi.Bool
    ) -> tuple[mi.Float, mi.Color3f]:
        """See :meth:`AbstractField.eval_everywhere`."""
        geometry = self._geometry(point, active)
        harmonics = dr.sh_eval(mi.Vector3f(direction), SH_ORDER)
        raw = [mi.Float(x) for x in self.colour_net(self._coop(geometry, harmonics))]
        density, radiance = self.activate(geometry[0], raw)
        return density & active, radiance & active

    def clipped(self, point: mi.Point3f) -> mi.Point3f:
        """Map a point of the field's frame to where the encoding is looked up."""
        return dr.clip(self.unit(point), 0.0, 1.0 - 1e-6)

    def activate(
        self, geometry: mi.Float, raw: list[mi.Float]
    ) -> tuple[mi.Float, mi.Color3f]:
        """Turn the networks' raw density (n,) and colours 3 x (n,) into quantities."""
        return self.density_scale * dr.exp(dr.minimum(geometry, 15.0)), activate(raw)

    def density_everywhere(self, point: mi.Point3f, active: mi.Bool) -> mi.Float:
        """See :meth:`AbstractField.density_everywhere`."""
        raw = self._geometry(point, active)[0]
        return (self.density_scale * dr.exp(dr.minimum(raw, 15.0))) & active

    def density_bound(self) -> float:
        """Estimate a bound: twice the largest density at a million random points.

        A network has no tight bound; where the estimate is too small, delta
        tracking darkens the densest parts.
        """
        rng = dr.rng(seed=0)
        point = mi.Point3f(*[rng.random(mi.Float, 1 << 20) for _ in range(3)])
        extent = mi.Vector3f(*map(float, self.upper - self.lower))
        world = mi.Point3f(*map(float, self.lower)) + point * extent
        return 2 * float(dr.max(self.density(world, mi.Bool(True)))[0])

    def _geometry(self, point: mi.Point3f, active: mi.Bool) -> list[mi.Float]:
        features = self.encoding(self.clipped(point), active)
        return [mi.Float(x) for x in self.density_net(self._coop(features))]

    def _coop(self, *values: Any) -> nn.CoopVec:
        kind = dr.leaf_t(self._weight_type)
        return nn.CoopVec(*[kind(x) for part in values for x in part])

    def background(self, direction: mi.Vector3f) -> mi.Color3f:
        """Interpolate the sky image bilinearly, (3, n), linear."""
        return sky_colour(self.sky, self.sky_shape, direction)

    def parameters(self) -> dict[str, Any]:
        """Return ``table``, ``density_weights``, ``colour_weights`` and ``sky``."""
        return {
            "table": self.encoding.data,
            "density_weights": self.density_net["weights"],
            "colour_weights": self.colour_net["weights"],
            "sky": self.sky,
        }

    @property
    def has_gradients(self) -> bool:
        """Whether derivatives with respect to what ``eval`` reads are asked for."""
        values = self.parameters()
        with dr.resume_grad():  # derivative passes ask while gradients are suspended
            return any(dr.grad_enabled(values[k]) for k in values if k != "sky")

    def set_parameter(self, name: str, value: Any) -> None:
        """Replace one of :meth:`parameters`, keeping its derivative graph."""
        if name not in self.parameters():
            raise KeyError(f"{name}: an NGP has {', '.join(self.parameters())}")
        old = self.parameters()[name]
        if dr.width(value) != dr.width(old):
            raise InputError(
                f"{name}: {dr.width(value)} values; expected {dr.width(old)}"
            )
        check_finite(name, value, place="value")
        if name == "table":
            self.encoding.data = value
        elif name == "sky":
            self.sky = value
        else:
            net = self.density_net if name[0] == "d" else self.colour_net
            net["weights"] = value
        self._relist()

    def tensors(self) -> dict[str, np.ndarray]:
        """Return table (half precision), network matrices, sky, occupancy bits."""
        result = {
            "table": self.encoding.data.numpy().astype(np.float16),
            "sky": self.sky.numpy().copy().reshape(*self.sky_shape, 3),
            **self.occupancy_tensors(),
        }
        packed = (self.density_net, self.colour_net)
        for prefix, net in zip(NETWORK_NAMES, packed, strict=True):
            linear = [layer for layer in net.layers if isinstance(layer, nn.Linear)]
            for index, layer in enumerate(linear):
                matrix = self._weight_type(nn.unpack(layer.weights))
                result[f"{prefix}.{index}"] = matrix.numpy().astype(np.float32)
        return result

    def metadata(self) -> dict[str, str]:
        """Return architecture, bounds, units and provenance."""
        return {
            **self.info,
            **{k: str(v) for k, v in asdict(self.layout).items()},
            **box_metadata(self, self.info),
        }

    @property
    def _weight_type(self) -> type:
        return _weight_type()


NETWORK_NAMES = ("density_net", "colour_net")

#: A network's sums stay below this in absolute value: far from what a float holds.
_LARGEST = 1e30


def _bound(name: str, weights: np.ndarray, before: float) -> float:
    """Bound what a layer returns; infinity less infinity would be NaN.

    Args:
        name: of the weights.
        weights: (outputs, inputs).
        before: bound of what the layer takes.
    """
    bound = before * float(np.abs(weights).sum(axis=1, dtype=np.float64).max())
    if not bound < _LARGEST:
        raise InputError(
            f"tensor '{name}': weights up to {np.abs(weights).max():g}, on values up "
            f"to {before:.3g}, give sums up to {bound:.3g}; below {_LARGEST:g} is "
            "allowed, fit the field again"
        )
    return bound


def _weight_type() -> type:
    on_cuda = dr.backend_v(mi.Float) == dr.JitBackend.CUDA
    return mi.TensorXf16 if on_cuda else mi.TensorXf


def _networks(layout: NGPLayout, rng: Any) -> tuple[nn.Module, nn.Module]:
    density = nn.Sequential(
        nn.Linear(-1, layout.width, bias=False),
        nn.ReLU(),
        nn.Linear(-1, GEOMETRY_FEATURES, bias=False),
    ).alloc(_weight_type(), layout.levels * layout.features, rng=rng)
    colour = nn.Sequential(
        nn.Linear(-1, layout.width, bias=False),
        nn.ReLU(),
        nn.Linear(-1, layout.width, bias=False),
        nn.ReLU(),
        nn.Linear(-1, 3, bias=False),
    ).alloc(_weight_type(), GEOMETRY_FEATURES + (SH_ORDER + 1) ** 2, rng=rng)
    return density, colour
