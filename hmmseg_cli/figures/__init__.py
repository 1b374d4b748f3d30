"""Figures of the commands, one file a figure."""
