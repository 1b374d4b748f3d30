"""Friction coefficients: bounds, slip and supports."""
