"""Minari datasets of discrete worlds and of walks; `datasets` reads and writes them."""
