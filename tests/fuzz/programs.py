"""The formats of policies, runs and recordings that are fuzzed; see `formats`."""

from __future__ import annotations

import io
import json
import random
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
from fuzz.mutations import WHOLES, of_bytes, of_tensors, of_text, one_of


def onnx_files(folder: Path) -> list[tuple[Path, Any]]:
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
    constants: dict[str, np.ndarray] = {
        "none": np.zeros(0, "f4"),
        "scales": np.float32([1, 1, 2, 2]),
        "seq": np.ones((3, 1, 2), "f4"),
        **dict.fromkeys(("wx", "wh"), np.ones((1, 8, 2), "f4")),
    }
    sizes = {"start": [0], "end": [2], "back": [0, -1], "pads": [0, 1, 0, 1]}
    sizes["wide"] = [2, 4]
    constants |= {name: np.int64(size) for name, size in sizes.items()}
    return _model(nodes, constants)


def _node(name: str, inputs: str, outputs: str, **attributes: Any) -> Any:
    from onnx import helper

    return helper.make_node(name, inputs.split(), outputs.split(), **attributes)


def _model(nodes: list[Any], constants: dict[str, np.ndarray]) -> Any:
    from support.files.policies import FLOAT, model

    inputs = {"image": (FLOAT, ["n", 3, 8, 10]), "goal": (FLOAT, ["n", 2])}
    return model(nodes, inputs, {"control": (FLOAT, ["n", 1])}, constants)


def of_onnx(rng: random.Random, raw: bytes) -> bytes:
    import onnx

    model = onnx.load_model_from_string(raw)
    holders: list[Any] = [model.graph]
    for holder in holders:  # which grows
        for field, value in holder.ListFields():
            if field.type == field.TYPE_MESSAGE:
                holders += list(value) if field.label == 3 else [value]
    holder = rng.choice(holders)
    field, value = rng.choice(holder.ListFields())
    if field.label == field.LABEL_REPEATED:
        i, j = rng.randrange(len(value)), rng.randrange(len(value))
        if field.type != field.TYPE_MESSAGE:
            value[i] = _scalar(rng, field, value[j], model)
        elif rng.random() < 0.5:
            value.insert(i, value[j])
        else:
            del value[i]
    elif field.type != field.TYPE_MESSAGE:
        setattr(holder, field.name, _scalar(rng, field, value, model))
    return model.SerializeToString()


def _scalar(rng: random.Random, field: Any, old: Any, model: Any) -> Any:
    if isinstance(old, bytes):
        return of_bytes(rng, old)
    if isinstance(old, str):
        from mi_nerfattack.policy.onnx.operators import OPERATORS

        nodes = model.graph.node
        names = [x for n in nodes for x in (n.op_type, *n.input, *n.output)]
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
    _, metadata = files.read_safetensors(folder / "whole.safetensors")
    tensors = {name: np.zeros(1, np.float32) for name in net.state_dict()}
    files.write_safetensors(folder / "pilotnet.safetensors", tensors, metadata)
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
    return (_ZIP if raw[:2] == b"PK" else _TENSORS)(rng, raw)


def programs(folder: Path) -> list[tuple[Path, Any]]:
    """Archives of programs; they are opened, and not run."""
    from mi_nerfattack.policy.exported import _read_archive

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
    from mi_nerfattack.scenes import bundled
    from mi_nerfattack.training.record import read_record

    path = folder / "record.json"
    path.write_bytes(bundled("policy/pilotnet.json").read_bytes())
    return [(path, read_record)]


def poses(folder: Path) -> list[tuple[Path, Any]]:
    from support.files import recordings as drives

    drives.write_csv_folder(folder / "csv")
    drives.write_csv_folder(folder / "toml")
    (folder / "toml/poses.csv").unlink()
    text = "[camera]\nwidth = 16\nheight = 8\nfx = 8.0\nfy = 8.0\ncx = 8.0\ncy = 4.0\n"
    for time, name, x, y, angle in (line.split(",") for line in drives.csv_rows()):
        text += f'[[frames]]\ntime_s = {time}\nfile = "{name}"\n'
        text += f"x_m = {x}\ny_m = {y}\nheading_rad = {angle}\n"
    (folder / "toml/poses.toml").write_text(text)
    return [(folder / f"{kind}/poses.{kind}", _replay) for kind in ("csv", "toml")]


def logs(folder: Path) -> list[tuple[Path, Any]]:
    from support.files import recordings as drives

    topics = drives.log_messages(folder)
    return [
        (drives.write_log(folder / f"{kind}.mcap", topics, kind), _replay)
        for kind in ("NONE", "ZSTD", "LZ4")
    ]


def videos(folder: Path) -> list[tuple[Path, Any]]:
    from support.files import recordings as drives

    return [(drives.write_drive_video(folder), _replay)]


def _replay(path: Path) -> None:
    """Open a recording, and read its images, and depths where there are some."""
    from support.files.recordings import CAMERA, MOUNT

    from mi_nerfattack.deploy.replay.environment import open_recording

    is_folder = path.stem == "poses"
    recording = open_recording(
        path.parent if is_folder else path, CAMERA if is_folder else None, MOUNT
    )
    for index in range(len(recording.track.times) if path.suffix == ".mp4" else 1):
        recording.image(index)
    if is_folder:
        recording.depth(0)


def scenes(folder: Path) -> list[tuple[Path, Any]]:
    from support.files.objects import four_colours
    from support.worlds.fields import blob
    from support.worlds.places import SCENE

    from mi_nerfattack.fields.io import save_field
    from mi_nerfattack.render.pathtrace.load import load_scene, scene_files

    save_field(folder / "field.safetensors", blob(np.random.default_rng(0)))
    four_colours().save(folder / "four.png")
    elements = """<shape type="cube"><bsdf type="diffuse">
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
    path.write_text(SCENE.replace("</scene>", elements))

    def read(path: Path) -> None:
        scene_files(path)
        load_scene(path)

    return [(path, read)]


def checkpoints(folder: Path) -> list[tuple[Path, Any]]:
    from support.worlds import loops as toy

    from mi_nerfattack.attack.gradient import GradientAttack
    from mi_nerfattack.attack.objectives import CrossTrackDeviation
    from mi_nerfattack.drives.spec import FORMAT, DriveSpec
    from mi_nerfattack.drives.store import Store, read_drive
    from mi_nerfattack.experiment.run_folder import CheckpointFile
    from mi_nerfattack.rollout.drive import Drive
    from mi_nerfattack.rollout.function import Rollout
    from mi_nerfattack.rollout.objective import StageSum

    loop, _ = toy.make_loop(coarse=True)
    objective = StageSum(CrossTrackDeviation(toy.ROUTE))
    rollout = Rollout(loop, objective, 2)
    attack = GradientAttack(rollout, toy.ROUTE, loop.initial(np.zeros((1, 3))))
    path = folder / "checkpoint.safetensors"
    CheckpointFile(path, {"a": "1"}).save(attack)
    spec = DriveSpec("surrogate", "line", "attack", 0, 0, 2, {"format": FORMAT})
    store = Store(folder / "drives")
    rows = np.zeros((3, 3)), np.zeros(2), np.zeros(2), np.arange(2.0)
    store.add(spec, Drive("surrogate", "line", "attack", 0, 0, *rows), 1.0)

    def read(path: Path) -> None:
        checkpoint = CheckpointFile(path, {"a": "1"})
        checkpoint.read()
        checkpoint.restore(attack)

    return [(path, read), (store.path(spec), read_drive)]


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


of_checkpoints = one_of(of_checkpoint, of_bytes)
_TENSORS = one_of(of_tensors, of_tensors, of_bytes)
_ZIP = one_of(of_zip, of_zip, of_bytes)
