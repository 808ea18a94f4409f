"""Inputs that once ended in a traceback, a hang or gigabytes, each told in a line."""

from __future__ import annotations

import json
import os
import shutil
import struct

import numpy as np
import pytest
from helpers.mesh_samples import plate
from helpers.scenario_text import HEAD, write_named_files

from mi_nerfattack.capture.mesh.nodes import MAX_MESHES
from mi_nerfattack.capture.mesh.read import load_mesh
from mi_nerfattack.errors import InputError, SetupError
from mi_nerfattack.io import files
from mi_nerfattack.scenario.scenario import load_scenario
from mi_nerfattack.vehicle.route.route import load_routes

HUGE = "1" + "0" * 400
LONG = "9" * 5000


def refused(read, path, match):
    """Check for our error, and that it is short."""
    with pytest.raises(InputError, match=match) as caught:
        read(path)
    assert len(str(caught.value)) < 10_000


@pytest.mark.parametrize(
    "number", [HUGE, f"-{HUGE}", LONG, "1e400", "9223372036854775808"]
)
def test_numbers_that_64_bits_do_not_hold(tmp_path, number):
    path = tmp_path / "a.json"
    path.write_text(f'{{"frames": [{{"w": 1}}, {{"w": [0.5, {number}]}}]}}')
    refused(files.read_json, path, r"frames\[1\]\.w\[1\]: .*not a JSON number")
    path.write_text('{"a": [-9223372036854775808, 9223372036854775807, -1e308]}')
    assert files.read_json(path) == {"a": [-(2**63), 2**63 - 1, -1e308]}


@pytest.mark.parametrize("number", [HUGE, LONG, "0x1" + "0" * 4000])
def test_numbers_of_toml(tmp_path, number):
    path = tmp_path / "a.toml"
    path.write_text(f"[drive]\nhorizon = [{number}]\n")
    refused(files.read_toml, path, "horizon: a whole number of .* bits|digits")


@pytest.mark.parametrize(
    "key", ["a" + ".a" * 100_000, '"a".' * 200 + "b", "[" + "a . " * 200 + "b]\nc"]
)
def test_keys_of_many_parts(tmp_path, key):
    path = tmp_path / "a.toml"
    path.write_text(f"{key} = 1\n")
    refused(files.read_toml, path, "names joined by dots")
    path.write_text("a" + ".a" * 90 + " = [" + "0.5, " * 1000 + "]\n")
    files.read_toml(path)


def test_many_keys(tmp_path):
    keys = [f"k{i} = 1\n" for i in range(300_000)]
    path = tmp_path / "many.toml"
    path.write_text("".join(keys))
    refused(load_scenario, path, "many.toml: .* bytes; at most")
    path.write_text("".join(keys[:20_000]))
    refused(load_scenario, path, "characters; a scenario has at most")
    path.write_text("".join(keys[:1000]))
    with pytest.raises(InputError, match=r":5: k4: unknown key(?s:.*)and 99\d more"):
        load_scenario(path)
    path = tmp_path / "many.json"
    table = {f"k{i}": 1 for i in range(300_000)}
    path.write_text(json.dumps(table)[:-1] + ', "k9": 1}')
    refused(files.read_json, path, "key 'k9' twice")


@pytest.mark.parametrize(
    ("old", "new", "match"),
    [
        ('"scene.safetensors"', "1979-05-27", "scene.field: must be a path"),
        ('"policy.safetensors"', "1979-05-27", "policy.file: "),
        ('"scene.safetensors"', f'"bundled:{"a" * 300}"', "not a bundled file"),
        ('"scene.safetensors"', r'"bundled:\u0000"', "not a bundled file"),
        ('"scene.safetensors"', f'"{"a" * 300}"', "too long"),
        ('file = "policy.safetensors"', 'url = "http://[::1"', "policy.url: "),
    ],
)
def test_paths_of_scenarios(tmp_path, old, new, match):
    write_named_files(tmp_path)
    path = tmp_path / "scenario.toml"
    assert old in HEAD
    path.write_text(HEAD.replace(old, new))

    def read(path):
        scenario, _ = load_scenario(path)
        scenario.identity()
        scenario.policy.build()

    refused(read, path, match)


def test_messages_are_short(tmp_path):
    path = tmp_path / "routes.json"
    path.write_text(json.dumps({"x" * 15_000_000: {}}))
    refused(load_routes, path, "characters\\) .*needs goal")
    with pytest.raises(InputError, match="no route 'a'"):
        from mi_nerfattack.vehicle.route.route import Route

        Route.from_file(path, "a")


def test_images(tmp_path, data_folder):
    shutil.copy(data_folder / "damaged/pal_two_channels.png", tmp_path / "a.png")
    refused(files.read_image, tmp_path / "a.png", "a.png: damaged image")


def test_tensors_of_70_dimensions(tmp_path):
    path = tmp_path / "a.safetensors"
    entry = {"a": {"dtype": "F32", "shape": [1] * 70, "data_offsets": [0, 4]}}
    header = json.dumps(entry).encode()
    path.write_bytes(struct.pack("<Q", len(header)) + header + bytes(4))
    refused(files.read_safetensors, path, "a.safetensors: .*dimension")


def test_nodes_of_gltf(tmp_path, data_folder):
    refused(
        load_mesh, data_folder / "damaged/cycle.glb", r"nodes\[\d\] has two parents"
    )
    gltf = plate()
    gltf.material()
    nodes = [{"children": [1, 2]}, {"mesh": 0}, {"children": [1]}]
    gltf.tree["nodes"] = nodes
    refused(load_mesh, gltf.write(tmp_path / "a.glb"), r"nodes\[1\] has two parents")
    chain = [{"children": [i + 1], "translation": [0, 0, 1]} for i in range(3000)]
    gltf.tree["nodes"] = [*chain, {"mesh": 0}]
    mesh = load_mesh(gltf.write(tmp_path / "a.glb"))
    np.testing.assert_allclose(mesh.bounds[:, 1], -3000)
    count = 12_000
    gltf.tree["nodes"] = [{"mesh": 0}] * count
    gltf.tree["scenes"] = [{"nodes": list(range(count))}]
    refused(load_mesh, gltf.write(tmp_path / "a.glb"), f"at most {MAX_MESHES}")
    gltf.tree["nodes"] = [{"mesh": 0, "scale": [0.5, 1]}]
    gltf.tree["scenes"] = [{"nodes": [0]}]
    refused(load_mesh, gltf.write(tmp_path / "a.glb"), "not a valid glTF file")


@pytest.mark.parametrize("number", [HUGE, LONG])
def test_numbers_of_gltf(tmp_path, number):
    gltf = plate()
    gltf.material()
    gltf.tree["nodes"][0]["translation"] = [0, 0, 1234567]
    path = gltf.write(tmp_path / "a.gltf")
    path.write_text(path.read_text().replace("1234567", number))
    refused(load_mesh, path, r"nodes\[0\]\.translation\[2\]: .* not a JSON number")


def test_a_scene_that_names_a_pipe(tmp_path, variant):
    from mi_nerfattack.render.pathtrace.load import load_scene

    os.mkfifo(tmp_path / "pipe.png")
    path = tmp_path / "scene.xml"
    path.write_text(
        """<scene version="3.0.0"><shape type="cube"><bsdf type="diffuse">
        <texture type="bitmap" name="reflectance"><string name="filename"
        value="pipe.png"/></texture></bsdf></shape></scene>"""
    )
    refused(load_scene, path, "'pipe.png' is a pipe or a device")


def test_capture_needs_an_integrator(tmp_path, variant):
    from helpers.tiny_place import write_place

    from mi_nerfattack.capture.scene import capture_scene

    place = write_place(tmp_path)
    text = place.scene.read_text()
    start, end = text.index("<integrator"), text.index("</integrator>") + 13
    place.scene.write_text(text[:start] + text[end:])
    rest = place.routes, tmp_path / "out", 2, place.camera, 1, 0
    refused(lambda path: capture_scene(path, *rest), place.scene, "no integrator")
    assert not (tmp_path / "out").exists()


def test_an_onnx_network_that_grows_without_end(data_folder):
    import torch

    load = pytest.importorskip("mi_nerfattack.policy.onnx.network").load_onnx

    def run(path):
        network = load(path)
        sizes = [[size or 1 for size in item.sizes] for item in network.inputs]
        network(*(torch.zeros(size) for size in sizes))

    refused(run, data_folder / "damaged/expandbomb.onnx", "take more than 1.1 GB")


def test_an_ngp_of_three_features(tmp_path, variant):
    from helpers.small_fields import small_ngp

    from mi_nerfattack.fields.io import load_field, save_field

    path = tmp_path / "a.safetensors"
    save_field(path, small_ngp())
    tensors, about = files.read_safetensors(path)
    for features in ("1", "3", "5", "6"):
        files.write_safetensors(path, tensors, {**about, "features": features})
        refused(load_field, path, f"features: {features}; allowed are")


def test_state_dicts(tmp_path):
    import torch

    from mi_nerfattack.policy.weights import load_state

    module, path = torch.nn.Linear(3, 2), tmp_path / "a.pt"
    state = module.state_dict()
    endless = torch.zeros(1).expand(1 << 40)
    sparse = state["weight"].to_sparse()
    for value in (endless, sparse, state["weight"].to("meta"), state["weight"][0]):
        torch.save({**state, "weight": value}, path)
        refused(lambda path: load_state(module, path), path, "a.pt: (?s:.*)weight")


def test_names_that_no_file_has(capsys):
    from mi_nerfattack import cli

    name = "a" * 300
    for command in (["capture", name], ["asset", f"{name}.glb"], ["fit", name]):
        assert cli.main([*command, "-o", "out.safetensors"]) == cli.EXIT_INPUT
        told = capsys.readouterr().err
        assert told.count("\n") == 1 and "too long; check the path" in told


@pytest.mark.slow
@pytest.mark.usefixtures("no_variant_left")
def test_capture_needs_colour(tmp_path):
    import mitsuba as mi
    from helpers.tiny_place import write_place

    from mi_nerfattack.capture.scene import capture_scene

    mi.set_variant("llvm_ad_mono")
    place = write_place(tmp_path)
    rest = place.routes, tmp_path / "out", 2, place.camera, 1, 0
    with pytest.raises(SetupError, match="'llvm_ad_mono': views need colour"):
        capture_scene(place.scene, *rest)
    assert not (tmp_path / "out").exists()
