"""Runs of the jobs: alone, disturbed, and what they leave."""

from __future__ import annotations

import random
import shutil
import tempfile
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest
import torch
from support.faults.injected import Watch

from mi_nerfattack import cli
from mi_nerfattack.io import files, locks
from tests.faults.jobs import JOBS, Job


@dataclass
class Runner:
    """Starts one job, always in one folder: absolute paths decide about results.

    Attributes:
        name: of the job.
        source: the folder that is copied.
        base: of the copies.
        patch: what stands in for large places.
        watch: what the undisturbed job wrote and showed.
    """

    name: str
    source: Path
    base: Path
    patch: pytest.MonkeyPatch
    watch: Watch = field(default_factory=Watch)

    def __post_init__(self) -> None:
        self.job: Job = JOBS[self.name]
        self.folder, self.undisturbed = self.base / "here", self.base / "whole"
        self.scratch = files.make_folder(self.base / "scratch")

    def begin(self) -> Path:
        """Copy what the job reads, and go there."""
        return self.put(self.source)

    def put(self, source: Path) -> Path:
        """Copy a folder to where the job works, and go there."""
        shutil.rmtree(self.folder, ignore_errors=True)
        shutil.copytree(source, self.folder, symlinks=True)
        self.patch.chdir(self.folder)
        return self.folder

    def run(self, watch: Watch | None = None) -> int:
        """Run the command, all of it in this process; return its exit code."""
        words = f"{self.job.words} {self.job.options}".split()
        self.patch.setattr(tempfile, "tempdir", str(files.make_folder(self.scratch)))
        random.seed(0)
        np.random.seed(0)
        torch.manual_seed(0)
        with (watch or Watch()).watching():
            return cli.main(words)

    def finish(self, watch: Watch | None = None) -> None:
        """Run it to its end, which is that of the undisturbed job."""
        assert self.run(watch) == 0
        ends = [
            contents(path, self.job.equal) for path in (self.folder, self.undisturbed)
        ]
        names = sorted({*ends[0], *ends[1]})
        other = [name for name in names if ends[0].get(name) != ends[1].get(name)]
        assert names and not other, other


def partial_files(folder: Path) -> list[Path]:
    """Return the files that were not written to their ends."""
    return [path for path in folder.rglob(".*") if locks.is_partial(path)]


def times(folder: Path, pattern: str) -> dict[Path, int]:
    """Return when each file was written."""
    paths = folder.glob(pattern) if pattern else ()
    return {path: path.stat().st_mtime_ns for path in paths if path.is_file()}


def contents(folder: Path, patterns: tuple[str, ...]) -> dict[str, object]:
    """Return what files hold, but for the times in records of safetensors."""
    paths = {path for pattern in patterns for path in folder.glob(pattern)}
    return {str(path.relative_to(folder)): _content(path) for path in sorted(paths)}


def _content(path: Path) -> object:
    raw = path.read_bytes()
    if path.suffix != ".safetensors" or b"kept.record" not in raw:
        return raw
    tensors, metadata = files.read_safetensors(path)
    metadata.pop("kept.record")
    return {
        name: (v.dtype, v.shape, v.tobytes()) for name, v in tensors.items()
    }, metadata
