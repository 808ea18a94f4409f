"""From photographs, scenes and meshes to posed images."""
