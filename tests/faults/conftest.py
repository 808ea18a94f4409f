"""Jobs that nothing disturbs, and folders to start them in."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator

import drjit as dr
import mitsuba as mi
import pytest

from mi_nerfattack.backend.determinism import one_thread
from mi_nerfattack.io import files
from mi_nerfattack.system import workers
from mi_nerfattack.system.workers import InThisProcess
from tests.faults import worlds
from tests.faults.jobs import JOBS
from tests.faults.running import Runner


@pytest.fixture(scope="module")
def start(tmp_path_factory) -> Iterator[Callable[[str], Runner]]:
    mi.set_variant("llvm_ad_rgb")
    threads, runners = dr.thread_count(), {}
    dr.set_thread_count(1)
    # torch's sums by several threads depend on what the process did before
    with one_thread(), pytest.MonkeyPatch.context() as patch:
        patch.setattr(workers, "Processes", lambda *_, **__: InThisProcess())

        def begin(name: str) -> Runner:
            if name in runners:
                return runners[name]
            base, world = tmp_path_factory.mktemp("job"), JOBS[name].world
            if world in JOBS:
                before = begin(world)
                before.begin()  # what it leaves names its inputs by their paths
                source = before.undisturbed
            else:
                source = files.make_folder(base / "source")
                getattr(worlds, world)(source, patch)
            runner = runners[name] = Runner(name, source, base, patch)
            runner.begin()
            assert runner.run(runner.watch) == 0
            shutil.copytree(runner.folder, runner.undisturbed, symlinks=True)
            return runner

        yield begin
    dr.set_thread_count(threads)
