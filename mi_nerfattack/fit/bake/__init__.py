"""Scenes as bricks: made from a fitted field, and compared with it."""
