"""Fields on a CPU: NumPy networks and packed parameters."""
