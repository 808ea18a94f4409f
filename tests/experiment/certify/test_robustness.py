"""Certificates of robustness: what is searched, driven, kept, counted and refused."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pandas as pd
import pytest
import scipy.stats
from support.faults.refusals import refused_at
from support.pages.read import drawn

from mi_nerfattack.backend.determinism import one_thread
from mi_nerfattack.deploy.environment import drive
from mi_nerfattack.drives.store import Store
from mi_nerfattack.experiment.certify.noise import (
    ATTACKED,
    CENTRE,
    SEARCH,
    Looks,
    NoisyDrives,
    Smoothing,
)
from mi_nerfattack.experiment.certify.robustness import (
    RobustnessSettings,
    certify_robustness,
)
from mi_nerfattack.experiment.certify.search import (
    CAP,
    BallSearch,
    into_ball,
    severity,
    steepest,
)
from mi_nerfattack.io import files
from mi_nerfattack.report.certificate import robustness_table
from mi_nerfattack.report.plots.certificate import plot_robustness
from mi_nerfattack.scenario.scenario import load_scenario
from mi_nerfattack.scenario.world import build_world
from mi_nerfattack.system.workers import InThisProcess
from tests.experiment.conftest import write_found

pytestmark = pytest.mark.usefixtures("variant")

SETTINGS = RobustnessSettings(
    runs=12, sd=0.5, radii=(0.3, 1.0), proposals=3, judged_by=2, attacked=4
)


def test_the_direction_is_the_normal_of_a_half_space():
    rng = np.random.default_rng(0)
    normal = rng.standard_normal(24)
    noise = 0.5 * rng.standard_normal((4000, 24))
    direction = steepest(noise, (noise @ normal > 1.0).astype(float))
    assert np.linalg.norm(direction) == pytest.approx(1)
    assert direction @ normal / np.linalg.norm(normal) > 0.95
    assert not steepest(noise, np.full(4000, 0.3)).any()


def test_a_search_stays_in_its_ball_and_finds_its_farthest_point():
    direction, asked = np.ones(6) / np.sqrt(6), []

    def judge(point: np.ndarray) -> float:
        asked.append(point)
        return float(point @ direction)

    search = BallSearch(0.7, np.zeros(6), 200, seed=1)
    farthest = search.best(judge)
    assert len(asked) == 200 and np.array_equal(asked[0], np.zeros(6))
    assert max(np.linalg.norm(point) for point in asked) <= 0.7 + 1e-12
    assert farthest @ direction > 0.95 * 0.7
    assert farthest @ direction == max(point @ direction for point in asked)
    again, first = list(asked), asked.clear()
    assert first is None and np.array_equal(search.best(judge), farthest)
    assert np.array_equal(again, asked)
    assert into_ball(np.array([3.0, 4.0]), 1.0) == pytest.approx([0.6, 0.8])


def test_severity_counts_in_limits_and_ends():
    assert severity(0.4, 0.8) == 0.5
    assert severity(8.0, 0.8) == CAP


@pytest.fixture(scope="module")
def scenario(tmp_path_factory):
    mi.set_variant("llvm_ad_rgb")
    path = write_found(tmp_path_factory.mktemp("scenario"))
    # the lane is hardly wider than the car: some drives depart, and some do not
    narrow = "[vehicle]\nwidth_m = 3.3\n[drive]"
    path.write_text(path.read_text().replace("[drive]", narrow))
    return load_scenario(path)[0]


@pytest.fixture(scope="module")
def certified(scenario, tmp_path_factory):
    output = tmp_path_factory.mktemp("out") / "certificate"
    return output, certify_robustness(scenario, output, SETTINGS, InThisProcess())


def test_figures_follow_from_the_drives(certified):
    output, document = certified
    drives = pd.read_csv(output / "drives.csv")
    counts = drives.groupby(["around", "radius"])["departed"].agg(["sum", "count"])
    departed = counts.loc["centre", 0.0]
    assert 0 < departed["sum"] < departed["count"] == 12
    assert document["departed"] == departed["sum"]
    bound = scipy.stats.beta.ppf(0.999, departed["sum"] + 1, 12 - departed["sum"])
    assert document["chance_bound"] == pytest.approx(bound)
    for row in document["rows"]:
        at = scipy.stats.norm.ppf(bound) + row["radius"] / 0.5
        assert row["bound"] == pytest.approx(scipy.stats.norm.cdf(at))
        noisy = counts.loc["attack", row["radius"]]
        assert (row["attack_departed"], row["attack_drives"]) == tuple(noisy)
        plain = counts.loc["attack without noise", row["radius"]]
        assert (row["plain_departed"], row["plain_drives"]) == tuple(plain)
        assert row["attack_chance"] == noisy["sum"] / 4
        assert row["gap"] == pytest.approx(row["bound"] - noisy["sum"] / 4)
        assert np.linalg.norm(row["attack"]) <= row["radius"] + 1e-9
    table = pd.read_csv(output / "certificate.csv")
    assert table["bound"].tolist() == [row["bound"] for row in document["rows"]]
    assert document == files.read_json(output / "certificate.json")
    # another start, texture and seed in each drive
    own = drives[drives["around"] == "centre"]
    assert own["start_y_m"].nunique() == own["seed"].nunique() == 12


def test_finished_drives_are_kept_and_more_are_added(scenario, certified):
    output, document = certified
    before = {p: p.stat().st_mtime_ns for p in output.rglob("*.safetensors")}
    again = certify_robustness(scenario, output, SETTINGS, InThisProcess())
    assert again == document
    assert {p: p.stat().st_mtime_ns for p in output.rglob("*.safetensors")} == before
    settings = RobustnessSettings(**{**vars(SETTINGS), "runs": 14, "radii": (0.3,)})
    wider = certify_robustness(scenario, output, settings, InThisProcess())
    runs = {p: p.stat().st_mtime_ns for p in output.rglob("random_*.safetensors")}
    assert len(runs) == 14 and sum(before.get(p) == at for p, at in runs.items()) == 12
    assert wider["departed"] >= document["departed"]
    # two numbers of runs are two looks, which lessen the confidence
    assert document["looks"] == again["looks"] == [12] and document["flags"] == []
    assert wider["looks"] == [12, 14]
    assert len(wider["flags"]) == 1 and "12, 14 runs" in wider["flags"][0]
    third = certify_robustness(scenario, output, SETTINGS, InThisProcess())
    assert third["looks"] == [12, 14] and third["flags"] == wider["flags"]


def test_no_start_has_the_random_numbers_of_a_noise(scenario, monkeypatch):
    world = build_world(scenario, scenario.build_policy())
    smoothing = Smoothing.of(world, "surrogate", Looks(world, 24), 0.5)
    keys, own = [], np.random.default_rng

    def recorded(key):
        keys.append(key)
        return own(key)

    monkeypatch.setattr(np.random, "default_rng", recorded)
    count = 2000
    for purpose in (CENTRE, ATTACKED, SEARCH):
        for number in range(count):
            smoothing.draw(world, purpose, number)
    streams = [tuple(np.random.SeedSequence(key).generate_state(4)) for key in keys]
    assert len(set(streams)) == len(streams) == 2 * 3 * count


def test_a_certificate_without_its_looks_is_refused(scenario, tmp_path):
    files.write_json(tmp_path / "certificate.json", {"schema": 1})
    with refused_at(tmp_path / "certificate.json", "looks"):
        certify_robustness(scenario, tmp_path, SETTINGS, InThisProcess())


def test_without_noise_it_is_the_drive_past_the_original_texture(scenario, tmp_path):
    world = build_world(scenario, scenario.build_policy())
    looks = Looks(world, 24)
    smoothing = Smoothing.of(world, "surrogate", looks, 0.5)
    zero, draw = np.zeros(looks.count), smoothing.nominal(world, 1)
    world_looks = world, looks
    specs = [
        smoothing.spec(zero, draw, "random", 0),
        smoothing.spec(zero, smoothing.draw(world, CENTRE, 0), "random", 0),
    ]
    work = NoisyDrives(Store(tmp_path), scenario, 24, specs, world_looks)
    driver, where = work.open(), (world.policy, world.route, world.initial[1])
    with one_thread():
        environment = world.open("surrogate")
        own = drive(environment, *where, scenario.seed + 1, world.horizon)
        plain, noisy = (driver.drive(spec, lambda step: None) for spec in specs)
    assert np.array_equal(plain.states, own.states)
    assert not np.array_equal(noisy.controls, own.controls)
    assert specs[0].digest != specs[1].digest


REFUSALS = [
    ({"environment": "moon"}, "--environment"),
    ({"radii": (0.5, 0.5)}, "--radii"),
    ({"radii": ()}, "--radii"),
    ({"coefficients": 2}, "coefficients"),
    ({"sd": 0.0}, "certify.sd"),
    ({"confidence": 1.0}, "certify.confidence"),
]


@pytest.mark.parametrize(("change", "where"), REFUSALS)
def test_refusals(change, where, scenario, tmp_path):
    output = tmp_path / "out"
    with refused_at(where):
        settings = RobustnessSettings(**{**vars(SETTINGS), **change})
        certify_robustness(scenario, output, settings, InThisProcess())
    assert not output.exists()


def test_poses_alone_and_other_folders_are_refused(scenario, tmp_path):
    path = write_found(tmp_path / "poses")
    text = path.read_text().replace('freedom.kind = "both"', 'freedom.kind = "pose"')
    path.write_text(text.replace("freedom.learning_rate = 0.5\n", ""))
    poses, output = load_scenario(path)[0], tmp_path / "out"
    with refused_at("attack.freedom.kind"):
        certify_robustness(poses, output, SETTINGS, InThisProcess())
    files.write_text(files.make_folder(output) / "thesis.txt", "mine")
    with refused_at(output, "thesis.txt"):
        certify_robustness(scenario, output, SETTINGS, InThisProcess())
    assert [path.name for path in output.iterdir()] == ["thesis.txt"]


def test_the_chart_has_the_bound_and_the_attacks(certified, monkeypatch):
    _, document = certified
    figures = drawn(monkeypatch)
    plot_robustness("certificate.png", document)
    (axis,) = figures[0].axes
    curve = np.asarray(axis.lines[0].get_xydata())
    for row in document["rows"]:
        at = np.interp(row["radius"], *curve.T)
        assert at == pytest.approx(row["bound"], abs=0.01)
    points = axis.containers[0].lines[0].get_xydata()
    assert points[:, 0].tolist() == [0.0, 0.3, 1.0]
    chances = [row["attack_chance"] for row in document["rows"]]
    assert points[:, 1].tolist() == [document["chance"], *chances]


def test_the_table_has_a_row_for_each_radius(certified):
    _, document = certified
    rows = list(robustness_table(document).body)
    assert [names for _, names, _ in rows] == [["0.000"], ["0.300"], ["1.000"]]
