"""What an attribution finds, as frozen objects."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from simgap.attribution.cells import Cell
from simgap.attribution.detection import Detection
from simgap.attribution.heldout import HowFar
from simgap.attribution.invariance import Invariance
from simgap.attribution.posterior import Model
from simgap.attribution.shares import Shares
from simgap.attribution.verdict import Verdict


@dataclass(frozen=True)
class ParameterPosterior:
    """Mean, standard deviation and 90 % interval, given that the effect acts."""

    mean: float
    sd: float
    interval_90: tuple[float, float]


@dataclass(frozen=True)
class EffectPosterior:
    """One effect: `probability` to act, `share` of the gap it explains with its 90 % interval (0 where it
    does not act), parameters, whether they are the same in all trials, and which of the gap's candidates (an
    effect may have several forms) they are of."""

    probability: float
    share: float
    share_90: tuple[float, float]
    parameters: dict[str, ParameterPosterior]
    invariance: Invariance | None
    candidate: int


@dataclass(frozen=True)
class Remainder:
    """What no named cause explains: its `share` of the gap, the chance of noise to look so, and where."""

    share: float
    p_value: float
    where: tuple[Cell, ...]


@dataclass(frozen=True)
class SmallGap:
    """A gap below the smallest that matters: `size` over that, of the `channel` and `part` with the most;
    `amount` there in sds of the noise, for the caller to turn into units."""

    size: float
    channel: str
    part: str
    amount: float


@dataclass(frozen=True)
class Attribution(Verdict):
    """The verdict, and everything found beside it; see the fields' own classes.

    `left` (n,): residual that the causes leave, `before` (n,): with nuisances alone, both as cosines of each
    cell.
    """

    effects: dict[str, EffectPosterior]
    detection: Detection
    remainder: Remainder
    where: tuple[Cell, ...]
    how_far: HowFar | None
    small_gap: SmallGap | None
    noise: dict[str, float]
    models: tuple[Model, ...]
    shares: Shares
    before: np.ndarray
    left: np.ndarray
