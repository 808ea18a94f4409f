"""A side of a comparison as a process: questions on stdin, answers as JSON on stdout.

Sides run in processes of their own because PyTorch's threads keep spinning for a while
after their work, which slows down whatever else its process computes, and because the
largest memory of a process is that of one side alone.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from mi_nerfattack import variant
from mi_nerfattack.bench.full_ngp import NGPData
from mi_nerfattack.bench.sides import AbstractSide


def main(arguments: Sequence[str]) -> None:
    """Serve one side until stdin ends.

    Args:
        arguments: role, width, height, and what the role needs: the field's file
            (``ours``, ``plain``, ``tuned``), samples per ray (``slab``), nothing
            (``object``); then, for the peers, sizes of chunks.
    """
    role, width, height, *rest = arguments
    side = make_side(role, int(width), int(height), rest)
    print(json.dumps("ready"), flush=True)
    for line in sys.stdin:
        print(json.dumps(_answer(side, line.strip())), flush=True)


def make_side(role: str, width: int, height: int, rest: list[str]) -> AbstractSide:
    """Make a side; imports only what it needs."""
    if role in ("plain", "tuned"):
        from mi_nerfattack.bench.peer import CHUNKS, TorchSide

        chunks = tuple(int(size) for size in rest[1:]) or CHUNKS
        data = NGPData.read(Path(rest[0]))
        return TorchSide(role, data, width, height, chunks)
    variant.ensure()
    from mi_nerfattack.bench import ours

    if role == "object":
        return ours.object_side(width, height)
    if role == "slab":
        return ours.slab_side(width, height, int(rest[0]))
    return ours.scene_side(NGPData.read(Path(rest[0])), width, height)


def _answer(side: AbstractSide, question: str) -> Any:
    return getattr(side, question)()


if __name__ == "__main__":
    main(sys.argv[1:])
