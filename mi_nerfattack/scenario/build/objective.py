"""Make the objective that a scenario describes."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from mi_nerfattack.attack import weights
from mi_nerfattack.attack.objectives import (
    AbsoluteDeviation,
    CrossTrackDeviation,
    DepartureTime,
    HeadingDeviation,
    TargetDistance,
)
from mi_nerfattack.attack.user_cost import UserCost
from mi_nerfattack.rollout.drive import departure_limit
from mi_nerfattack.rollout.objective import (
    AbstractObjective,
    StageCost,
    StageSum,
    Terminal,
    WeightedSum,
)
from mi_nerfattack.rollout.reduction import AbstractReduction, CVaR, Mean, Worst
from mi_nerfattack.scenario.scenario import Scenario, resolve
from mi_nerfattack.scenario.sections import AbstractTerm, ObjectiveSection
from mi_nerfattack.scenario.user_code import check_trust, load_function, split_reference
from mi_nerfattack.vehicle.dynamics import AbstractDynamics
from mi_nerfattack.vehicle.route.route import Route
from mi_nerfattack.vehicle.state import to_state


def build_objective(
    scenario: Scenario, route: Route, dynamics: AbstractDynamics, base: str | Path
) -> AbstractObjective:
    """Make the objective of a scenario.

    Args:
        scenario: from :func:`scenario.load_scenario`.
        route: the lane centre.
        dynamics: the vehicle, for the number of rows of a state.
        base: folder that relative paths start from.

    Raises:
        InputError: a file is missing or wrong, a function of the user's returns
            something else than costs, or weights do not fit the weights.
    """
    section = scenario.objective
    terms = [
        (term.weight, _term(term, scenario, route, dynamics, base))
        for term in (section, *section.terms)
    ]
    if len(terms) == 1 and section.weight == 1:
        return terms[0][1]
    return WeightedSum(tuple(terms))


def build_reduction(section: ObjectiveSection) -> AbstractReduction:
    """Make what joins the costs of all initial poses."""
    if section.reduction == "cvar":
        assert section.cvar_fraction is not None, "checked with the section"
        return CVaR(section.cvar_fraction)
    return Worst() if section.reduction == "worst" else Mean()


def _term(
    term: AbstractTerm,
    scenario: Scenario,
    route: Route,
    dynamics: AbstractDynamics,
    base: str | Path,
) -> AbstractObjective:
    if term.kind == "departure_time":
        width = scenario.vehicle.width_m
        limit = term.limit_m or departure_limit(route.lane_width_m, width)
        return DepartureTime(route, limit, term.softness_m)
    cost = _cost(term, route, dynamics, base)
    if term.at == "end":
        return Terminal(cost)
    return StageSum(cost, _weights(term, scenario))


def _cost(
    term: AbstractTerm, route: Route, dynamics: AbstractDynamics, base: str | Path
) -> StageCost:
    if term.kind == "cross_track":
        return CrossTrackDeviation(route, term.rounding_m)
    if term.kind == "absolute_cross_track":
        return AbsoluteDeviation(route)
    if term.kind == "heading":
        return HeadingDeviation(route, float(np.radians(term.rounding_deg)))
    if term.kind == "target_path":
        assert term.target and term.target_route, "checked with the section"
        path = Route.from_file(resolve(term.target, base), term.target_route)
        return TargetDistance(path, term.rounding_m)
    assert term.function, "checked with the section"
    check_trust("objective.function", term.function, term.trust_code)
    return _user_cost(term.function, route, dynamics, base)


def _user_cost(
    reference: str, route: Route, dynamics: AbstractDynamics, base: str | Path
) -> UserCost:
    """Load a cost and try it beside the lane, off its centre."""
    file, name = split_reference(reference)
    cost = UserCost(reference, load_function(resolve(file, base), name))
    arc = np.array([0.25, 0.75]) * route.length
    poses = route.pose_at(arc, np.array([0.31, -0.17]), np.array([0.07, -0.05]))
    cost.check(to_state(dynamics.extend(poses)))
    return cost


def _weights(term: AbstractTerm, scenario: Scenario) -> np.ndarray | None:
    steps, dt = scenario.drive.horizon, scenario.vehicle.dt_s
    if term.weights == "linear":
        return weights.linear(steps)
    if term.weights == "last":
        return weights.last_seconds(steps, dt, term.last_s or 0.0)
    if term.weights == "discount":
        return weights.discounted(steps, dt, term.discount_per_s or 0.0)
    if term.weights == "listed":
        return weights.listed(steps, term.listed_weights or ())
    return None
