"""Steering angle and heading rate of the bicycle model, in NumPy alone.

Dr.Jit's models in `vehicle` have the same formula in their derivatives.
"""

from __future__ import annotations

from typing import Any

import numpy as np


def steering_angle(heading_rate: Any, speed: Any, wheelbase: float) -> Any:
    """Return the angle atan(l w / v) of the front wheels, radians.

    Args:
        heading_rate: w, radians per second.
        speed: v, metres per second, at least 0.
        wheelbase: l, metres.

    Source: appendix A.8.
    """
    return np.arctan2(wheelbase * heading_rate, speed)


def heading_rate(steering: Any, speed: Any, wheelbase: float) -> Any:
    """Return v tan(u) / l, radians per second; the inverse of `steering_angle`."""
    return speed * np.tan(steering) / wheelbase
