"""Learned maps: the configuration, learning from walks, and the result on disk."""
