"""The loop that drives a real car, its devices, and what it writes down."""
