"""Random textures of grid fields: training data, and the baseline of an attack."""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from mi_nerfattack.errors import InputError
from mi_nerfattack.fields.grid import GridField

#: Kinds that "mixed" chooses from.
KINDS = ("noise", "blobs", "flat")
#: Standard deviation of the sum of raw values over the levels (before the sigmoid):
#: about that of the logit of a uniform number.
SPREAD = 1.8
#: Vertices along an edge of the lattice of random values under "blobs".
BLOB_RESOLUTION = (2, 7)


def random_texture(field: GridField, kind: str, seed: int) -> np.ndarray:
    """Draw raw colour values for every vertex of a grid field.

    The colour at a point is the sigmoid of the sum over all levels of interpolated
    values. The sum has a standard deviation of about 1.8 over positions and seeds, so
    that colours cover most of [0, 1] (sRGB). Levels that a kind leaves out are zero.

    - `"flat"`: one colour, uniform in [0.02, 0.98] per channel;
    - `"blobs"`: random values on a lattice of 2 to 7 vertices along an edge,
      interpolated onto the coarsest level: patches of a third of the object and less;
    - `"noise"`: white noise on the finest level, a quarter of the levels or the
      coarsest level, around a random mean: speckles as small as the grid can hold;
    - `"mixed"`: one of these, by seed.

    Args:
        field: only its `levels` and `n_vertices` are read.
        kind: one of the four above.
        seed: non-negative integer; the same seed gives the same texture.

    Returns:
        (n_vertices, 3) float32, without unit; for `set_parameter("texture", ...)`.

    Raises:
        InputError: unknown kind or negative seed.
    """
    if kind not in (*KINDS, "mixed"):
        raise InputError(f"kind: {kind!r}; allowed: {', '.join(KINDS)}, mixed")
    if seed < 0:
        raise InputError(f"seed: {seed}; at least 0")
    rng = np.random.default_rng(seed)
    if kind == "mixed":
        kind = KINDS[rng.integers(len(KINDS))]
    texture = np.zeros((field.n_vertices, 3), np.float32)
    coarsest = field.levels()[0]
    if kind == "flat":
        texture[coarsest.vertices] = _logit(rng.uniform(0.02, 0.98, 3))
    elif kind == "blobs":
        texture[coarsest.vertices] = _blobs(coarsest.resolution, rng)
    else:
        _add_noise(field, texture, rng)
    return texture


def _blobs(resolution: int, rng: np.random.Generator) -> np.ndarray:
    """Interpolate a coarse random lattice, (resolution^3, 3), x fastest."""
    coarse = int(rng.integers(BLOB_RESOLUTION[0], BLOB_RESOLUTION[1] + 1))
    # interpolation halves the variance and more between the lattice's vertices
    values = rng.normal(0, 1.4 * SPREAD, (coarse, coarse, coarse, 3))
    at = np.linspace(0, coarse - 1, resolution)
    where = np.stack(np.meshgrid(at, at, at, indexing="ij"))
    channels = [
        ndimage.map_coordinates(values[..., c], where, order=1) for c in range(3)
    ]
    return np.stack(channels, axis=-1).reshape(-1, 3)


def _add_noise(field: GridField, texture: np.ndarray, rng: np.random.Generator) -> None:
    """Add white noise to one, a quarter or none but the coarsest of the levels."""
    levels = field.levels()
    quarter = max(1, len(levels) // 4)
    chosen = (levels[-1:], levels[-quarter:], levels[:1])[rng.integers(3)]
    for level in chosen:
        spread = 1.4 * SPREAD / np.sqrt(len(chosen))
        noise = rng.normal(0, spread, (level.resolution**3, 3))
        texture[level.vertices] += noise.astype(np.float32)
    mean = _logit(rng.uniform(0.15, 0.85, 3))
    texture[levels[0].vertices] += mean.astype(np.float32)


def _logit(colour: np.ndarray) -> np.ndarray:
    """Invert the sigmoid."""
    return np.log(colour / (1 - colour))
