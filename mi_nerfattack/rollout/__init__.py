"""The closed loop and its adjoint."""
