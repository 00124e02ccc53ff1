"""Discrete worlds: graphs, transition models, backups, solvers, likelihood and planning."""
