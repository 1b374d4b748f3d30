"""Probabilities of explanations of two ensembles' difference."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from scipy.special import expit, logsumexp

PRIOR = -4.0  # prior: log prior of a candidate against none
SURPRISE = 2.0  # chosen: decades: what noise leaves once in a hundred may as well be noise
WIDTH = 0.25  # chosen: of the share's logarithm, logistic


def joined(effects: Sequence[str]) -> str:
    """A candidate's name: its effects in alphabetical order joined by +."""
    return "+".join(sorted(effects))


def probabilities(
    evidence: Mapping[str, float], left: float, p_left: float, unknown_at: float
) -> dict[str, float]:
    """Probabilities of none, unknown and every candidate; they sum to 1.

    `evidence` [nats, tempered] over none; `left`: share of the gap that the best one leaves, at `unknown_at`
    as likely of another cause; `p_left` the chance of noise to look like that.
    """
    score = np.array([0.0, *(value + PRIOR for value in evidence.values())])
    share = np.exp(score - logsumexp(score))
    odds, surprise = np.log(max(left, 1e-6) / unknown_at) / WIDTH, -np.log10(max(p_left, 1e-300))
    unknown = float(expit(odds) * expit(2 * (surprise - SURPRISE))) if evidence else 0.0
    none, *each = (float(part * (1 - unknown)) for part in share)
    return {"none": none, "unknown": unknown, **dict(zip(evidence, each, strict=True))}
