"""Programs that were exported from torch: ``torch.export`` and TorchScript.

A program is code. torch unpickles parts of it, runs its guards as Python and calls
whatever operators it names, those that write files too: no check of its text makes it
safe. Load programs of people that you trust, as you run their Python files.
"""

from __future__ import annotations

import io
import warnings
import zipfile
from pathlib import Path
from typing import Any

import torch

from mi_nerfattack.errors import InputError, is_interrupt
from mi_nerfattack.io import files
from mi_nerfattack.policy.checks import misfit
from mi_nerfattack.policy.pilotnet import IMAGE_SHAPE, PilotNet

MAX_PROGRAM_BYTES = 1 << 31


class ExportedNetwork(torch.nn.Module):
    """A program of ``torch.export``; its mode was fixed when it was exported.

    Attributes:
        sizes: of the images that it takes, None where any.
        batch: the first of them.
    """

    def __init__(self, program: torch.export.ExportedProgram, name: str) -> None:
        """Take a program over; `name` is for messages."""
        super().__init__()
        self.program, self.name = program.module(), name
        self.sizes: tuple[int | None, ...] = _image_sizes(program)
        self.batch: int | None = self.sizes[0] if self.sizes else None

    def train(self, mode: bool = True) -> ExportedNetwork:
        """Do nothing: an exported program cannot change its mode."""
        del mode
        return self

    def forward(self, *arguments: torch.Tensor) -> Any:
        """Call the program."""
        shape = tuple(arguments[0].shape)
        pairs = zip(self.sizes, shape, strict=False)
        if any(size not in (None, actual) for size, actual in pairs):
            raise InputError(f"{self.name}: {misfit(self.sizes, shape)}")
        return self.program(*arguments)


def load_exported(path: Path) -> ExportedNetwork:
    """Read a ``.pt2`` file of ``torch.export.save``, which runs code in it.

    Raises:
        InputError: no such file, or another format.
    """
    raw = _read_archive(path, "torch.export.save")
    try:
        program = torch.export.load(io.BytesIO(raw))
        network = ExportedNetwork(program, str(path))
    except Exception as err:  # torch raises whatever a damaged program leads to
        if is_interrupt(err):
            raise
        raise InputError(
            f"{path}: torch {torch.__version__} cannot load the program ({err}); "
            "export it again with this version"
        ) from err
    return network


def load_torchscript(path: Path) -> torch.nn.Module:
    """Read a file of ``torch.jit.save``, onto the CPU; running it runs its code.

    Raises:
        InputError: no such file, or another format.
    """
    raw = _read_archive(path, "torch.jit.save")
    try:
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", "`torch.jit.load`", DeprecationWarning)
            return torch.jit.load(io.BytesIO(raw), map_location="cpu")
    except RuntimeError as err:
        reason = str(err).strip().splitlines()[0]
        raise InputError(
            f"{path}: is no TorchScript program ({reason}); save one with "
            "torch.jit.save, or give weights to a FILE.py:NAME as policy.weights_file"
        ) from err


def _read_archive(path: Path, writer: str) -> bytes:
    """Return a ZIP file whose content is not larger than a program may be."""
    raw = files.read_bytes(path, MAX_PROGRAM_BYTES)
    try:
        with zipfile.ZipFile(io.BytesIO(raw)) as archive:
            size = sum(item.file_size for item in archive.infolist())
    # a damaged archive makes zipfile raise whatever its parser stumbles over
    except Exception as err:
        raise InputError(
            f"{path}: is no program ({err}); write it with {writer}"
        ) from err
    if size > MAX_PROGRAM_BYTES:
        raise InputError(
            f"{path}: unpacks to {size} bytes; {MAX_PROGRAM_BYTES} are allowed"
        )
    return raw


def _image_sizes(program: torch.export.ExportedProgram) -> tuple[int | None, ...]:
    """Return the sizes of the first input, None where one is free."""
    first = list(program.graph_signature.user_inputs)[0]
    for node in program.graph.nodes:
        if node.op == "placeholder" and node.name == first:
            sizes = node.meta["val"].shape
            return tuple(size if isinstance(size, int) else None for size in sizes)
    return ()


#: Suffix of programs, as `policy.exported` reads them.
SUFFIX = ".pt2"


def export_program(module: PilotNet, path: str | Path) -> None:
    """Write a policy as a program with any number of images.

    It is called with images (n, 3, 66, 200), sRGB in [0, 1], float32, and goals (n,),
    int64, and returns controls (n,). `policy.exported.load_exported` and, elsewhere,
    `torch.export.load` read it.

    Args:
        module: its mode does not matter; left unchanged.
        path: ends in .pt2; replaced atomically.
    """
    copy = PilotNet(module.goals, module.max_control, module.unit)
    copy.load_state_dict(module.state_dict())
    copy.eval().requires_grad_(False)
    image, goal = torch.zeros(2, 3, *IMAGE_SHAPE), torch.zeros(2, dtype=torch.int64)
    count = torch.export.Dim("n", min=1, max=1 << 16)
    with warnings.catch_warnings():
        # of torch about its own modules
        warnings.simplefilter("ignore", DeprecationWarning)
        warnings.simplefilter("ignore", FutureWarning)
        program = torch.export.export(
            copy, (image, goal), dynamic_shapes=({0: count}, {0: count})
        )
        buffer = io.BytesIO()
        torch.export.save(program, buffer)
    files.write_bytes(path, buffer.getvalue())
