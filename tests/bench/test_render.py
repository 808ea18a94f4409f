"""The PyTorch peer agrees with the renderer; what `bench render` prints."""

from __future__ import annotations

import json
import math
import subprocess
import sys

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
import torch
from helpers.small_fields import small_ngp

from bench.__main__ import main
from bench.full_ngp import NGPData, enlarge, level_sizes
from bench.render.run import Worker
from bench.render.table import ROWS, render_table
from bench.torch.encoding import PlainHashGrid, TunedHashGrid
from bench.torch.ngp import TorchNGP, decode, spherical_harmonics, sum_before
from mi_nerfattack import cli
from mi_nerfattack.errors import InputError, NerfAttackError
from mi_nerfattack.fields import NGPLayout, Occupancy
from mi_nerfattack.io import files
from mi_nerfattack.render.interleaved import InterleavedComposite
from mi_nerfattack.render.march import March, Rays
from mi_nerfattack.render.posed import PosedField
from mi_nerfattack.system.memory import peak_memory_mb

pytestmark = pytest.mark.usefixtures("variant")
STOP = 1e-3
GRIDS = [PlainHashGrid, TunedHashGrid]


def peer_field(rng: np.random.Generator) -> NGPData:
    """Make a field with holes, a growing step, and densities up to opaque."""
    field = small_ngp(cone=1 / 64)
    field.occupancy = Occupancy(rng.random((6, 5, 4)) < 0.6)
    data = NGPData.of(field)
    data.tensors["density_net.1"][0] *= 3
    return data


def fan(rng: np.random.Generator, count: int = 64) -> tuple[np.ndarray, np.ndarray]:
    """Make rays from inside and outside of the box, in all directions."""
    origin = rng.uniform(-1.5, 1.5, (count, 3)).astype(np.float32)
    direction = rng.normal(size=(count, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    return origin, direction.astype(np.float32)


def our_image(field, origin, direction):
    rays = Rays(mi.Point3f(origin.T.copy()), mi.Vector3f(direction.T.copy()))
    posed = PosedField(field)
    seen = InterleavedComposite().render([posed], rays, STOP)
    behind = field.background(rays.direction)
    image = seen.total.radiance + (1 - seen.total.opacity) * behind
    return posed, rays, seen, behind, image.numpy().T


@pytest.mark.parametrize("grid", GRIDS)
def test_the_peer_sees_the_same_image(rng, grid):
    data = peer_field(rng)
    origin, direction = fan(rng)
    image = our_image(data.field(), origin, direction)[-1]
    peer = TorchNGP(data, grid(data.layout), STOP)
    found = peer.render(torch.tensor(origin), torch.tensor(direction)).numpy()
    assert image.std() > 0.05
    assert np.abs(found - image).max() < 1e-3


@pytest.mark.parametrize("grid", GRIDS)
def test_the_peer_has_the_same_gradients(rng, grid):
    data = peer_field(rng)
    origin, direction = fan(rng)
    cotangent = rng.normal(size=origin.shape).astype(np.float32)
    field = data.field()
    for name in ("table", "density_weights", "colour_weights"):
        dr.enable_grad(field.parameters()[name])
    posed, rays, seen, behind, _ = our_image(field, origin, direction)
    by_radiance = mi.Color3f(cotangent.T.copy())
    by_total = March(by_radiance, -dr.dot(by_radiance, dr.detach(behind)), mi.Float(0))
    InterleavedComposite().backward([posed], rays, seen, by_total, STOP)

    peer = TorchNGP(data, grid(data.layout), STOP)
    for value in peer.parameters.values():
        value.requires_grad_(True)
    image = peer.render(torch.tensor(origin), torch.tensor(direction))
    (image * torch.tensor(cotangent)).sum().backward()
    table = dr.grad(field.parameters()["table"]).numpy()
    assert relative(peer.parameters["table"].grad.numpy().ravel(), table) < 1e-2
    for name, net in (("density", field.density_net), ("colour", field.colour_net)):
        packed = dr.grad(net["weights"])
        ours = np.linalg.norm(packed.numpy())
        theirs = [
            value.grad.numpy().ravel()
            for key, value in peer.parameters.items()
            if key.startswith(name)
        ]
        assert np.linalg.norm(np.concatenate(theirs)) == pytest.approx(ours, rel=1e-2)


def relative(found: np.ndarray, expected: np.ndarray) -> float:
    return float(np.linalg.norm(found - expected) / np.linalg.norm(expected))


def test_both_encodings_agree_where_levels_are_hashed(rng):
    layout = NGPLayout(6, 2, 9, 4, 64, 16)
    plain, tuned = PlainHashGrid(layout), TunedHashGrid(layout)
    assert 0 < plain.dense < layout.levels
    table = torch.tensor(rng.normal(size=(plain.rows, 2)), dtype=torch.float32)
    unit = torch.tensor(rng.random((50, 3)), dtype=torch.float32)
    assert torch.allclose(plain(table, unit), tuned(table, unit), atol=1e-5)


def test_the_tuned_encoding_refuses_other_features():
    with pytest.raises(InputError, match="features: 4"):
        TunedHashGrid(NGPLayout(features=4))


def test_level_sizes_are_those_of_the_encoding():
    field = small_ngp()
    offsets = [field.encoding.level_offset(i) for i in range(field.layout.levels + 1)]
    sizes = level_sizes(field.layout)
    assert [size for _, _, size in sizes] == np.diff(offsets).tolist()


def test_harmonics_are_orthonormal_and_dr_jits(rng):
    """Integrals over the sphere by a product rule that is exact for degree 6."""
    nodes, weights = np.polynomial.legendre.leggauss(8)
    azimuth = np.arange(16) * 2 * np.pi / 16
    z, phi = (a.ravel() for a in np.meshgrid(nodes, azimuth, indexing="ij"))
    radius = np.sqrt(1 - z * z)
    points = np.stack([radius * np.cos(phi), radius * np.sin(phi), z], 1)
    values = spherical_harmonics(torch.tensor(points)).numpy()
    weight = np.repeat(weights, 16) * 2 * np.pi / 16
    assert np.allclose(values.T @ (values * weight[:, None]), np.eye(16), atol=1e-12)
    theirs = dr.sh_eval(mi.Vector3f(points.T.astype(np.float32)), 3)
    theirs = np.stack([value.numpy() for value in map(mi.Float, theirs[1:])], 1)
    assert np.allclose(theirs, values[:, 1:], atol=1e-5)


def test_sum_before_starts_anew_at_each_ray():
    x = torch.tensor([1.0, 2.0, 3.0, 10.0, 20.0, 5.0])
    ray = torch.tensor([0, 0, 0, 4, 4, 7])
    assert sum_before(x, ray).tolist() == [0, 1, 3, 0, 10, 0]


def test_decode_has_finite_derivatives_at_both_ends():
    raw = torch.tensor([-100.0, -4.0, 0.0, 100.0], requires_grad=True)
    decode(raw).sum().backward()
    assert torch.isfinite(raw.grad).all()
    assert decode(raw).detach().numpy() == pytest.approx(
        [0, 0.0013921, 0.2140, 1], 1e-3
    )


def test_an_enlarged_field_shows_the_same(rng):
    data = peer_field(rng)
    full = NGPLayout(7, 2, 12, 4, 16, 32)
    large = enlarge(data, full)
    assert (large.layout.levels, large.layout.width) == (7, 32)
    origin, direction = fan(rng)
    small_image = our_image(data.field(), origin, direction)[-1]
    large_image = our_image(large.field(), origin, direction)[-1]
    assert np.abs(small_image - large_image).max() < 2e-3


def test_field_data_survive_a_file(rng, tmp_path):
    data = peer_field(rng)
    data.write(tmp_path / "field.safetensors")
    back = NGPData.read(tmp_path / "field.safetensors")
    assert back.layout == data.layout
    assert (back.step_m, back.cone) == (data.step_m, data.cone)
    assert np.array_equal(back.cells, data.cells)
    assert all(np.array_equal(back.tensors[k], v) for k, v in data.tensors.items())


@pytest.mark.slow
def test_a_quick_benchmark_prints_the_promised_keys(capsys, tmp_path):
    size = ["--sizes", "16x8", "--repeats", "1"]
    output = tmp_path / "results"
    command = ["render", "--quick", "--json", *size, "-o", str(output)]
    assert main(command) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["kernels_compiled_after_warmup"] == 0
    assert list(document["sizes"]) == ["16x8"]
    row = document["sizes"]["16x8"]
    for side in ("", "torch_", "torch_tuned_"):
        for key in ("forward_samples_per_s", "backward_samples_per_s", "frame_ms"):
            assert 0 < row[side + key] < math.inf
    assert row["peak_memory_mb"] > 0
    assert row["samples"] == pytest.approx(row["torch_samples"], rel=0.02)
    assert set(document["memory_by_samples_per_ray"]) == {"64", "1024", "change"}
    assert document["object_grid"]["ratio"] > 0
    [written] = output.iterdir()
    assert json.loads(written.read_text()) == document
    assert written.name.startswith(document["date"])


@pytest.mark.parametrize(
    ("argument", "value"),
    [("--sizes", "200"), ("--sizes", "2x2"), ("--repeats", "0")],
)
def test_bad_arguments_are_refused(capsys, argument, value):
    assert main(["render", argument, value]) == cli.EXIT_INPUT
    message = capsys.readouterr().err
    assert argument in message
    assert value in message


def test_a_process_does_not_inherit_the_peak_of_its_parent():
    """A child that only imports the package, of a parent that holds 800 MB more."""
    ballast = np.ones(100_000_000)
    code = "from mi_nerfattack.system import memory; print(memory.peak_memory_mb())"
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, check=True)
    assert 20 < float(run.stdout) < 700
    assert peak_memory_mb() > ballast.nbytes / 1e6


def test_a_worker_that_fails_names_itself():
    with pytest.raises(NerfAttackError, match="plain 8 8 missing"):
        with Worker("plain", "8", "8", "missing.safetensors"):
            pass


def test_the_table_has_a_ratio_for_each_speed():
    row = {
        f"{prefix}{key}": 100.0 / factor
        for prefix, factor in (("", 1), ("torch_", 4), ("torch_tuned_", 2))
        for _, _, key, _ in ROWS
    }
    document = {"field": "a field", "sizes": {"200x66": row}}
    columns = [list(column.cells) for column in render_table(document).columns]
    assert columns[5][:3] == ["4.00"] * 3
    assert columns[7][:3] == ["2.00"] * 3


def test_bench_composite_writes_figure_and_numbers(tmp_path, capsys, variant):
    path = tmp_path / "composite.png"
    arguments = ["composite", "--size", "48x24", "--json", "-o", str(path)]
    assert main(arguments) == 0
    document = json.loads(capsys.readouterr().out)
    by_height = {row["height_m"]: row for row in document["heights"]}
    assert by_height[0.8]["largest"] < 1 / 255  # apart, both composites are exact
    assert by_height[-0.75]["largest"] > by_height[0.8]["largest"]
    assert files.read_image(path).shape[2] in (3, 4)
