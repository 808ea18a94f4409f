"""Weights of networks that Python code makes, from files of tensors alone."""

from __future__ import annotations

import io
from collections.abc import MutableMapping
from pathlib import Path
from typing import Any

import torch

from mi_nerfattack.errors import InputError
from mi_nerfattack.io import files

MAX_WEIGHT_BYTES = 1 << 33


def load_state(module: torch.nn.Module, path: Path) -> None:
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
    try:
        module.load_state_dict(state)
        wrong = [n for n, v in module.state_dict().items() if not v.isfinite().all()]
    except (RuntimeError, NotImplementedError, TypeError, AttributeError) as err:
        raise InputError(
            f"{path}: {err}; save the state_dict() of the very module that policy.file "
            "names"
        ) from err
    if wrong:
        raise InputError(f"{path}: {wrong[0]!r} is no tensor of finite values")


def load_drjit_state(network: Any, path: Path) -> None:
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
