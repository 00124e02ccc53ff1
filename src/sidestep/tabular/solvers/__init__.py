"""Solvers of the Bellman equation and of its adjoint; `base` holds the mathematics that they share."""
