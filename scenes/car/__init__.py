"""A car built by a script."""
