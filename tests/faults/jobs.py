"""Commands that can be disturbed: how each starts small, what it keeps, how it ends.

A command joins the suite with one entry of `JOBS`, or of `WRITERS` where it only writes
at its end. `docs/generate.py` writes tables of docs/reference/faults.md from this file.
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Job:
    """One command, started in a folder that holds what it reads.

    Attributes:
        words: of the command, without its options.
        options: its options.
        world: function of :mod:`worlds` that writes what it reads, or the job from
            whose folder it starts.
        equal: patterns of the files that end equal to the bit, however the job was
            disturbed; of safetensors without the record of times.
        keeps: pattern of the files that are written once.
        claims: the folder that keeps a second process out; none where none is needed.
        reads: it reads its inputs before it locks ("lock"), before it checks that it
            may write ("mode"), or both.
        leaves: pattern of hidden files of a killed process that the next one does not
            remove, since another process may be writing there.
        retries: too little memory is a failed try, and the command tries again.
        places: at so many, one after the other, each event comes.
        slow: takes tens of seconds.
    """

    words: str
    options: str
    world: str
    equal: tuple[str, ...]
    keeps: str = ""
    claims: str = ""
    reads: tuple[str, ...] = ()
    leaves: str = ""
    retries: bool = False
    places: int = 4
    slow: bool = False


def _drives(folder: str) -> str:
    return f"{folder}/**/*_0*-*.safetensors"


_BOTH = ("lock", "mode")
JOBS = {
    "attack": Job(
        "attack scenario.toml",
        "-o out --anyway --pictures none",
        "scenario",
        (_drives("out"), "out/objects/*", "out/steps.csv", "out/checkpoint.*"),
        _drives("out"),
        "out",
        ("mode",),
    ),
    "transfer": Job(
        "transfer out",
        "-o moved --environments surrogate mitsuba --conditions day --runs 1 --spp 1",
        "attack",
        ("moved/transfer.json", _drives("moved")),
        _drives("moved"),
        "moved",
        ("lock",),
    ),
    "certify robustness": Job(
        "certify robustness scenario.toml",
        "-o bounded --runs 3 --radii 0.5 --proposals 2 --judged-by 1 --attacked 1",
        "scenario",
        ("bounded/certificate.csv", _drives("bounded")),
        _drives("bounded"),
        "bounded",
        ("lock",),
    ),
    "certify gradient": Job(
        "certify gradient out",
        "-o true --directions 3",
        "attack",
        ("true/certificate.*", "true/differences/*-*.safetensors"),
        "true/differences/*-*.safetensors",
        "true",
        ("lock",),
    ),
    "sweep": Job(
        "sweep grid.toml",
        "-o swept",
        "grid",
        ("swept/results.csv", _drives("swept")),
        _drives("swept"),
        "swept",
        ("lock",),
        retries=True,
        leaves="swept/shared/*/*",
    ),
    "reproduce": Job(
        "reproduce swept 0",
        "-o again",
        "sweep",
        (_drives("again"),),
        _drives("again"),
        "again",
        ("lock",),
        retries=True,
        places=2,
        leaves="again/shared/*/*",
    ),
    "evaluate": Job(
        "evaluate still.py:drive",
        "--environments mitsuba --scene scene.xml --routes-file routes.json --runs 2 "
        "--set policy.kind=callable --set policy.trust_code=true "
        "--horizon 3 --drives kept -o card.json",
        "painted",
        ("card.json", _drives("kept")),
        _drives("kept"),
        leaves="**/*",
    ),
    "render path": Job(
        "render path scene.xml",
        "--path path.json -o out",
        "balls",
        ("out/*.exr",),
        "out/*.exr",
        "out",
        ("lock",),
    ),
    "render path to a video": Job(
        "render path scene.xml",
        "--path path.json -o a.mp4",
        "balls",
        ("a.mp4",),
        "a.frames/*.exr",
        "a.frames",
        ("lock",),
        leaves="*",
    ),
    "capture scene": Job(
        "capture scene scene.xml",
        "--routes-file routes.json -o out --views 2 --size 8 6 --spp 1",
        "ground",
        ("out/**/*.*",),
        "",
        "out",
    ),
    "fit": Job(
        "fit views",
        "-o a.safetensors --steps 30 --batch-rays 64 --network small --log2-table 8 "
        "--max-resolution 32 --occupancy 8 --step-m 0.5",
        "sphere",
        ("a.safetensors",),
        "",
        "a.report",
        leaves="**/*",
        places=1,
        slow=True,
    ),
    "bake": Job(
        "bake scenario.toml",
        "--views 4 --cone 0.1",
        "solid",
        ("b.safetensors",),
        reads=("mode",),
        leaves="**/*",
        places=1,
        slow=True,
    ),
    "export mesh": Job(
        "export mesh cube.safetensors",
        "-o a.glb",
        "cube",
        ("a.glb",),
        reads=("mode",),
        leaves="*",
    ),
    "report": Job("report run", "-o a.html", "made", ("a.html",), leaves="*"),
    "train": Job(
        "train",
        "-o a.safetensors --data data --frames mitsuba 80 --epochs 1 --dagger-rounds 0 "
        "--runs 1 --batch 16 --validate-in mitsuba",
        "site",
        ("a.safetensors", "data/**/shard_*"),
        "data/**/shard_*",
        "data",
        leaves="*",
        places=1,
        slow=True,
    ),
    "retrain": Job(
        "retrain run",
        "-o new.safetensors --data data --epochs 1 --card-runs 1 --runs 1 "
        "--frames surrogate 64 --exposures-ev 0 --environments surrogate",
        "pilotnet",
        ("new.safetensors", "new-retrain.csv", "new-retrain.json"),
        "data/**/shard_*",
        "data/old_before",
        ("lock",),
        leaves="*",
        places=2,
        slow=True,
    ),
    "retrain by a module": Job(
        "retrain run",
        "-o new.safetensors --data data --module mine.py:train --trust-code --runs 1 "
        "--frames surrogate 64 --exposures-ev 0 --environments surrogate",
        "module",
        ("new.safetensors", "new-retrain.csv", "new-retrain.json"),
        "data/**/shard_*",
        "data/old_before",
        ("lock",),
        leaves="*",
        places=2,
        slow=True,
    ),
}
#: Commands that write at their ends, and what they would read, which is missing where
#: it can be; the last word is the output. By the folder that they claim, if any.
WRITERS = {
    "capture photographs absent -o out": "out",
    "capture video absent -o out": "",
    "asset mesh absent -o a.safetensors": "a.report",
    "asset cube --edge-m 1 -o a.safetensors": "",
    "asset flat patch --width-m 1 --height-m 2 -o a.safetensors": "",
    "asset folder absent -o a.safetensors": "",
    "render frame absent -o a.exr": "",
    "render compare absent absent --routes-file absent -o out": "",
    "evaluate --page out": "",
    "demo -o out": "",
    "export faces {scenes}/cube/field.safetensors -o out": "",
    "export print absent -o a.pdf": "",
    "export screen absent -o a.png": "",
    "export openscenario absent -o out": "",
    "export routes absent --map absent -o a.json": "",
    "view absent -o a.html": "",
    "check {scenes}/demo.toml -o a.png": "",
    "car overlay absent absent -o out": "",
    "car compare absent --attack absent -o out": "",
    "car calibrate /dev/absent -o out": "",
    "car drive --policy expert --simulated -o a.mcap": "",
}


@dataclass(frozen=True)
class Event:
    """Something that happens to a job.

    Attributes:
        places: where: the files that are written, or the stages whose bars are drawn.
        code: the exit code; None of a process that is killed.
        message: part of the line that is printed.
    """

    places: str
    code: int | None
    message: str = ""


EVENTS = {
    "full disk": Event("files", 2, "no space left on the disk; free some"),
    "killed process": Event("files", None),
    "SIGTERM": Event("files", 130, "mi-nerfattack: interrupted"),
    "Ctrl-C": Event("stages", 130, "mi-nerfattack: interrupted"),
    "too little memory": Event("stages", 2, "error: not enough memory: 249 TiB"),
}
