"""Scenarios whose surrogate is a Mitsuba scene."""

from __future__ import annotations

import json

import numpy as np
import pytest
from helpers.attack_jobs import write_scenario

from mi_nerfattack.errors import InputError
from mi_nerfattack.evaluation.metrics import validate
from mi_nerfattack.experiment.checks.before_attack import place_findings
from mi_nerfattack.io.exr import read_layers
from mi_nerfattack.scenario.scenario import load_scenario
from mi_nerfattack.scenario.world import build_surrogate, build_world
from mi_nerfattack.vehicle.state import to_state

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
FIELD, OBJECT = '[scene]\nfield = "scene.safetensors"', 'field = "object.safetensors"\n'
PLACED = "position_m = [7.0, 4.2, 1.6]\nscale = 1.5\n"
NAMED = {FIELD: '[scene]\nsurrogate = "surrogate.xml"', OBJECT + PLACED: ""}


@pytest.fixture
def load(tmp_path):
    """Write the tiny scenario with changes, and read it."""

    def inner(changes=NAMED, more="", add=""):
        folder = write_scenario(tmp_path, changes)
        (folder / "surrogate.xml").write_text(XML.replace("<!-- more -->", more))
        path = folder / "scenario.toml"
        path.write_text(path.read_text() + add)
        return load_scenario(path)[0]

    return inner


def test_keys_and_xml_describe_the_same_sensor(load):
    state = to_state(np.array([[0.0, 0.2, 0.1]]))
    images = []
    for changes in ({}, NAMED):
        sensor = build_surrogate(load(changes))
        seen = sensor.observe(state, 0)
        images.append(seen.image.numpy())
    assert np.abs(images[0] - images[1]).max() < 1e-4
    assert images[0].std() > 0.01


def test_files_of_the_scene_are_part_of_the_identity(load, tmp_path):
    scenario = load(more='<include filename="wall.xml"/>')
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
        assert {k for k in before if before[k] != after[k]} == {
            "scenario.scene.surrogate"
        }
        path.write_bytes(raw)


@pytest.mark.parametrize(
    ("changes", "add", "message"),
    [
        ({FIELD: "[scene]"}, "", r"3: scene.field: is missing; give it, or surrogate"),
        ({FIELD: FIELD + '\nsurrogate = "surrogate.xml"'}, "", r"4: scene.field: "),
        ({OBJECT: ""}, "", r"8: objects.0.field: is missing"),
        ({FIELD: NAMED[FIELD], OBJECT: ""}, "", r"10: objects.0.position_m: .*out"),
        (NAMED, "[camera]\nwidth = 96\n", "camera.width: surrogate.xml says it; leave"),
        (NAMED, "[camera]\nk1 = -0.01\n", "camera.k1: surrogate.xml says it; leave"),
    ],
)
def test_what_the_xml_says_is_said_once(load, changes, add, message):
    with pytest.raises(InputError, match=message):
        load(changes, add=add)


def test_attached_with_surfaces_is_refused_before_the_first_drive(load):
    scenario = load({**NAMED, "[attack]": "[attack]\nattached = true"}, more=WALL)
    with pytest.raises(InputError, match="surrogate.xml: .*attached to false"):
        build_surrogate(scenario)


def test_objects_of_the_xml_are_checked_where_they_stand(load, tmp_path):
    scenario = load()
    world = build_world(scenario, scenario.policy.build())
    assert not list(place_findings(world))
    xml = tmp_path / "surrogate.xml"
    xml.write_text(xml.read_text().replace('y="4.2"', 'y="2"'))
    world = build_world(scenario, scenario.policy.build())
    (found,) = place_findings(world)
    assert "ball stands on the lane" in found


@pytest.mark.slow
def test_attack_writes_its_run_folder(load, tmp_path):
    """With a wall before the object; the texture moves, layers are there."""
    from mi_nerfattack.experiment.job import Job

    fewer = {
        "max_iterations = 30": "max_iterations = 1",
        "textures = 4": "textures = 1",
    }
    scenario = load({**NAMED, **fewer}, more=WALL)
    text = (tmp_path / "scenario.toml").read_text()
    output = tmp_path / "run"
    Job(scenario, text, scenario.policy.build(), output).run()
    document = json.loads((output / "metrics.json").read_text())
    validate(document)
    layers, _ = read_layers(output / "frames/surrogate_attack/0000.exr")
    assert {"", "Z", "scene", "scene.Z", "object", "object.Z"} <= set(layers)
    assert (output / "objects/ball.safetensors").is_file()
