"""Reference paths: projection, files."""
