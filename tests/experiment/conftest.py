"""Fixtures of attacks: folders of tiny jobs and scenarios."""

from helpers.attack_folder import scenario_folder  # noqa: F401
from helpers.attack_jobs import leave_out_results, make_folder  # noqa: F401
