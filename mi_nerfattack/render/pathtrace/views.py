"""Render posed views of Mitsuba scenes: colour, opacity and depth.

The renderer keeps one sensor and moves it from view to view. It compiles nothing after
the first view, and no reconstruction filter crosses from one view into the next. A
scene with Mitsuba's `batch` sensor must be built again for other poses, and its kernels
must be compiled again.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_nerfattack.backend.freeze import freeze_method
from mi_nerfattack.backend.versions import versions
from mi_nerfattack.errors import InputError, SetupError
from mi_nerfattack.render.camera.conventions import (
    mitsuba_sensor_dict,
    opencv_to_mitsuba,
    to_colmap,
)
from mi_nerfattack.render.camera.intrinsics import Camera
from mi_nerfattack.render.camera.lens import generate_rays, pose_arrays

POSE_CONVENTION = (
    "camera.to_world: 4x4, row by row; columns right, down, forward, position "
    "(OpenCV); world right-handed, z up, metres"
)


def describe_lens(camera: Camera) -> dict[str, Any]:
    """Return intrinsics as JSON can say them."""
    model, values = to_colmap(camera)
    return {"type": model, **values}


def frame_metadata(
    lens: Mapping[str, Any],
    camera_to_world: np.ndarray,
    seed: int,
    spp: int | None,
    digests: Mapping[str, str],
    **details: Any,
) -> dict[str, str]:
    """Describe a frame: where it was seen from, and what it was made of.

    Args:
        lens: from `describe_lens`, or whatever describes another one.
        camera_to_world: (4, 4), OpenCV axes, metres.
        seed: of what is random in it.
        spp: samples per pixel; None where the frame is not made of samples.
        digests: SHA-256 of what it shows, by name.
        details: whatever else is known, as JSON can say it, e.g. ``time_s=0.4``; None
            is left out.

    Returns:
        by name, as JSON, or unchanged where a value is text: ``camera`` with its
        ``to_world``, ``pose_convention``, ``seed``, ``spp``, ``variant``, ``versions``,
        ``digests`` and `details`.
    """
    # nine digits tell all 32-bit numbers apart; no -0
    rows = [[float(f"{value + 0:.9g}") for value in row] for row in camera_to_world]
    metadata = {
        "camera": {**lens, "to_world": rows},
        "pose_convention": POSE_CONVENTION,
        "seed": seed,
        "spp": spp,
        "variant": mi.variant(),
        "versions": versions(),
        "digests": dict(sorted(digests.items())),
        **details,
    }
    # JSON, but text as it is; an entry without a value is left out
    return {
        name: value if isinstance(value, str) else json.dumps(value)
        for name, value in metadata.items()
        if value is not None
    }


@dataclass(frozen=True, eq=False)
class View:
    """One rendered view, linear Rec.709.

    Args:
        rgb: (height, width, 3), float32, premultiplied by alpha.
        alpha: (height, width), float32, share of samples that hit a surface (or an
            environment emitter, unless the integrator hides emitters).
        depth: (height, width), float32, metres from the camera along the ray through
            the pixel's centre to the first surface, infinite where there is none.
            A surface with a partly transparent `mask` counts as solid.
    """

    rgb: np.ndarray
    alpha: np.ndarray
    depth: np.ndarray


def require_colour() -> None:
    """Raise SetupError in a monochromatic variant: its film has no opacity."""
    if mi.is_monochromatic:
        raise SetupError(
            f"variant {mi.variant()!r}: views need colour and opacity; set "
            "MI_NERFATTACK_VARIANT=llvm_ad_rgb"
        )


class ViewRenderer:
    """Renders one scene with one camera from any number of poses.

    After the first view no kernel is compiled, and after the second (of one number of
    samples) none is traced, unless a plugin of the scene reads values while it is
    traced. So arrays of the scene may change between views; what a plugin holds as
    plain numbers of Python is that of the first. Not differentiable.

    Args:
        scene: any scene; its own sensors are ignored.
        camera: intrinsics.
        integrator: `mi.Integrator` for colour; None for the scene's own.
    """

    def __init__(self, scene: Any, camera: Camera, integrator: Any = None) -> None:
        film = {"pixel_format": "rgba"}
        self.scene, self.camera = scene, camera
        self._integrator = scene.integrator() if integrator is None else integrator
        self._sensor = mi.load_dict(
            mitsuba_sensor_dict(camera, np.eye(4), spp=1, film=film)
        )
        self._parameters = mi.traverse(self._sensor)
        _evaluate_means(scene)
        self._frozen: Callable[..., Any] | None
        self._frozen = freeze_method(self._record, self._state)

    def render(self, camera_to_world: np.ndarray, spp: int, seed: int) -> View:
        """Render one view.

        Args:
            camera_to_world: (4, 4), OpenCV axes, metres.
            spp: samples per pixel, at least 1; rounded up to a grid (32 to 35).
            seed: of the samples, in [0, 2^32).
        """
        require_colour()
        to_world = mi.Transform4f(opencv_to_mitsuba(camera_to_world))
        dr.make_opaque(to_world)
        self._parameters["to_world"] = to_world
        self._parameters.update()
        image = self._launch(_grid_samples(spp), dr.opaque(mi.UInt32, seed)).numpy()
        return View(image[..., :3], image[..., 3], self.depth(camera_to_world))

    def _launch(self, spp: int, seed: mi.UInt32) -> mi.TensorXf:
        """Replay the launch, or trace it where it cannot be recorded."""
        if self._frozen is not None:
            try:
                return self._frozen(spp, seed)
            except RuntimeError:  # a plugin that reads values; or its own error, below
                self._frozen = None
        return self._record(spp, seed)

    def _record(self, spp: int, seed: mi.UInt32) -> mi.TensorXf:
        return mi.render(
            self.scene,
            sensor=self._sensor,
            integrator=self._integrator,
            spp=spp,
            seed=seed,
        )

    def _state(self, spp: int, seed: mi.UInt32) -> list[Any]:
        del spp, seed
        return [self.scene, self._sensor, self._integrator]

    def depth(self, camera_to_world: np.ndarray) -> np.ndarray:
        """Return the depth image alone; see `View.depth`."""
        o, d = generate_rays(self.camera, *pose_arrays(camera_to_world), 1)
        t = self.scene.ray_intersect_preliminary(mi.Ray3f(o, d), coherent=True).t
        return t.numpy().reshape(self.camera.height, self.camera.width)


def _evaluate_means(scene: Any) -> None:
    """Evaluate the means of bitmaps, which Mitsuba leaves pending.

    A recording would evaluate all of them in one kernel, in an order that differs from
    process to process.
    """
    for node in mi.traverse(scene).hierarchy:
        if node.class_name().startswith("BitmapTexture"):
            dr.eval(node.mean())


def _grid_samples(spp: int) -> int:
    """Round up as the `multijitter` sampler does, which warns where it has to."""
    if spp < 1:
        raise InputError(f"spp: {spp}; must be at least 1")
    rows = math.isqrt(spp)
    return rows * -(-spp // rows)


def iterate_views(
    scene: Any,
    camera: Camera,
    camera_to_world: np.ndarray,
    spp: int,
    seed: int,
    integrator: Any = None,
) -> Iterator[View]:
    """Render a scene from n poses, one after the other.

    Args:
        scene: any scene; its own sensors are ignored.
        camera: intrinsics.
        camera_to_world: (n, 4, 4), OpenCV axes, metres.
        spp: samples per pixel.
        seed: each view has samples of its own derived from it.
        integrator: `mi.Integrator`; None for the scene's own.
    """
    renderer = ViewRenderer(scene, camera, integrator)
    seeds = view_seeds(seed, len(camera_to_world))
    for matrix, view_seed in zip(camera_to_world, seeds, strict=True):
        yield renderer.render(matrix, spp, view_seed)


def view_seeds(seed: int, n: int) -> list[int]:
    """Return the seeds of the samples of n views."""
    return np.random.SeedSequence(seed).generate_state(n).tolist()
