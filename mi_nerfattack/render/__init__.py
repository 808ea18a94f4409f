"""Rendering of fields: cameras, marching, compositing."""
