"""Splats in scene files and in scenario files."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from support.files import objects as made
from support.reference.derivatives import (
    MONO,
    RGB,
    SPECTRAL,
    Derivatives,
    images,
    key_of,
)
from support.worlds import fields as small

from mi_nerfattack.backend.colour import srgb_to_linear_numpy
from mi_nerfattack.errors import InputError
from mi_nerfattack.fields import save_field
from mi_nerfattack.scenario.scenario import load_scenario
from mi_nerfattack.scenario.world import build_world
from mi_nerfattack.vehicle.dynamics import to_state

pytestmark = pytest.mark.usefixtures("variant")

BLUE = np.array([0.1, 0.3, 0.9])
DENSITY, RAW = 0.7, 0.3
COLOUR = float(small.sigmoid_to_linear(np.array(RAW)))
CUBE_OPACITY = 1 - np.exp(-2 * DENSITY)

# The integrator


@pytest.fixture
def paths(tmp_path: Path, variant: str) -> dict[str, str]:
    """Files of a wall at x = 0 and of the cube."""
    save_field(tmp_path / "cube.safetensors", small.homogeneous(DENSITY, RAW))
    made.write_ply(tmp_path / "wall.ply", made.columns(made.wall(0, step=0.3, half=9)))
    return {name: str(tmp_path / name) for name in ("cube.safetensors", "wall.ply")}


def scene(paths: dict[str, str], shift: float, **entries: Any) -> Any:
    """Load the wall at x = -4 and the cube at x = shift, seen from x = 6."""
    at = mi.ScalarTransform4f().translate
    integrator = {
        "type": "field_integrator",
        "composite": "depth",
        "aovs": True,
        "street": {
            "type": "splat_background",
            "filename": paths["wall.ply"],
            "to_world": at([-4, 0, 0]),
        },
        "object": {
            "type": "grid_field",
            "filename": paths["cube.safetensors"],
            "to_world": at([shift, 0, 0]),
        },
    }
    integrator |= entries.pop("integrator", {})
    view = mi.ScalarTransform4f().look_at([6, 0, 0], [0, 0, 0], [0, 0, 1])
    film = {"type": "hdrfilm", "width": 9, "height": 9, "rfilter": {"type": "box"}}
    camera = {"type": "perspective", "fov": 30, "to_world": view, "film": film}
    return mi.load_dict(
        {"type": "scene", "integrator": integrator, "sensor": camera, **entries},
        parallel=False,
    )


def named(image: Any, world: Any) -> dict[str, np.ndarray]:
    """Split an image into channels by name."""
    names = ["R", "G", "B", *world.integrator().aov_names()]
    return dict(zip(names, np.moveaxis(image.numpy(), -1, 0), strict=True))


@pytest.mark.parametrize("shift", [0.0, -20.0])
def test_an_image_shows_both_by_depth(paths, shift: float) -> None:
    world = scene(paths, shift)
    channels = named(mi.render(world, spp=4), world)
    assert world.integrator().aov_names()[2:7] == [f"street.{c}" for c in "RGBAZ"]
    back = srgb_to_linear_numpy(BLUE)
    a = CUBE_OPACITY if shift == 0 else 0.0
    for name, colour in zip("RGB", back, strict=True):
        expected = a * COLOUR + (1 - a) * colour
        assert channels[name][4, 4] == pytest.approx(expected, abs=5e-4)
        assert channels[name][0, 0] == pytest.approx(colour, abs=5e-4)
    assert channels["opacity"][4, 4] == pytest.approx(1, abs=2e-3)
    assert channels["street.Z"][4, 4] == pytest.approx(10, rel=1e-2)


def test_surfaces_end_the_march(paths) -> None:
    at = mi.ScalarTransform4f().translate([4, 0, 0])
    screen = at @ mi.ScalarTransform4f().rotate([0, 1, 0], 90).scale(0.2)
    world = scene(paths, 0.0, screen={"type": "rectangle", "to_world": screen})
    channels = named(mi.render(world, spp=1), world)
    assert channels["opacity"][4, 4] == 0  # behind the rectangle
    assert channels["opacity"][4, 0] == pytest.approx(1, abs=2e-3)


def test_a_texture_in_front_of_splats_has_a_gradient(paths) -> None:
    world = scene(paths, 0.0)
    params = mi.traverse(world)
    key = key_of(params, "colour")
    dr.enable_grad(params[key])
    params.update()
    image = mi.render(world, params, spp=1)
    dr.backward(dr.sum(image[..., 0]))
    assert float(np.abs(dr.grad(params[key]).numpy()).max()) > 0


@pytest.mark.parametrize("name", ["harmonics", "opacity"])
def test_splats_have_derivatives(rng, paths, name: str) -> None:
    made.write_ply(Path(paths["wall.ply"]), made.columns(made.cloud(rng, 200)))
    world = scene(paths, 4.5)
    params = mi.traverse(world)
    key = key_of(params, f"street.{name}")
    base = params[key].numpy().copy()
    along = rng.uniform(-1, 1, base.shape) * (
        base * (1 - base) if name == "opacity" else 1
    )
    Derivatives(params, key, images(world, params)).check([along])


@pytest.mark.parametrize("each_variant", RGB + SPECTRAL + MONO, indirect=True)
def test_every_variant_shows_splats(paths, each_variant: str) -> None:
    world = scene(paths, -20.0)
    image = mi.render(world, spp=64)  # every pixel shows the wall
    back = srgb_to_linear_numpy(BLUE)
    if image.shape[2] == 1 + len(world.integrator().aov_names()):
        expected = [float(np.dot(back, [0.212671, 0.715160, 0.072169]))]
    else:
        expected = back.tolist()
    mean = image.numpy().mean((0, 1))[: len(expected)]
    np.testing.assert_allclose(mean, expected, atol=8e-3)


def reasons(err: BaseException | None) -> str:
    """Return the messages of an error and of its causes."""
    return "" if err is None else f"{err} {reasons(err.__cause__)}"


def test_what_cannot_be_shown_is_refused(paths) -> None:
    grid = {"type": "grid_field", "filename": paths["cube.safetensors"]}
    splat = {"type": "splat_background", "filename": paths["wall.ply"]}
    emitter = {"type": "field_emitter", "a": grid, "b": splat}
    shear = splat | {"to_world": mi.ScalarTransform4f().scale([1, 2, 1])}
    lit = {"object": grid | {"relit": True}}
    for make, message in (
        (lambda: scene(paths, 0, integrator={"composite": "interleaved"}), "to depth"),
        (lambda: scene(paths, 0, integrator=lit), "wall.ply: .* set relit to false"),
        (lambda: mi.load_dict(emitter), "cannot use the nested SplatBackground"),
        (
            lambda: mi.load_dict({"type": "heterogeneous", "sigma_t": splat}),
            "is no medium",
        ),
        (lambda: mi.load_dict(shear), "to_world"),
    ):
        with pytest.raises(RuntimeError, match=message):
            make()
    params = mi.traverse(scene(paths, 0.0))
    for name, value in (("opacity", 1.1), ("opacity", np.nan), ("harmonics", np.inf)):
        key = key_of(params, f"street.{name}")
        before = mi.Float(params[key])
        params[key] = dr.full(mi.Float, value, dr.width(before))
        with pytest.raises(InputError, match=f"wall.ply: {name} "):
            params.update()
        params[key] = before
    world = scene(paths, 0.0)
    frozen = dr.freeze(lambda seed: mi.render(world, spp=1, seed=seed))
    with pytest.raises(RuntimeError) as caught:
        frozen(mi.UInt32(0))
    assert "render each frame as it is" in reasons(caught.value)
    data = mi.TensorXf([[0, 0, 0, 1, 1, 1, 0, 0, 0, 1]])
    world = scene(paths, 0.0, dots={"type": "ellipsoids", "data": data})
    with pytest.raises(InputError, match="dots: .* nest a splat_background"):
        world.integrator().render(world, spp=1)


# The scenario

SCENARIO = """\
name = "splats"
[scene]
field = "wall.ply"
to_world = [[2, 0, 0, 9], [0, 2, 0, 0], [0, 0, 2, 0], [0, 0, 0, 1]]
deployment = "deployment.xml"
routes = "routes.json"
route = "line"
spp = 1
[[objects]]
id = "cube"
field = "cube.safetensors"
position_m = [5.0, 0.0, 1.0]
[policy]
file = "policy.safetensors"
[camera]
width = 12
height = 6
"""


@pytest.fixture
def build(paths):
    """Return a function that builds the world of a scenario text."""
    folder = Path(paths["wall.ply"]).parent
    points = [[-20.0, 0.0], [60.0, 0.0]]
    route = {"goal": 0, "lane_width_m": 3.5, "speed_ms": 5.0, "points_m": points}
    (folder / "routes.json").write_text(json.dumps({"line": route}))
    body = '<integrator type="path"/><shape type="rectangle"/>'
    (folder / "deployment.xml").write_text(f'<scene version="3.0.0">{body}</scene>')

    def inner(text: str) -> Any:
        path = folder / "scenario.toml"
        path.write_text(text)
        return build_world(load_scenario(path)[0], None)

    return inner


def test_a_scenario_drives_among_splats(build) -> None:
    sensor = build(SCENARIO).surrogate
    marches = sensor.observe(to_state(np.zeros((1, 3))), 0).integrator_state.marches
    depth = marches.layers[0].depth.numpy().reshape(6, 12)  # the wall at x = 9
    ahead = np.cos(np.arctan(1 / 12)) * np.cos(np.radians(6) - np.arctan(1 / 12))
    assert depth[2, 6] == pytest.approx((9 - 0.5) / ahead, rel=0.02)


def test_steps_and_the_end_of_rays_are_the_scenarios(build) -> None:
    text = SCENARIO.replace("[[objects]]", "stop = 0.01\n[[objects]]\nstep_m = 0.5")
    world = build(text)
    assert (world.surrogate.integrator.stop, world.fields[0].step_m) == (0.01, 0.5)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("[scene]", "[scene]\nstep_m = 0.1", "scene.step_m: .*wall.ply holds splats"),
        ("[scene]", '[scene]\ncomposite = "interleaved"', "set composite to depth"),
        ("[[2, 0", "[[3, 0", "scene.to_world: .*expected a 3x3 rotation"),
        ("[[2, 0", '[["2", 0', r"scenario.toml:4: scene.to_world"),
    ],
)
def test_what_scenarios_with_splats_cannot_do(build, old, new, message) -> None:
    with pytest.raises(InputError, match=message):
        build(SCENARIO.replace(old, new))
