"""Priors, and fits that maximize the posterior."""
