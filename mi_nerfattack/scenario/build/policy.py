"""The policy that a scenario describes."""

from __future__ import annotations

import io
from collections.abc import Callable, MutableMapping
from pathlib import Path
from typing import Any

import torch

from mi_nerfattack.errors import InputError, is_interrupt
from mi_nerfattack.io import files
from mi_nerfattack.policy.base import AbstractPolicy
from mi_nerfattack.policy.black_box import DIFFERENTIABLE_KINDS, CallablePolicy
from mi_nerfattack.policy.drjit_network import DrJitNetwork
from mi_nerfattack.policy.exported.load import load_exported, load_torchscript
from mi_nerfattack.policy.goals import AbstractGoal, IntegerGoal, NoGoal, OneHotGoal
from mi_nerfattack.policy.http_policy import HttpPolicy
from mi_nerfattack.policy.one_image import OneImage
from mi_nerfattack.policy.pilotnet import PilotNet
from mi_nerfattack.policy.preprocess import (
    AbstractStage,
    Crop,
    FractionalCrop,
    Normalise,
    Preprocess,
    Resize,
    ToLinear,
    antialias,
    area,
    bilinear,
    channels_first,
    channels_last,
    time_channels_last,
    time_first,
    to_bgr,
    to_grey,
    to_yuv,
)
from mi_nerfattack.policy.torch_policy import TorchPolicy
from mi_nerfattack.scenario.scenario import resolve
from mi_nerfattack.scenario.sections import PolicySection, PreprocessSection
from mi_nerfattack.scenario.user_code import check_trust, load_function, split_reference

FILTERS = {"antialias": antialias, "bilinear": bilinear, "area": area}
LAYOUTS = {
    "NCHW": channels_first,
    "NHWC": channels_last,
    "NTCHW": time_first,
    "NTHWC": time_channels_last,
}
COLOURS: dict[str, Callable[[], AbstractStage]] = {
    "linear": ToLinear,
    "yuv": to_yuv,
    "grey": to_grey,
    "bgr": to_bgr,
}
#: Kinds by the suffix of the file.
SUFFIXES = {
    ".safetensors": "pilotnet",
    ".py": "module",
    ".pt2": "exported",
    ".pt": "torchscript",
    ".onnx": "onnx",
}
#: Kinds whose files are code.
CODE = ("module", "drjit", "callable", "exported", "torchscript")
MAX_WEIGHT_BYTES = 1 << 33


def load_policy(section: PolicySection, base: str | Path) -> AbstractPolicy:
    """Make the policy of a scenario.

    Args:
        section: what the scenario says.
        base: folder that relative paths start from.

    Raises:
        InputError: a file is missing or wrong, or is code without the word of trust,
            a key does not fit the kind, or a package that the kind needs is not
            installed.
    """
    kind = policy_kind(section)
    _check_keys(section, kind)
    if kind in CODE:
        check_trust("policy.file", str(section.file), section.trust_code)
    return _LOADERS[kind](section, base)


def load_differentiable(section: PolicySection, base: str | Path) -> AbstractPolicy:
    """Make the policy of a scenario for a gradient method.

    Raises:
        InputError: as `load_policy`, or the policy is a black box.
    """
    policy = load_policy(section, base)
    if not policy.differentiable:
        raise InputError(
            f"policy: {section.file or section.url}: is a black box, which has no "
            f"derivatives; a gradient attack takes the kinds {DIFFERENTIABLE_KINDS}"
        )
    return policy


def policy_kind(section: PolicySection) -> str:
    """Return the kind, told by the file's suffix where it is left out."""
    if section.file is None:
        kind = section.kind or "http"
    else:
        named = ".py:" in section.file
        suffix = ".py" if named else Path(section.file).suffix.lower()
        kind = section.kind or SUFFIXES.get(suffix)
    if kind is None and ":" in (section.file or ""):
        raise InputError(
            f"policy.file: {section.file}: code is given as FILE.py:NAME, with the "
            "path of a Python file; import modules of a package in such a file"
        )
    if kind is None:
        raise InputError(
            f"policy.file: {section.file}: its suffix tells no kind; give policy.kind, "
            f"or one of {', '.join(SUFFIXES)}"
        )
    if (kind == "http") != (section.url is not None):
        raise InputError(
            f'policy.kind: "{kind}"; a url belongs to the kind "http", a file to the '
            "others"
        )
    return kind


def build_preprocess(section: PreprocessSection) -> Preprocess:
    """Make the stages that a scenario lists, in the order of its keys."""
    stages: list[AbstractStage] = []
    if section.crop_px is not None:
        stages.append(Crop(*section.crop_px))
    if section.crop_fraction is not None:
        stages.append(FractionalCrop(*section.crop_fraction))
    if section.resize_px is not None:
        stages.append(Resize(*section.resize_px, FILTERS[section.filter]))
    if section.colour != "srgb":
        stages.append(COLOURS[section.colour]())
    shift = Normalise(section.scale, section.mean, section.std)
    if (section.scale, section.mean, section.std) != (1.0, (0.0,), (1.0,)):
        stages.append(shift)
    layout = LAYOUTS[section.layout]
    return Preprocess(stages, section.frames, section.stride, layout)


def _check_keys(section: PolicySection, kind: str) -> None:
    """Refuse keys that would be ignored."""
    black = kind in ("callable", "http")
    allowed = {
        "weights_file": kind in ("module", "drjit"),
        "timeout_s": kind == "http",
        "retries": kind == "http",
        "goal": not black,
        "goals": not black,
        "recurrent": not black and kind not in ("pilotnet", "drjit"),
        "batch": not black,
    }
    for key, fits in allowed.items():
        value = getattr(section, key)
        if not fits and value != PolicySection.model_fields[key].default:
            raise InputError(f'policy.{key}: {value}; kind = "{kind}" does not take it')


def _pilotnet(section: PolicySection, base: str | Path) -> AbstractPolicy:
    assert section.file is not None
    module = PilotNet.load(resolve(section.file, base))
    goal = _goal(section, IntegerGoal(module.goals))
    return _torch_policy(section, module, goal, section.batch)


def _module(section: PolicySection, base: str | Path) -> AbstractPolicy:
    module = _make(section, base, torch.nn.Module, "torch.nn.Module")
    if section.weights_file is not None:
        _load_weights(module, resolve(section.weights_file, base))
    return _torch_policy(section, module, _goal(section, NoGoal()), section.batch)


def _exported(section: PolicySection, base: str | Path) -> AbstractPolicy:
    assert section.file is not None
    network = load_exported(resolve(section.file, base))
    batch = section.batch or network.batch
    return _torch_policy(section, network, _goal(section, NoGoal()), batch)


def _torchscript(section: PolicySection, base: str | Path) -> AbstractPolicy:
    assert section.file is not None
    network = load_torchscript(resolve(section.file, base))
    return _torch_policy(section, network, _goal(section, NoGoal()), section.batch)


def _onnx(section: PolicySection, base: str | Path) -> AbstractPolicy:
    from mi_nerfattack.policy.onnx.network import load_onnx

    assert section.file is not None
    network = load_onnx(resolve(section.file, base))
    batch = section.batch or network.batch
    return _torch_policy(section, network, _goal(section, NoGoal()), batch)


def _drjit(section: PolicySection, base: str | Path) -> AbstractPolicy:
    network = _make(section, base, Callable, "drjit.nn module or a function")
    if section.weights_file is not None:
        _load_drjit_weights(network, resolve(section.weights_file, base))
    module = DrJitNetwork(network)
    return _torch_policy(section, module, _goal(section, NoGoal()), section.batch)


def _callable(section: PolicySection, base: str | Path) -> AbstractPolicy:
    assert section.file is not None
    file, name = split_reference(section.file)
    function = load_function(resolve(file, base), name)
    return CallablePolicy(function, section.file, *_black_box_arguments(section))


def _http(section: PolicySection, base: str | Path) -> AbstractPolicy:
    del base
    assert section.url is not None
    arguments = _black_box_arguments(section)
    return HttpPolicy(section.url, section.timeout_s, section.retries, *arguments)


_LOADERS: dict[str, Callable[[PolicySection, str | Path], AbstractPolicy]] = {
    "pilotnet": _pilotnet,
    "module": _module,
    "exported": _exported,
    "torchscript": _torchscript,
    "onnx": _onnx,
    "drjit": _drjit,
    "callable": _callable,
    "http": _http,
}


def _black_box_arguments(
    section: PolicySection,
) -> tuple[Preprocess, float, int | None]:
    preprocess = build_preprocess(section.preprocess)
    return preprocess, section.control_scale, section.output


def _torch_policy(
    section: PolicySection,
    module: torch.nn.Module,
    goal: AbstractGoal,
    batch: int | None,
) -> TorchPolicy:
    if batch not in (None, 1):
        raise InputError(
            f"{section.file}: takes exactly {batch} images at a time; export it with a "
            "free batch size, or for one image"
        )
    return TorchPolicy(
        module if batch is None else OneImage(module, section.recurrent),
        goal,
        build_preprocess(section.preprocess),
        section.recurrent,
        section.control_scale,
        section.output,
        section.file,
    )


def _goal(section: PolicySection, default: AbstractGoal) -> AbstractGoal:
    if section.goal is None:
        return default
    if section.goal == "none" or section.goals is None:
        return NoGoal()
    kinds = {"integer": IntegerGoal, "one_hot": OneHotGoal}
    return kinds[section.goal](section.goals)


def _make(section: PolicySection, base: str | Path, kind: Any, wanted: str) -> Any:
    """Return the object of ``FILE.py:NAME``, or what calling it gives."""
    assert section.file is not None
    file, name = split_reference(section.file)
    found: Any = load_function(resolve(file, base), name)
    if isinstance(found, MutableMapping | torch.nn.Module):
        result = found  # a finished network of drjit.nn or torch.nn
    else:
        try:
            result = found()
        except Exception as err:
            if is_interrupt(err):
                raise
            raise InputError(
                f"{section.file}: calling it without arguments raises "
                f"{type(err).__name__}: {err}"
            ) from err
    if not isinstance(result, kind):
        raise InputError(
            f"{section.file}: gives a {type(result).__name__}; a {wanted} is needed"
        )
    return result


def _load_weights(module: torch.nn.Module, path: Path) -> None:
    """Copy a state dict into a module: safetensors, or torch's with tensors alone."""
    if path.suffix.lower() == ".safetensors":
        arrays, _ = files.read_safetensors(path)
        state: Any = {name: torch.from_numpy(a.copy()) for name, a in arrays.items()}
    else:
        raw = files.read_bytes(path, MAX_WEIGHT_BYTES)
        try:
            state = torch.load(io.BytesIO(raw), map_location="cpu", weights_only=True)
        except Exception as err:
            reason = str(err).strip().split("\n")[0]
            raise InputError(
                f"{path}: is no state dict of plain tensors ({reason}); save "
                "module.state_dict(), or safetensors"
            ) from err
    if not isinstance(state, dict):
        raise InputError(f"{path}: holds a {type(state).__name__}; a state dict needed")
    wrappers = [
        key for key in ("state_dict", "model", "model_state_dict") if key in state
    ]
    if wrappers and isinstance(state[wrappers[0]], dict):
        raise InputError(
            f"{path}: is a checkpoint of {', '.join(map(str, state))}; save its "
            f"{wrappers[0]!r} alone: torch.save(checkpoint[{wrappers[0]!r}], FILE)"
        )
    for name, value in state.items():
        if not isinstance(value, torch.Tensor) or not torch.isfinite(value).all():
            raise InputError(f"{path}: {name!r} is no tensor of finite values")
    try:
        module.load_state_dict(state)
    except RuntimeError as err:
        raise InputError(
            f"{path}: {err}; save the state_dict() of the very module that policy.file "
            "names"
        ) from err


def _load_drjit_weights(network: Any, path: Path) -> None:
    """Copy safetensors into a network of drjit.nn, by its own keys."""
    arrays, _ = files.read_safetensors(path)
    known = set(network) if isinstance(network, MutableMapping) else set()
    if known != set(arrays):
        raise InputError(
            f"{path}: tensors {sorted(arrays)}; the network has {sorted(known)}"
        )
    for name, value in arrays.items():
        like = network[name]
        if tuple(like.shape) != value.shape:
            raise InputError(
                f"{path}: tensor {name!r} of shape {value.shape}; {tuple(like.shape)} "
                "is needed"
            )
        network[name] = type(like)(value)
