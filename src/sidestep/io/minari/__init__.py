"""Minari datasets of discrete worlds and of walks, in and out; `datasets` opens and writes them."""
