"""Kill attacks at random moments and resume them."""
