"""Calls of public functions with wrong arguments, and calls with arguments that are less usual but right.

A wrong call is a row: a name, a function without arguments, and a word of the error that it must end in.
"""
