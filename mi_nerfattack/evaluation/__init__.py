"""Closed-loop error and its intervals; fields against scenes."""
