"""Flags that switch mechanisms of the diagnosis of blocks off (experiments/ablate.py)."""

ON: set[str] = set()
