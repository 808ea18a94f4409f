"""3D Gaussian splats made by hand, as files and as a float64 reference."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from mi_nerfattack.fields.splats import Splats

C0 = 0.5 / np.sqrt(np.pi)  # the harmonic of degree 0
NAMES = ("x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2")
TAIL = ("opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3")


def splats(
    centers,
    colours=(0.8, 0.4, 0.2),
    opacities=0.6,
    scales=0.1,
    quaternions=(1.0, 0.0, 0.0, 0.0),
    rest=None,
) -> Splats:
    """Make splats; everything but the centres is broadcast to (n, ...).

    Args:
        centers: (n, 3).
        colours: sRGB, where the view does not matter.
        opacities: at the centre, below 1.
        scales: standard deviations.
        quaternions: w, x, y, z.
        rest: (n, k - 1, 3) further harmonics.
    """
    centers = np.atleast_2d(np.asarray(centers, np.float32))
    n = len(centers)
    harmonics = (np.broadcast_to(colours, (n, 3))[:, None] - 0.5) / C0
    if rest is not None:
        harmonics = np.concatenate([harmonics, rest], 1)
    turns = np.broadcast_to(np.asarray(quaternions, np.float32), (n, 4))
    turns = turns / np.linalg.norm(turns, axis=1, keepdims=True)
    scales = np.asarray(scales, np.float32)
    scales = scales[:, None] if scales.ndim == 1 and len(scales) == n != 3 else scales
    return Splats(
        "splats",
        centers,
        np.array(np.broadcast_to(scales, (n, 3))),
        turns,
        np.array(np.broadcast_to(np.asarray(opacities, np.float32), n)),
        harmonics.astype(np.float32),
    )


def cloud(rng: np.random.Generator, count: int, giants: int = 0) -> Splats:
    """Make random splats of all shapes around the origin, some of them huge."""
    sizes = np.exp(rng.normal(-1.8, 0.7, (count, 3)))
    sizes[:giants] *= 12
    return splats(
        rng.uniform(-5, 5, (count, 3)),
        rng.uniform(0, 1, (count, 3)),
        rng.uniform(0.02, 0.6, count),
        sizes,
        rng.normal(size=(count, 4)),
    )


def wall(
    x: float, colour=(0.1, 0.3, 0.9), half: float = 6.0, step: float = 0.4
) -> Splats:
    """Make an opaque wall of splats across the x axis."""
    ticks = np.arange(-half, half + step / 2, step)
    y, z = np.meshgrid(ticks, ticks)
    places = np.stack([np.full(y.shape, x), y, z], -1).reshape(-1, 3)
    return splats(places, colour, 0.9999, [0.01, step, step])


def columns(item: Splats) -> dict[str, np.ndarray]:
    """Return what a trainer writes, by property, in its order."""
    n, k = item.harmonics.shape[:2]
    rest = item.harmonics[:, 1:].transpose(0, 2, 1).reshape(n, -1)
    names = [*NAMES, *(f"f_rest_{i}" for i in range(3 * (k - 1))), *TAIL]
    logits = np.log(item.opacities) - np.log1p(-item.opacities)
    table = np.concatenate(
        [
            item.centers,
            np.zeros((n, 3)),
            item.harmonics[:, 0],
            rest,
            logits[:, None],
            np.log(item.scales),
            item.quaternions,
        ],
        axis=1,
    )
    return dict(zip(names, table.T, strict=True))


def write_ply(
    path: Path,
    values: dict[str, np.ndarray],
    text: bool = False,
    types: dict[str, str] | None = None,
) -> Path:
    """Write properties as a PLY file of float, or of the types given."""
    types = types or {}
    codes = {"float": "<f4", "double": "<f8", "uchar": "u1"}
    kinds = [(name, types.get(name, "float")) for name in values]
    count = len(next(iter(values.values())))
    head = ["ply", f"format {'ascii' if text else 'binary_little_endian'} 1.0"]
    head += ["comment made by hand", f"element vertex {count}"]
    head += [f"property {kind} {name}" for name, kind in kinds]
    start = ("\n".join([*head, "end_header"]) + "\n").encode()
    rows = np.zeros(count, [(name, codes[kind]) for name, kind in kinds])
    for name, value in values.items():
        rows[name] = value
    if text:
        lines = (" ".join(f"{float(v):.9g}" for v in row) for row in rows.tolist())
        body = ("\n".join(lines) + "\n").encode()
    else:
        body = rows.tobytes()
    path.write_bytes(start + body)
    return path


def reference(
    item: Splats, origin: np.ndarray, directions: np.ndarray, t_max: float = np.inf
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Lay splats of degree 0 over each other in float64, without any structure.

    Returns:
        premultiplied sRGB (n, 3), opacity and depth moment (n,).
    """
    axes = Rotation.from_quat(item.quaternions[:, [1, 2, 3, 0]]).as_matrix()
    rows = axes.transpose(0, 2, 1) / item.scales[:, :, None].astype(float)
    colour = np.maximum(C0 * item.harmonics[:, 0].astype(float) + 0.5, 0)
    o = np.einsum("nij,nj->ni", rows, origin - item.centers.astype(float))
    seen, opacity, moment = [], [], []
    for direction in directions.astype(float):
        d = rows @ direction
        t = -(o * d).sum(1) / (d**2).sum(1)
        squared = ((o + t[:, None] * d) ** 2).sum(1)
        alpha = np.minimum(item.opacities * np.exp(-0.5 * squared), 0.9999)
        alpha[(squared > 9) | (t <= 0) | (t >= t_max)] = 0
        order = np.argsort(t)
        passed = np.cumprod(np.concatenate([[1.0], 1 - alpha[order]]))
        weight = passed[:-1] * alpha[order]
        seen.append(weight @ colour[order])
        opacity.append(1 - passed[-1])
        moment.append(weight @ t[order])
    return np.array(seen), np.array(opacity), np.array(moment)
