"""A country road: two curves, hedges, trees, a house."""
