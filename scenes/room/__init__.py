"""A room with a square track for the small car, built by a script."""
