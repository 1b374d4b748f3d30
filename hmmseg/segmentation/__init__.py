"""Segmentation of block tasks: contact emissions, boundaries, conformity."""
