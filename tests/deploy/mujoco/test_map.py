"""Materials of Mitsuba scenes as MuJoCo's textures; needs no OpenGL."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest

from mi_nerfattack.deploy.mujoco.map import read_meshes
from mi_nerfattack.errors import InputError

pytestmark = pytest.mark.usefixtures("variant")


def scene(shape) -> mi.Scene:
    return mi.load_dict({"type": "scene", "shape": shape})


def test_what_cannot_be_drawn_is_named():
    ball = {"type": "sphere", "id": "ball"}
    with pytest.raises(InputError, match="'ball'.*Sphere"):
        read_meshes(scene(ball))
    pane = {"type": "rectangle", "id": "pane", "bsdf": {"type": "thindielectric"}}
    with pytest.raises(InputError, match="'pane'.*transparent"):
        read_meshes(scene(pane))
    colours = {"type": "mesh_attribute", "name": "vertex_color"}
    painted = {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": colours}}
    with pytest.raises(InputError, match="'painted'.*MeshAttribute.*bake them"):
        read_meshes(scene({"type": "rectangle", "id": "painted", "bsdf": painted}))


def test_uniform_materials_have_one_colour():
    colour = {"type": "rgb", "value": [0.6, 0.2, 0.1]}
    dents = {"type": "bitmap", "bitmap": mi.Bitmap(np.ones((4, 2, 3), np.float32))}
    under = {"type": "diffuse", "reflectance": colour}
    for material in (
        {"type": "principled", "base_color": colour},
        {"type": "normalmap", "normalmap": dents | {"raw": True}, "bsdf": under},
    ):
        (mesh,) = read_meshes(scene({"type": "rectangle", "bsdf": material}))
        expected = np.broadcast_to([0.6, 0.2, 0.1], mesh.texture.shape)
        np.testing.assert_allclose(mesh.texture, expected, atol=1e-6)


@pytest.mark.parametrize("scale", [1.0, 1.01, 3.0])
@pytest.mark.parametrize("wrap", ["repeat", "clamp", "mirror"])
def test_images_that_do_not_repeat_end_where_their_coordinates_do(wrap, scale, rng):
    texels = rng.uniform(0.1, 0.9, (8, 8, 3)).astype(np.float32)
    image = {"type": "bitmap", "bitmap": mi.Bitmap(texels), "raw": True}
    image |= {"wrap_mode": wrap, "to_uv": mi.ScalarTransform4f().scale(scale)}
    shape = {"type": "rectangle", "id": "sheet"}
    shape["bsdf"] = {"type": "diffuse", "reflectance": image}
    if scale < 2 or wrap == "repeat":  # 1.01: less than a texel
        (mesh,) = read_meshes(scene(shape))
        np.testing.assert_allclose(mesh.uv.max(), scale, rtol=1e-6)
        np.testing.assert_allclose(mesh.texture, texels, atol=1e-3)
    else:
        message = "'sheet': coordinates reach 16.0 texels beyond .* set wrap_mode to"
        with pytest.raises(InputError, match=message):
            read_meshes(scene(shape))
