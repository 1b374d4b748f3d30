"""Figures of recordings and their subtasks; functions draw into a figure and return its axes."""
