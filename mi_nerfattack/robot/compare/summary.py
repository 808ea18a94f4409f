"""A comparison in words."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from mi_nerfattack.robot.compare.criteria import Criteria
from mi_nerfattack.robot.compare.sequential import ACCEPT, GO_ON, REJECT


def sentences(document: Mapping[str, Any], criteria: Criteria) -> Iterator[str]:
    """Yield what a comparison came to, a line each.

    Args:
        document: of :func:`compare.compare`.
        criteria: that it was made with.
    """
    test, plan, done = criteria.test, document["plan"], document["test"]
    yield (
        f"Success is {criteria.sentence}. Criteria of {document['criteria']['written']}"
        f", sha256 {document['criteria']['sha256'][:16]}."
    )
    for row in document["drives"]:
        yield _drive(row, document)
    yield (
        f"Test of {test.p1:g} against {test.p0:g}: expected drives "
        f"{plan['expected_drives_at_p1']:.1f} at {test.p1:g}, "
        f"{plan['expected_drives_at_p0']:.1f} at {test.p0:g}; it accepts wrongly "
        f"in {100 * plan['accepts_at_p0']:.1f} %, rejects wrongly in "
        f"{100 * plan['rejects_at_p1']:.1f} %."
    )
    low, high = done["rate_ci95_anytime"]
    meaning = {
        GO_ON: "another drive is needed",
        ACCEPT: f"the rate of success is {test.p1:g} rather than {test.p0:g}",
        REJECT: f"the rate of success is {test.p0:g} rather than {test.p1:g}",
    }[done["decision"]]
    yield (
        f"{done['successes']} of {done['drives']} succeeded: {done['decision']}, "
        f"{meaning}. The rate is {low:.2f} to {high:.2f} (95 %, whenever one stops)."
    )
    if done["after_decision"]:
        yield f"{done['after_decision']} drives after the decision do not count."


def _drive(row: Mapping[str, Any], document: Mapping[str, Any]) -> str:
    figures, beside = row["figures"], row["beside_run"]
    correlation = beside["steering_change_correlation"]
    told = "" if correlation is None else f", change of steering r {correlation:.2f}"
    judged = ""
    if "success" in row:
        judged = {
            True: "; success",
            False: "; no success",
            None: f"; not judged, it ends after {100 * row['coverage']:.0f} % of the "
            "way",
        }[row["success"]]
    if "decision" in row:
        judged += f": {row['decision']}"
    judged += "".join(f"; {remark}" for remark in row["remarks"])
    return (
        f"{row['file']} ({row['case']}): mean error "
        f"{figures['cross_track_mean_m']:.3f} m, at most "
        f"{figures['cross_track_max_m']:.3f} m, {figures['wheel_out_s']:.1f} s with a "
        f"wheel out; {beside['cross_track_rms_m']:.3f} m (rms) from "
        f"{document['environment']}, {beside['time_behind_s']:+.1f} s{told}{judged}"
    )
