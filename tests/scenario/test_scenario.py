"""The scenario file: defaults, paths, what counts to its identity, portable text."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from support.files.runs import HEAD, write_named_files

from mi_nerfattack.errors import InputError
from mi_nerfattack.io import files
from mi_nerfattack.io.resumable import differences
from mi_nerfattack.policy.pilotnet import PilotNet
from mi_nerfattack.render.camera.intrinsics import Camera
from mi_nerfattack.rollout.variation import SunRanges
from mi_nerfattack.scenario.named_file import NamedFile, portable_text, section_content
from mi_nerfattack.scenario.scenario import load_scenario
from mi_nerfattack.scenario.world import initial_states
from mi_nerfattack.scenes import resolve
from mi_nerfattack.vehicle.route.route import Route

POLICY = 'file = "policy.safetensors"'


@pytest.fixture
def load(tmp_path):
    """Return a function that reads the scenario of a text, or of its file's path."""

    def inner(text, *field):
        path = tmp_path / "scenario.toml"
        path.write_text(text)
        return load_scenario(path, *field)

    return inner


def replayed(scenario, text, folder):
    """Read the text of a run from another folder."""
    folder.mkdir()
    path = folder / "scenario.toml"
    path.write_text(portable_text(scenario, text))
    return load_scenario(path)[0]


def test_defaults_and_text(load):
    text = f"{HEAD}[attack.method]\nmax_iterations = 3\n"
    text += HEAD[HEAD.index("[[") : HEAD.index("[policy]")].replace("hydrant", "other")
    scenario, read = load(f"{text}scale = 2.0\n")
    assert read == f"{text}scale = 2.0\n"
    assert scenario.attack.method.max_iterations == 3
    assert scenario.camera.width == 200 and scenario.camera.height == 66
    assert [item.scale for item in scenario.objects] == [1.0, 2.0]


LENS = "fx = 175.5\nfy = 170\ncx = 165\nk1 = -0.17\nk2 = 0.03\np1 = 1e-3\n"


def test_a_measured_lens_takes_the_place_of_an_angle(load):
    text = HEAD + "[camera]\nwidth = 336\nheight = 188\n"
    camera, _ = load(text + LENS)[0].camera.build()
    bent = {"k1": -0.17, "k2": 0.03, "p1": 1e-3}
    assert camera == Camera(336, 188, 175.5, 170.0, 165.0, 94.0, **bent)
    camera, _ = load(text + "fx = 200\n")[0].camera.build()
    assert camera == Camera(336, 188, 200.0, 200.0, 168.0, 94.0)


TERM = "[[objective.term]]\nkind = "
CODE = f'{POLICY}\n{TERM}"function"\nfunction = "costs.py:f"'
TARGET = f'{POLICY}\n{TERM}"target_path"\ntarget = "a.json"\ntarget_route = "verge"'
NET = 'file = "net.py:make"\nweights_file = "w.pt"'
CAR = 'file = "a.onnx"\n[vehicle]\nkind = "custom"\ncontrol_limit = 1.0\nfunction = '
TAPE = f'{POLICY}\n[[deployment]]\n[[deployment]]\nkind = "replay"\nrecording = "tape"'


@pytest.mark.parametrize(
    ("policy", "name", "key"),
    [
        (POLICY, "policy.safetensors", "policy.file"),
        (POLICY, "scene.safetensors", "scene.field"),
        (CODE, "costs.py", "objective.term[0].function"),
        (TARGET, "a.json", "objective.term[0].target"),
        (NET, "net.py", "policy.file"),
        (NET, "w.pt", "policy.weights_file"),
        (f'{CAR}"car.py:car"', "car.py", "vehicle.function"),
        (TAPE, "tape/0.png", "deployment[1].recording"),
    ],
)
def test_the_content_of_a_named_file_counts(load, tmp_path, policy, name, key):
    write_named_files(tmp_path)
    (tmp_path / "tape").mkdir()
    for each in ("costs.py", "a.json", "net.py", "w.pt", "a.onnx", "car.py", name):
        (tmp_path / each).write_text("1")
    text = HEAD.replace(POLICY, policy)
    before, read = load(text)
    assert load(f"# remark\n{text}")[0].digest() == before.digest()
    assert replayed(before, read, tmp_path / "other").digest() == before.digest()
    first, digest = before.identity(), before.digest()
    (tmp_path / name).write_text("2")
    after, _ = load(text)
    second = after.identity()
    assert {k for k in first if first[k] != second[k]} == {f"scenario.{key}"}
    assert after.digest() != digest


def test_values_and_names_of_functions_count(load, tmp_path):
    write_named_files(tmp_path)
    (tmp_path / "costs.py").write_text("1")
    text = HEAD.replace(POLICY, CODE)
    texts = HEAD, f"{HEAD}[drive]\nhorizon = 4\n", text, text.replace(":f", ":g")
    assert len({load(each)[0].digest() for each in texts}) == 4


def test_keys_that_came_later_count_where_they_are_set(load, tmp_path):
    write_named_files(tmp_path)
    light = HEAD + "[attack.vary.sun]\nelevation_deg = [15, 60]\n"
    lag = HEAD + "[attack.vary]\nsteering_lag_s_sd = 0.1\n"
    delay = lag.replace("steering_lag_s_sd", "delay_s_sd")
    texts = HEAD, light, light.replace("60", "50"), lag, delay
    assert len({load(each)[0].digest() for each in texts}) == 5
    key = "scenario.attack.vary"
    later = {f"{key}.{name}" for name in ("sun", "steering_lag_s_sd", "delay_s_sd")}
    assert not later & set(load(HEAD)[0].identity())
    scenario, _ = load(light)
    assert scenario.identity()[f"{key}.sun.elevation_deg"] == "[15.0, 60.0]"
    sun = scenario.attack.vary.sun
    assert sun is not None
    assert sun.build() == SunRanges(elevation_deg=(15.0, 60.0))


def test_a_billboard_counts_with_its_picture(load, tmp_path):
    write_named_files(tmp_path)
    board = """[[objects]]
kind = "billboard"
id = "board"
width_m = 2
height_m = 1.5
picture = "a.png"
position_m = [1, 2, 0]
yaw_deg = 90
"""
    files.write_image(tmp_path / "a.png", np.full((3, 4, 3), 200, np.uint8))
    before, text = load(HEAD + board)
    first = before.identity()
    assert first["scenario.objects[1].kind"] == '"billboard"'
    again = replayed(before, text, tmp_path / "other")
    assert again.digest() == before.digest()
    field, pose = again.objects[1].load(), again.objects[1].pose
    np.testing.assert_allclose(field.upper - field.lower, [2, 0.02, 1.5])
    np.testing.assert_allclose(pose.rotation[:, 0], [0, 1, 0], atol=1e-9)
    files.write_image(tmp_path / "a.png", np.full((3, 4, 3), 100, np.uint8))
    second = load(HEAD + board)[0].identity()
    changed = {key for key in first if first[key] != second[key]}
    assert changed == {"scenario.objects[1].picture"}


def test_an_object_of_a_file_need_not_say_so(load, tmp_path):
    write_named_files(tmp_path)
    said = HEAD.replace("[[objects]]", '[[objects]]\nkind = "field"')
    assert load(said)[0].digest() == load(HEAD)[0].digest()


def test_all_problems_of_a_table_are_told_at_once(load):
    text = "[attack.method]\nposes = 0\nfoo = 1\n[attack]\nbar = 2\n"
    with pytest.raises(InputError) as caught:
        load(f'{HEAD}{text}[vehicle]\nspeed_ms = -1\nx = 1\nkind = "custom"\n')
    keys = [line.split(": ")[1] for line in str(caught.value).split("\n")]
    assert sorted(keys) == [
        *(f"attack.{key}" for key in ("bar", "method.foo", "method.poses")),
        *(f"vehicle.{key}" for key in ("control_limit", "function", "speed_ms", "x")),
    ]


@pytest.mark.parametrize("unit", ["rad/s", "rad"])
def test_a_vehicle_takes_pilotnets_unit_or_a_factor_to_its_own(load, tmp_path, unit):
    write_named_files(tmp_path)
    PilotNet(goals=1, max_control=0.4, unit=unit).save(tmp_path / "policy.safetensors")
    turned = f'{HEAD}[vehicle]\nkind = "ackermann"\n'
    fits, fits_not = (turned, HEAD) if unit == "rad" else (HEAD, turned)
    assert load(fits)[0].policy.unit() == unit
    with pytest.raises(InputError, match=f"vehicle.kind: .* gives {unit}; take ano"):
        load(fits_not)
    load(fits_not.replace(POLICY, f"{POLICY}\ncontrol_scale = 2"))
    other = "rad" if unit == "rad/s" else "rad/s"
    same, differs = (f'{POLICY}\ncontrol_unit = "{one}"' for one in (unit, other))
    assert load(fits.replace(POLICY, same))[0].digest() == load(fits)[0].digest()
    with pytest.raises(InputError, match="policy.control_unit: .*says it in its file"):
        load(fits.replace(POLICY, differs))


def test_resolve(tmp_path):
    assert resolve("a/b", tmp_path) == tmp_path / "a/b"
    assert resolve(str(tmp_path / "c"), "elsewhere") == tmp_path / "c"
    assert resolve("bundled:intersection/routes.json", tmp_path).is_file()
    with pytest.raises(InputError, match="bundled"):
        resolve("bundled:nothing.toml", tmp_path)
    with pytest.raises(InputError, match="absent.toml"):
        load_scenario(tmp_path / "absent.toml")


@pytest.mark.parametrize("rank", [1, 3])
def test_initial_poses_scatter_by_the_covariance(load, rank):
    root = np.random.default_rng(0).normal(size=(3, rank)) * [[0.5], [0.2], [0.02]]
    covariance = root @ root.T
    scenario, _ = load(f"{HEAD}[drive]\ncovariance = {covariance.tolist()}\n")
    route = Route("north", 0, np.array([[2.0, 1.0], [2.0, 9.0], [4.0, 20.0]]))
    states = initial_states(scenario, route, 20001, 0)
    # along the lane is +y, to the left of it -x
    shifts = (states - [2.0, 1.0, np.pi / 2])[:, [1, 0, 2]] * [1, -1, 1]
    deviation = np.sqrt(covariance.diagonal())
    scale = np.outer(deviation, deviation)
    np.testing.assert_allclose(np.cov(shifts.T) / scale, covariance / scale, atol=0.04)
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
def test_drives_end_with_the_route_or_before(load, keys, closed, steps):
    route = Route("bend", 0, np.array([[0, 0], [3.2, 0], [3.2, 20]]), closed=closed)
    scenario, _ = load(f"{HEAD}[drive]\n{keys}\n")
    assert scenario.drive.steps(route, 0.1) == steps


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("", 'policy.file = "policy.safetensors"  # why\n'),
        (POLICY, '"file" = "policy.safetensors"'),
        (POLICY, 'file = """\\\n   policy.safetensors"""'),
        (POLICY, f"{POLICY}\n[policy.preprocess]\nframes = 2"),
        ('"object.safetensors"', r'"it\u0073 \"ö\".st"'),
    ],
)
def test_every_form_of_toml_replays_anywhere(load, tmp_path, old, new):
    """Dotted and quoted keys, long strings, tables in another order, escapes."""
    text = HEAD.replace(old, new) if old else new + HEAD.partition("[policy]")[0]
    scenario, text = load(text.replace("deployment.xml", "bundled:demo.xml"))
    assert portable_text(scenario, text).count("# why") == text.count("# why")
    again = replayed(scenario, text, tmp_path / "elsewhere")
    assert again.policy.source == str(tmp_path / "policy.safetensors")
    assert again.scene.deployment.name == "bundled:demo.xml"
    name = 'its "ö".st' if "ö" in new else "object.safetensors"
    assert again.objects[0].field.name == str(tmp_path / name)
    assert scenario.objects[0].field.path == Path(tmp_path / name)


def test_the_token_of_a_server_is_found_from_anywhere(load, tmp_path):
    keys = 'url = "http://127.0.0.1:8000"\ntoken_file = "secret/token"'
    scenario, text = load(HEAD.replace(POLICY, keys))
    again = replayed(scenario, text, tmp_path / "elsewhere")
    assert again.policy.token_file.name == str(tmp_path / "secret/token")


def test_results_depend_on_a_servers_revision_and_not_on_patience(load, tmp_path):
    def read(*keys):
        url = 'url = "http://127.0.0.1:8000"'
        return load(HEAD.replace(POLICY, "\n".join([url, *keys])))

    first, _ = read()
    patient, text = read("timeout_s = 60.0", "retries = 5")
    assert dict(patient.leaves()) == dict(first.leaves())
    assert section_content(patient.policy) == section_content(first.policy)
    again = replayed(patient, text, tmp_path / "elsewhere")
    assert (again.policy.timeout_s, again.policy.retries) == (60.0, 5)
    newer, _ = read('revision = "epoch 40"')
    assert dict(newer.leaves()) != dict(first.leaves())
    assert section_content(newer.policy) != section_content(first.policy)


def test_another_field_for_every_object_replays_anywhere(load, tmp_path):
    scenario, text = load(HEAD, tmp_path / "mine.safetensors")
    for read in (scenario, replayed(scenario, text, tmp_path / "elsewhere")):
        assert read.objects[0].field.name == str(tmp_path / "mine.safetensors")


def test_module_of_a_vehicle_counts_with_its_source(load, tmp_path, monkeypatch):
    package = tmp_path / "cars_of_this_test"
    package.mkdir()
    (package / "__init__.py").write_text("raise AssertionError('was imported')")
    (package / "slow.py").write_text("speed = 1")
    monkeypatch.syspath_prepend(tmp_path)
    write_named_files(tmp_path)
    (tmp_path / "a.onnx").write_text("policy")

    def identity(reference):
        scenario, text = load(HEAD.replace(POLICY, f'{CAR}"{reference}"'))
        assert f'"{reference}"' in portable_text(scenario, text)
        return scenario.identity()

    before = identity("cars_of_this_test.slow:car")
    assert before == identity("cars_of_this_test.slow:car")
    (package / "slow.py").write_text("speed = 2")
    (changed,) = differences(before, identity("cars_of_this_test.slow:car"))
    assert changed.startswith("scenario.vehicle.function: ")
    for absent in ("cars_of_this_test.absent", "absent_package.absent", "math.absent"):
        identity(f"{absent}:car")  # refused later, where it is imported


BITMAP = '<texture type="bitmap" id="t"><string name="filename" {}/></texture>'
SPECTRUM = '<bsdf type="conductor" id="c"><spectrum name="eta" filename="{}"/></bsdf>'
DEFAULT = '<default name="{}" value="{}"/>'.format
DEFAULT_BACKWARDS = '<default value="{}" name="{}"/>'.format
WAYS = {
    "single quotes": ("t.png", BITMAP.format("value='t.png'")),
    "spaces": ("t.png", BITMAP.format('value  = "t.png"')),
    "line break": ("t.png", BITMAP.format('value=\n"t.png"')),
    "parameter": ("t.png", DEFAULT("w", "t") + BITMAP.format('value="$w.png"')),
    "entity": ("a&b.png", BITMAP.format('value="a&amp;b.png"')),
    "search path": ("in/t.png", '<path value="in"/>' + BITMAP.format('value="t.png"')),
    "included": ("t.png", '<include filename="inner.xml"/>'),
    "spectrum": ("s.spd", DEFAULT("s", "s.spd") + SPECTRUM.format("$s")),
    "spectrum with an entity": ("a&b.spd", SPECTRUM.format("a&amp;b.spd")),
    "spectrum of a default of defaults": (
        "s.spd",
        DEFAULT_BACKWARDS("s", "d")
        + DEFAULT_BACKWARDS("$d.spd", "s")
        + SPECTRUM.format("$s"),
    ),
    "comment that XML forbids": (
        "t.png",
        "<!-- a -- b -->" + BITMAP.format("value='t.png'"),
    ),
}


@pytest.mark.usefixtures("variant")
@pytest.mark.parametrize("way", WAYS)
def test_a_changed_file_is_noticed(tmp_path, way):
    name, body = WAYS[way]
    named, scene = tmp_path / name, tmp_path / "scene.xml"
    named.parent.mkdir(exist_ok=True)
    inner = BITMAP.format("value='t.png'")
    (tmp_path / "inner.xml").write_text(f'<scene version="3.0.0">{inner}</scene>')
    scene.write_text(f"<scene version='3.0.0'>{body}</scene>")
    digests = []
    for value in ("400 1\n700 1\n", "400 1\n700 2\n"):
        named.write_text(value)
        digests.append(NamedFile("scene.xml", scene).content()["sha256"])
    assert digests[0] != digests[1]


@pytest.mark.usefixtures("variant")
def test_a_scene_that_cannot_be_read_is_refused(tmp_path):
    scene = tmp_path / "scene.xml"
    body = "<string name='filename' value='$t'/>"
    scene.write_text(f"<scene version='3.0.0'>{body}</scene>")
    with pytest.raises(InputError, match=r"undefined parameter.*\$t.*<default>"):
        NamedFile("scene.xml", scene).content()
