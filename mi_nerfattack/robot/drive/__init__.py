"""The loop that drives a real car, what stops it, and what it writes down."""
