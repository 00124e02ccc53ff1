"""Evaluation of learned maps and of planned paths against the true map."""
