"""What a run shows: frames of drives, strips, trajectories, videos."""
