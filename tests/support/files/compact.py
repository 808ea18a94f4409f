"""SPZ and SPLAT files of splats, written as their descriptions say."""

from __future__ import annotations

import struct

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_nerfattack.fields.splats import Splats

from .objects import C0

FLIP = np.array([1.0, -1, -1])  # of SPZ's axes: right, up, back


def byte(values: np.ndarray) -> bytes:
    return np.clip(np.round(values), 0, 255).astype(np.uint8).tobytes()


def flipped(harmonics: np.ndarray) -> np.ndarray:
    """Return harmonics that show from F d what the others show from d."""
    directions = np.random.default_rng(0).normal(size=(64, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    degree = round(harmonics.shape[1] ** 0.5) - 1

    def basis(of: np.ndarray) -> np.ndarray:
        values = dr.sh_eval(mi.Vector3f(of.T.astype(np.float32)), degree)
        return np.stack([np.broadcast_to(x.numpy(), 64) for x in values], 1)

    colours = np.einsum("dk,nkc->dnc", basis(directions), harmonics)
    solution = np.linalg.lstsq(
        basis(directions * FLIP), colours.reshape(64, -1), rcond=None
    )
    return solution[0].reshape(harmonics.shape[1], -1, 3).swapaxes(0, 1)


def spz(item: Splats, version: int = 3, **header: int) -> bytes:
    """Write splats, decompressed, as the format's description says."""
    fields = {"degree": item.degree, "bits": 12, "flags": 0, "count": item.count}
    fields |= header
    fixed = np.round(item.centers * FLIP * 2 ** fields["bits"]).astype(np.int32)
    at = fixed.reshape(-1)[:, None] >> np.array([0, 8, 16]) & 255
    harmonics = flipped(item.harmonics)
    turns = item.quaternions[:, [1, 2, 3, 0]] * [*FLIP, 1]
    if version == 2:
        turns = turns * np.where(turns[:, 3:] < 0, -1, 1)
        rotations = byte(turns[:, :3] * 127.5 + 127.5)
    else:
        rotations = b"".join(smallest_three(row) for row in turns)
    head = fields["count"], fields["degree"], fields["bits"], fields["flags"], 0
    return (
        b"NGSP"
        + struct.pack("<IIBBBB", version, *head)
        + at.astype(np.uint8).tobytes()
        + byte(item.opacities * 255)
        + byte(harmonics[:, 0] * 0.15 * 255 + 0.5 * 255)
        + byte((np.log(item.scales) + 10) * 16)
        + rotations
        + byte(harmonics[:, 1:] * 128 + 128)
    )


def smallest_three(turn: np.ndarray) -> bytes:
    """Pack x, y, z, w: two bits say which is left out, then ten for each other."""
    largest = int(np.abs(turn).argmax())
    turn = turn * np.sign(turn[largest])
    word = largest
    for index in (k for k in range(4) if k != largest):
        size = int(abs(turn[index]) * np.sqrt(2) * 511 + 0.5)
        word = word << 10 | (turn[index] < 0) << 9 | size
    return struct.pack("<I", word)


def splat(item: Splats) -> bytes:
    turns = np.round(item.quaternions * 128 + 128).clip(0, 255).astype(np.uint8)
    colours = 0.5 + C0 * item.harmonics[:, 0]
    shades = np.concatenate([colours, item.opacities[:, None]], 1)
    shades = np.round(255 * shades).clip(0, 255).astype(np.uint8)
    rows = zip(item.centers, item.scales, shades, turns, strict=True)
    return b"".join(b"".join(part.tobytes() for part in row) for row in rows)
