"""A side of a comparison as a process: questions and answers are lines of JSON.

A question on stdin is the name of a method of the side and its arguments, in a list.

Sides run in processes of their own because PyTorch's threads keep spinning for a while
after their work, which slows down whatever else its process computes, and because the
largest memory of a process is that of one side alone.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from bench.attack.sides import AbstractAttack
from bench.full_ngp import NGPData
from bench.render.sides import AbstractSide, AbstractTrainer
from mi_nerfattack import variant

if TYPE_CHECKING:
    from bench.loop.ways import AbstractLoop


def main(arguments: Sequence[str]) -> None:
    """Serve one side until stdin ends.

    Args:
        arguments: ``fit`` and what :func:`make_trainer` takes; ``attack`` and what
            :func:`make_attack` takes; ``loop`` and what :func:`make_loop` takes; or
            role, width, height,
            and what the role needs: the field's file (``ours``, ``plain``,
            ``tuned``), samples per ray (``slab``), nothing (``object``); then, for the
            peers, sizes of chunks.
    """
    side: Any
    if arguments[0] == "fit":
        side = make_trainer(*arguments[1:])
    elif arguments[0] == "attack":
        side = make_attack(*arguments[1:])
    elif arguments[0] == "loop":
        side = make_loop(*arguments[1:])
    else:
        role, width, height, *rest = arguments
        side = make_side(role, int(width), int(height), rest)
    print(json.dumps("ready"), flush=True)
    for line in sys.stdin:
        question, *given = json.loads(line)
        print(json.dumps(getattr(side, question)(*given)), flush=True)


def make_side(role: str, width: int, height: int, rest: list[str]) -> AbstractSide:
    """Make a side; imports only what it needs."""
    if role in ("plain", "tuned"):
        from bench.render.peer import CHUNKS, TorchSide
        from bench.torch import device

        device.choose()
        chunks = tuple(int(size) for size in rest[1:]) or CHUNKS
        data = NGPData.read(Path(rest[0]))
        return TorchSide(role, data, width, height, chunks)
    variant.ensure()
    from bench.render import ours

    if role == "object":
        return ours.object_side(width, height)
    if role == "slab":
        return ours.slab_side(width, height, int(rest[0]))
    return ours.scene_side(NGPData.read(Path(rest[0])), width, height)


def make_trainer(role: str, start: str, *rest: str) -> AbstractTrainer:
    """Make a side of a comparison of training steps; imports only what it needs.

    Args:
        role: ``ours``, ``plain`` or ``tuned``.
        start: for ours, the file of what is fitted; for a peer, the field's file.
        rest: for a peer, the file of the pictures, rays a step, and, to try nothing
            else, the rays of a chunk.
    """
    if role in ("plain", "tuned"):
        from bench.fit.peer import TorchTrainer
        from bench.torch import device

        device.choose()
        pictures, rays, *chunk = rest
        return TorchTrainer(
            role, Path(start), Path(pictures), int(rays), *map(int, chunk)
        )
    variant.ensure()
    from bench.fit.ours import OurTrainer

    return OurTrainer(Path(start))


def make_attack(role: str, *rest: str) -> AbstractAttack:
    """Make a side of a comparison of attack iterations; imports only what it needs.

    Args:
        role: ``ours``, ``plain``, ``tuned`` or ``baked``.
        rest: width, height, poses, horizon and objects; for ours, also the file of the
            bricks, if they are asked for; for a peer, the files of the background and
            of the object, and, to try nothing else, the rays of a chunk and the
            object's lookup.
    """
    from bench.attack.drive import Job

    job, others = Job(*map(int, rest[:5])), rest[5:]
    if role != "ours":
        from bench.attack.peer import LOOKUPS, TorchAttack
        from bench.render.peer import CHUNKS
        from bench.torch import device

        device.choose()
        scene, item, *choices = others
        chunks = (int(choices[0]),) if choices else CHUNKS
        lookups = (choices[1],) if choices else tuple(LOOKUPS)
        return TorchAttack(role, Path(scene), Path(item), job, chunks, lookups)
    variant.ensure()
    from bench.attack.ours import OurAttack

    return OurAttack(job, *map(Path, others))


def make_loop(way: str, policy: str, width: str, height: str) -> AbstractLoop:
    """Make a side of `bench loop`.

    Args:
        way: ``replay``, ``kept_backgrounds`` or ``plain``.
        policy: ``torch`` or ``drjit``, the library of the policy.
        width: of the image, pixels.
        height: of the image, pixels.
    """
    variant.ensure()
    from bench.loop.ways import PlainLoop, RolloutLoop
    from mi_nerfattack.rollout.adjoint import KeptBackgrounds, Replay

    if way == "plain":
        return PlainLoop(policy, int(width), int(height))
    adjoint = Replay() if way == "replay" else KeptBackgrounds()
    return RolloutLoop(adjoint, policy, int(width), int(height))


if __name__ == "__main__":
    main(sys.argv[1:])
