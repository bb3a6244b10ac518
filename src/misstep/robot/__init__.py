"""Trials on a robot: the exploration service, what keeps it safe, and ways to reach it."""
