"""Many attacks: a grid of scenarios, its cells done by any executor, one table."""
