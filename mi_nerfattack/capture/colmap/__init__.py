"""COLMAP models: reading them, and making them by pycolmap."""
