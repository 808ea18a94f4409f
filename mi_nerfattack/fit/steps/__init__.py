"""Training steps of each kind of field."""
