"""Experiments by name: the paper's figures, and demonstrations of the library."""
