"""Bricks as a volume: loaded from XML, shown like their field, and what is refused."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from helpers import small_fields as small

from mi_nerfattack.errors import InputError
from mi_nerfattack.fields import (
    BrickField,
    NGPField,
    Occupancy,
    load_field,
    save_field,
)
from mi_nerfattack.render.posed import PosedField

pytestmark = pytest.mark.usefixtures("variant")


@pytest.fixture
def path(tmp_path: Path, variant: str, rng: np.random.Generator) -> Path:
    """A file of bricks in [-1, 1]^3."""
    path = tmp_path / "bricks.safetensors"
    save_field(path, small.small_bricks(rng))
    return path


def volume_of(posed: PosedField) -> mi.Volume:
    """Make the volume ``scene`` of a loaded field."""
    from mi_nerfattack.plugins import loaded  # of the variant

    return loaded.volume_of(posed, "scene")


def scene(volume: Any, **options: Any) -> mi.Scene:
    """Load bricks before a camera that looks at them from 3 m."""
    t = mi.ScalarTransform4f()
    film = {"type": "hdrfilm", "width": 24, "height": 16, "pixel_format": "rgb"}
    sensor = {
        "type": "perspective",
        "fov": 50,
        "to_world": t.look_at([-3, 0.2, 0.5], [0, 0, 0], [0, 0, 1]),
        "film": film | {"rfilter": {"type": "box"}},
    }
    integrator = {"type": "field_integrator", "id": "fields", **options}
    nested = integrator | {"scene": volume}
    described = {"type": "scene", "integrator": nested, "sensor": sensor}
    return mi.load_dict(described, parallel=False)


def test_the_file_and_the_field_in_memory_are_seen_alike_before_the_sky(path):
    """A volume of a file, and one that shares a loaded field; the corners show sky."""
    described = {"type": "brick_field", "filename": str(path)}
    field = load_field(path)
    assert isinstance(field, BrickField)
    shared = volume_of(PosedField(field))
    images = [mi.render(scene(v), spp=1).numpy() for v in (described, shared)]
    np.testing.assert_allclose(*images, atol=1e-6)
    opaque = mi.render(scene(described, aovs=True), spp=1).numpy()[..., 3]
    sky = images[0][opaque == 0]
    assert len(sky) > 10 and sky.std() > 0.01 and opaque.max() > 0.9


def test_density_has_a_bound_and_follows_the_scale(path, rng):
    t = mi.ScalarTransform4f().scale(2)
    described = {"type": "brick_field", "filename": str(path), "to_world": t}
    volume, field = mi.load_dict(described), load_field(path)
    place = rng.uniform(-2, 2, (4000, 3)).astype(np.float32)
    it = dr.zeros(mi.Interaction3f, len(place))
    it.p = mi.Point3f(place.T.copy())
    found = volume.eval_1(it).numpy()
    local = mi.Point3f((place / 2).T.copy())
    wanted = field.eval(local, mi.Vector3f(0, 0, 1), mi.Bool(True))[0].numpy() / 2
    np.testing.assert_allclose(found, wanted, rtol=1e-4)
    assert 0 < found.max() <= volume.max() < 3 * found.max()
    assert str(volume).startswith("brick_field[") and "quantity=density" in str(volume)


def test_what_has_no_derivative_is_refused(path):
    described = {"type": "brick_field", "filename": str(path)}
    loaded = scene(described)
    params = mi.traverse(loaded)
    key = "fields.scene.to_world"
    assert params.flags(key) & mi.ParamFlags.NonDifferentiable.value
    dr.enable_grad(params[key].matrix)
    params.update()
    image = mi.render(loaded, params, spp=1)
    with pytest.raises(InputError, match="brick_field: .* keep the camera detached"):
        dr.backward(dr.mean(image))
    with pytest.raises(RuntimeError, match="cannot be relit; set relit to false"):
        mi.load_dict({**described, "relit": True})


def thin_ngp() -> NGPField:
    """Return an NGP of which every second octant is thin."""
    ngp = small.small_ngp()
    cells = np.zeros((8, 8, 8), bool)
    cells[1:-1, 1:-1, 1:-1] = True
    ngp.occupy(Occupancy(cells, np.full(cells.shape, 0b01010101, np.uint8)))
    return ngp


def test_thin_parts_that_are_skipped_have_no_derivative_by_a_pose(tmp_path):
    """Also in the image: a file that is loaded with `skip_thin` shows fewer parts."""
    ngp = thin_ngp()
    path = tmp_path / "ngp.safetensors"
    save_field(path, ngp)
    described = {"type": "ngp_field", "filename": str(path)}
    whole, thin, same = (
        mi.render(scene(volume), spp=1).numpy()
        for volume in (
            described,
            {**described, "skip_thin": True},
            volume_of(PosedField(ngp)),
        )
    )
    assert np.abs(whole - thin).max() > 0.01
    np.testing.assert_allclose(thin, same, atol=1e-3)  # files have half precision
    loaded = scene(volume_of(PosedField(ngp)))
    params = mi.traverse(loaded)
    dr.enable_grad(params["fields.scene.to_world"].matrix)
    with pytest.raises(InputError, match="skip thin parts .* set skip_thin to false"):
        params.update()
    ngp.see_all()
    params.update()
