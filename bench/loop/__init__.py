"""`bench loop`: a closed-loop gradient, beside a loop over `mi.render`."""
