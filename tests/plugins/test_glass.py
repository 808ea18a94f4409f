"""Fields with glass, metal and a billboard: the example's derivatives are right."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from helpers import toy_loop as toy
from helpers.derivatives import central_difference

from mi_nerfattack.fields import GridLayout, save_field
from mi_nerfattack.fields.occupancy import Occupancy

EXAMPLE = Path(__file__).parents[2] / "docs" / "examples" / "glass.xml"
SPP = 128

pytestmark = [pytest.mark.usefixtures("variant"), pytest.mark.slow]


@pytest.fixture
def scene(variant: str, tmp_path: Path) -> mi.Scene:
    """The example with a soft object: differences need edges wider than a step."""
    field = toy.blob(GridLayout(3, 6, 12), 0.4, 3.5, 0.02, 2)
    field.lower, field.upper = (x + [0, 0, 0.4] for x in (field.lower, field.upper))
    cells = np.zeros((16, 16, 16), bool)
    cells[1:-1, 1:-1, 1:-1] = True  # the pose has derivatives if the border is empty
    field.occupy(Occupancy(cells))
    red = np.tile(np.float32([0.8, -0.8, -0.8]), (field.n_vertices, 1))
    field.set_parameter("texture", red)
    save_field(tmp_path / "soft.safetensors", field)
    size = {"width": 24, "height": 12}
    soft = str(tmp_path / "soft.safetensors")
    return mi.load_file(str(EXAMPLE), object=soft, parallel=False, **size)


def loss(image: Any) -> Any:
    """Weigh the pixels, linearly: noise of two passes cancels."""
    height, width, _ = image.shape
    row, column, _ = np.mgrid[:height, :width, :1]
    weight = ((column + 0.3 * row) / width).astype(np.float32)
    return dr.mean(image * mi.TensorXf(weight), axis=None)


def turned(s: Any, base: Any) -> Any:
    step = mi.AffineTransform4f().translate([0.3 * s, s, 0])
    return step @ base


def painted(s: Any, base: Any) -> Any:
    rng = np.random.default_rng(2)
    along = rng.uniform(0, 1, base.shape).astype(np.float32)
    values = dr.detach(base).numpy()
    return base + s * mi.TensorXf(along * values * (1 - values))


@pytest.mark.parametrize(
    ("key", "change", "step"),
    [
        ("hydrant.colour", painted, 0.1),
        ("board.bsdf.brdf_0.reflectance.data", painted, 0.1),
        ("hydrant.to_world", turned, 2e-2),
    ],
    ids=["texture", "bitmap", "pose"],
)
def test_derivatives_are_those_of_differences(scene, key, change, step) -> None:
    params = mi.traverse(scene)
    base = type(params[key])(params[key])

    def value(s: Any) -> Any:
        params[key] = change(s, base)
        params.update()
        seeds = {"seed": 5, "seed_grad": 7} if dr.grad_enabled(s) else {"seed": 7}
        return loss(mi.render(scene, params, spp=SPP, **seeds))

    number = mi.Float(0)
    dr.enable_grad(number)
    dr.backward(value(number))
    found = float(dr.grad(number)[0])
    expected = central_difference(
        lambda s: float(dr.detach(value(mi.Float(s))).array[0]), step
    )
    assert abs(expected) > 1e-4
    assert found == pytest.approx(expected, rel=2e-2)
