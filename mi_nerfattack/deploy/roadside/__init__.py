"""Where objects stand at the roadside of a scene's routes, drawn at random."""
