"""`bench loop`: a closed-loop gradient, by the rollout and over `mi.render`."""
