"""SPZ and SPLAT: what is read of them is what was written, in the frame of PLY."""

from __future__ import annotations

import gzip
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from support.files import objects as made
from support.files.compact import splat, spz

from mi_nerfattack.errors import InputError
from mi_nerfattack.fields.compact_splats import load_splats
from mi_nerfattack.fields.splats import Splats, read_splats


def agree(loaded: Splats, item: Splats, turns: float, colours: float) -> None:
    np.testing.assert_allclose(loaded.centers, item.centers, atol=2e-4)
    np.testing.assert_allclose(loaded.scales, item.scales, rtol=0.04)
    np.testing.assert_allclose(loaded.opacities, item.opacities, atol=0.003)
    cosine = np.abs((loaded.quaternions * item.quaternions).sum(1))
    assert cosine.min() > np.cos(turns)
    np.testing.assert_allclose(loaded.harmonics, item.harmonics, atol=colours)


@pytest.fixture
def item(rng, variant) -> Splats:
    """Forty splats of degree 3."""
    item = made.cloud(rng, 40)
    bands = rng.uniform(-0.4, 0.4, (40, 15, 3)).astype(np.float32)
    return replace(item, harmonics=np.concatenate([item.harmonics, bands], 1))


@pytest.mark.parametrize(("version", "turns"), [(2, 0.1), (3, 0.005)])
@pytest.mark.parametrize("degree", [0, 2, 3])
def test_spz_comes_back(tmp_path: Path, item, version, turns, degree) -> None:
    item = replace(item, harmonics=item.harmonics[:, : (degree + 1) ** 2])
    path = tmp_path / "a.spz"
    path.write_bytes(gzip.compress(spz(item, version)))
    agree(load_splats(path), item, turns, 0.014)


def test_splat_comes_back(tmp_path: Path, item) -> None:
    item = replace(item, harmonics=item.harmonics[:, :1])
    path = tmp_path / "a.SPLAT"
    path.write_bytes(splat(item))
    agree(load_splats(path), item, 0.02, 0.01)


def test_ply_is_read_as_before(tmp_path: Path, item) -> None:
    path = made.write_ply(tmp_path / "a.ply", made.columns(item))
    np.testing.assert_array_equal(load_splats(path).centers, read_splats(path).centers)


def test_what_is_no_splats_is_refused(tmp_path: Path, item) -> None:
    compressed, web = gzip.compress(spz(item)), splat(item)
    nan = np.full(3, np.nan, np.float32).tobytes()
    cases = {
        "a.spz": (
            (compressed[:-20], "ends early"),
            (b"PK" + compressed, "incorrect header check; damaged"),
            (gzip.compress(b"ply\n" + bytes(20)), "does not begin as an .spz"),
            (gzip.compress(spz(item)[:-1]), "damaged; export"),
            (gzip.compress(spz(item, 4)), "version 4; versions 2 and 3"),
            (gzip.compress(spz(item, flags=2)), "an .spz with extensions"),
            (gzip.compress(spz(item, degree=4)), "harmonics of degree 4"),
            (gzip.compress(spz(item, count=1 << 30)), "need"),
        ),
        "a.splat": (
            (b"", "0 bytes"),
            (web[:-1], "truncated"),
            (web[:12] + bytes(4) + web[16:], "scale is not positive"),
            (web[:12] + nan + web[24:], "scale is not positive"),
            (nan + web[12:], "position is not finite"),
            (web[:28] + bytes([128] * 4) + web[32:], "are all 0"),
        ),
    }
    for name, rows in cases.items():
        for content, message in rows:
            (tmp_path / name).write_bytes(content)
            with pytest.raises(InputError, match=message):
                load_splats(tmp_path / name)
