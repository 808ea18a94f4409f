"""Table 2 of the paper beside our figures."""
