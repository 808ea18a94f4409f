"""Where objects stand beside the routes of a scene, drawn at random."""
