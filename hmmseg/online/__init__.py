"""Alignment, properties and conformity of a block task while it runs."""
