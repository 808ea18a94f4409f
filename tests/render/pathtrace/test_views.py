"""Views of scenes whose integrators can and cannot be recorded."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mi_nerfattack.render.camera.intrinsics import from_fov
from mi_nerfattack.render.pathtrace.views import ViewRenderer

pytestmark = pytest.mark.usefixtures("plugin")


@pytest.fixture
def plugin(variant: str) -> None:
    del variant

    class Counting(mi.SamplingIntegrator):
        """Paints what a ray hits, and counts how often it is traced."""

        def __init__(self, props: mi.Properties) -> None:
            super().__init__(props)
            self.gain, self.traced = mi.Float(1.0), 0
            self.reads = props.get("reads", False)
            self.fails = props.get("fails", False)

        def sample(
            self,
            scene: mi.Scene,
            sampler: mi.Sampler,
            ray: mi.RayDifferential3f,
            medium: mi.Medium | None = None,
            active: Any = True,
        ) -> tuple[mi.Color3f, mi.Bool, list[mi.Float]]:
            del sampler, medium
            self.traced += 1
            if self.fails:
                raise RuntimeError("of the plugin's own")
            gain = self.gain[0] if self.reads else self.gain
            hit = scene.ray_test(ray, active)
            return mi.Color3f(dr.select(hit, gain, 0)), hit, []

    mi.register_integrator("counting", Counting)


def _renderer(**keys: bool) -> ViewRenderer:
    ball = {"type": "sphere", "center": [0, 0, 4]}
    integrator = {"type": "counting", **keys}
    scene = mi.load_dict({"type": "scene", "integrator": integrator, "ball": ball})
    return ViewRenderer(scene, from_fov(24, 16, 40.0))


def _means(renderer: ViewRenderer) -> list[float]:
    """Render four views, each with twice the gain of the one before."""
    means = []
    for seed in range(4):
        renderer.scene.integrator().gain = mi.Float(2.0**seed)
        means.append(float(renderer.render(np.eye(4), 4, seed).rgb.mean()))
    return means


def test_launches_are_recorded_and_follow_the_scene() -> None:
    """What a plugin holds may change between views, although it is not traced again."""
    renderer = _renderer()
    means = _means(renderer)
    assert renderer.scene.integrator().traced <= 2
    np.testing.assert_allclose(means, means[0] * 2.0 ** np.arange(4), rtol=0.1)
    assert means[0] > 0.05


def test_an_integrator_that_reads_values_is_traced_each_time() -> None:
    """It gives the same views."""
    renderer = _renderer(reads=True)
    assert _means(renderer) == _means(_renderer())
    assert renderer.scene.integrator().traced >= 4


def test_no_mean_of_a_bitmap_is_left_to_the_recording() -> None:
    """It would evaluate all of them in one kernel, in an order of the process."""
    image = mi.TensorXf(np.full((4, 4, 3), 0.25))
    texture = {"type": "bitmap", "data": image, "raw": True}
    bsdf = {"type": "diffuse", "reflectance": texture}
    ball = {"type": "sphere", "center": [0, 0, 4], "bsdf": bsdf}
    scene = mi.load_dict({"type": "scene", "ball": ball})
    (found,) = [
        node
        for node in mi.traverse(scene).hierarchy
        if node.class_name().startswith("Bitmap")
    ]
    assert found.mean().state == dr.VarState.Unevaluated
    ViewRenderer(scene, from_fov(24, 16, 40.0))
    assert found.mean().state == dr.VarState.Evaluated


def test_errors_of_an_integrator_are_its_own() -> None:
    """Not those of a recording."""
    with pytest.raises(RuntimeError) as told:
        _renderer(fails=True).render(np.eye(4), 4, 0)
    causes = str(told.value), str(told.value.__cause__)
    assert any("of the plugin's own" in text for text in causes)
    assert "record" not in causes[0]
