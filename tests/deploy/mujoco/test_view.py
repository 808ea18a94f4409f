"""MuJoCo's pictures of Mitsuba scenes against Mitsuba's and against known colours."""

from __future__ import annotations

import math
from dataclasses import replace

import mitsuba as mi
import numpy as np
import pytest
from support.faults.refusals import refusals

from mi_nerfattack.backend.colour import linear_to_uint8
from mi_nerfattack.deploy.mujoco import opengl
from mi_nerfattack.deploy.mujoco.light import read_lighting
from mi_nerfattack.deploy.mujoco.map import read_meshes
from mi_nerfattack.deploy.mujoco.view import MujocoView
from mi_nerfattack.errors import InputError
from mi_nerfattack.render.camera.intrinsics import from_fov, look_at
from mi_nerfattack.render.pathtrace.load import load_scene
from mi_nerfattack.render.pathtrace.views import ViewRenderer
from mi_nerfattack.scenes import bundled

pytestmark = pytest.mark.usefixtures("variant")
CAMERA = from_fov(48, 32, 60.0)
DOWN = look_at((0, 0, 4), (0, 0, 0))


def diffuse(colour) -> dict:
    reflectance = {"type": "rgb", "value": list(colour)}
    return {"type": "twosided", "b": {"type": "diffuse", "reflectance": reflectance}}


def placed(*translate, scale=1.0, turn=(0, 0, 1, 0)):
    t = mi.ScalarTransform4f
    turned = t().translate(translate or (0, 0, 0)) @ t().rotate(turn[:3], turn[3])
    return turned @ t().scale(scale)


def scene(*shapes, **emitters):
    """Load a scene of shapes, lit by a constant sky of radiance 0.5 unless told."""
    emitters = emitters or {"sky": {"type": "constant", "radiance": 0.5}}
    named_shapes = {f"shape_{i}": shape for i, shape in enumerate(shapes)}
    integrator = {"type": "path", "max_depth": 2}
    return mi.load_dict(
        {"type": "scene", "integrator": integrator, **named_shapes, **emitters}
    )


def ground(colour=(0.5, 0.25, 0.1)) -> dict:
    return {"type": "rectangle", "to_world": placed(scale=20), "bsdf": diffuse(colour)}


def picture(view: MujocoView, pose) -> np.ndarray:
    frame = view.render(pose, 0)
    view.close()
    return frame.image.astype(int)


@pytest.mark.parametrize("exposure_ev", [0.0, -1.0])
def test_level_ground_and_lamps_have_the_path_tracers_colour(gl, exposure_ev):
    colour = np.array([0.5, 0.25, 0.1])
    lamp = {"type": "rectangle", "to_world": placed(scale=20)}
    lamp["emitter"] = {"type": "area", "radiance": 0.8}
    # albedo E / pi with E = pi L
    for shape, light in ((ground(colour), colour * 0.5), (lamp, np.full(3, 0.8))):
        view = MujocoView(scene(shape), CAMERA, exposure_ev=exposure_ev)
        expected = linear_to_uint8((light * 2.0**exposure_ev).astype(np.float32))
        assert np.abs(picture(view, DOWN) - expected.astype(int)).max() <= 1


def sunny(*shapes):
    sun = {"type": "directional", "direction": [1, 0, -1], "irradiance": 2.0}
    return scene(*shapes, sun=sun, sky={"type": "constant", "radiance": 0.2})


def test_sun_and_shadow_have_the_path_tracers_colours(gl):
    box = {"type": "cube", "to_world": placed(0, 0, 1), "bsdf": diffuse((0.8,) * 3)}
    image = picture(
        MujocoView(sunny(ground(), box), CAMERA), look_at((0, 0, 9), (0,) * 3)
    )
    colour = np.array([0.5, 0.25, 0.1])
    lit = linear_to_uint8(colour * (0.2 + 2.0 * math.sqrt(0.5) / math.pi))
    shaded = linear_to_uint8(colour * 0.2)
    # seen from above +x is to the right: the sun shines from the left
    focal = CAMERA.fx / 9
    right = round(24 + 1.6 * focal), round(24 - 2.5 * focal)
    np.testing.assert_allclose(image[16, right[0]], shaded, atol=4)
    np.testing.assert_allclose(image[16, right[1]], lit, atol=4)


def quadrants() -> dict:
    """A wall with an own colour in each quarter, and another in the middle of one."""
    texels = np.full((8, 8, 3), 0.1, np.float32)
    texels[:4, :4, 0] = texels[4:, :4, 1] = texels[:4, 4:, 2] = 0.9
    texels[1:3, 5:7] = 0.9
    bitmap = {"type": "bitmap", "bitmap": mi.Bitmap(texels), "raw": True}
    bitmap |= {"filter_type": "nearest", "wrap_mode": "clamp"}
    wall = {"type": "twosided", "b": {"type": "diffuse", "reflectance": bitmap}}
    place = placed(0, 3, 1, turn=(1, 0, 0, 90))
    return {"type": "rectangle", "to_world": place, "bsdf": wall}


@pytest.mark.parametrize("eye", [(0.4, 0, 1.2), (-0.5, 6, 0.8)], ids=["front", "back"])
def test_texture_is_neither_mirrored_nor_upside_down(gl, eye):
    world = scene(quadrants())
    pose = look_at(eye, (0, 3, 1))
    ours = picture(MujocoView(world, CAMERA), pose)
    rendered = ViewRenderer(world, CAMERA).render(pose, 64, 0)
    theirs = linear_to_uint8(rendered.rgb).astype(int)
    difference = np.abs(ours - theirs).max(axis=2)
    assert np.median(difference) <= 3
    assert (difference < 20).mean() > 0.85  # all but the borders of texels
    mirrored = np.abs(ours[:, ::-1] - theirs).max(axis=2)
    assert (mirrored < 20).mean() < 0.7


def test_sky_is_where_mitsuba_has_it(gl, rng):
    texels = rng.uniform(0.1, 0.9, (4, 8, 3)).astype(np.float32)
    sky = {"type": "envmap", "bitmap": mi.Bitmap(texels)}
    world = scene(ground(), sky=sky)
    view, renderer = MujocoView(world, CAMERA), ViewRenderer(world, CAMERA)
    for target in ((1, 0, 2), (-1, 1, 3), (0, -1, 3), (0.1, 0, 9)):
        pose = look_at((0, 0, 1), target)
        frame, theirs = view.render(pose, 0), renderer.render(pose, 16, 0)
        outside = np.isinf(theirs.depth)
        assert outside.mean() > 0.5
        np.testing.assert_array_equal(np.isinf(frame.depth), outside)
        expected = linear_to_uint8(theirs.rgb).astype(int)
        assert np.abs(frame.image - expected)[outside].mean() < 2
    view.close()


@pytest.mark.parametrize(
    "change", [{}, {"fy": 2 * CAMERA.fy}, {"width": 32, "cx": 13.0, "cy": 9.0}]
)
def test_depth_is_the_distance_along_the_ray(gl, change):
    world, camera = scene(ground(), quadrants()), replace(CAMERA, **change)
    view = MujocoView(world, camera)
    pose = look_at((0.5, 0.2, 1.4), (0, 3, 0.6))
    frame = view.render(pose, 0)
    view.close()
    expected = ViewRenderer(world, camera).depth(pose)
    both = np.isfinite(expected) & np.isfinite(frame.depth)
    assert (np.isfinite(expected) == np.isfinite(frame.depth)).mean() > 0.99
    error = np.abs(frame.depth[both] - expected[both])
    assert np.median(error) < 1e-4
    assert np.quantile(error, 0.95) < 2e-3
    np.testing.assert_allclose(frame.camera_to_world, pose)


def test_frames_repeat_and_contexts_close(gl):
    world, pose = scene(ground(), quadrants()), look_at((0.5, 0.2, 1.4), (0, 3, 0.6))
    first, second = MujocoView(world, CAMERA), MujocoView(world, CAMERA)
    frames = [view.render(pose, seed) for seed, view in enumerate((first, second))]
    np.testing.assert_array_equal(frames[1].image, frames[0].image)
    np.testing.assert_array_equal(frames[1].depth, frames[0].depth)
    first.close()
    with pytest.raises(InputError, match="before close"):
        first.render(pose, 0)
    assert second.render(pose, 0).image.any()
    second.close()


def test_sun_is_told_from_the_sky():
    lighting = read_lighting(load_scene(bundled("intersection/scene.xml")))
    expected = np.array([-0.44, -0.50, 0.75]) / np.linalg.norm([-0.44, -0.50, 0.75])
    assert lighting.sun_direction @ expected > math.cos(math.radians(0.6))
    assert lighting.sun[0] > lighting.sun[2] and lighting.sky[2] > lighting.sky[0]


def test_lamps_without_extent_light_a_room():
    mast = {"type": "cube", "to_world": placed(0, 0, 1, scale=0.1)}
    lamp = {"type": "point", "position": [0, 0, 100], "intensity": 1e4}
    black = ground((0, 0, 0))
    lighting = read_lighting(scene(black, mast | {"bsdf": diffuse([0.1] * 3)}, l=lamp))
    np.testing.assert_allclose(lighting.sun + lighting.sky, 1.0, rtol=0.05)  # I / r^2


def shown(camera):
    return lambda: MujocoView(scene(ground()), camera).close()


test_cameras_that_opengl_has_not_are_refused = pytest.mark.usefixtures("gl")(
    refusals(
        (shown(replace(CAMERA, k1=0.1)), "distortion"),
        (shown(from_fov(40_000, 1, 60.0)), "camera: 40000 x 1 px"),
    )
)


def test_machines_without_opengl(gl, monkeypatch):
    monkeypatch.setattr(opengl.sys, "platform", "linux")
    monkeypatch.setenv(opengl.VARIABLE, "off")  # the user's choice stays
    with pytest.raises(InputError, match="MUJOCO_GL=off"):
        opengl.make_context(8, 8)
    monkeypatch.delenv(opengl.VARIABLE)
    monkeypatch.setattr(opengl, "_is_there", lambda library: False)
    with pytest.raises(InputError, match="libegl1.*libosmesa6.*'mujoco'"):
        opengl.make_context(8, 8)
    monkeypatch.setattr(opengl, "_is_there", lambda library: library == "OSMesa")
    assert opengl.backend() == "osmesa"
    monkeypatch.setattr(opengl.os, "getpid", lambda: -1)  # in a forked process
    with pytest.raises(InputError, match="'context': 'spawn'"):
        opengl.make_context(8, 8)


def one_shape(shape) -> mi.Scene:
    return mi.load_dict({"type": "scene", "shape": shape})


def meshes_of(**shape):
    return lambda: read_meshes(one_shape(shape))


CLEAR = {"type": "thindielectric"}
COLOURS = {"type": "mesh_attribute", "name": "vertex_color"}
PAINTED = {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": COLOURS}}
test_what_cannot_be_drawn_is_named = refusals(
    (meshes_of(type="sphere", id="ball"), "'ball'.*Sphere"),
    (meshes_of(type="rectangle", id="p", bsdf=CLEAR), "'p'.*transparent"),
    (meshes_of(type="rectangle", id="p", bsdf=PAINTED), "'p'.*MeshAttribute"),
)


@pytest.mark.parametrize("scale", [1.0, 1.01, 3.0])
@pytest.mark.parametrize("wrap", ["repeat", "clamp", "mirror"])
def test_images_that_do_not_repeat_end_where_their_coordinates_do(wrap, scale, rng):
    texels = rng.uniform(0.1, 0.9, (8, 8, 3)).astype(np.float32)
    image = {"type": "bitmap", "bitmap": mi.Bitmap(texels), "raw": True}
    image |= {"wrap_mode": wrap, "to_uv": mi.ScalarTransform4f().scale(scale)}
    shape = {"type": "rectangle", "id": "sheet"}
    shape["bsdf"] = {"type": "diffuse", "reflectance": image}
    if scale < 2 or wrap == "repeat":  # 1.01: less than a texel
        (mesh,) = read_meshes(one_shape(shape))
        np.testing.assert_allclose(mesh.uv.max(), scale, rtol=1e-6)
        np.testing.assert_allclose(mesh.texture, texels, atol=1e-3)
    else:
        with pytest.raises(InputError, match="'sheet': .* 16.0 texels .* wrap_mode"):
            read_meshes(one_shape(shape))
