"""Worlds to try the library on: the grids of the paper's experiments, and random offices, apartments and blocks."""
