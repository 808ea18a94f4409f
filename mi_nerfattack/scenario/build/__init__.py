"""From the sections of a scenario to world, vehicle, policy and objective."""
