"""Attacks on a closed loop: gradient, baselines, objectives."""
