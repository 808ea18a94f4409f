"""What a run leaves behind: metrics, tables, EXR frames, plots and a page."""
