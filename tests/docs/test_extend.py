"""The guides of docs/dev/extend: their examples run, and the template installs."""

from __future__ import annotations

import importlib
import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from support.files.packages import use_packages, write_package
from support.worlds.attacks import write_scenario
from support.worlds.places import blank_environment, write_place

from mi_nerfattack import cli
from mi_nerfattack.attack.black_box.search import Proposal
from mi_nerfattack.deploy.place import Conditions
from mi_nerfattack.deploy.registry import make_environment
from mi_nerfattack.errors import InputError
from mi_nerfattack.render.pathtrace.load import load_scene
from mi_nerfattack.scenario.policy.kinds import load_policy
from mi_nerfattack.scenario.scenario import load_scenario
from mi_nerfattack.scenario.section import read_section
from mi_nerfattack.scenario.vehicle import VehicleSection
from mi_nerfattack.vehicle.dynamics import to_control, to_state
from mi_nerfattack.vehicle.integrators import Transition
from mi_nerfattack.vehicle.route.route import Route

pytestmark = pytest.mark.usefixtures("variant")

ROOT = Path(__file__).parents[2]
EXAMPLES = ROOT / "docs/examples/extend"
TEMPLATE = ROOT / "docs/examples/package_template"
POINTS = {
    "plugin": {"plugins.stripes": "nf_examples.plugin"},
    "environment": {"environments.foggy": "nf_examples.environment:make"},
    "vehicle": {"vehicles.yaw_lag": "nf_examples.vehicle:YawLagSection"},
    "policy": {"policies.linear_csv": "nf_examples.policy:LinearSection"},
    "method": {"methods.one_plus_one": "nf_examples.method:OnePlusOneMethod"},
    "condition": {"conditions.play": "nf_examples.condition:Play"},
}


@pytest.fixture
def examples(tmp_path, monkeypatch) -> None:
    """A package of the examples, whose entry points are those of the guides."""
    paths = EXAMPLES.glob("*.py")
    sources = {f"nf_examples/{p.name}": p.read_text("utf-8") for p in paths}
    points = {key: value for each in POINTS.values() for key, value in each.items()}
    init = {"nf_examples/__init__.py": ""}
    write_package(tmp_path / "site", points, sources | init, "nf-examples")
    use_packages(monkeypatch, tmp_path / "site")


@pytest.mark.parametrize("name", POINTS)
def test_a_guide_shows_its_example_and_its_entry_point(name):
    source = (EXAMPLES / f"{name}.py").read_text("utf-8")
    assert len(source.splitlines()) <= 40
    page = (ROOT / f"docs/dev/extend/{name}.md").read_text("utf-8")
    assert f"```python\n{source}```\n" in page
    ((key, value),) = POINTS[name].items()
    group, _, point = key.partition(".")
    table = f'[project.entry-points."mi_nerfattack.{group}"]\n{point} = "{value}"\n'
    assert table in page
    words = len(re.sub(r"(?s)```.*?```", "", page).split())
    assert words <= 600


@pytest.mark.usefixtures("examples")
def test_the_vehicle_follows_its_lag():
    table = {"kind": "yaw_lag", "lag_s": 0.3, "dt_s": 0.1, "substeps": 10}
    section = read_section("vehicle", VehicleSection, table, ".")
    motion = section.motion()
    step = Transition(motion.dynamics, motion.integrator, 0.1, motion.substeps, 0)
    control, state = to_control(np.full((1, 1), 0.4)), to_state(np.zeros((1, 4)))
    for _ in range(8):
        state = step.advance(state, *step.controls([control], 0, state))
    acting = motion.dynamics.saturate(control).numpy()[0]
    decay = np.exp(-0.8 / 0.3)
    rate, heading = acting * (1 - decay), acting * (0.8 - 0.3 * (1 - decay))
    assert np.allclose([state[3][0], state[2][0]], [rate, heading], rtol=1e-6)


@pytest.mark.usefixtures("examples")
def test_the_policy_has_the_derivative_of_its_weights(tmp_path, rng):
    weights = rng.normal(size=(3, 4))
    np.savetxt(tmp_path / "weights.csv", weights, delimiter=",")
    table = {"kind": "linear_csv", "file": "weights.csv"}
    policy = load_policy(table, tmp_path)
    image = rng.uniform(size=(2, 3, 4, 3))
    tensor = mi.TensorXf(image.astype(np.float32))
    control, d_image = policy.vjp(tensor, 0, mi.Float([1.0, -2.0]))
    expected = np.einsum("nijc,ij->n", image, weights) / 3
    assert np.allclose(control, expected, atol=1e-5)
    shares = np.array([1, -2])[:, None, None, None] * weights[..., None] / 3
    assert np.allclose(d_image.numpy(), np.broadcast_to(shares, image.shape), atol=1e-6)
    (tmp_path / "weights.csv").write_text("1, two\n")
    with pytest.raises(InputError, match="weights.csv: .*give numbers alone"):
        load_policy(table, tmp_path)


class Basis:
    """Four coefficients that are the texture themselves."""

    count = 4

    def propose(self, coefficients: np.ndarray) -> Proposal:
        return Proposal([coefficients])


def search_for(made, asks: int, objectives: list[float]) -> list[float]:
    """Minimise the distance from a point; first repeat what another search was told."""
    for index in range(asks):
        (texture,) = made.ask().textures
        if index >= len(objectives):
            objectives.append(float(np.sum((texture - [0.5, -0.2, 0.1, 0.3]) ** 2)))
        made.tell(objectives[index])
    return objectives


@pytest.mark.usefixtures("examples")
def test_the_search_finds_a_minimum_and_continues_by_its_history():
    search = importlib.import_module("nf_examples.method").OnePlusOne
    full = search_for(search(Basis(), 0.2, 3), 200, [])
    assert full[0] == pytest.approx(0.25 + 0.04 + 0.01 + 0.09)  # the original texture
    assert min(full) < 1e-3 * full[0]
    half = search_for(search(Basis(), 0.2, 3), 100, [])
    assert search_for(search(Basis(), 0.2, 3), 200, half) == full


@pytest.mark.usefixtures("examples")
def test_fog_covers_with_distance(tmp_path):
    place, conditions = write_place(tmp_path), Conditions(spp=2)
    route = Route("line", 0, np.array([[0.0, 0.0], [30.0, 0.0]]))
    settings = {"density_per_m": 0.05}
    clear = make_environment("mitsuba", place, conditions).reset(route, seed=1)
    foggy = make_environment("foggy", place, conditions, settings).reset(route, seed=1)
    transmittance = np.exp(-0.05 * clear.depth.astype(np.float64))[..., None]
    expected = 190 + transmittance * (clear.image.astype(np.float64) - 190)
    assert np.abs(foggy.image - expected).max() <= 0.51
    assert transmittance.max() > 0.5 and (clear.depth == np.inf).any()


@pytest.mark.usefixtures("examples")
def test_play_holds_a_control_until_it_has_changed_enough():
    play = importlib.import_module("nf_examples.condition").Play
    loose, exact = play(blank_environment(), 0.2), blank_environment()
    route = Route("line", 0, np.array([[0.0, 0.0], [30.0, 0.0]]))
    for environment in (loose, exact):
        environment.reset(route, np.zeros(3), 0)
    controls, taken = (0.05, 0.3, 0.25, 0.0, -0.5), (0.0, 0.2, 0.2, 0.1, -0.4)
    for asked, held in zip(controls, taken, strict=True):
        loose.step(asked)
        exact.step(held)
        assert np.allclose(loose.state, exact.state)
    with pytest.raises(InputError, match="play: -1"):
        play(blank_environment(), -1)


STRIPES = """<scene version="3.0.0"><shape type="rectangle"><bsdf type="diffuse">
<texture type="stripes" name="reflectance"><float name="count" value="3"/>
<rgb name="colour" value="0.8, 0.4, 0.2"/></texture></bsdf></shape></scene>"""


@pytest.mark.usefixtures("examples")
def test_stripes_have_two_shades_and_a_derivative(tmp_path):
    (tmp_path / "scene.xml").write_text(STRIPES)
    scene = load_scene(tmp_path / "scene.xml")
    params, (shape,) = mi.traverse(scene), scene.shapes()
    (key,) = [key for key in params.keys() if key.endswith("reflectance.colour")]
    dr.enable_grad(params[key])
    params.update()
    at = dr.zeros(mi.SurfaceInteraction3f, 2)
    at.uv = mi.Point2f([0.05, 0.3], [0, 0])  # in a bright stripe, in a dark one
    value = shape.bsdf().eval_diffuse_reflectance(at)
    assert np.allclose(value.numpy(), [[0.8, 0.4], [0.4, 0.2], [0.2, 0.1]])
    dr.backward(value.x + 2 * value.z)
    assert np.allclose(dr.grad(params[key]).numpy().ravel(), [1.5, 0, 3])


@pytest.mark.usefixtures("examples")
def test_all_of_them_in_one_scenario(tmp_path, rng):
    folder = write_scenario(
        tmp_path / "s",
        {
            'file = "policy.safetensors"\n': 'kind = "linear_csv"\nfile = "w.csv"\n'
            '[vehicle]\nkind = "yaw_lag"\nlag_s = 0.2\n',
            "runs = 2": "runs = 1\n[camera]\nwidth = 24\nheight = 10",
            "method.max_iterations = 30\n": "method.frames = 8\n"
            'method.kind = "one_plus_one"\n',
            "textures = 4": "textures = 1\ndeployment_textures = 1",
            "[deployment]\n": '[deployment]\nkind = "foggy"\ndensity_per_m = 0.05\n',
        },
    )
    np.savetxt(folder / "w.csv", 0.01 * rng.normal(size=(10, 24)), delimiter=",")
    xml, plain = folder / "deployment.xml", '<bsdf type="diffuse"/>'
    stripes = re.search("(?s)<bsdf.*</bsdf>", STRIPES)
    assert plain in xml.read_text() and stripes is not None
    xml.write_text(xml.read_text().replace(plain, stripes[0]))
    path, run, table = folder / "scenario.toml", tmp_path / "run", tmp_path / "table"
    assert cli.main(["check", str(path), "-o", str(tmp_path / "check.png")]) == 0
    words = ["attack", str(path), "-o", str(run), "--workers", "1", "--anyway"]
    assert cli.main(words) == 0
    values = json.loads((run / "metrics.json").read_text())["scenario"]
    for section in ("vehicle", "policy", "deployment"):
        assert values[section]["package"].startswith("nf-examples 1.0, code ")
    assert values["attack"]["method"]["kind"] == "one_plus_one"
    deployment = load_scenario(path)[0].identity()["scenario.scene.deployment"]
    assert "nf-examples 1.0" in json.loads(deployment)["packages"]
    words = ["transfer", str(run), "-o", str(table), "--workers", "1", "--spp", "1"]
    words += ["--environments", "foggy", "--conditions", "play:0.1", "--runs", "1"]
    assert cli.main(words) == 0
    document = json.loads((table / "transfer.json").read_text())
    assert document["complete"] and set(document["conditions"]) == {"play:0.1"}


def test_the_template_installs_offline_and_passes_its_test(tmp_path):
    source, target = tmp_path / "copy", tmp_path / "site"
    shutil.copytree(TEMPLATE, source)
    pip = [sys.executable, "-m", "pip", "install", "--quiet", "--no-index", "--no-deps"]
    pip += ["--no-build-isolation", "--target", str(target), str(source)]
    called = {"capture_output": True, "text": True, "check": False, "timeout": 300}
    done = subprocess.run(pip, **called)
    assert done.returncode == 0, done.stderr
    paths = map(str, (target, ROOT))
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(paths)}
    test = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider"]
    test += ["-c", str(source / "pyproject.toml"), str(source / "test_template.py")]
    (source / "nf_template.py").unlink()  # what is installed counts
    done = subprocess.run(test, env=environment, cwd=tmp_path, **called)
    assert done.returncode == 0 and "1 passed" in done.stdout, done.stdout
