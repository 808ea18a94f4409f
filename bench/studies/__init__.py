"""The studies of bench/results.toml: their state, their runs and their pages."""
