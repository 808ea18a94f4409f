"""How a hand holds a phone while its owner walks through the room."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from mi_nerfattack.render.camera.intrinsics import Camera, from_fov, look_at

WIDTH, HEIGHT, FOV_DEG = 640, 360, 65.0
SHUTTER_S = 1 / 50
_ROUNDS = 1.5  # in the film
_RADIUS = np.array([1.75, 1.45])  # of the walk, along x and y, metres
_EYE, _TARGET = 1.5, 0.65  # heights, metres
_GLANCE = 0.5  # radians that the gaze goes to either side of the room's middle
_SWAY_M, _TREMOR_M = 0.02, 0.002  # standard deviations, of the walk and of the hand
_SWAY_DEG, _TREMOR_DEG = 0.8, 0.12
_ROLL_DEG = 6.0
_EXPOSURE_EV = 0.25
_GAZE, _SLOW = (0.02, 0.08), (0.05, 0.25)  # Hz
_STEPS, _TREMOR = (0.6, 1.8), (4.0, 9.0)
_WAVES = 6


def phone() -> Camera:
    """Return the phone's camera."""
    return from_fov(WIDTH, HEIGHT, FOV_DEG)


class Walk:
    """Poses and exposures of a film at any time; smooth, and of one seed.

    One and a half rounds through the room, across which the phone looks, to and fro.
    It sways with the steps, trembles in the hand, and rolls about its axis.

    Args:
        seconds: of the film.
        seed: of what is random.
    """

    def __init__(self, seconds: float, seed: int) -> None:
        rng = np.random.default_rng(seed)
        self.seconds = seconds
        self._place = [_Noise(rng, 3, _STEPS), _Noise(rng, 3, _TREMOR)]
        self._turn = [_Noise(rng, 3, _STEPS), _Noise(rng, 3, _TREMOR)]
        self._roll, self._exposure = _Noise(rng, 1, _SLOW), _Noise(rng, 1, _SLOW)
        self._glance = _Noise(rng, 1, _GAZE)

    def pose(self, time_s: float) -> np.ndarray:
        """Return camera_to_world (4, 4), OpenCV axes, metres."""
        angle = 2 * np.pi * _ROUNDS * time_s / self.seconds
        eye = np.array([*(_RADIUS * [np.cos(angle), np.sin(angle)]), _EYE])
        sway, tremor = (noise.at(time_s) for noise in self._place)
        eye = eye + _SWAY_M * sway + _TREMOR_M * tremor
        gaze = angle + np.pi + _GLANCE * self._glance.at(time_s)[0]
        ahead = np.array([np.cos(gaze), np.sin(gaze)])
        pose = look_at(eye, np.array([*(eye[:2] + 1.7 * ahead), _TARGET]))
        sway, tremor = (noise.at(time_s) for noise in self._turn)
        turn = _SWAY_DEG * sway + _TREMOR_DEG * tremor
        turn[2] += _ROLL_DEG * self._roll.at(time_s)[0]
        pose[:3, :3] = pose[:3, :3] @ Rotation.from_rotvec(turn, True).as_matrix()
        return pose

    def exposure(self, time_s: float) -> float:
        """Return the factor of linear radiance; 1 on average."""
        return float(2 ** (_EXPOSURE_EV * self._exposure.at(time_s)[0]))


class _Noise:
    """Sums of waves of random frequencies and phases, of standard deviation 1."""

    def __init__(
        self, rng: np.random.Generator, count: int, band_hz: tuple[float, float]
    ) -> None:
        self._speed = 2 * np.pi * rng.uniform(*band_hz, (count, _WAVES))
        self._phase = rng.uniform(0, 2 * np.pi, (count, _WAVES))

    def at(self, time_s: float) -> np.ndarray:
        waves = np.sin(self._speed * time_s + self._phase)
        return waves.sum(1) * np.sqrt(2 / _WAVES)
