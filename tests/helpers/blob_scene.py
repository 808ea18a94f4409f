"""A soft blob before a camera of 12 x 8 pixels, for `field_integrator`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
from helpers import small_fields as small

from mi_nerfattack.fields import save_field


def T() -> Any:
    return mi.ScalarTransform4f()


def write_blob(folder: Path, rng: np.random.Generator) -> dict[str, Any]:
    """Write a blob in [-1, 1]^3, its border empty, and describe it as a volume."""
    path, field = folder / "blob.safetensors", small.blob(rng, step_m=0.05)
    small.empty_border(field)
    save_field(path, field)
    return {"type": "grid_field", "id": "blob", "filename": str(path)}


def load(
    nested: dict[str, Any], more: dict[str, Any] | None = None, **film: Any
) -> mi.Scene:
    """Load a scene with fields before the camera.

    Args:
        nested: of the integrator.
        more: objects of the scene, or others in their place.
        film: properties that differ.
    """
    view = T().look_at([-3.0, 0.2, 0.6], [0, 0, 0], [0, 0, 1])
    size = {"width": 12, "height": 8, "rfilter": {"type": "box"}}
    if film.get("type") != "specfilm":
        film = {"type": "hdrfilm", "pixel_format": "rgb", **film}
    sensor = {
        "type": "perspective",
        "id": "camera",
        "fov": 50,
        "to_world": view,
        "film": {**size, **film},
        "sampler": {"type": "independent", "sample_count": 4},
    }
    integrator = {"type": "field_integrator", "id": "fields", "stop": 0.0, **nested}
    scene = {"type": "scene", "i": integrator, "camera": sensor, **(more or {})}
    return mi.load_dict(scene, parallel=False)
