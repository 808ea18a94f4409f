"""Found attacks, unchanged, in every environment and under conditions."""
