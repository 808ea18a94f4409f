"""A finished run in the browser: scene, drives, frames at any time, moved objects."""
