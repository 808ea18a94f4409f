"""Files of all kinds, checked and atomic: the only place that opens user files."""
