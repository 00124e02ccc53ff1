"""Experiments that run by name: the paper's figures, and a first look at what the library does."""
