"""Scenarios that drive with a server, and how many processes may drive them."""

from __future__ import annotations

from collections.abc import Sequence

from mi_nerfattack.errors import InputError
from mi_nerfattack.scenario.deployment import labelled
from mi_nerfattack.scenario.scenario import Scenario
from mi_nerfattack.system.workers import AbstractWorkers, chosen_workers


def drives_in_carla(
    scenarios: Sequence[Scenario], environment: str | None = None
) -> bool:
    """Whether a deployment is in CARLA, whose server has one client.

    Args:
        scenarios: to be driven.
        environment: label of the only one that they drive in; None: all.
    """
    return any(
        section.has_one_client and environment in (None, label)
        for scenario in scenarios
        for label, section in labelled(scenario.deployment)
    )


def need_one_process(
    scenarios: Sequence[Scenario], count: int | None, environment: str | None = None
) -> bool:
    """Whether one process drives scenarios, because of a server.

    Args:
        scenarios: to be driven.
        count: of processes, as the user chose it; None if the user did not.
        environment: as of `drives_in_carla`.

    Raises:
        InputError: several processes for a deployment in CARLA.
    """
    if in_carla := drives_in_carla(scenarios, environment):
        if count not in (None, 1):
            raise InputError(
                f"workers: {count} for a deployment in CARLA, whose server one process "
                "steps; give 1"
            )
    behind_url = any(scenario.policy.is_remote for scenario in scenarios)
    return in_carla or (count is None and behind_url)


def scenario_workers(
    scenarios: Sequence[Scenario], count: int | None, environment: str | None = None
) -> AbstractWorkers:
    """Return who drives scenarios; without a server, by default a process per core.

    Args:
        scenarios: to be driven.
        count: as of `need_one_process`.
        environment: as of `drives_in_carla`.

    Raises:
        InputError: see `need_one_process`.
    """
    return chosen_workers(count, need_one_process(scenarios, count, environment))
