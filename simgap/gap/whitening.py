"""Residuals in units of their sensors' noise."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from simgap.gap.frame import Frame


class Whitening(NamedTuple):
    """`weight` (T, N, C) of trials, samples, channels: 1 / standard deviation, 0 where there is nothing."""

    weight: np.ndarray


def whitening(frame: Frame) -> Whitening:
    """The whitening of a frame's residuals."""
    a = frame.arrays
    return Whitening(np.where(a.there > 0, 1 / a.sd, 0.0))
