"""What a frame says about itself, as text in its EXR file."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

import mitsuba as mi
import numpy as np

from mi_nerfattack.backend.versions import versions
from mi_nerfattack.render.camera.intrinsics import Camera

POSE_CONVENTION = (
    "camera.to_world: 4x4, row by row; columns right, down, forward, position "
    "(OpenCV); world right-handed, z up, metres"
)


def describe_lens(camera: Camera) -> dict[str, Any]:
    """Return intrinsics as JSON can say them."""
    return {"type": "OPENCV", **asdict(camera)}


def frame_metadata(
    lens: Mapping[str, Any],
    camera_to_world: np.ndarray,
    seed: int,
    spp: int | None,
    digests: Mapping[str, str],
    **more: Any,
) -> dict[str, str]:
    """Describe a frame: where it was seen from, and what it was made of.

    Args:
        lens: from `describe_lens`, or whatever describes another one.
        camera_to_world: (4, 4), OpenCV axes, metres.
        seed: of what is random in it.
        spp: samples per pixel; None where the frame is not made of samples.
        digests: SHA-256 of what it shows, by name.
        more: whatever else is known, as JSON can say it, e.g. ``time_s=0.4``; None is
            left out.

    Returns:
        by name, JSON but for what is text itself: ``camera`` with its ``to_world``,
        ``pose_convention``, ``seed``, ``spp``, ``variant``, ``versions``, ``digests``
        and `more`.
    """
    # nine digits tell all 32-bit numbers apart; no -0
    rows = [[float(f"{value + 0:.9g}") for value in row] for row in camera_to_world]
    found = {
        "camera": {**lens, "to_world": rows},
        "pose_convention": POSE_CONVENTION,
        "seed": seed,
        "spp": spp,
        "variant": mi.variant(),
        "versions": versions(),
        "digests": dict(sorted(digests.items())),
        **more,
    }
    return {
        name: value if isinstance(value, str) else json.dumps(value)
        for name, value in found.items()
        if value is not None
    }
