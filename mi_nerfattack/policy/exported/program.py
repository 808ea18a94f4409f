"""A trained policy as a program of `torch.export`, to run without this package."""

from __future__ import annotations

import io
import warnings
from pathlib import Path

import torch

from mi_nerfattack.io import files
from mi_nerfattack.policy.pilotnet import IMAGE_SHAPE, PilotNet

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
