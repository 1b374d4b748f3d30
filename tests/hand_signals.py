"""Signals of a hand, zero but for what is given; the rig of a jointed hand."""

import numpy as np

from hmmseg.hand.signals import Signals
from hmmseg.io.rig import parse_rig

FINGERS = {"1": {"base": [0.05, 0.17], "links": [0.12, 0.11]},
           "2": {"base": [0.21, 0.17], "links": [0.1, 0.12]}}  # fmt: skip
JOINTED = parse_rig({"fingers": FINGERS, "noise": {"angle": 2e-4, "velocity": 0.03, "force": 0.012}})
COLUMNS = sorted(set(Signals.__dataclass_fields__) - {"t", "sd_force", "derived", "touches"})


def signals_of(t: np.ndarray, sd_force: float = 0.0, **columns) -> Signals:
    """Signals at times (num_timesteps,) [s]; a column is an array or one number."""
    given = {name: np.broadcast_to(np.asarray(columns.get(name, 0.0), float), t.shape) for name in COLUMNS}
    return Signals(t=t, **{name: values.copy() for name, values in given.items()}, sd_force=sd_force)
