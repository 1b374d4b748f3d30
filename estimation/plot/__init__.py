"""Figures of an identification; functions draw into a figure and return its axes."""
