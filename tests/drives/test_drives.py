"""Finished drives by what decides them, and the runner that does the others."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace

import numpy as np
import pytest
from support.faults.refusals import refused_at

from mi_nerfattack.drives.run import AbstractDriver, AbstractDrives, run_drives
from mi_nerfattack.drives.spec import DriveSpec, identify
from mi_nerfattack.drives.store import Store, drive_files, read_drive, read_drives
from mi_nerfattack.errors import InputError
from mi_nerfattack.rollout.drive import Drive
from mi_nerfattack.system.machine import peak_of_children_mb
from mi_nerfattack.system.workers import InThisProcess, Processes

STEPS = 3
pytestmark = pytest.mark.usefixtures("variant")


def spec_of(run: int, environment: str = "surrogate", **decisive) -> DriveSpec:
    labels = environment, "line", "own", run, 10 + run, STEPS
    identity = {"format": "mi_nerfattack drive 5", "run": f"{run}", **decisive}
    return DriveSpec(*labels, identity, context=0.1 * run)


def straight(spec: DriveSpec, shift: float) -> Drive:
    states = np.zeros((STEPS + 1, 3))
    states[:, 0] = np.arange(STEPS + 1)
    errors, times = np.full(STEPS, shift), np.arange(1.0, STEPS + 1)
    labels = spec.environment, spec.route, spec.case, spec.run, spec.seed
    return Drive(*labels, states, np.zeros(STEPS), errors, times)


class Driver(AbstractDriver):
    def drive(self, spec, on_step):
        if spec.context < 0:
            raise InputError("the policy diverged")
        for step in range(STEPS):
            on_step(step)
        return straight(spec, spec.context)


@dataclass(frozen=True, eq=False)
class Drives(AbstractDrives):
    groups: tuple = ()  # pyright: ignore[reportIncompatibleMethodOverride]

    def open(self):
        return Driver()


def add(store: Store, spec: DriveSpec, shift: float = 0.5) -> None:
    store.add(spec, straight(spec, shift), 1.5)


def test_a_drive_is_found_by_what_decides_it(tmp_path):
    store, spec = Store(tmp_path), spec_of(2, "../mitsuba@noon+1EV")  # no path
    assert store.read(spec) is None and not store.has(spec)
    add(store, spec)
    stored = store.read(spec)
    assert store.has(spec) and stored is not None and stored.wall_s == 1.5
    assert (stored.drive.cross_track_m == 0.5).all() and stored.drive.seed == 12
    other = spec_of(2, spec.environment, policy="another")
    assert store.read(other) is None and not store.has(other)
    (path,) = drive_files(tmp_path)
    assert path == store.path(spec) and path.parent.parent == tmp_path
    loaded = read_drive(path)
    assert (loaded.route, loaded.case, loaded.run, loaded.seed) == (
        "line",
        "own",
        2,
        12,
    )
    assert loaded.environment == spec.environment
    add(store, other)
    assert len(read_drives(tmp_path)) == 2
    store.remove_others([other])
    assert drive_files(tmp_path) == [store.path(other)]
    store.remove()
    assert not tmp_path.exists()


def test_all_rows_of_the_state_are_kept(tmp_path):
    store, spec = Store(tmp_path), spec_of(0)
    drive = straight(spec, 0.5)
    states = np.hstack([drive.states, np.arange(8.0).reshape(4, 2)])
    store.add(spec, replace(drive, states=states), 1.0)
    loaded = read_drive(store.path(spec))
    np.testing.assert_array_equal(loaded.states, states)
    np.testing.assert_array_equal(loaded.poses, drive.states)


@pytest.mark.parametrize("damage", ["cut", "bit", "entries"])
def test_a_damaged_drive_is_told(tmp_path, damage):
    store, spec = Store(tmp_path), spec_of(0)
    drive = straight(spec, 0.5)
    if damage == "entries":
        object.__setattr__(drive, "controls", np.zeros(1))
    store.add(spec, drive, 1.0)
    path = store.path(spec)
    if damage != "entries":
        raw = bytearray(path.read_bytes())
        raw[-9] ^= 1
        path.write_bytes(raw[:-7] if damage == "cut" else raw)
    for read in (lambda: store.read(spec), lambda: read_drive(path)):
        with refused_at(path):
            read()


def test_shared_drives_are_taken_over_and_given(tmp_path):
    shared = tmp_path / "shared"
    one, other = (Store(tmp_path / name, shared) for name in ("one", "other"))
    spec = spec_of(0)
    add(one, spec)
    assert other.has(spec) and not drive_files(other.folder)
    stored = other.read(spec)
    assert stored is not None and (stored.drive.cross_track_m == 0.5).all()
    assert drive_files(other.folder) == [other.path(spec)]
    # a name of one's own for a drive that another run made
    relabelled = other.read(replace(spec, environment="surrogate", case="own", seed=99))
    assert relabelled is not None and relabelled.drive.seed == 99
    other.path(spec).unlink()
    next(shared.rglob("*.safetensors")).write_bytes(b"no drive")
    with pytest.raises(InputError, match="shared"):
        other.read(spec)


@pytest.mark.parametrize("workers", [InThisProcess(), Processes(2)])
def test_missing_drives_are_done_once(tmp_path, workers):
    before = peak_of_children_mb()
    specs = [spec_of(run) for run in range(4)]
    store = Store(tmp_path)
    add(store, specs[1], 9.0)
    work = Drives(store, ((specs[0], specs[1]), (specs[2],), (specs[3],)))
    reports, steps = [], []
    groups = run_drives(work, workers, lambda *both: steps.append(both), reports.append)
    shifts = [[item.drive.cross_track_m[0] for item in group] for group in groups]
    assert shifts == [[0.0, 9.0], [0.2], [pytest.approx(0.3)]]
    assert reports[0] == {} and sorted(next(iter(each)) for each in reports[1:]) == [
        0,
        1,
        2,
    ]
    assert steps[0] == (STEPS + 1, 4 * STEPS) and steps[-1] == (4 * STEPS, 4 * STEPS)
    if isinstance(workers, Processes):  # an interpreter with Dr.Jit
        assert peak_of_children_mb() >= max(before, 50)
    times = [path.stat().st_mtime_ns for path in drive_files(tmp_path)]
    reports.clear()
    again = run_drives(work, workers, on_groups=reports.append)
    assert [path.stat().st_mtime_ns for path in drive_files(tmp_path)] == times
    assert len(reports) == 1 and len(reports[0]) == len(again) == 3


class Refusing(Drives):
    def check(self, missing):
        raise InputError(f"{len(missing)} drives without a place")


class Losing(Drives):
    def drive(self, driver, spec, on_step):
        outcome = super().drive(driver, spec, on_step)
        if spec.run == 2:
            self.store.path(spec).unlink()
        return outcome


@pytest.mark.parametrize(
    ("kind", "shift", "match", "runs"),
    [
        (Drives, -1.0, "the policy diverged", [0]),  # and leaves those before
        (Refusing, 0.1, "3 drives without a place", []),  # before the first
        (Losing, 0.1, "own_0002-.*missing", [0, 1]),  # removed meanwhile
    ],
)
def test_drives_that_fail(tmp_path, kind, shift, match, runs):
    specs = spec_of(0), replace(spec_of(1), context=shift), spec_of(2)
    work = kind(Store(tmp_path), tuple((spec,) for spec in specs))
    with pytest.raises(InputError, match=match):
        run_drives(work, InThisProcess())
    assert [drive.run for drive in read_drives(tmp_path)] == runs


def test_versions_and_packages_of_the_environment_decide():
    plain, simulated = identify(None, {"a": 1}), identify("mujoco", {"a": "x"})
    assert plain["a"] == "1" and simulated["a"] == "x"
    assert {"format", "version.source", "version.numpy"} <= plain.keys()
    assert simulated.keys() - plain.keys() == {"version.mujoco"}


def test_a_file_counts_by_its_content(tmp_path):
    def spec_with(name: str, digest: str) -> DriveSpec:
        return spec_of(0, policy=json.dumps({"file": name, "sha256": digest}))

    store = Store(tmp_path)
    add(store, spec_with("a.pt", "12"))
    assert store.read(spec_with("renamed.pt", "12")) is not None
    assert store.read(spec_with("a.pt", "34")) is None
