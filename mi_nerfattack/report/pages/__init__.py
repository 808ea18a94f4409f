"""Pages for a reader: one file each."""
