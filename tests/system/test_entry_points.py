"""Other packages' entry points: who is found, who is refused, what results record."""

from __future__ import annotations

import json
import pickle
from pathlib import Path

import drjit as dr
import mitsuba as mi
import pytest
from support.files.packages import use_packages, write_package
from support.worlds.attacks import write_scenario

from mi_nerfattack.deploy.place import bundled_place
from mi_nerfattack.deploy.registry import environment_versions, make_environment
from mi_nerfattack.errors import InputError
from mi_nerfattack.experiment.transfer.columns import make_columns, parse_condition
from mi_nerfattack.render.pathtrace.load import load_scene
from mi_nerfattack.scenario.deployment import DeploymentSection
from mi_nerfattack.scenario.named_file import section_content
from mi_nerfattack.scenario.scenario import load_scenario
from mi_nerfattack.scenario.section import read_section
from mi_nerfattack.scenario.vehicle import VehicleSection
from mi_nerfattack.system import entry_points

pytestmark = pytest.mark.usefixtures("variant")

VEHICLE = """
from typing import Literal
from mi_nerfattack.scenario.vehicle import AbstractVehicleSection
from mi_nerfattack.vehicle.dynamics import Dubins
class Slow(AbstractVehicleSection):
    kind: Literal["slow"]
    speed_ms: float = 1.0
    def build(self):
        return Dubins(self.speed_ms)
    def handling(self):
        return {"max_control": 1.5}
class Odd(Slow):
    kind: Literal["odd"]
    def handling(self):
        return {"max_control": 1.5, "control_unit": "other"}
class Bare(AbstractVehicleSection):
    kind: Literal["bare"]
class Other(Slow):
    kind: Literal["another"]
number = 3
"""
ENVIRONMENT = """
def make(place, conditions, length: int = 2):
    raise AssertionError
def untyped(place, conditions, length=2):
    raise AssertionError
def needy(place, conditions, length: int):
    raise AssertionError
def nothing(place, conditions):
    return length
length = 3
"""
POINTS = {
    "vehicles.slow": "other.vehicle:Slow",
    "vehicles.odd": "other.vehicle:Odd",
    "vehicles.bare": "other.vehicle:Bare",
    "vehicles.misnamed": "other.vehicle:Other",
    "vehicles.number": "other.vehicle:number",
    "vehicles.missing": "other.absent:Slow",
    "vehicles.nameless": "other.vehicle:Fast",
    "vehicles.broken": "other.broken",
    "vehicles.dubins": "other.broken",
    "environments.long": "other.environment:make",
    "environments.untyped": "other.environment:untyped",
    "environments.needy": "other.environment:needy",
    "environments.nothing": "other.environment:nothing",
    "environments.length": "other.environment:length",
    "conditions.length": "other.environment:length",
    "conditions.nothing": "other.environment:nothing",
    "plugins.half": "other.half",
    "plugins.function": "other.environment:make",
    "plugins.idle": "other.environment",
}
HALF = """
import mitsuba as mi
class Half(mi.Texture):
    def __init__(self, props):
        super().__init__(props)
    def eval(self, si, active=True):
        return mi.Spectrum(0.5)
    def eval_1(self, si, active=True):
        return mi.Float(0.5)
    def mean(self):
        return mi.Float(0.5)
mi.register_texture("half", Half)
"""
SOURCES = {
    "other/__init__.py": "",
    "other/vehicle.py": VEHICLE,
    "other/broken.py": "raise RuntimeError('no licence')",
    "other/environment.py": ENVIRONMENT,
    "other/half.py": HALF,
}


@pytest.fixture(autouse=True)
def installed(tmp_path, monkeypatch) -> Path:
    """The folder of a package that offers all of the above."""
    folder = write_package(tmp_path / "site", POINTS, SOURCES)
    use_packages(monkeypatch, folder)
    return folder


def vehicle(**keys):
    return read_section("vehicle", VehicleSection, keys, ".")


def deployment(**keys):
    return read_section("deployment", DeploymentSection, keys, ".")


def test_a_kind_of_another_package_is_read_written_and_sent_to_a_process():
    section = vehicle(kind="slow", speed_ms=2.0)
    assert section.motion().dynamics.speed == 2.0
    assert section.package.startswith("other 1.0, code ")
    again = pickle.loads(pickle.dumps(section))
    assert again == section and again.package == section.package
    leaves = dict(section.leaves())
    assert leaves["package",] == section.package
    assert leaves["speed_ms",] == 2.0
    content = section_content(section)
    assert content == {"kind": "slow", "speed_ms": 2.0, "package": section.package}
    assert not vehicle(kind="dubins").package  # ours; the package's is not looked at


def test_an_environment_takes_the_functions_arguments_as_keys():
    section = deployment(kind="long", length=3, sky="noon")
    assert section.settings == {"length": 3} and section.sky == "noon"
    again = pickle.loads(pickle.dumps(section))
    assert again.settings == {"length": 3} and again.package == section.package
    assert environment_versions("long") == {"long": section.package}
    for wrong in ({"length": "3"}, {"width": 3}, {"objects": "built-in"}):
        with pytest.raises(InputError, match=f"deployment.{next(iter(wrong))}: "):
            deployment(kind="long", **wrong)


REFUSED = {
    "slower": ("slower", "dubins.*of other packages bare, broken"),
    "bare": ("other 1.0", "build, handling"),
    "misnamed": ("other 1.0", 'Literal."misnamed"'),
    "number": ("other 1.0", "AbstractVehicleSection"),
    "missing": ("other 1.0", "ModuleNotFoundError.*other.absent.*uninstall"),
    "nameless": ("other 1.0", "AttributeError.*Fast"),
    "broken": ("other 1.0", "RuntimeError: no licence"),
}


@pytest.mark.parametrize("kind", REFUSED)
def test_a_vehicle_is_refused_with_its_package_and_the_cause(kind):
    package, cause = REFUSED[kind]
    with pytest.raises(InputError, match=f"vehicle.kind: .*{package}.*{cause}"):
        vehicle(kind=kind)


@pytest.mark.parametrize(
    ("call", "cause"),
    [
        (
            lambda: deployment(kind="short"),
            "deployment.kind: is .short.*mitsuba, .*needy",
        ),
        (lambda: deployment(kind="untyped"), "other 1.0.*'length' has no type"),
        (lambda: deployment(kind="length"), "other 1.0.*no function"),
        (
            lambda: make_environment("nothing", bundled_place()),
            "'nothing': its package makes int",
        ),
        (lambda: make_environment("needy", bundled_place()), "'needy': .*'length'"),
        (
            lambda: make_columns(["none"], ["day"], 1),
            "--environments: 'none'.*of other packages length, long",
        ),
        (lambda: parse_condition("length:1"), "other 1.0.*no class"),
        (lambda: parse_condition("nothing:x"), "--conditions: 'nothing:x'"),
        (lambda: parse_condition("none:1"), "pitch, length, nothing, each once"),
        (lambda: parse_condition("nothing:1,nothing:2"), "each once"),
    ],
)
def test_other_extensions_are_refused(call, cause):
    with pytest.raises(InputError, match=cause):
        call()


def test_a_vehicle_without_wheels_does_not_drive_in_mujoco(tmp_path):
    odd = {"[drive]": 'control_scale = 2.0\n[vehicle]\nkind = "odd"\n[drive]'}
    folder = write_scenario(tmp_path / "s", odd)
    path = folder / "scenario.toml"
    scenario, _ = load_scenario(path)
    mitsuba, mujoco = make_columns(["mitsuba", "mujoco"], ["day"], 1)
    mitsuba.check(scenario)
    with pytest.raises(InputError, match="--environments: mujoco drives a car with"):
        mujoco.check(scenario)
    with pytest.raises(InputError, match="deployment: mujoco: .*car with wheels"):
        load_scenario(path, settings=["deployment.kind=mujoco"])


def test_a_name_that_two_packages_offer_is_refused(installed):
    rival = {"vehicles.slow": "rival:Slow"}
    write_package(installed, rival, {"rival.py": VEHICLE}, "rival", "2.0")
    entry_points._load.cache_clear()
    with pytest.raises(InputError, match="(other 1.0|rival 2.0) and .*uninstall one"):
        vehicle(kind="slow")


def test_a_condition_is_named_in_label_and_identity():
    condition = parse_condition("noise:0.1,nothing:2")
    assert condition.label == "noise:0.1,nothing:2"
    identity = condition.identity()
    assert identity["others"] == [("nothing", 2.0)]
    assert identity["packages"]["nothing"].startswith("other 1.0, code ")
    assert "others" not in parse_condition("noise:0.1").identity()


def scene(folder: Path, plugin: str) -> Path:
    path = folder / "scene.xml"
    path.write_text(
        '<scene version="3.0.0"><shape type="sphere"><bsdf type="diffuse">'
        f'<texture type="{plugin}" name="reflectance"/></bsdf></shape></scene>'
    )
    return path


def test_a_scene_loads_a_plugin_in_each_variant(tmp_path):
    path = scene(tmp_path, "half")
    for name in ("llvm_ad_rgb", "llvm_ad_mono", "llvm_ad_rgb"):
        mi.set_variant(name)
        (shape,) = load_scene(path).shapes()
        at = dr.zeros(mi.SurfaceInteraction3f)
        value = shape.bsdf().eval_diffuse_reflectance(at)
        assert type(value) is mi.Spectrum and dr.all(value == 0.5)


@pytest.mark.parametrize(
    ("plugin", "cause"),
    [
        ("none", 'Plugin "none" not found'),
        ("function", "other 1.0.*is no module"),
        ("idle", 'Plugin "idle" not found'),
    ],
)
def test_a_plugin_is_refused(tmp_path, plugin, cause):
    with pytest.raises(InputError, match=cause):
        load_scene(scene(tmp_path, plugin))


def digest_of(scenario: Path) -> dict[str, str]:
    return load_scenario(scenario)[0].identity()


def test_results_depend_on_the_code_of_the_packages(tmp_path, installed):
    folder = write_scenario(
        tmp_path / "s", {"[drive]": '[vehicle]\nkind = "slow"\n[drive]'}
    )
    scene(folder, "half").rename(folder / "deployment.xml")
    path = folder / "scenario.toml"
    before = digest_of(path)
    assert json.loads(before["scenario.vehicle.package"]).startswith("other 1.0")
    assert "other 1.0" in before["scenario.scene.deployment"]
    source = installed / "other/vehicle.py"
    source.write_text(source.read_text() + "\n# another version\n")
    entry_points._load.cache_clear()
    after = digest_of(path)
    changed = {key for key in before if before[key] != after[key]}
    assert changed == {"scenario.vehicle.package", "scenario.scene.deployment"}


def test_nothing_is_looked_up_for_our_own_kinds(tmp_path, monkeypatch):
    monkeypatch.setattr(entry_points, "entry_points", None)
    path = write_scenario(tmp_path / "s") / "scenario.toml"
    load_scenario(path)[0].identity()
