"""Build wheel and sdist, and use the wheel in an environment that has nothing else.

The environment has no extras while the wheel is used. Then ask how much of the package
is typed for whoever installs it.

Run by `make dist`, in minutes: most of them install PyTorch, which comes from pip's
cache once `make test` has fetched it. The arguments are further requirements.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import tempfile
import zipfile
from pathlib import Path

ROOT = Path(__file__).parents[1]
DIST, TREE, EMPTY = ROOT / "dist", ROOT / "build" / "tree", ROOT / "build" / "empty"
MOST_MB = 45
LEAST_TYPED = 0.9  # of the public names, so that other people's checkers know them
RENDER = "render frame bundled:intersection/field.xml -o frame.png --size 48 16 --spp 1"


def call(*command: str | Path, where: Path = ROOT) -> str:
    """Run a command without what Python is told by variables; returns its output."""
    known = {k: v for k, v in os.environ.items() if not k.startswith("PYTHON")}
    words = [str(word) for word in command]
    done = subprocess.run(words, cwd=where, env=known, stdout=subprocess.PIPE)
    if done.returncode:
        sys.stderr.buffer.write(done.stdout)
        raise SystemExit(f"{' '.join(words)}: ended with {done.returncode}")
    return done.stdout.decode()


def build() -> Path:
    """Build the sdist, a wheel of it and one of the tree; return the first wheel."""
    for folder in (DIST, TREE):
        shutil.rmtree(folder, ignore_errors=True)
    module = (sys.executable, "-m", "build", "--outdir")
    call(*module, DIST)
    call(*module, TREE, "--wheel")
    (wheel,), (other,) = DIST.glob("*.whl"), TREE.glob("*.whl")
    found, wanted = contents(wheel), contents(other)
    if wrong := [name for name, _ in sorted(found.items() ^ wanted.items())]:
        raise SystemExit(f"{DIST}: the sdist builds other files: {', '.join(wrong)}")
    for path in DIST.iterdir():
        size = path.stat().st_size / 1e6
        print(f"{path.name}: {size:.1f} MB", flush=True)
        if size > MOST_MB:
            raise SystemExit(f"{path.name}: {size:.1f} MB; at most {MOST_MB} MB")
    return wheel


def contents(wheel: Path) -> dict[str, int]:
    """Return the checksum of each file in a wheel."""
    with zipfile.ZipFile(wheel) as archive:
        return {item.filename: item.CRC for item in archive.infolist()}


def install(wheel: Path, *more: str) -> Path:
    """Make an environment of the wheel without extras; return its programs."""
    shutil.rmtree(EMPTY, ignore_errors=True)
    call(sys.executable, "-m", "venv", EMPTY)
    programs = EMPTY / ("Scripts" if os.name == "nt" else "bin")
    pip = programs / "python", "-m", "pip", "--disable-pip-version-check", "-q"
    call(*pip, "install", "--no-compile", *more, wheel)
    return programs


def add_extras(programs: Path, wheel: Path) -> None:
    """Install the extras whose types the public names have."""
    pip = programs / "python", "-m", "pip", "--disable-pip-version-check", "-q"
    call(*pip, "install", "--no-compile", f"{wheel}[demo,gym,mujoco,video]")


def use(programs: Path, version: str) -> None:
    """Run the command line in an empty folder."""
    ours = programs / "mi-nerfattack"
    with tempfile.TemporaryDirectory() as folder:
        where = Path(folder)
        told = call(ours, "--version", where=where).split()
        if told != ["mi-nerfattack", version]:
            raise SystemExit(f"--version: {' '.join(told)}; the wheel is of {version}")
        call(ours, "doctor", where=where)  # 0: the core is all there
        frame = json.loads(call(ours, *RENDER.split(), "--json", where=where))
        look = "from PIL import Image; print(*Image.open('frame.png').size, "
        look += "*Image.open('frame.png').convert('L').getextrema())"
        *size, least, most = map(
            int, call(programs / "python", "-c", look, where=where).split()
        )
    if size != frame["size_px"] or least == most:
        raise SystemExit(f"frame.png: {size}, {least} to {most}; not what was asked")
    print(f"installed and run: {frame['seconds']:.1f} s for a frame")


def check_types(programs: Path) -> None:
    """Ask pyright for how many of the installed public names it knows the type."""
    pyright = Path(sys.executable).with_name("pyright"), "--outputjson"
    words = *pyright, "--ignoreexternal", "--verifytypes", "mi_nerfattack"
    known = os.environ | {"PATH": f"{programs}{os.pathsep}{os.environ['PATH']}"}
    with tempfile.TemporaryDirectory() as where:  # it ends with 1 below 100 %
        done = subprocess.run(words, cwd=where, env=known, stdout=subprocess.PIPE)
    found = json.loads(done.stdout)["typeCompleteness"]
    share = found["completenessScore"]
    print(f"{share:.1%} of the public names are typed, {found['exportedSymbolCounts']}")
    if share < LEAST_TYPED:
        raise SystemExit(f"types: less than {LEAST_TYPED:.0%}; annotate what is new")


if __name__ == "__main__":
    built = build()
    installed = install(built, *sys.argv[1:])
    use(installed, built.name.split("-")[1])
    add_extras(installed, built)
    check_types(installed)
