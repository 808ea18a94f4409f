"""One attack as a job: stages, run folder, results."""
