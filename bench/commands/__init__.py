"""The command line of the benches."""
