"""Scenarios whose surrogate is a Mitsuba scene, the demo's, and where drives start."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest
from support.worlds.attacks import write_scenario

from mi_nerfattack.errors import InputError
from mi_nerfattack.evaluation.metrics import validate
from mi_nerfattack.experiment.checks.before_attack import place_findings
from mi_nerfattack.io import files
from mi_nerfattack.io.exr import read_layers
from mi_nerfattack.rollout import SceneSensor
from mi_nerfattack.scenario.scenario import load_scenario
from mi_nerfattack.scenario.world import build_attack, build_surrogate, build_world
from mi_nerfattack.scenes import bundled
from mi_nerfattack.vehicle.dynamics import to_state

pytestmark = pytest.mark.usefixtures("variant")

XML = """\
<scene version="3.0.0">
    <integrator type="field_integrator">
        <string name="composite" value="depth"/>
        <volume type="grid_field" id="ball">
            <string name="filename" value="object.safetensors"/>
            <transform name="to_world">
                <scale value="1.5"/><translate x="7" y="4.2" z="1.6"/>
            </transform>
        </volume>
        <volume type="grid_field" id="scene">
            <string name="filename" value="scene.safetensors"/>
        </volume>
    </integrator>
    <sensor type="perspective">
        <float name="fov" value="90"/>
        <float name="near_clip" value="1e-6"/>
        <sampler type="stratified">
            <integer name="sample_count" value="1"/>
            <boolean name="jitter" value="false"/>
        </sampler>
        <film type="hdrfilm">
            <integer name="width" value="200"/>
            <integer name="height" value="66"/>
        </film>
    </sensor>
    <!-- more -->
</scene>
"""
WALL = """\
    <shape type="rectangle" id="wall">
        <transform name="to_world">
            <rotate y="1" angle="-90"/><translate x="6" y="4.2" z="1.6"/>
        </transform>
    </shape>
"""
FIELD, OBJECT = (
    '[scene]\nfield = "scene.safetensors"\nspp = 1',
    'field = "object.safetensors"\n',
)
PLACED = "position_m = [7.0, 4.2, 1.6]\nscale = 1.5\n"
NAMED = {FIELD: '[scene]\nsurrogate = "surrogate.xml"', OBJECT + PLACED: ""}


@pytest.fixture
def load(tmp_path):
    """Write the tiny scenario with changes, and read it."""

    def inner(changes=NAMED, objects="", add=""):
        folder = write_scenario(tmp_path, changes)
        (folder / "surrogate.xml").write_text(XML.replace("<!-- more -->", objects))
        path = folder / "scenario.toml"
        path.write_text(path.read_text() + add)
        return load_scenario(path)[0]

    return inner


def test_keys_and_xml_describe_the_same_sensor(load):
    state = to_state(np.array([[0.0, 0.2, 0.1]]))
    sensors = [build_surrogate(load(changes)) for changes in ({}, NAMED)]
    one, other = (sensor.observe(state, 0).image.numpy() for sensor in sensors)
    assert np.abs(one - other).max() < 1e-4 and one.std() > 0.01


@pytest.mark.parametrize("changes", [{FIELD: FIELD.replace("1", "4")}, NAMED])
def test_attached_takes_rays_enough(load, changes):
    add = {"[attack]": "[attack]\nattached = true"}
    with pytest.raises(InputError, match="rays per pixel: [14], too few.*to 9 or more"):
        build_surrogate(load(changes | add))
    enough = {FIELD: FIELD.replace("1", "9")}
    if changes is not NAMED:
        assert build_surrogate(load(enough | add)).camera.spp == 9


def test_files_of_the_scene_are_part_of_the_identity(load, tmp_path):
    scenario = load(objects='<include filename="wall.xml"/>')
    (tmp_path / "wall.xml").write_text(
        '<scene version="3.0.0"><texture type="bitmap" id="wall">'
        '<string name="filename" value="brick"/></texture></scene>'
    )
    (tmp_path / "brick").write_text("red")
    before = scenario.identity()
    for name in ("object.safetensors", "surrogate.xml", "brick"):
        path = tmp_path / name
        raw = path.read_bytes()
        path.write_bytes(raw + b" ")
        after = scenario.identity()
        (changed,) = {key for key in before if before[key] != after[key]}
        assert changed == "scenario.scene.surrogate"
        path.write_bytes(raw)


@pytest.mark.parametrize("lines", ["width = 96", "k1 = -0.01"])
def test_what_the_xml_says_is_said_once(load, lines):
    key = f"camera.{lines.partition(' ')[0]}"
    with pytest.raises(InputError, match=f"{key}: surrogate.xml says it; leave"):
        load(add=f"[camera]\n{lines}\n")


def test_attached_with_surfaces_is_refused_before_the_first_drive(load):
    scenario = load({**NAMED, "[attack]": "[attack]\nattached = true"}, objects=WALL)
    with pytest.raises(InputError, match="surrogate.xml: .*attached to false"):
        build_surrogate(scenario)


def test_objects_of_the_xml_are_checked_where_they_stand(load, tmp_path):
    scenario = load()
    world = build_world(scenario, scenario.policy.build())
    assert not list(place_findings(world))
    xml = tmp_path / "surrogate.xml"
    xml.write_text(xml.read_text().replace('y="4.2"', 'y="2"'))
    world = build_world(scenario, scenario.policy.build())
    (finding,) = place_findings(world)
    assert "ball stands on the lane" in finding


@pytest.mark.slow
def test_attack_writes_its_run_folder(load, tmp_path):
    """With a wall before the object; the texture moves, layers are there."""
    from mi_nerfattack.experiment.job import Job

    fewer = {"iterations = 30": "iterations = 1", "textures = 4": "textures = 1"}
    scenario = load({**NAMED, **fewer}, objects=WALL)
    text = (tmp_path / "scenario.toml").read_text()
    output = tmp_path / "run"
    Job(scenario, text, scenario.policy.build(), output).run()
    validate(files.read_json(output / "metrics.json"))
    layers, _ = read_layers(output / "frames/surrogate_attack/0000.exr")
    assert {"", "Z", "scene", "scene.Z", "object", "object.Z"} <= set(layers)
    assert (output / "objects/ball.safetensors").is_file()


@pytest.fixture
def build(tmp_path):
    """Build the tiny scenario, with other keys of its drives."""

    def inner(keys):
        folder = write_scenario(tmp_path, {"horizon = 2\nruns = 2\n": keys})
        path = folder / "scenario.toml"
        path.write_text(path.read_text().replace("[attack]", "[attack]\nposes = 3"))
        scenario, _ = load_scenario(path)
        return build_world(scenario, scenario.policy.build())

    return inner


def test_evaluation_starts_where_no_optimisation_does(build):
    world = build("runs = 40\nstart_m = 71.0\n")
    attack = build_attack(world)
    mine = np.array(attack.initial).T[:, :3]
    nominal = [51.0, 0.0, 0.0]  # of a line from x = -20 to 60
    np.testing.assert_allclose(mine[0], nominal, atol=1e-5)
    apart = np.abs(world.initial[:, None] - mine[None]).max(axis=-1)
    assert apart.min() > 1e-6
    np.testing.assert_allclose(world.initial.mean(axis=0), nominal, atol=0.08)
    assert world.horizon == attack.rollout.horizon == 18  # 9 m to the end of the line


def test_start_beyond_the_route_is_refused(build):
    with pytest.raises(InputError, match=r"start_m: 80 m; route 'line' is 80.0 m long"):
        build("start_m = 80\n")


SIZE = {"width": 100, "height": 33}


def scenario():
    """Return the demo's, of a small image with samples in the middle of intervals."""
    demo, _ = load_scenario(bundled("demo.toml"))
    camera = demo.camera.model_copy(update=SIZE)
    attack = demo.attack.model_copy(update={"jitter": False})
    return demo.model_copy(update={"camera": camera, "attack": attack})


def test_the_scenario_drives_in_the_scene_that_the_file_shows():
    """Image and gradient through the loop's camera, and the image of `mi.render`."""
    world = build_world(scenario(), None)
    scene = mi.load_file(str(bundled("demo.xml")), parallel=False, **SIZE)
    start = world.route.pose_at(0.0)
    sensor = SceneSensor(scene, world.place.mount, ["fields.hydrant.colour"])
    linear = mi.render(scene, spp=1).numpy()
    near = to_state(np.array([world.route.pose_at(16.0)]))
    weight = None
    gradients = []
    for one in (world.surrogate, sensor):
        pixels = one.observe(to_state(start[None]), 0).linear.numpy().T
        error = pixels.reshape(linear.shape) - linear
        assert np.sqrt((error**2).mean()) < 1e-5
        image = one.observe(near, 0)
        if weight is None:
            shape, rng = image.image.shape, np.random.default_rng(0)
            weight = mi.TensorXf(rng.normal(size=shape).astype(np.float32))
        one.start_gradient()
        one.vjp(image, near, weight, False)
        gradients.append(one.texture_gradients()[0].numpy().copy())
        one.stop_gradient()
    (expected, other), size = gradients, np.abs(gradients[0]).sum()
    assert size > 1
    assert np.abs(other - expected).sum() < 1e-3 * size
