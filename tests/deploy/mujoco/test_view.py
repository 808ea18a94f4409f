"""MuJoCo's pictures of Mitsuba scenes against Mitsuba's and against known colours."""

from __future__ import annotations

import math
import subprocess
import sys
from dataclasses import replace

import mitsuba as mi
import mujoco
import numpy as np
import pytest

from mi_nerfattack.backend.colour import linear_to_uint8
from mi_nerfattack.deploy.built_in import BuiltInObject
from mi_nerfattack.deploy.car import SMALL_CAR
from mi_nerfattack.deploy.mujoco import opengl
from mi_nerfattack.deploy.mujoco.light import read_lighting
from mi_nerfattack.deploy.mujoco.spec import world_spec, write_mjcf
from mi_nerfattack.deploy.mujoco.view import MujocoView
from mi_nerfattack.errors import InputError
from mi_nerfattack.render.camera.intrinsics import (
    CameraMount,
    from_fov,
    look_at,
    mount_matrix,
)
from mi_nerfattack.render.camera.pose import Pose
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
    return (
        t().translate(translate or (0, 0, 0))
        @ t().rotate(turn[:3], turn[3])
        @ t().scale(scale)
    )


def scene(*shapes, **emitters):
    """Load a scene of shapes, lit by a constant sky of radiance 0.5 unless told."""
    emitters = emitters or {"sky": {"type": "constant", "radiance": 0.5}}
    parts = {f"shape_{i}": shape for i, shape in enumerate(shapes)}
    integrator = {"type": "path", "max_depth": 2}
    return mi.load_dict(
        {"type": "scene", "integrator": integrator, **parts, **emitters}
    )


def ground(colour=(0.5, 0.25, 0.1)) -> dict:
    return {"type": "rectangle", "to_world": placed(scale=20), "bsdf": diffuse(colour)}


def picture(view: MujocoView, pose) -> np.ndarray:
    frame = view.render(pose, 0)
    view.close()
    return frame.image.astype(int)


@pytest.mark.parametrize("exposure_ev", [0.0, -1.0])
def test_level_ground_has_the_path_tracers_colour(gl, exposure_ev):
    colour = np.array([0.5, 0.25, 0.1])
    view = MujocoView(scene(ground(colour)), CAMERA, exposure_ev=exposure_ev)
    # albedo E / pi with E = pi L
    expected = linear_to_uint8(colour * 0.5 * 2.0**exposure_ev)
    assert np.abs(picture(view, DOWN) - expected).max() <= 1


def test_exposure_multiplies_what_lamps_show(gl):
    lamp = {"type": "rectangle", "to_world": placed(scale=20)}
    lamp["emitter"] = {"type": "area", "radiance": 0.8}
    for exposure_ev in (0.0, -2.0):
        view = MujocoView(scene(lamp), CAMERA, exposure_ev=exposure_ev)
        expected = linear_to_uint8(np.float32(0.8 * 2.0**exposure_ev))
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
    bitmap = {
        "type": "bitmap",
        "bitmap": mi.Bitmap(texels),
        "raw": True,
        "filter_type": "nearest",
        "wrap_mode": "clamp",
    }
    wall = {"type": "diffuse", "reflectance": bitmap}
    return {
        "type": "rectangle",
        "to_world": placed(0, 3, 1, turn=(1, 0, 0, 90)),
        "bsdf": {"type": "twosided", "b": wall},
    }


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


def test_built_in_object_stands_where_its_pose_says(gl):
    vertices = np.array([(-1, 0, -1), (1, 0, -1), (1, 0, 1), (-1, 0, 1)], np.float64)
    uv = np.array([(0, 0), (1, 0), (1, 1), (0, 1)], np.float64)
    texels = np.zeros((16, 16, 3), np.uint8)
    texels[:8, :8], texels[8:, 8:] = (200, 40, 40), (40, 40, 200)
    turn = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    item = BuiltInObject(
        vertices,
        np.array([[0, 1, 2], [0, 2, 3]]),
        uv,
        texels,
        Pose(turn, np.array([3.0, 0, 1.5]), 0.5),
    )
    world = scene(ground(), sky={"type": "constant", "radiance": 1.0})
    view = MujocoView(world, CAMERA, [item])
    frame = view.render(look_at((6, 0, 1.5), (3, 0, 1.5)), 0)
    view.close()
    assert frame.depth[16, 24] == pytest.approx(3.0, abs=5e-3)
    # The turn brings the object's x to y, which is on the right looking against x; v
    # points up in the object.
    reach = 0.25 * CAMERA.fx / 3
    columns = [round(23.5 - reach), round(23.5 + reach)]
    rows = [round(15.5 - reach), round(15.5 + reach)]
    expected = texels[np.ix_([4, 12], [4, 12])]
    found = frame.image[np.ix_(rows, columns)].astype(int)
    np.testing.assert_allclose(found, expected, atol=3)


def test_frames_repeat_and_contexts_close(gl):
    world = scene(ground(), quadrants())
    pose = look_at((0.5, 0.2, 1.4), (0, 3, 0.6))
    first, second = MujocoView(world, CAMERA), MujocoView(world, CAMERA)
    frames = [view.render(pose, seed) for seed, view in enumerate((first, second))]
    frames.append(first.render(pose, 5))
    for frame in frames[1:]:
        np.testing.assert_array_equal(frame.image, frames[0].image)
        np.testing.assert_array_equal(frame.depth, frames[0].depth)
    first.close()
    first.close()
    with pytest.raises(InputError, match="before close"):
        first.render(pose, 0)
    assert second.render(pose, 0).image.any()
    second.close()


@pytest.mark.slow
def test_process_ends_without_a_word(gl):
    code = (
        "import mi_nerfattack, mitsuba as mi, numpy as np\n"
        "mi.set_variant('llvm_ad_rgb')\n"
        "from mi_nerfattack.deploy.mujoco.view import MujocoView\n"
        "from mi_nerfattack.render.camera.intrinsics import from_fov\n"
        "s = mi.load_dict({'type': 'scene', 'a': {'type': 'rectangle'},\n"
        "                  'e': {'type': 'constant'}})\n"
        "view = MujocoView(s, from_fov(8, 8, 60.0))\n"
        "other = MujocoView(s, from_fov(8, 8, 60.0))\n"
        "view.render(np.eye(4), 0); del other\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=120
    )
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


@pytest.mark.slow
def test_bundled_intersection_agrees_in_depth_and_brightness(gl):
    world = load_scene(bundled("intersection/scene.xml"))
    camera = from_fov(100, 33, 90.0)
    view, renderer = MujocoView(world, camera), ViewRenderer(world, camera)
    states = np.array([[-12, -1.75, 0], [1.75, -25, math.pi / 2], [0, 0, 2.5]])
    for pose in mount_matrix(states, CameraMount()):
        frame, theirs = view.render(pose, 0), renderer.render(pose, 16, 0)
        both = np.isfinite(frame.depth) & np.isfinite(theirs.depth)
        error = np.abs(frame.depth[both] - theirs.depth[both])
        assert np.median(error) < 1e-3  # metres; 0.05 mm was measured
        assert np.quantile(error, 0.9) < 0.01
        assert (np.isfinite(frame.depth) == np.isfinite(theirs.depth)).mean() > 0.99
        expected = linear_to_uint8(theirs.rgb).astype(float)
        difference = np.abs(frame.image - expected)
        assert difference.mean() < 20
        assert np.median(difference) < 8
        assert abs(frame.image.mean() - expected.mean()) < 8
    view.close()


@pytest.mark.slow
def test_room_is_as_bright_as_its_lamps_make_it(gl):
    room, camera = load_scene(bundled("room/scene.xml")), from_fov(100, 33, 90.0)
    lighting = read_lighting(room)
    assert not lighting.has_shadows
    assert (lighting.sky > 0.1).all() and (lighting.sun >= 0).all()
    view, renderer = MujocoView(room, camera), ViewRenderer(room, camera)
    states = np.array([[-0.2, -1.6, 0], [1.6, -0.2, math.pi / 2], [0.2, 1.6, math.pi]])
    for pose in mount_matrix(states, CameraMount(0.2, 0.3, 10.0)):
        expected = linear_to_uint8(renderer.render(pose, 16, 0).rgb).astype(float)
        image = view.render(pose, 0).image
        assert abs(image.mean() - expected.mean()) < 12
        floor = np.abs(image[-10:].mean((0, 1)) - expected[-10:].mean((0, 1)))
        assert floor.max() < 12
    view.close()


def test_sun_is_told_from_the_sky():
    lighting = read_lighting(load_scene(bundled("intersection/scene.xml")))
    expected = np.array([-0.44, -0.50, 0.75]) / np.linalg.norm([-0.44, -0.50, 0.75])
    assert lighting.sun_direction @ expected > math.cos(math.radians(0.6))
    assert lighting.sun[0] > lighting.sun[2]  # warm
    assert lighting.sky[2] > lighting.sky[0]  # blue


def test_lamps_without_extent_light_a_room():
    mast = {"type": "cube", "to_world": placed(0, 0, 1, scale=0.1)}
    lamp = {"type": "point", "position": [0, 0, 100], "intensity": 1e4}
    black = ground((0, 0, 0))
    lighting = read_lighting(scene(black, mast | {"bsdf": diffuse([0.1] * 3)}, l=lamp))
    np.testing.assert_allclose(lighting.sun + lighting.sky, 1.0, rtol=0.05)  # I / r^2


def test_map_and_car_in_one_model():
    spec = world_spec(scene(ground()), SMALL_CAR)
    model = spec.compile()
    data = mujoco.MjData(model)
    for _ in range(200):
        mujoco.mj_step(model, data)
    # the drawn ground is not what it stands on, and nothing is in its way
    assert abs(data.body("car").xpos[2]) < 1e-3
    assert model.geom("000_shape_0").matid[0] >= 0  # the map is drawn, too


def test_written_model_is_read_by_mujoco(tmp_path, rng):
    texels = rng.uniform(0.1, 0.9, (4, 8, 3)).astype(np.float32)
    sky = {"type": "envmap", "bitmap": mi.Bitmap(texels)}
    spec = world_spec(scene(quadrants(), sky=sky), SMALL_CAR)
    expected = spec.compile()
    written = write_mjcf(tmp_path / "model", spec)
    assert [path.name for path in written[1:]] == ["texture_001.png", "model.xml"]
    found = mujoco.MjModel.from_xml_path(str(written[-1]))
    for key in ("tex_data", "tex_type", "geom_type", "geom_matid", "mesh_face"):
        np.testing.assert_array_equal(getattr(found, key), getattr(expected, key), key)
    for key in ("body_mass", "eq_data", "actuator_gainprm", "mesh_vert", "light_dir"):
        np.testing.assert_allclose(
            getattr(found, key), getattr(expected, key), rtol=1e-4, atol=1e-6
        )
    assert spec.textures[0].file == ""


def test_distorted_camera_is_refused():
    with pytest.raises(InputError, match="distortion"):
        MujocoView(scene(ground()), replace(CAMERA, k1=0.1))


def test_images_larger_than_opengl_draws_are_refused(gl):
    camera = from_fov(40_000, 1, 60.0)
    with pytest.raises(InputError, match="camera: 40000 x 1 px.*smaller image"):
        MujocoView(scene(ground()), camera)


def test_machine_without_opengl(monkeypatch):
    monkeypatch.delenv(opengl.VARIABLE, raising=False)
    monkeypatch.setattr(opengl.sys, "platform", "linux")
    monkeypatch.setattr(opengl, "_is_there", lambda library: False)
    with pytest.raises(InputError, match="libegl1.*libosmesa6.*'mujoco'"):
        opengl.make_context(8, 8)
    monkeypatch.setattr(opengl, "_is_there", lambda library: library == "OSMesa")
    assert opengl.backend() == "osmesa"


def test_a_forked_process_is_told_to_spawn(gl, monkeypatch):
    monkeypatch.setattr(opengl.os, "getpid", lambda: -1)
    with pytest.raises(InputError, match="forked.*vector_kwargs={'context': 'spawn'}"):
        opengl.make_context(8, 8)


def test_the_users_choice_of_opengl_stays(monkeypatch):
    monkeypatch.setenv(opengl.VARIABLE, "off")
    with pytest.raises(InputError, match="MUJOCO_GL=off does not work"):
        opengl.make_context(8, 8)
