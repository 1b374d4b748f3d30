"""Signals of a hand, zero but for what is given."""

import numpy as np

from hmmseg.hand.signals import Signals

COLUMNS = sorted(set(Signals.__dataclass_fields__) - {"t", "sd_force", "derived", "touches"})


def signals_of(t: np.ndarray, sd_force: float = 0.0, **columns) -> Signals:
    """Signals at times (num_timesteps,) [s]; a column is an array or one number."""
    given = {name: np.broadcast_to(np.asarray(columns.get(name, 0.0), float), t.shape) for name in COLUMNS}
    return Signals(t=t, **{name: values.copy() for name, values in given.items()}, sd_force=sd_force)
