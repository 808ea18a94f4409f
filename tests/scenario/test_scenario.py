"""The scenario file: defaults, refusals with lines, paths."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from helpers.scenario_text import write_named_files

from mi_nerfattack.errors import InputError
from mi_nerfattack.io.resumable import differences
from mi_nerfattack.policy.pilotnet import PilotNet
from mi_nerfattack.render.camera.intrinsics import Camera
from mi_nerfattack.scenario.scenario import load_scenario, portable_text
from mi_nerfattack.scenario.world import initial_states
from mi_nerfattack.scenes import resolve
from mi_nerfattack.vehicle.route.route import Route

MINIMAL = """\
name = "test"
[scene]
field = "scene.safetensors"
deployment = "bundled:intersection/scene.xml"
routes = "routes.json"
route = "right"

[[objects]]
id = "hydrant"
field = "object.safetensors"
position_m = [1.0, 2.0, 0.0]

[[objects]]
id = "second"
field = "object.safetensors"
position_m = [1.0, 2.0, 0.0]
scale = 2.0

[policy]
file = "policy.safetensors"
[attack]
max_iterations = 3
"""


@pytest.fixture
def write(tmp_path):
    def inner(text):
        path = tmp_path / "scenario.toml"
        path.write_text(text)
        return path

    return inner


def test_defaults_and_text(write):
    scenario, text = load_scenario(write(MINIMAL))
    assert text == MINIMAL
    assert scenario.attack.method.max_iterations == 3
    assert scenario.camera.width == 200 and scenario.camera.height == 66
    assert [item.scale for item in scenario.objects] == [1.0, 2.0]


LENS = "fx = 175.5\nfy = 170\ncx = 165\nk1 = -0.17\nk2 = 0.03\np1 = 1e-3\n"


def test_a_measured_lens_takes_the_place_of_an_angle(write):
    size = "[camera]\nwidth = 336\nheight = 188\n"
    scenario, _ = load_scenario(write(MINIMAL + size + LENS))
    camera, _ = scenario.camera.build()
    bent = {"k1": -0.17, "k2": 0.03, "p1": 1e-3}
    assert camera == Camera(336, 188, 175.5, 170.0, 165.0, 94.0, **bent)
    scenario, _ = load_scenario(write(MINIMAL + size + "fx = 200\n"))
    assert scenario.camera.build()[0] == Camera(336, 188, 200.0, 200.0, 168.0, 94.0)


@pytest.mark.parametrize(
    ("lines", "message"),
    [
        ("fx = 200\nfov_x_deg = 70", "camera.fx: stands beside fov_x_deg"),
        ("fy = 200", "camera.fy: stands without fx"),
        ("fx = 0", "camera.fx: "),
        ("k1 = -3", "camera.k1: .*folds the image over itself"),
    ],
)
def test_impossible_lenses_are_refused(write, lines, message):
    with pytest.raises(InputError, match=message):
        load_scenario(write(MINIMAL + f"[camera]\n{lines}\n"))


def test_digest_tells_scenarios_apart(write, tmp_path):
    write_named_files(tmp_path)

    def digest(text):
        return load_scenario(write(text))[0].digest()

    first = digest(MINIMAL)
    assert first == digest("# remark\n" + MINIMAL)
    assert first == digest(portable_text(*load_scenario(write(MINIMAL))))
    assert first != digest(MINIMAL.replace("= 3", "= 4"))
    (tmp_path / "policy.safetensors").write_bytes(b"another policy")
    assert first != digest(MINIMAL)


@pytest.mark.parametrize(
    ("old", "new", "line", "words"),
    [
        (
            "max_iterations = 3",
            "max_iteratons = 3",
            22,
            ["max_iteratons", "unknown", "max_iterations"],
        ),
        ("max_iterations = 3", "max_iterations = 0", 22, ["max_iterations", "0"]),
        ("max_iterations = 3", 'max_iterations = "3"', 22, ["max_iterations"]),
        ("scale = 2.0", "scale = -2.0", 17, ["scale", "-2"]),
        ("scale = 2.0", "scale = nan", 17, ["scale"]),
        ('route = "right"\n', "", 2, ["route", "required"]),
        ("[policy]", "[polisy]", 19, ["polisy"]),
        ('id = "second"', 'id = "hydrant"', None, ["hydrant", "differ"]),
        ('id = "second"', 'id = "scene1"', None, ["scene1", "layers"]),
        ('id = "second"', 'id = "background"', None, ["background", "layers"]),
        ("[attack]", "[attack", None, ["scenario.toml"]),
        ("[attack]", "[attack]\nlowest = 0.9\nhighest = 0.2", 22, ["lowest", "0.2"]),
        (
            "[attack]",
            "[attack]\nfixed_m = [[[0, 0, 0], [0, 1, 1]]]",
            22,
            ["fixed_m", "lower < upper"],
        ),
        ("[attack]", '[attack]\ngamut = "none.icc"', 22, ["gamut", "none.icc"]),
        ("[attack]", "[attack]\nsegment = 8", 22, ["segment", "checkpointed"]),
        ("[attack]", "[attack]\npose_limit_m = 2.0", 22, ["pose_limit_m", "both"]),
        (
            "[attack]",
            '[attack]\nparameters = "pose"\nlearning_rate = 0.2',
            23,
            ["learning_rate", "pose"],
        ),
        ("[attack]", "[vehicle]\nwheelbase_m = 3.0\n[attack]", 22, ["ackermann"]),
        (
            "[attack]",
            '[vehicle]\nmodel = "bicycle"\nmax_heading_rate = 3.0\n[attack]',
            23,
            ["max_heading_rate", "dubins"],
        ),
        (
            "[attack]",
            "[drive]\ncovariance = [[1, 0, 0], [0, 1, 0.5], [0, 0, 1]]\n[attack]",
            22,
            ["covariance", "symmetric"],
        ),
        (
            "[attack]",
            "[drive]\ncovariance = [[1, 2, 0], [2, 1, 0], [0, 0, 1]]\n[attack]",
            22,
            ["covariance", "eigenvalue -1;"],
        ),
        (
            "[attack]",
            "[drive]\nlateral_sd_m = 0.2\ncovariance = [[1, 0, 0], [0, 1, 0], "
            "[0, 0, 1]]\n[attack]",
            23,
            ["covariance", "lateral_sd_m"],
        ),
        (
            "[attack]",
            "[drive]\nlength_m = 3.0\nhorizon = 60\n[attack]",
            23,
            ["horizon", "length_m", "give one of them"],
        ),
    ],
)
def test_errors_name_key_and_line(write, old, new, line, words):
    path = write(MINIMAL.replace(old, new))
    with pytest.raises(InputError) as caught:
        load_scenario(path)
    message = str(caught.value)
    assert str(path) in message
    for word in words:
        assert word in message
    if line is not None:
        assert f"{path}:{line}" in message


def test_all_problems_of_a_table_are_told_at_once(write):
    text = (
        MINIMAL + "poses = 0\nfoo = 1\nsegment = 2\n[vehicle]\nspeed_ms = -1\nx = 1\n"
    )
    with pytest.raises(InputError) as caught:
        load_scenario(write(text + 'model = "custom"\n'))
    keys = [line.split(": ")[1] for line in str(caught.value).split("\n")]
    assert sorted(keys) == [
        *(f"attack.{key}" for key in ("foo", "poses", "segment")),
        *(f"vehicle.{key}" for key in ("control_limit", "function", "speed_ms", "x")),
    ]


def test_a_wrong_object_is_one_problem(write):
    text = MINIMAL.replace("position_m = [1.0, 2.0, 0.0]\nscale", "scale")
    first = MINIMAL.index("[[objects]]")
    text = text[:first] + text[text.index("[[objects]]", first + 1) :]
    with pytest.raises(InputError, match=r"objects.0.position_m: [^\n]*$") as caught:
        load_scenario(write(text))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("unit", ["rad/s", "rad"])
def test_a_vehicle_takes_pilotnets_unit_or_a_factor_to_its_own(write, tmp_path, unit):
    PilotNet(goals=1, max_control=0.4, unit=unit).save(tmp_path / "policy.safetensors")
    steered = '[vehicle]\nmodel = "ackermann"\n[attack]'
    turned = MINIMAL.replace("[attack]", steered)
    fits, fits_not = (turned, MINIMAL) if unit == "rad" else (MINIMAL, turned)
    assert load_scenario(write(fits))[0].policy.unit() == unit
    with pytest.raises(InputError, match=f"vehicle.model: .* gives {unit}; take ano"):
        load_scenario(write(fits_not))
    scaled = fits_not.replace(
        '"policy.safetensors"', '"policy.safetensors"\ncontrol_scale = 2'
    )
    load_scenario(write(scaled))


def test_missing_file(tmp_path):
    with pytest.raises(InputError, match="absent.toml"):
        load_scenario(tmp_path / "absent.toml")


def test_resolve(tmp_path):
    assert resolve("a/b", tmp_path) == tmp_path / "a/b"
    assert resolve(str(tmp_path / "c"), "elsewhere") == tmp_path / "c"
    assert resolve("bundled:intersection/routes.json", tmp_path).is_file()
    with pytest.raises(InputError, match="bundled"):
        resolve("bundled:nothing.toml", tmp_path)


def test_text_of_a_run_replays_anywhere(write, tmp_path):
    path = write(MINIMAL)
    scenario, text = load_scenario(path, tmp_path / "mine.safetensors")
    portable = tmp_path / "elsewhere" / "scenario.toml"
    portable.parent.mkdir()
    portable.write_text(portable_text(scenario, text))
    again, _ = load_scenario(portable)
    mine = str(tmp_path / "mine.safetensors")
    assert [item.field.name for item in again.objects] == [mine, mine]
    assert [item.field.name for item in scenario.objects] == [mine, mine]
    assert again.scene.field.name == str(tmp_path / "scene.safetensors")
    assert again.scene.deployment.name == "bundled:intersection/scene.xml"
    assert again.policy.source == str(tmp_path / "policy.safetensors")


@pytest.mark.parametrize("rank", [1, 3])
def test_initial_poses_scatter_by_the_covariance(write, rank):
    root = np.random.default_rng(0).normal(size=(3, rank)) * [[0.5], [0.2], [0.02]]
    wanted = root @ root.T
    text = f"[drive]\ncovariance = {wanted.tolist()}\n[attack]"
    scenario, _ = load_scenario(write(MINIMAL.replace("[attack]", text)))
    route = Route("north", 0, np.array([[2.0, 1.0], [2.0, 9.0], [4.0, 20.0]]))
    states = initial_states(scenario, route, 20001, 0)
    # along the lane is +y, to the left of it -x
    shifts = (states - [2.0, 1.0, np.pi / 2])[:, [1, 0, 2]] * [1, -1, 1]
    deviation = np.sqrt(wanted.diagonal())
    scale = np.outer(deviation, deviation)
    np.testing.assert_allclose(np.cov(shifts.T) / scale, wanted / scale, atol=0.04)
    np.testing.assert_allclose(shifts.mean(axis=0) / deviation, 0, atol=0.04)


@pytest.mark.parametrize(
    ("keys", "closed", "steps"),
    [
        ("", False, 46),  # 23.2 m at 5 m/s and 0.1 s
        ("start_m = 13.2", False, 20),
        ("start_m = 23.1", False, 1),
        ("start_m = 13.2\nlength_m = 4.0", False, 8),
        ("length_m = 0.3", False, 1),
        ("start_m = 13.2\nhorizon = 7", False, 7),
        ("start_m = 13.2", True, 86),  # a lap of 43.45 m
    ],
)
def test_drives_end_with_the_route_or_before(write, keys, closed, steps):
    route = Route("bend", 0, np.array([[0, 0], [3.2, 0], [3.2, 20]]), closed=closed)
    text = MINIMAL.replace("[attack]", f"[drive]\n{keys}\n[attack]")
    scenario, _ = load_scenario(write(text))
    assert scenario.drive.steps(route, 0.1) == steps


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ('[policy]\nfile = "policy.safetensors"\n', ""),
        ('file = "policy.safetensors"', '"file" = "policy.safetensors"'),
        ('file = "policy.safetensors"', 'file = """\\\n   policy.safetensors"""'),
        ("= 3", "= 3\n[policy.preprocess]\nframes = 2"),
    ],
)
def test_every_form_of_toml_replays_anywhere(write, tmp_path, old, new):
    """Inline tables, quoted keys, long strings, tables in another order."""
    assert old in MINIMAL
    text = MINIMAL.replace(old, new)
    if not new:
        text = 'policy.file = "policy.safetensors"  # why\n' + text
    portable = portable_text(*load_scenario(write(text)))
    assert portable.count("# why") == text.count("# why")
    (elsewhere := tmp_path / "elsewhere.toml").write_text(portable)
    again, _ = load_scenario(elsewhere)
    assert again.policy.source == str(tmp_path / "policy.safetensors")


@pytest.mark.parametrize(
    ("old", "new", "line"),
    [
        ('[policy]\nfile = "p', 'policy = { file = "a.onnx", batch = 2 }\n#', 19),
        ('name = "test"', 'attack.max_iterations = 0\nname = "test"', 1),
        ("[attack]", '[policy.preprocess]\nmean = [\n  0.5,\n  "a",\n]\n[attack]', 22),
        ("max_iterations = 3", "max_iterations = 3\nmean.x = 1", 23),
        (
            "max_iterations = 3",
            "max_iterations = 3\nmean.x = 1\nseed = 3\nmean.y = 1",
            23,
        ),
        ("[attack]\nmax_iterations = 3", "[mean.x]\ny = 1", 21),
    ],
)
def test_lines_of_every_form(write, old, new, line):
    text = MINIMAL.replace(old, new)
    if "attack" in new and "policy" not in new:
        text = text[: text.index("[attack]")]
    elif "{" in new:  # an inline table stands before the first table
        text = "\n" * 18 + new + "\n" + MINIMAL.replace(old, "#")
    with pytest.raises(InputError, match=f"scenario.toml:{line}: "):
        load_scenario(write(text))


def test_escapes_in_paths_survive(write, tmp_path):
    text = MINIMAL.replace("object.safetensors", r"it\u0073 \"ö\".st")
    scenario, text = load_scenario(write(text))
    portable = tmp_path / "elsewhere.toml"
    portable.write_text(portable_text(scenario, text))
    again, _ = load_scenario(portable)
    wanted = str(tmp_path / 'its "ö".st')
    assert [item.field.name for item in again.objects] == [wanted, wanted]
    assert [item.field.path for item in scenario.objects] == [Path(wanted)] * 2


def test_module_of_a_vehicle_counts_with_its_source(write, tmp_path, monkeypatch):
    package = tmp_path / "cars_of_this_test"
    package.mkdir()
    (package / "__init__.py").write_text("raise AssertionError('was imported')")
    source = package / "slow.py"
    source.write_text("speed = 1")
    monkeypatch.syspath_prepend(tmp_path)
    vehicle = '[vehicle]\nmodel = "custom"\ncontrol_limit = 1.0\nfunction = '
    write_named_files(tmp_path)

    def identity(reference):
        text = MINIMAL.replace("[attack]", f'{vehicle}"{reference}"\n[attack]')
        return load_scenario(write(text))[0].identity()

    before = identity("cars_of_this_test.slow:car")
    assert before == identity("cars_of_this_test.slow:car")
    source.write_text("speed = 2")
    assert differences(before, identity("cars_of_this_test.slow:car")) == [
        "scenario.vehicle.function: the content of cars_of_this_test.slow:car has "
        "changed"
    ]
    identity("cars_of_this_test.absent:car")  # refused later, where it is imported
    identity("absent_package.absent:car")
    identity("math.absent:car")
