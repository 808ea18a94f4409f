"""The formats of policies, runs and recordings that are fuzzed; see `formats`."""

from __future__ import annotations

import io
import json
import random
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
from fuzz.mutations import (
    WHOLES,
    of_bytes,
    of_tensors,
    of_text,
    one_of,
)


def onnx_files(folder: Path) -> list[tuple[Path, Any]]:
    """Two networks, evaluated on an image and a goal."""
    import torch

    from mi_nerfattack.policy.onnx.network import load_onnx

    made = {"layers": _onnx_layers(), "shapes": _onnx_shapes()}
    for name, value in made.items():
        (folder / f"{name}.onnx").write_bytes(value.SerializeToString())
    torch.set_num_threads(1)
    image, goal = torch.rand(2, 3, 8, 10), torch.eye(2)

    def read(path: Path) -> None:
        with torch.no_grad():
            load_onnx(path)(image, goal)

    return [(folder / f"{name}.onnx", read) for name in made]


def _onnx_layers() -> Any:
    rng = np.random.default_rng(0)
    nodes = [
        _node("Conv", "image w0 b0", "a", strides=[2, 2], pads=[1, 1, 1, 1]),
        _node("BatchNormalization", "a s s b0 s", "b"),
        _node("MaxPool", "b", "c", kernel_shape=[2, 2]),
        _node("Flatten", "c", "e"),
        _node("Concat", "e goal", "f", axis=1),
        _node("Gemm", "f w1", "control", transB=0),
    ]
    weights = {
        "w0": rng.normal(0, 0.2, (4, 3, 3, 3)).astype("f4"),
        "b0": np.zeros(4, "f4"),
        "s": np.ones(4, "f4"),
        "w1": rng.normal(0, 0.2, (50, 1)).astype("f4"),
    }
    return _model(nodes, weights)


def _onnx_shapes() -> Any:
    nodes = [
        _node("Resize", "image none scales", "a", mode="linear"),
        _node("Shape", "a", "b"),
        _node("Slice", "b start end", "c"),
        _node("Reshape", "a back", "d"),
        _node("ConstantOfShape", "c", "zero"),
        _node("Pad", "d pads", "e"),
        _node("Split", "e", "f g", axis=1),
        _node("ReduceMean", "f", "control", axes=[1], keepdims=1),
        _node("Expand", "control wide", "other"),
        _node("LSTM", "seq wx wh", "y h", hidden_size=2),
    ]
    constants = {
        "none": np.zeros(0, "f4"),
        "scales": np.float32([1, 1, 2, 2]),
        "start": np.int64([0]),
        "end": np.int64([2]),
        "back": np.int64([0, -1]),
        "pads": np.int64([0, 1, 0, 1]),
        "wide": np.int64([2, 4]),
        "seq": np.ones((3, 1, 2), "f4"),
        "wx": np.ones((1, 8, 2), "f4"),
        "wh": np.ones((1, 8, 2), "f4"),
    }
    return _model(nodes, constants)


def _node(name: str, inputs: str, outputs: str, **attributes: Any) -> Any:
    from onnx import helper

    return helper.make_node(name, inputs.split(), outputs.split(), **attributes)


def _model(nodes: list[Any], constants: dict[str, np.ndarray]) -> Any:
    from onnx import helper, numpy_helper

    sizes = {"image": ["n", 3, 8, 10], "goal": ["n", 2], "control": ["n", 1]}
    *inputs, output = [
        helper.make_tensor_value_info(name, 1, shape) for name, shape in sizes.items()
    ]
    kept = [numpy_helper.from_array(v, n) for n, v in constants.items()]
    graph = helper.make_graph(nodes, "test", inputs, [output], kept)
    opset = helper.make_opsetid("", 17)
    return helper.make_model(graph, opset_imports=[opset], ir_version=8)


def of_onnx(rng: random.Random, raw: bytes) -> bytes:
    """Change a field of an ONNX model, or of a part of it."""
    import onnx

    model = onnx.load_model_from_string(raw)
    holders, at = [model.graph], 0
    while at < len(holders):
        for field, value in holders[at].ListFields():
            if field.type == field.TYPE_MESSAGE:
                holders += list(value) if field.label == 3 else [value]
        at += 1
    holder = rng.choice(holders)
    fields = [field for field, _ in holder.ListFields()]
    if not fields:
        return raw
    field = rng.choice(fields)
    value = getattr(holder, field.name)
    if field.label == field.LABEL_REPEATED and len(value):
        i, j = rng.randrange(len(value)), rng.randrange(len(value))
        if field.type == field.TYPE_MESSAGE:
            if rng.random() < 0.5:
                value.insert(i, value[j])
            else:
                del value[i]
        else:
            value[i] = _scalar(rng, field, value[j], model)
    elif field.type != field.TYPE_MESSAGE:
        setattr(holder, field.name, _scalar(rng, field, value, model))
    return model.SerializeToString()


def _scalar(rng: random.Random, field: Any, old: Any, model: Any) -> Any:
    if isinstance(old, bytes):
        return of_bytes(rng, old)
    if isinstance(old, str):
        names = [node.op_type for node in model.graph.node]
        for node in model.graph.node:
            names += [*node.input, *node.output]
        from mi_nerfattack.policy.onnx.operators import OPERATORS

        return rng.choice((*names, *OPERATORS, "", "x", "\x1b"))
    if isinstance(old, float):
        return float(rng.choice((0, -1, 1e38, -1e38, "nan", "inf", 0.5)))
    if field.type == field.TYPE_ENUM:
        return rng.randrange(20)
    most = (1 << 31) - 1 if field.cpp_type == field.CPPTYPE_INT32 else (1 << 63) - 1
    return rng.choice([n for n in WHOLES if -most <= n <= most])


def policies(folder: Path) -> list[tuple[Path, Any]]:
    """Weights of PilotNet by their names alone, and of a small module."""
    import torch

    from mi_nerfattack.io import files
    from mi_nerfattack.policy.pilotnet import PilotNet
    from mi_nerfattack.policy.weights import load_state

    torch.set_num_threads(1)
    net = PilotNet()
    net.save(folder / "whole.safetensors")
    _, about = files.read_safetensors(folder / "whole.safetensors")
    tensors = {name: np.zeros(1, np.float32) for name in net.state_dict()}
    files.write_safetensors(folder / "pilotnet.safetensors", tensors, about)
    (folder / "whole.safetensors").unlink()
    module = torch.nn.Linear(3, 2)
    state = {name: value.detach() for name, value in module.state_dict().items()}
    arrays = {name: value.numpy() for name, value in state.items()}
    files.write_safetensors(folder / "state.safetensors", arrays)
    torch.save(state, folder / "state.pt")

    def load_own(path: Path) -> None:
        load_state(module, path)

    return [
        (folder / "pilotnet.safetensors", _unless_good(PilotNet.load)),
        (folder / "state.safetensors", load_own),
        (folder / "state.pt", load_own),
    ]


def _unless_good(load: Any) -> Any:
    """Take a file whose tensors have no size, which is good but for that."""
    from mi_nerfattack.errors import InputError

    def read(path: Path) -> None:
        try:
            load(path)
        except InputError as err:
            if "is needed" not in str(err):
                raise

    return read


def of_policy(rng: random.Random, raw: bytes) -> bytes:
    """Damage a file of tensors, or a ZIP archive."""
    return (_ZIP if raw[:2] == b"PK" else _TENSORS)(rng, raw)


def programs(folder: Path) -> list[tuple[Path, Any]]:
    """Archives of programs; they are opened, and not run."""
    from mi_nerfattack.policy.exported.load import _read_archive

    with zipfile.ZipFile(folder / "a.pt2", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("a/version", "3\n")
        archive.writestr("a/data/model.json", json.dumps({"graph": [1, 2]}))
        archive.writestr("a/data/weights", bytes(1000))

    return [(folder / "a.pt2", lambda path: _read_archive(path, "torch.export.save"))]


def of_zip(rng: random.Random, raw: bytes) -> bytes:
    """Damage a member of an archive, whose checksums stay right."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(raw)) as archive:
        members = [(item.filename, archive.read(item)) for item in archive.infolist()]
    i = rng.randrange(len(members))
    name, data = members[i]
    kind = rng.randrange(4)
    if kind == 0:
        del members[i]
    elif kind == 1:
        members[i] = rng.choice(("x", "a" * 300, "../x", "é")), data
    else:
        members[i] = name, rng.choice((of_bytes, of_text))(rng, data)
    with zipfile.ZipFile(buffer, "w") as archive:
        for name, data in members:
            archive.writestr(name, data)
    return buffer.getvalue()


def records(folder: Path) -> list[tuple[Path, Any]]:
    """What a training writes beside its policy."""
    from mi_nerfattack.scenes import bundled
    from mi_nerfattack.training.record import read_record

    path = folder / "record.json"
    path.write_bytes(bundled("policy/pilotnet.json").read_bytes())
    return [(path, read_record)]


def poses(folder: Path) -> list[tuple[Path, Any]]:
    """Poses of recorded drives, as CSV and TOML."""
    from helpers import recorded_drives as drives

    from mi_nerfattack.deploy.replay.environment import open_recording

    drives.write_csv_folder(folder / "csv")
    drives.write_csv_folder(folder / "toml")
    (folder / "toml/poses.csv").unlink()
    rows = [line.split(",") for line in drives.csv_rows()]
    text = "[camera]\nwidth = 16\nheight = 8\nfx = 8.0\nfy = 8.0\ncx = 8.0\ncy = 4.0\n"
    for time, name, x, y, angle in rows:
        text += f'[[frames]]\ntime_s = {time}\nfile = "{name}"\n'
        text += f"x_m = {x}\ny_m = {y}\nheading_rad = {angle}\n"
    (folder / "toml/poses.toml").write_text(text)

    def read(path: Path) -> None:
        recording = open_recording(path.parent, drives.CAMERA, drives.MOUNT)
        recording.image(0)
        recording.depth(0)

    return [(folder / f"{kind}/poses.{kind}", read) for kind in ("csv", "toml")]


def logs(folder: Path) -> list[tuple[Path, Any]]:
    """MCAP logs, compressed and not, and a video."""
    from helpers import recorded_drives as drives

    from mi_nerfattack.deploy.replay.environment import open_recording

    topics = drives.log_messages(folder)
    paths = [
        drives.write_log(folder / f"{kind}.mcap", topics, kind)
        for kind in ("NONE", "ZSTD", "LZ4")
    ]

    def read(path: Path) -> None:
        recording = open_recording(path, None, drives.MOUNT)
        recording.image(0)

    return [(path, read) for path in paths]


def videos(folder: Path) -> list[tuple[Path, Any]]:
    """Videos beside their poses."""
    from helpers import recorded_drives as drives

    from mi_nerfattack.deploy.replay.environment import open_recording

    path = drives.write_drive_video(folder)

    def read(path: Path) -> None:
        recording = open_recording(path, None, drives.MOUNT)
        for index in range(len(recording.track.times)):
            recording.image(index)

    return [(path, read)]


def scenes(folder: Path) -> list[tuple[Path, Any]]:
    """A Mitsuba scene with a mesh, a picture and a field."""
    from mi_nerfattack import variant

    variant.ensure()
    from helpers.mesh_samples import four_colours
    from helpers.small_fields import blob
    from helpers.tiny_place import SCENE

    from mi_nerfattack.fields.io import save_field
    from mi_nerfattack.render.pathtrace.load import load_scene, scene_files

    save_field(folder / "field.safetensors", blob(np.random.default_rng(0)))
    four_colours().save(folder / "four.png")
    more = """<shape type="cube"><bsdf type="diffuse">
    <texture type="bitmap" name="reflectance">
    <string name="filename" value="four.png"/></texture></bsdf></shape>
    <default name="spp" value="4"/>
    <sensor type="perspective"><float name="fov" value="45"/>
    <film type="hdrfilm"><integer name="width" value="8"/>
    <integer name="height" value="6"/></film>
    <sampler type="independent"><integer name="sample_count" value="$spp"/></sampler>
    </sensor>
    <shape type="cube"><emitter type="field_emitter"><volume type="grid_field">
    <string name="filename" value="field.safetensors"/></volume></emitter></shape>
    </scene>"""
    path = folder / "scene.xml"
    path.write_text(SCENE.replace("</scene>", more))

    def read(path: Path) -> None:
        scene_files(path)
        load_scene(path)

    return [(path, read)]


def checkpoints(folder: Path) -> list[tuple[Path, Any]]:
    """The state of an attack and a finished drive."""
    from mi_nerfattack import variant

    variant.ensure()
    from helpers import toy_loop as toy

    from mi_nerfattack.attack.gradient import GradientAttack
    from mi_nerfattack.attack.objectives import CrossTrackDeviation
    from mi_nerfattack.experiment.checkpoint import CheckpointFile
    from mi_nerfattack.experiment.effort import Effort
    from mi_nerfattack.experiment.kept_drives import KeptDrives
    from mi_nerfattack.rollout.drive import Drive
    from mi_nerfattack.rollout.function import Rollout
    from mi_nerfattack.rollout.objective import StageSum

    loop, _ = toy.make_loop(coarse=True)
    objective = StageSum(CrossTrackDeviation(toy.ROUTE))
    rollout = Rollout(loop, objective, 2)
    attack = GradientAttack(rollout, toy.ROUTE, loop.initial(np.zeros((1, 3))))
    path = folder / "checkpoint.safetensors"
    CheckpointFile(path, {"a": "1"}).save(attack, Effort())
    drives = KeptDrives(folder / "drives", {"a": "1"}, "line", 0)
    rows = np.zeros((3, 3)), np.zeros(2), np.zeros(2), np.arange(2.0)
    drives.add(Drive("surrogate", "line", "attack", 0, 0, *rows), Effort())

    def read(path: Path) -> None:
        kept = CheckpointFile(path, {"a": "1"})
        kept.read()
        kept.restore(attack)

    def read_drive(path: Path) -> None:
        KeptDrives(path.parent, {"a": "1"}, "line", 0).read()

    return [(path, read), (drives.paths()[0], read_drive)]


def of_checkpoint(rng: random.Random, raw: bytes) -> bytes:
    """Change a state, whose checksum becomes right again."""
    import safetensors.numpy

    from mi_nerfattack.io import resumable

    raw = of_tensors(rng, raw)
    tensors = safetensors.numpy.load(raw)
    length = int.from_bytes(raw[:8], "little")
    header = json.loads(raw[8 : 8 + length])
    header["__metadata__"][resumable._CHECKSUM] = resumable._checksum(tensors)
    text = json.dumps(header).encode()
    return len(text).to_bytes(8, "little") + text + raw[8 + length :]


_TENSORS = one_of(of_tensors, of_tensors, of_bytes)
_ZIP = one_of(of_zip, of_zip, of_bytes)
