"""The PyTorch trainer agrees with our step; what `bench fit` prints."""

from __future__ import annotations

import json

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
import torch
from helpers.small_fields import small_ngp

from bench.__main__ import main
from bench.fit.table import ratio_table, remarks
from bench.full_ngp import NGPData
from bench.torch.encoding import PlainHashGrid, TunedHashGrid
from bench.torch.fit import BELOW_WHITE, Pictures, Plan, TorchFit, encode
from mi_nerfattack import cli
from mi_nerfattack.backend.colour import linear_to_srgb, linear_to_srgb_numpy
from mi_nerfattack.fields import Occupancy
from mi_nerfattack.fit.loss import huber
from mi_nerfattack.render.interleaved import InterleavedComposite
from mi_nerfattack.render.march import STOP, March, Rays
from mi_nerfattack.render.posed import PosedField

pytestmark = pytest.mark.usefixtures("variant")
GRIDS = [PlainHashGrid, TunedHashGrid]
IMAGES, PIXELS = 3, 40


@pytest.fixture(autouse=True)
def one_thread():
    """Let PyTorch's threads not wait for each other in tiny operations."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@pytest.fixture
def data(rng) -> NGPData:
    """Return a field with holes and a growing step."""
    field = small_ngp(cone=1 / 64)
    field.occupancy = Occupancy(rng.random((6, 5, 4)) < 0.6)
    return NGPData.of(field)


@pytest.fixture
def pictures(rng) -> Pictures:
    """Return random pixels on random rays around the field."""
    direction = rng.normal(size=(IMAGES, PIXELS, 3))
    direction /= np.linalg.norm(direction, axis=2, keepdims=True)
    return Pictures(
        rng.integers(0, 256, (IMAGES, PIXELS, 3), dtype=np.uint8),
        rng.uniform(-1.2, 1.2, (IMAGES, 3)).astype(np.float32),
        direction.astype(np.float32),
    )


def every_pixel(rng) -> tuple[torch.Tensor, torch.Tensor]:
    count = IMAGES * PIXELS
    jitter = torch.tensor(rng.random(count), dtype=torch.float32)
    return torch.arange(count), jitter


@pytest.mark.parametrize("grid", GRIDS)
def test_the_peer_has_the_gradients_of_our_renderer(rng, data, pictures, grid):
    """Ours: the exact composite, which no fit uses, and its replayed derivative."""
    index, jitter = every_pixel(rng)
    fit = TorchFit(data, grid(data.layout), pictures, len(index))
    loss = fit.gradients(index, jitter)

    field = data.field()
    names = ("table", "density_weights", "colour_weights", "sky")
    for name in names:
        dr.enable_grad(field.parameters()[name])
    rays = Rays(
        mi.Point3f(np.repeat(pictures.origin, PIXELS, axis=0).T.copy()),
        mi.Vector3f(pictures.direction.reshape(-1, 3).T.copy()),
        mi.Float(dr.inf),
        mi.Float(jitter.numpy().copy()),
    )
    posed, composite = [PosedField(field)], InterleavedComposite()
    seen = composite.render(posed, rays, STOP)
    radiance = mi.Color3f(seen.total.radiance)
    opacity = mi.Float(seen.total.opacity)
    dr.enable_grad(radiance, opacity)
    image = radiance + (1 - opacity) * field.background(rays.direction)
    wanted = mi.Color3f(pictures.colour.reshape(-1, 3).T.astype(np.float32) / 255)
    error = linear_to_srgb(image * BELOW_WHITE) - wanted
    objective = dr.mean(sum(huber(channel, 0.1) for channel in error)) / 3
    dr.backward(objective)
    total = March(dr.grad(radiance), dr.grad(opacity), dr.zeros(mi.Float, len(index)))
    composite.backward(posed, rays, seen, total, STOP)

    assert loss == pytest.approx(float(objective[0]), rel=1e-3)
    ours = {name: dr.grad(field.parameters()[name]).numpy() for name in names}
    theirs = fit.model.parameters["table"].grad.numpy().ravel()
    assert relative(theirs, ours["table"]) < 1e-2
    assert relative(fit.model.sky.grad.numpy().ravel(), ours["sky"]) < 1e-2
    for net in ("density", "colour"):
        parts = [
            value.grad.numpy().ravel()
            for key, value in fit.model.parameters.items()
            if key.startswith(net)
        ]
        packed = np.linalg.norm(ours[f"{net}_weights"])
        assert np.linalg.norm(np.concatenate(parts)) == pytest.approx(packed, rel=1e-2)


def relative(found: np.ndarray, expected: np.ndarray) -> float:
    return float(np.linalg.norm(found - expected) / np.linalg.norm(expected))


@pytest.mark.parametrize("grid", GRIDS)
def test_gradients_do_not_depend_on_the_plan(rng, data, pictures, grid):
    index, jitter = every_pixel(rng)
    fit = TorchFit(data, grid(data.layout), pictures, len(index))
    results = []
    for plan in Plan.candidates(len(index)):
        fit.plan = plan
        loss = fit.gradients(index, jitter)
        results.append((loss, [leaf.grad.clone() for leaf in fit.leaves]))
    assert len(results) > 2
    for loss, gradients in results[1:]:
        assert loss == pytest.approx(results[0][0], rel=1e-4)
        for found, expected in zip(gradients, results[0][1], strict=True):
            assert (found - expected).norm() < 1e-3 * expected.norm()


@pytest.mark.parametrize("grid", GRIDS)
def test_the_peer_learns(data, pictures, grid):
    pictures.colour[...] = np.array([200, 120, 40], np.uint8)
    fit = TorchFit(data, grid(data.layout), pictures, 32)
    losses = [fit.step() for _ in range(100)]
    assert np.mean(losses[-5:]) < 0.3 * np.mean(losses[:5])


def test_encode_is_the_srgb_curve_with_a_finite_slope_at_black():
    linear = np.linspace(0, 1, 101, dtype=np.float32)
    value = torch.tensor(linear, requires_grad=True)
    encode(value).sum().backward()
    assert encode(value).detach().numpy() == pytest.approx(
        linear_to_srgb_numpy(linear), abs=1e-6
    )
    assert value.grad is not None
    assert torch.isfinite(value.grad).all()


def test_pictures_survive_a_file(pictures, tmp_path):
    pictures.write(tmp_path / "pictures.safetensors")
    back = Pictures.read(tmp_path / "pictures.safetensors")
    for name, value in vars(pictures).items():
        assert np.array_equal(getattr(back, name), value)


def document() -> dict:
    row = {"network": "small", "stage": "early", "rays": 9, "breakdown": {}}
    row["breakdown"] = {"networks": 1.25}
    for prefix, seconds in (("", 0.01), ("torch_", 0.06), ("torch_tuned_", 0.02)):
        row |= {
            f"{prefix}ratio": seconds / 0.01,
            f"{prefix}cpu_ratio": seconds / 0.02,
            f"{prefix}seconds_per_step": seconds,
            f"{prefix}samples_per_step": 1000.0,
            f"{prefix}us_per_sample": 1e3 * seconds,
            f"{prefix}loss_first": 0.2,
            f"{prefix}loss_last": 0.1,
            f"{prefix}peak_memory_mb": 300.0,
        }
    return {"ratio": 6.0, "tuned_ratio": 2.0, "data": "views", "steps": [row]}


def test_the_ratio_comes_first():
    lines = remarks(document())
    assert "6.00 times" in lines[0]
    assert "2.00 times" in lines[0]
    assert "networks 1.25" in lines[-1]
    assert lines[-2].endswith("3.00, to tuned 1.00")
    columns = [list(column.cells) for column in ratio_table(document()).columns]
    assert [column[0] for column in columns[2:]] == [
        *("10.0", "60.0", "6.00", "20.0", "2.00")
    ]


def test_unfair_comparisons_are_called_so():
    unfair = document()
    unfair["steps"][0] |= {"torch_samples_per_step": 1100.0, "loss_last": 0.3}
    lines = "\n".join(remarks(unfair))
    assert "differ from ours by +10.0%" in lines
    assert "ours did not learn" in lines
    assert "PyTorch did not learn" not in lines


@pytest.mark.slow
def test_a_quick_benchmark_prints_the_promised_keys(capsys, tmp_path):
    path = tmp_path / "fit.json"
    command = ["fit", "--quick", "--json", "--repeats", "1", "-o", str(path)]
    assert main(command) == 0
    result = json.loads(capsys.readouterr().out)
    assert len(remarks(result)) > len(result["steps"])  # all that they need is there
    assert json.loads(path.read_text()) == result
    assert [row["stage"] for row in result["steps"]] == ["early", "late"]
    for row in result["steps"]:
        assert row["torch_ratio"] > 0
        assert row["torch_samples_per_step"] == pytest.approx(
            row["samples_per_step"], rel=0.1
        )
        assert row["torch_samples_per_step"] == row["torch_tuned_samples_per_step"]
    assert result["ratio"] == min(row["torch_ratio"] for row in result["steps"])


def test_bad_repeats_are_refused(capsys):
    assert main(["fit", "--repeats", "0"]) == cli.EXIT_INPUT
    assert "--repeats: 0" in capsys.readouterr().err
