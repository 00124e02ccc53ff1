"""Worlds to try the library on: the grids of the paper's experiments, flats, and offices as large as you like."""
