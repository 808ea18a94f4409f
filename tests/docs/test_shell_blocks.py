"""Commands of the documentation: all parse, and blocks that take no input run.

A block is what stands between fences without a language and calls us. Each is run as it
stands, or is listed with the reason why not. Those of `bash` are run by docs/follow.py.
"""

from __future__ import annotations

import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest
import tyro
from support.pages.blocks import fenced

from mi_nerfattack import cli
from mi_nerfattack.commands import COMMANDS, each

ROOT = Path(__file__).parents[2]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
RUN = {
    "mi-nerfattack check scenes/demo.toml --no-drives -o check.png",
    "mi-nerfattack render frame scenes/intersection/field.xml -o hydrant.exr",
    "mi-nerfattack render frame scenes/intersection/field.xml -o hydrant.png \\",
    "mi-nerfattack render frame scenes/intersection/field.xml -o by_depth.exr \\",
    "mi-nerfattack render frame scenes/intersection/field.xml -o lit.png --sensor 1 "
    "--set relit=true",
    "mi-nerfattack asset flat patch -o patch.safetensors --width-m 1.8 --height-m 4",
}
# Why the other blocks of a page are not run.
INPUT = "takes files of the user's, or a folder that minutes to hours of work made"
LONG = "takes more than a minute"
CAR = "takes a run, a camera, a tracker or a car"
USAGE = "shows what may be given, in words that stand for it"
SKIPPED = {
    **dict.fromkeys("README index howto/certify howto/evaluate".split(), LONG),
    **dict.fromkeys("howto/frames howto/training howto/your_policy".split(), LONG),
    **dict.fromkeys("reference/room results/bench results/refine".split(), LONG),
    **dict.fromkeys("howto/reproduce howto/sweep howto/sweep_cluster".split(), USAGE),
    **dict.fromkeys("results/accuracy results/attack_size".split(), LONG),
    **dict.fromkeys("results/attack_speed results/rendering".split(), LONG),
    **dict.fromkeys("results/reach results/training".split(), LONG),
    **dict.fromkeys("results/photographs results/pages".split(), INPUT),
    "results/gpu": "takes a GPU",
    "results/certificates": LONG,
    **dict.fromkeys("howto/attack howto/flat_objects howto/search".split(), INPUT),
    **dict.fromkeys("howto/check howto/deployment".split(), INPUT),
    **dict.fromkeys("howto/resume howto/vehicle".split(), INPUT),
    **dict.fromkeys("examples howto/fields howto/place".split(), INPUT),
    **dict.fromkeys("howto/asset howto/bake howto/export".split(), INPUT),
    **dict.fromkeys("howto/photographs howto/poses howto/splats".split(), INPUT),
    "results/fields": INPUT,
    **dict.fromkeys("howto/render howto/report howto/retrain".split(), INPUT),
    **dict.fromkeys("howto/transfer howto/view howto/policy".split(), INPUT),
    "howto/retrain_code": INPUT,
    **dict.fromkeys("howto/policy_steering howto/policy_url".split(), INPUT),
    **dict.fromkeys("howto/conditions howto/openscenario".split(), INPUT),
    **dict.fromkeys("howto/environments howto/mujoco".split(), LONG),
    **dict.fromkeys("reference/places reference/routes".split(), LONG),
    **{f"results/{x}/README": INPUT for x in ("matrix", "methods", "table2")},
    "results/findings/index": LONG,
    **{f"car/{x}": CAR for x in "compare drive monitor motor overlay".split()},
    **{f"car/{x}": CAR for x in "print remote setup".split()},
    "results/car": LONG,
    "howto/carla": "takes CARLA's server",
    "reference/commands": "writes into the home folder",
    "start/first_attack": LONG,
    "start/install": "installs",
    "examples/package_template/README": "installs",
    "dev/extend/condition": INPUT,
}


def blocks(page: Path, languages: tuple[str, ...] = ("",)) -> list[str]:
    """Find the blocks of a page that call us."""
    ours = r"^(\S*/)?(mi-nerfattack|python -m|make|pip) "
    return [text for text in fenced(page, *languages) if re.search(ours, text, re.M)]


def name(page: Path) -> str:
    """Return the path of a page below docs, without its ending."""
    return re.sub(r"^docs/", "", page.relative_to(ROOT).with_suffix("").as_posix())


def commands(text: str) -> list[list[str]]:
    """Split the calls of a block into words, without what the shell does to them."""
    joined = re.sub(r"\\\n\s*", " ", text)
    lines = re.findall(r"^(?:\S*/)?mi-nerfattack ([a-z-]+ ?.*)$", joined, re.M)
    lines = [re.sub(r" [>|&].*|[\[\]]|\.\.\.", "", line) for line in lines]
    return [shlex.split(line, comments=True) for line in lines if line[0] != "-"]


CALLS = [
    pytest.param(words, id=f"{name(page)}-{k}-{words[0]}")
    for page in PAGES
    for k, words in enumerate(
        words for text in blocks(page, ("", "bash")) for words in commands(text)
    )
]


@pytest.mark.parametrize("words", CALLS)
def test_commands_parse(words):
    ((length, command),) = [
        (len(name), command)
        for name, command in each(COMMANDS)
        if tuple(words[: len(name)]) == name
    ]
    with cli._FIELDS:  # has -o
        assert tyro.cli(command, args=words[length:], config=cli._STYLE) is not None


def test_every_block_is_run_or_has_a_reason():
    first = {name(page): {x.split("\n")[0] for x in blocks(page)} for page in PAGES}
    assert set().union(*first.values()) >= RUN
    assert {page for page, lines in first.items() if lines - RUN} == set(SKIPPED)


@pytest.mark.slow
@pytest.mark.parametrize("first", sorted(RUN))
def test_blocks_run(first, tmp_path):
    (text,) = [b for page in PAGES for b in blocks(page) if b.split("\n")[0] == first]
    (tmp_path / "scenes").symlink_to(ROOT / "scenes")
    tools = f'PATH="{Path(sys.executable).parent}:$PATH"; export PATH\n'
    done = subprocess.run(
        ["bash", "-euc", tools + text], cwd=tmp_path, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    outputs = [words[words.index("-o") + 1] for words in commands(text)]
    assert outputs and all((tmp_path / name).stat().st_size for name in outputs)
