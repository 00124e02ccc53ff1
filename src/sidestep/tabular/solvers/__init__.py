"""Solvers of the Bellman equation and of its adjoint; `process` holds the mathematics that they share."""
