"""Thresholds and shapes of noise that several files share."""

from __future__ import annotations

from math import log

# chosen: noise sds at which something is surely there, or contradicts a statement: normal noise exceeds them
# once in two million readings, an hour at 500 Hz
SURE = 5.0
SHOWN = 3.0  # chosen: noise sds above which something shows: normal noise exceeds them once in 370 readings
CERTAIN = 0.99  # chosen: probability from which something is taken as true, and reported
FIRM = 0.5  # chosen: share of a grip's usual force from which the fingers hold
MOVED = 3e-3  # chosen: m from which a hand or a block has moved; blocks are taller, slips shorter
GAP = 3.0  # chosen: usual sample periods that make a gap
SETTLING = 0.2  # prior: s in which a contact settles after a change, and rings
# chosen: s from any grip beyond which nothing is held or touched: a touch is known to a fifth of it, and the
# two fingers touch, or let go, within it
AROUND = 0.1
DRIFTS = 0.15  # chosen: s in which a hand at rest stays in place; over longer times it drifts
TAIL = 4.0  # cited: degrees of freedom of Student-t residuals: Lange, Little and Taylor, JASA 84, 1989


def decisive(prior: float) -> float:
    """Evidence [nats] that makes a hypothesis of this prior probability CERTAIN."""
    return log(CERTAIN / (1 - CERTAIN)) - log(prior / (1 - prior))
