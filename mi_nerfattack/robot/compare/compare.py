"""Real drives judged by criteria, and beside those of a run: figures and words."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

from mi_nerfattack.errors import InputError
from mi_nerfattack.evaluation.metrics import summarise
from mi_nerfattack.experiment.transfer.found import FoundAttack
from mi_nerfattack.robot.compare.aligned import Aligned, align
from mi_nerfattack.robot.compare.course import Course, read_surrogate
from mi_nerfattack.robot.compare.criteria import WrittenCriteria
from mi_nerfattack.robot.compare.recorded import RecordedDrive, read_recorded
from mi_nerfattack.robot.compare.sequential import GO_ON, SequentialTest, rate_interval
from mi_nerfattack.rollout.drive import NO_OBJECT, OWN, Drive

FORMAT = "mi_nerfattack compare-drives 1"
_NO_CASE = "choose other recordings, or a run or --environment that drives past it"


@dataclass(frozen=True, eq=False)
class Compared:
    """Real drives beside those of a run.

    Attributes:
        document: for ``metrics.json``.
        aligned: of each real drive, in the order of the document.
        run: drives of the run, of the real ones' cases.
    """

    document: dict[str, Any]
    aligned: list[Aligned]
    run: list[Drive]


def read_all(
    recordings: Mapping[str, Sequence[Path]], course: Course
) -> list[RecordedDrive]:
    """Read recordings by case, in the order in which they were driven.

    Raises:
        InputError: as of :func:`read_recorded`; one is given twice, or was driven
            before the one that it follows.
    """
    drives: list[RecordedDrive] = []
    for case, paths in recordings.items():
        before: RecordedDrive | None = None
        for run, path in enumerate(paths):
            drive = read_recorded(path, case, run, course)
            for other in drives:
                if other.sha256 == drive.sha256:
                    raise InputError(f"{path}: is the drive of {other.path} again")
            if before and before.has_clock and drive.has_clock:
                if drive.began < before.began:
                    raise InputError(
                        f"{path}: was driven before {before.path}, which stands before "
                        f"it; give the drives of --{case} in the order of driving"
                    )
            drives.append(drive)
            before = drive
    return drives


def compare(
    found: FoundAttack,
    course: Course,
    environment: str,
    written: WrittenCriteria,
    drives: Sequence[RecordedDrive],
) -> Compared:
    """Judge real drives, and compare each with those of the run past the same look.

    Args:
        found: the run.
        course: of the run.
        environment: of the run's drives.
        written: the criteria.
        drives: real ones, from :func:`read_all`; may be none.

    Raises:
        InputError: the run has no drives of a case, or none on the same stretch.
    """
    of_run = read_surrogate(found, environment)
    cases = {item.drive.case for item in drives}
    for case in sorted(cases - of_run.keys()):
        raise InputError(
            f"{found.folder}: no drives past {case} in {environment}, only past "
            f"{', '.join(of_run)}; {_NO_CASE}"
        )
    real = [item.drive for item in drives]
    plain = next((c for c in (OWN, NO_OBJECT) if c in cases), None)
    aligned = []
    for item in drives:
        ours: list[Drive] = []
        theirs: list[Drive] = []
        if plain not in (None, item.drive.case):
            ours = [drive for drive in real if drive.case == plain]
            theirs = of_run[plain]
        aligned.append(align(course, item, of_run[item.drive.case], ours, theirs))
    driven = [drive for case in of_run if case in cases for drive in of_run[case]]
    document = _document(found, course, environment, written, aligned, driven)
    return Compared(document, aligned, driven)


def _document(
    found: FoundAttack,
    course: Course,
    environment: str,
    written: WrittenCriteria,
    aligned: Sequence[Aligned],
    driven: Sequence[Drive],
) -> dict[str, Any]:
    criteria, lanes = written.criteria, {course.route.name: course.lane}
    rows, outcomes = [], []
    for item in aligned:
        recorded = item.recorded
        (per_run,) = _figures([recorded.drive], lanes)["per_run"]
        row: dict[str, Any] = {
            "file": str(recorded.path),
            "sha256": recorded.sha256,
            "case": recorded.drive.case,
            "began": recorded.began_utc,
            "coverage": recorded.coverage,
            "remarks": list(recorded.remarks),
            "figures": {k: v for k, v in per_run.items() if k not in ("run", "seed")},
            "beside_run": item.figures(),
        }
        if recorded.drive.case == criteria.case:
            row["success"] = criteria.judge(per_run, recorded.is_whole)
            if row["success"] is not None:
                outcomes.append(row["success"])
                row["decision"] = criteria.test.decisions(outcomes)[-1]
        rows.append(row)
    by_case = {
        case: _figures([d for d in driven if d.case == case], lanes)
        for case in dict.fromkeys(drive.case for drive in driven)
    }
    moment = datetime.fromtimestamp(written.written, timezone.utc)
    return {
        "format": FORMAT,
        "run": {"folder": found.label, "sha256": found.digest},
        "environment": environment,
        "route": course.route.name,
        "stretch_m": [course.start_m, course.end_m],
        "control_unit": course.control_unit,
        "criteria": {
            "file": str(written.path),
            "sha256": written.sha256,
            "written": moment.isoformat(),
            **criteria.model_dump(exclude_none=True),
        },
        "plan": _plan(criteria.test),
        "test": _verdict(criteria.test, outcomes),
        "drives": rows,
        "run_drives": by_case,
    }


def _figures(drives: Sequence[Drive], lanes: Mapping[str, Any]) -> dict[str, Any]:
    """Summarise drives of one environment and case."""
    [environments] = summarise(drives, lanes).values()
    [cases] = environments.values()
    [figures] = cases.values()
    return figures


def _plan(test: SequentialTest) -> dict[str, Any]:
    """Return what the test costs and how often it errs, exactly."""
    bad, good = test.forecast(test.p0), test.forecast(test.p1)
    return {
        "expected_drives_at_p0": bad.drives,
        "expected_drives_at_p1": good.drives,
        "accepts_at_p0": bad.accepted,
        "rejects_at_p1": 1 - good.accepted,
    }


def _verdict(test: SequentialTest, outcomes: Sequence[bool]) -> dict[str, Any]:
    """Return what the test says of drives so far; those after a decision count not."""
    decisions = test.decisions(outcomes)
    undecided = decisions.count(GO_ON)
    drives = min(len(outcomes), undecided + 1)
    successes = sum(outcomes[:drives])
    return {
        "drives": drives,
        "successes": successes,
        "after_decision": len(outcomes) - drives,
        "log_likelihood_ratio": test.log_ratio(successes, drives),
        "bounds": list(test.bounds),
        "decision": decisions[-1] if decisions else GO_ON,
        "rate_ci95_anytime": rate_interval(successes, drives),
    }
