"""Blind check of the diagnosis on robots modelled by others, with seeded faults."""
