"""Distant lights as few directions: that of captured objects, and sun with sky."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import mitsuba as mi
import numpy as np

from mi_nerfattack.ranges import Share, checked

_GOLDEN = math.pi * (3 - math.sqrt(5))
_DOME = 96  # directions of a light from everywhere
_LOBE = 16  # and of a key light
_ALBEDO = 0.2  # of the ground below objects
_NM = np.array([610.0, 550.0, 465.0])  # of red, green and blue
_SECOND_RADIATION = 1.4388e7  # nm K
_WHITE_K = 6500.0
_LUMINANCE = np.array([0.212671, 0.71516, 0.072169])


def sun_direction(elevation_deg: float, azimuth_deg: float) -> np.ndarray:
    """Return the unit vector (3,) towards the sun; x is east and y is north.

    Args:
        elevation_deg: above the horizon.
        azimuth_deg: clockwise from north.
    """
    up, around = math.radians(elevation_deg), math.radians(azimuth_deg)
    flat = math.cos(up)
    return np.array([flat * math.sin(around), flat * math.cos(around), math.sin(up)])


@dataclass(frozen=True)
class Light:
    """Light from k directions.

    Attributes:
        towards: (k, 3), unit vectors from a surface to the light.
        strength: (k, 3), linear RGB: the radiance of a white surface that faces the
            direction and gets no other light.
    """

    towards: np.ndarray
    strength: np.ndarray


def dome(count: int = _DOME) -> np.ndarray:
    """Return directions (count, 3), uniform on the sphere: a Fibonacci lattice."""
    z = 1 - (2 * np.arange(count) + 1) / count
    angle, radius = np.arange(count) * _GOLDEN, np.sqrt(1 - z**2)
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), z], axis=1)


def _add(*sources: tuple[np.ndarray, np.ndarray]) -> Light:
    towards, strength = zip(*sources, strict=True)
    return Light(np.concatenate(towards), np.concatenate(strength))


@dataclass(frozen=True)
@checked()
class Lighting:
    """White light of a constant part and a soft key light.

    The radiance from direction w is `ambient + b max(0, w . key)^sharpness`, with b
    such that an unoccluded surface facing the key has outgoing radiance equal to
    its reflectance, and one facing away `ambient` times that. Nothing is brighter than
    its reflectance, so that an 8-bit image clips nothing.

    Args:
        ambient: share of the constant part, in [0, 1].
        sharpness: exponent of the key's lobe; 16 has half its brightness at 17 degrees.
        key: direction towards the key light, any length.
    """

    ambient: Share = 0.75
    sharpness: float = 16.0
    key: tuple[float, float, float] = (0.5, -0.6, 1.0)

    def emitter(self) -> dict[str, Any]:
        """Describe the light as an `envmap` (64 x 128), z up."""
        height, width = 64, 128
        theta = (np.arange(height) + 0.5)[:, None] * np.pi / height
        phi = np.arange(width) * 2 * np.pi / width
        # Mitsuba's envmap: y up, column u is the direction (sin, ., -cos)(2 pi u)
        x = np.sin(theta) * np.sin(phi)
        z = -np.sin(theta) * np.cos(phi)
        y = np.cos(theta) + 0 * phi
        # turned by 90 degrees about x, its y becomes our z and its z our -y
        key = self._key
        cosine = np.maximum(0, x * key[0] - z * key[1] + y * key[2])
        radiance = self.ambient + self._gain * cosine**self.sharpness
        image = np.repeat(radiance[..., None], 3, axis=2).astype(np.float32)
        return {
            "type": "envmap",
            "bitmap": mi.Bitmap(image),
            "to_world": mi.ScalarTransform4f().rotate([1, 0, 0], 90),
        }

    def light(self) -> Light:
        """Return the same as directions; those of the key are denser in its middle."""
        towards = dome()
        constant = np.full((len(towards), 3), 4 * self.ambient / len(towards))
        # Drawn in proportion to the lobe: cos^(1 + sharpness) is uniform in [0, 1]
        share = (np.arange(_LOBE) + 0.5) / _LOBE
        cosine = share ** (1 / (1 + self.sharpness))
        angle, sine = np.arange(_LOBE) * _GOLDEN, np.sqrt(1 - cosine**2)
        around = np.stack([sine * np.cos(angle), sine * np.sin(angle), cosine], axis=1)
        strength = 2 * self._gain / (1 + self.sharpness) / _LOBE
        lobe = around @ _frame(self._key), np.full((_LOBE, 3), strength)
        return _add((towards, constant), lobe)

    @property
    def _key(self) -> np.ndarray:
        return np.array(self.key) / np.linalg.norm(self.key)

    @property
    def _gain(self) -> float:
        return (1 - self.ambient) * (self.sharpness + 2) / 2


def _frame(axis: np.ndarray) -> np.ndarray:
    """Return a rotation (3, 3) whose last row is a unit vector."""
    other = np.eye(3)[np.abs(axis).argmin()]
    first = np.cross(other, axis)
    first /= np.linalg.norm(first)
    return np.stack([first, np.cross(axis, first), axis])


@dataclass(frozen=True)
class Sunlight:
    """A sun, an even white sky and an even ground that both light.

    An unoccluded surface that faces the sun has outgoing luminance equal to its
    reflectance's.

    Args:
        elevation_deg: of the sun above the horizon.
        azimuth_deg: of the sun, clockwise from north, +y.
        share: of the sun in what lights a surface that faces it, the ground left out.
        colour_k: temperature of the sun's colour; 6500 is white.
    """

    elevation_deg: float
    azimuth_deg: float
    share: float
    colour_k: float = _WHITE_K

    def light(self, rotation: np.ndarray) -> Light:
        """Return the light as directions; the last is the sun.

        Args:
            rotation: (3, 3), from the frame of the directions to the world.
        """
        towards, (direct, sky, ground) = dome(), self._radiances
        is_sky = towards @ rotation[2] > 0  # the world's z
        radiance = np.where(is_sky, sky, ground)
        diffuse = np.repeat(radiance[:, None] * 4 / len(towards), 3, axis=1)
        colour = direct * black_body(self.colour_k)
        return _add((towards, diffuse), ((self._sun @ rotation)[None], colour[None]))

    def emitters(self) -> dict[str, Any]:
        """Describe the same as an `envmap` and, if it shines, a `directional` sun."""
        direct, sky, ground = self._radiances
        image = np.full((64, 128, 3), sky, np.float32)
        image[32:] = ground
        emitters: dict[str, Any] = {
            "dome": {
                "type": "envmap",
                "bitmap": mi.Bitmap(image),
                "to_world": mi.ScalarTransform4f().rotate([1, 0, 0], 90),  # z is up
            }
        }
        if direct > 0:
            irradiance = np.pi * direct * black_body(self.colour_k)
            emitters["sun"] = {
                "type": "directional",
                "direction": (-self._sun).tolist(),
                "irradiance": {"type": "rgb", "value": irradiance.tolist()},
            }
        return emitters

    @property
    def _sun(self) -> np.ndarray:
        return sun_direction(self.elevation_deg, self.azimuth_deg)

    @property
    def _radiances(self) -> tuple[float, float, float]:
        """Return a sun's `Light.strength`, and the radiances of sky and ground."""
        height = float(self._sun[2])
        # Of a sky of radiance 1, a surface that faces the sun sees (1 + height) / 2
        direct = self.share / (1 - self.share) * (1 + height) / 2
        ground = _ALBEDO * (1 + direct * height)
        luminance = direct + (1 + height) / 2 + ground * (1 - height) / 2
        return direct / luminance, 1 / luminance, ground / luminance


def black_body(temperature_k: float) -> np.ndarray:
    """Return the colour (3,) of a black body, of luminance 1; white at 6500 K."""

    def spectrum(kelvin: float) -> np.ndarray:
        return 1 / np.expm1(_SECOND_RADIATION / (_NM * kelvin))

    colour = spectrum(temperature_k) / spectrum(_WHITE_K)
    return colour / (_LUMINANCE @ colour)
