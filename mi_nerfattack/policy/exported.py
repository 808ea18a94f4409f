"""Programs that were exported from torch: ``torch.export`` and TorchScript."""

from __future__ import annotations

import io
import json
import warnings
import zipfile
from pathlib import Path
from typing import Any

import torch

from mi_nerfattack import files
from mi_nerfattack.errors import InputError

MAX_PROGRAM_BYTES = 1 << 31
#: Parts of a program that torch would unpickle, or load as native code.
_UNSAFE = ("custom_obj", "opaque_obj", "data/aotinductor")


class ExportedNetwork(torch.nn.Module):
    """A program of ``torch.export``; its mode was fixed when it was exported.

    Attributes:
        batch: the number of images that it takes, None where any.
    """

    def __init__(self, program: torch.export.ExportedProgram) -> None:
        super().__init__()
        self.program = program.module()
        self.batch = _batch(program)

    def train(self, mode: bool = True) -> ExportedNetwork:
        """Do nothing: an exported program cannot change its mode."""
        del mode
        return self

    def forward(self, *arguments: torch.Tensor) -> Any:
        """Call the program."""
        return self.program(*arguments)


def load_exported(path: Path) -> ExportedNetwork:
    """Read a ``.pt2`` file of ``torch.export.save``.

    Raises:
        InputError: no such file, another format, or one with pickled objects.
    """
    raw = files.read_bytes(path, MAX_PROGRAM_BYTES)
    _check_archive(path, raw)
    try:
        program = torch.export.load(io.BytesIO(raw))
        network = ExportedNetwork(program)
    except (RuntimeError, ValueError, KeyError, AssertionError, TypeError) as err:
        raise InputError(
            f"{path}: torch {torch.__version__} cannot load the program ({err}); "
            "export it again with this version"
        ) from err
    return network


def load_torchscript(path: Path) -> torch.nn.Module:
    """Read a file of ``torch.jit.save``, onto the CPU.

    Raises:
        InputError: no such file, or another format.
    """
    raw = files.read_bytes(path, MAX_PROGRAM_BYTES)
    try:
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", "`torch.jit.load`", DeprecationWarning)
            return torch.jit.load(io.BytesIO(raw), map_location="cpu")
    except RuntimeError as err:
        reason = str(err).strip().splitlines()[0]
        raise InputError(
            f"{path}: is no TorchScript program ({reason}); save one with "
            "torch.jit.save, or give weights to a FILE.py:NAME as policy.weights"
        ) from err


def _batch(program: torch.export.ExportedProgram) -> int | None:
    """Return the first size of the first input where it is fixed."""
    first = program.graph_signature.user_inputs[0]
    for node in program.graph.nodes:
        if node.op == "placeholder" and node.name == first:
            size = node.meta["val"].shape[0]
            return size if isinstance(size, int) else None
    return None


def _check_archive(path: Path, raw: bytes) -> None:
    """Refuse everything but plain tensors: torch would unpickle the rest."""
    try:
        with zipfile.ZipFile(io.BytesIO(raw)) as archive:
            names = archive.namelist()
            contents = {
                name: archive.read(name)
                for name in names
                if name.endswith("_config.json") or "/sample_inputs/" in name
            }
    except (zipfile.BadZipFile, NotImplementedError, RuntimeError, EOFError) as err:
        raise InputError(
            f"{path}: is no .pt2 file ({err}); write it with torch.export.save"
        ) from err
    if len(set(names)) < len(names) or not any("/models/" in n for n in names):
        raise InputError(
            f"{path}: holds no exported program; write it with torch.export.save of "
            "torch 2.9 or later"
        )
    unsafe = [n for n in names if any(part in n for part in _UNSAFE)]
    unsafe += [n for n in names if "/data/weights/" in n and n.endswith(".pt")]
    unsafe += [n for n in names if "/data/constants/" in n and n.endswith(".pt")]
    unsafe += [n for n, data in contents.items() if not _is_plain(n, data)]
    if unsafe:
        raise InputError(
            f"{path}: {unsafe[0]}: pickled objects or native code, which are not "
            "loaded; export a program whose inputs and weights are plain tensors"
        )


def _is_plain(name: str, data: bytes) -> bool:
    """Tell a list of plain tensors, or example inputs without other objects."""
    if name.endswith("_config.json"):
        try:
            entries = json.loads(data).get("config", {})
            return not any(entry.get("use_pickle") for entry in entries.values())
        except (ValueError, AttributeError):
            return False
    if not data:
        return True
    try:
        torch.load(io.BytesIO(data), weights_only=True)
    except Exception:
        return False
    return True
