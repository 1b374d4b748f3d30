"""What a document says of posterior draws."""

from __future__ import annotations

import numpy as np

INTERVALS = {"interval_68": (16.0, 84.0), "interval_95": (2.5, 97.5)}  # physics: a definition: percentiles


def summary(draws: np.ndarray, unit: str) -> dict:
    """Unit, mean, sd, median and intervals of posterior draws (num_draws,)."""
    out = {"unit": unit, "mean": float(draws.mean()), "sd": float(draws.std(ddof=1))}
    out |= {"median": float(np.median(draws))}
    return out | {name: np.percentile(draws, q) for name, q in INTERVALS.items()}
