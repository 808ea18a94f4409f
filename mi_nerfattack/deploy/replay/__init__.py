"""Recorded drives as environments: folders, videos, MCAP."""
