"""Inputs that once ended in a traceback, a hang or gigabytes, each told in a line."""

from __future__ import annotations

import json
import os
import shutil
import struct

import numpy as np
import pytest
from support.files.objects import plate
from support.files.runs import HEAD, write_named_files

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


MANY = [f"k{i} = 1\n" for i in range(300_000)]
TWICE = json.dumps({f"k{i}": 1 for i in range(300_000)})[:-1] + ', "k9": 1}'
TEXTS = [
    *(
        (
            files.read_json,
            f'{{"a": [{{"w": 1}}, {{"w": [0.5, {number}]}}]}}',
            r"a\[1\]\.w\[1\]: ",
        )
        for number in (HUGE, f"-{HUGE}", LONG, "1e400", "9223372036854775808")
    ),
    *(
        (
            files.read_toml,
            f"[drive]\nhorizon = [{number}]\n",
            "horizon: a whole number of .* bits|digits",
        )
        for number in (HUGE, LONG, "0x1" + "0" * 4000)
    ),
    *(
        (files.read_toml, f"{key} = 1\n", "names joined by dots")
        for key in (
            "a" + ".a" * 100_000,
            '"a".' * 200 + "b",
            "[" + "a . " * 200 + "b]\nc",
        )
    ),
    (files.read_json, TWICE, "key 'k9' twice"),
    (load_scenario, "".join(MANY), "many.*: .* bytes; at most"),
    (load_scenario, "".join(MANY[:20_000]), "characters; a scenario has at most"),
    (load_scenario, "".join(MANY[:1000]), r":4: k3: unknown key(?s:.*)and 996 more"),
    (load_routes, json.dumps({"x" * 15_000_000: {}}), "characters\\) .*needs goal"),
]


@pytest.mark.parametrize(("read", "text", "match"), TEXTS, ids=range(len(TEXTS)))
def test_texts(tmp_path, read, text, match):
    path = tmp_path / "many.file"
    path.write_text(text)
    refused(read, path, match)


def test_texts_that_are_just_allowed(tmp_path):
    path = tmp_path / "a"
    path.write_text('{"a": [-9223372036854775808, 9223372036854775807, -1e308]}')
    assert files.read_json(path) == {"a": [-(2**63), 2**63 - 1, -1e308]}
    path.write_text("a" + ".a" * 90 + " = [" + "0.5, " * 1000 + "]\n")
    files.read_toml(path)


@pytest.mark.parametrize(
    ("old", "new", "match"),
    [
        ('"scene.safetensors"', "1979-05-27", "scene.field: "),
        ('"policy.safetensors"', "1979-05-27", "policy.file: "),
        ('"scene.safetensors"', f'"bundled:{"a" * 300}"', "bundled file"),
        ('"scene.safetensors"', r'"bundled:\u0000"', "has a null character"),
        ('"scene.safetensors"', f'"{"a" * 300}"', "too long"),
        ('"scene.safetensors"', '"."', "is a folder; a file is needed"),
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
    refused(load_mesh, data_folder / "damaged/cycle.glb", r"nodes\[\d\] has two")
    gltf = plate()
    gltf.material()

    def written(nodes, roots=1):
        gltf.tree["nodes"], gltf.tree["scenes"] = nodes, [{"nodes": list(range(roots))}]
        return gltf.write(tmp_path / "a.glb")

    nodes = [{"children": [1, 2]}, {"mesh": 0}, {"children": [1]}]
    refused(load_mesh, written(nodes), r"nodes\[1\] has two")
    count = 12_000
    refused(load_mesh, written([{"mesh": 0}] * count, count), f"at most {MAX_MESHES}")
    refused(load_mesh, written([{"mesh": 0, "scale": [0.5, 1]}]), "not a valid glTF")
    chain = [{"children": [i + 1], "translation": [0, 0, 1]} for i in range(3000)]
    mesh = load_mesh(written([*chain, {"mesh": 0}]))
    np.testing.assert_allclose(mesh.bounds[:, 1], -3000)


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


def captured(folder, place):
    from mi_nerfattack.capture.scene import capture_scene

    capture_scene(place.scene, place.routes, folder / "out", 2, place.camera, 1, 0)


def test_capture_needs_an_integrator(tmp_path, variant):
    from support.worlds.places import write_place

    place = write_place(tmp_path)
    text = place.scene.read_text()
    start, end = text.index("<integrator"), text.index("</integrator>") + 13
    place.scene.write_text(text[:start] + text[end:])
    with pytest.raises(InputError, match="no integrator"):
        captured(tmp_path, place)
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
    from support.worlds.fields import small_ngp

    from mi_nerfattack.fields.io import load_field, save_field

    path = tmp_path / "a.safetensors"
    save_field(path, small_ngp())
    tensors, metadata = files.read_safetensors(path)
    for features in ("1", "3", "5", "6"):
        files.write_safetensors(path, tensors, {**metadata, "features": features})
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


@pytest.mark.parametrize("command", ["capture photographs", "asset mesh", "fit"])
def test_names_that_no_file_has(command, capsys):
    from mi_nerfattack import cli

    words = [*command.split(), "a" * 300 + ".glb", "-o", "out.safetensors"]
    assert cli.main(words) == cli.EXIT_INPUT
    assert "too long" in capsys.readouterr().err


@pytest.mark.slow
@pytest.mark.usefixtures("no_variant_left")
def test_capture_needs_colour(tmp_path):
    import mitsuba as mi
    from support.worlds.places import write_place

    mi.set_variant("llvm_ad_mono")
    with pytest.raises(SetupError, match="llvm_ad_mono"):
        captured(tmp_path, write_place(tmp_path))
    assert not (tmp_path / "out").exists()
