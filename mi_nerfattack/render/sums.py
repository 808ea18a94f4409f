"""The recurrence of a march along a ray, and its derivative.

A sample is an interval of a ray on which the density ``sigma_k`` and the radiance
``L_k`` of each field k are taken as constant. With ``x_k = sigma_k width`` its optical
depths, ``x = sum x_k``, and T the transmittance in front of it, field k has the weight

    w_k = T phi(x) x_k,   phi(x) = (1 - exp(-x)) / x,

and the ray gathers ``sum_k w_k L_k`` of radiance and ``sum_k w_k t`` of moment.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from mi_nerfattack.render.rays import March


def absorption(x: mi.Float) -> tuple[mi.Float, mi.Float]:
    """Return ``phi(x) = (1 - exp(-x)) / x`` and its derivative, accurate at 0.

    ``x phi(x)`` is the opacity of optical depth x; in single precision ``1 - exp(-x)``
    loses the digits that thin media live on.
    """
    small = x < 0.1
    # The closed form, without a division by 0
    safe = dr.select(small, 1, x)
    passed = dr.exp(-safe)
    phi = (1 - passed) / safe
    # Taylor series around 0, of phi and of its derivative
    series = 1 + x * (-1 / 2 + x * (1 / 6 + x * (-1 / 24 + x / 120)))
    slope = -1 / 2 + x * (1 / 3 + x * (-1 / 8 + x * (1 / 30 - x / 144)))
    return (
        dr.select(small, series, phi),
        dr.select(small, slope, (passed - phi) / safe),
    )


def sample_weight(tau: mi.Float, x: mi.Float) -> mi.Float:
    """Return the weight of a sample of one field behind optical depth `tau`."""
    return dr.exp(-tau) * x * absorption(x)[0]


@dataclass
class Sums:
    """What rays have gathered so far.

    Attributes:
        tau: (n,), optical depth of the samples behind.
        shares: what each field gave.
    """

    tau: mi.Float
    shares: list[March]

    @staticmethod
    def zeros(fields: int) -> Sums:
        """Return what rays have before their first sample."""
        return Sums(mi.Float(0), [March() for _ in range(fields)])

    def plus(
        self, depths: Sequence[mi.Float], colours: Sequence[mi.Color3f], t: mi.Float
    ) -> Sums:
        """Add a sample.

        Args:
            depths: (n,), optical depth of each field.
            colours: (3, n), radiance of each field.
            t: (n,), position of the sample, metres.
        """
        x = sum(depths, mi.Float(0))
        # A.1 to A.3 are sums of w L, w and w t, with the weights w = T phi(x) x_k
        attenuation = dr.exp(-self.tau) * absorption(x)[0]
        shares = []
        for share, depth, colour in zip(self.shares, depths, colours, strict=True):
            w = attenuation * depth
            march = March(
                share.radiance + w * colour, share.opacity + w, share.moment + w * t
            )
            shares.append(march)
        return Sums(self.tau + x, shares)

    def march(self) -> March:
        """Return what the rays of a single field gathered."""
        (share,) = self.shares
        # 1 - exp(-tau), the opacity of A.2, without the rounding of a sum
        opacity = self.tau * absorption(self.tau)[0]
        return March(share.radiance, opacity, share.moment)


@dataclass
class Remainder:
    """What of a march is still to come, while it is replayed.

    Attributes:
        tau: (n,), optical depth of the samples behind.
        radiance: (3, n), premultiplied radiance.
        moment: (n,), metres.
        passed: (n,), transmittance of the whole ray.
    """

    tau: mi.Float
    radiance: mi.Color3f
    moment: mi.Float
    passed: mi.Float

    @staticmethod
    def of(primal: March) -> Remainder:
        """Return all of a march."""
        radiance, moment = mi.Color3f(primal.radiance), mi.Float(primal.moment)
        return Remainder(mi.Float(0), radiance, moment, passed=1 - primal.opacity)

    def minus(
        self, depths: Sequence[mi.Float], colours: Sequence[mi.Color3f], t: mi.Float
    ) -> tuple[Remainder, Slope]:
        """Take a sample away, as :meth:`Sums.plus` added it, and differentiate."""
        x = sum(depths, mi.Float(0))
        light = mix(depths, colours)
        through, behind = dr.exp(-self.tau), dr.exp(-self.tau - x)
        phi, d_phi = absorption(x)
        attenuation = through * phi
        # Without the sample's part, the remainder is all that lies behind the sample
        remainder = Remainder(
            self.tau + x,
            self.radiance - attenuation * light,
            self.moment - attenuation * x * t,
            passed=self.passed,
        )
        # More depth in any field dims the sample's own light, and all light behind it.
        d_radiance = through * d_phi * light - remainder.radiance
        # It takes from what passes the whole ray in proportion.
        d_opacity = self.passed
        # All depth in the sample is at t: T x phi(x) grows by what is behind it.
        d_moment = behind * t - remainder.moment
        # The field that has more depth adds light of its own: see `Slope.change`.
        return remainder, Slope(attenuation, March(d_radiance, d_opacity, d_moment))


@dataclass
class Slope:
    """Derivative of a march by one of its samples.

    Attributes:
        attenuation: (n,), what arrives of light that the sample emits, ``T phi(x)``.
        by_depth: derivative by the optical depth of all fields, their light fixed.
    """

    attenuation: mi.Float
    by_depth: March

    def change(
        self, depths: Sequence[mi.Float], colours: Sequence[mi.Color3f]
    ) -> March:
        """Return a quantity whose derivative by the arguments is that of the march."""
        x, by_depth = sum(depths, mi.Float(0)), self.by_depth
        light = mix(depths, colours)
        return March(
            self.attenuation * light + x * by_depth.radiance,
            x * by_depth.opacity,
            x * by_depth.moment,
        )

    def growth(
        self,
        cotangent: March,
        depths: Sequence[mi.Float],
        colours: Sequence[mi.Color3f],
    ) -> list[mi.Float]:
        """Return an objective's derivative by the logarithm of each field's depth.

        Args:
            cotangent: the objective's derivative by the march.
            depths: as given to :meth:`change`.
            colours: as given to :meth:`change`.
        """
        # dJ/d ln x_k = x_k dJ/dx_k: a shared term, and the light that field k adds
        shared = cotangent.pair(self.by_depth)
        pairs = zip(depths, colours, strict=True)
        return [
            x * (shared + self.attenuation * dr.dot(colour, cotangent.radiance))
            for x, colour in pairs
        ]


def mix(depths: Sequence[mi.Float], colours: Sequence[mi.Color3f]) -> mi.Color3f:
    """Return ``sum_k x_k L_k``, the light of a sample before it is absorbed."""
    pairs = zip(depths, colours, strict=True)
    return sum((x * colour for x, colour in pairs), mi.Color3f(0))
