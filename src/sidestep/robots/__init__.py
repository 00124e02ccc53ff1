"""Robots that plan in a learned map: their beliefs, their planners, and replanning after a bump."""
