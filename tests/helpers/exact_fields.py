"""Fields whose integrals are known, and their closed forms in float64."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy.special import erf

from mi_nerfattack.fields import AbstractField
from mi_nerfattack.fields.occupancy import Occupancy
from mi_nerfattack.render.camera.pose import Pose
from mi_nerfattack.render.rays import Rays

WAVES = np.array([[1.0, 0.3, -0.5], [-0.4, 1.2, 0.2], [0.1, -0.6, 0.9]])
PHASES = np.array([0.3, 1.1, 2.5])


class GaussianField(AbstractField):
    """Density ``peak exp(-r^2 / (2 sd^2))``, colour ``0.5 + 0.4 sin(wave x + phase)``.

    The box is [-half, half]^3. What bounds its errors: along any line, the largest
    values of density and its derivatives (`sigma`) and of colour (`colour`).
    """

    kind = "gaussian"

    def __init__(self, peak: float, sd: float, half: float, step_m: float) -> None:
        self.peak, self.sd, self.half = peak, sd, half
        self.lower, self.upper = -half * np.ones(3), half * np.ones(3)
        self.step_m, self.cone = step_m, 0.0
        self.occupy(Occupancy.full())
        self.sigma = peak, peak / sd * np.exp(-0.5), peak / sd**2
        frequency = np.linalg.norm(WAVES, axis=1).max()
        self.colour = 0.9, 0.4 * frequency, 0.4 * frequency**2

    def eval_everywhere(
        self, point: Any, direction: Any, active: Any
    ) -> tuple[Any, Any]:
        """Evaluate density and colour."""
        squared = dr.squared_norm(mi.Vector3f(point))
        density = self.peak * dr.exp(squared * (-0.5 / self.sd**2))
        rows = [
            dr.sin(dr.dot(mi.Vector3f(*wave), mi.Vector3f(point)) + phase)
            for wave, phase in zip(WAVES.tolist(), PHASES.tolist(), strict=True)
        ]
        return density & active, (0.5 + 0.4 * mi.Color3f(*rows)) & active

    def depth_to(self, o: np.ndarray, d: np.ndarray, near: Any, t: Any) -> np.ndarray:
        """Return the optical depth (n, k) from near (n,) to t (n, k), with erf."""
        middle = -(o * d).sum(1)[:, None]
        squared = (o**2).sum(1)[:, None] - middle**2
        top = self.peak * np.exp(-squared / (2 * self.sd**2))
        width = np.sqrt(2) * self.sd
        part = erf((t - middle) / width) - erf((near[:, None] - middle) / width)
        return top * self.sd * np.sqrt(np.pi / 2) * part


def box_interval(
    o: np.ndarray, d: np.ndarray, pose: Pose, half: float, t_max: Any = np.inf
) -> tuple[np.ndarray, np.ndarray]:
    """Return where rays (n, 3) enter and leave a posed cube, (n,); equal if never."""
    with np.errstate(divide="ignore"):
        o = (o - pose.translation) @ pose.rotation / pose.scale
        d = d @ pose.rotation / pose.scale
        sides = np.sort(np.stack([(-half - o) / d, (half - o) / d]), axis=0)
    near = np.maximum(sides[0].max(1), 0)
    return near, np.maximum(near, np.minimum(sides[1].min(1), t_max))


def quadrature(
    fields: list[tuple[GaussianField, Pose]], o: np.ndarray, d: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Integrate blobs as one medium in float64: radiance, opacity, moment.

    Gauss-Legendre on the parts between the borders of the boxes, with the closed form
    of the transmittance. Poses must not scale or turn (a blob is round).
    """
    parts = [(f, o - p.translation, *box_interval(o, d, p, f.half)) for f, p in fields]
    cuts = np.sort(np.stack([cut for part in parts for cut in part[2:]], 1), axis=1)
    nodes, weights = np.polynomial.legendre.leggauss(200)
    radiance, moment = np.zeros((len(o), 3)), np.zeros(len(o))
    for a, b in zip(cuts.T[:-1], cuts.T[1:], strict=True):
        t = 0.5 * (a + b)[:, None] + 0.5 * (b - a)[:, None] * nodes
        tau = np.zeros_like(t)
        density, emission = np.zeros_like(t), np.zeros((*t.shape, 3))
        for field, local, near, far in parts:
            clipped = np.clip(t, near[:, None], far[:, None])
            tau += field.depth_to(local, d, near, clipped)
            x = local[:, None] + t[..., None] * d[:, None]
            inside = (t > near[:, None]) & (t < far[:, None])
            sigma = field.peak * np.exp(-(x**2).sum(-1) / (2 * field.sd**2)) * inside
            density += sigma
            colour = 0.5 + 0.4 * np.sin(x @ WAVES.T + PHASES)
            emission += sigma[..., None] * colour
        given = np.exp(-tau) * weights * 0.5 * (b - a)[:, None]
        radiance += (given[..., None] * emission).sum(1)
        moment += (given * density * t).sum(1)
    ends = [f.depth_to(q, d, near, far[:, None])[:, 0] for f, q, near, far in parts]
    return radiance, -np.expm1(-np.sum(ends, axis=0)), moment


def piecewise(
    layers: list[tuple[np.ndarray, np.ndarray, float, np.ndarray]],
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Integrate homogeneous parts as one medium, in closed form and float64.

    Args:
        layers: near (n,), far (n,), density, colour (3,) of each part.

    Returns:
        radiance (n, 3), opacity (n,) and moment (n,).
    """
    count = len(layers[0][0])
    radiance, moment, tau = np.zeros((count, 3)), np.zeros(count), np.zeros(count)
    cuts = np.sort(np.stack([cut for layer in layers for cut in layer[:2]]), axis=0)
    for a, b in zip(cuts[:-1], cuts[1:], strict=True):
        middle = 0.5 * (a + b)
        sigmas = [s * ((n < middle) & (middle < f)) for n, f, s, _ in layers]
        sigma = np.sum(sigmas, axis=0)
        emission = sum(
            np.outer(s, layer[3]) for s, layer in zip(sigmas, layers, strict=True)
        )
        safe = np.where(sigma > 0, sigma, 1)
        passed, before = np.exp(-sigma * (b - a)), np.exp(-tau)
        radiance += (before * (1 - passed) / safe)[:, None] * emission
        gained = (a + 1 / safe) - (b + 1 / safe) * passed
        moment += np.where(sigma > 0, before * gained, 0)
        tau += sigma * (b - a)
    return radiance, -np.expm1(-tau), moment


def rays_towards(
    middle: np.ndarray, spread: float, count: int = 64
) -> tuple[Rays, np.ndarray, np.ndarray]:
    """Make rays of all directions that pass near a point, half of them from inside."""
    rng = np.random.default_rng(5)
    d = rng.normal(size=(count, 3))
    d = (d / np.linalg.norm(d, axis=1, keepdims=True)).astype(np.float32)
    aim = middle + rng.uniform(-spread, spread, (count, 3))
    back = np.where(np.arange(count) % 2, 3.0, 0.3)[:, None]
    o = (aim - back * d).astype(np.float32)
    rays = Rays(mi.Point3f(o.T.copy()), mi.Vector3f(d.T.copy()))
    rays.t_max, rays.jitter = mi.Float(np.inf), mi.Float(0.5)
    dr.make_opaque(rays)
    d64 = d.astype(np.float64)
    return rays, o.astype(np.float64), d64
