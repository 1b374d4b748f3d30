"""Does a trial follow its plain ordered task?

Two scores of a trial, compared with the trials the model was learned from: how much better free
switching among the same states explains it than the forced order does, and how poorly even the
forced order does per cell. Besides, a subtask squeezed to almost nothing did not happen.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from hmmseg.hmm import dense as ergodic
from hmmseg.hmm.results import AlignmentPosterior
from hmmseg.robust import NORMAL
from hmmseg.segmentation.spans import Failure

WIDTHS = 6.0  # chosen: a trial this many widths outside the others does not fit
LEAST_WIDTH = (2.0, 0.02)  # chosen: nats for the first score, nats per cell for the second
FEW = 4.0  # chosen: trials; the usual width of scores is widened by one over their number, times this
MEASURABLE = 20.0  # chosen: cells a subtask usually lasts, for two cells to be too few
SQUEEZED = 0.03  # chosen: of the typical duration


def scores(log_likelihoods: np.ndarray, mean_cells: np.ndarray, alignment: AlignmentPosterior) -> np.ndarray:
    """(2,): log evidence of free switching over forced order [nats], minus log evidence per cell."""
    return np.array([
        ergodic.log_evidence(*_free(log_likelihoods, mean_cells)) - alignment.log_evidence,
        -alignment.log_evidence / len(log_likelihoods),
    ])  # fmt: skip


def reference(per_trial: Sequence[np.ndarray]) -> np.ndarray:
    """(2, 2): median and width of each score over the trials learned from.

    The width of few trials is uncertain itself and widened by 1 + FEW / their number.
    """
    table = np.array(per_trial)
    center = np.median(table, 0)
    width = NORMAL * np.median(np.abs(table - center), 0)
    widened = np.maximum(width, LEAST_WIDTH) * (1 + FEW / len(table))
    return np.column_stack([center, widened])


def find_failure(names: Sequence[str], optional: Sequence[bool], typical: np.ndarray, usual: np.ndarray,
                 log_likelihoods: np.ndarray, mean_cells: np.ndarray,
                 alignment: AlignmentPosterior) -> Failure | None:  # fmt: skip
    """The first subtask at which the trial leaves its task; None where it fits.

    `usual` (2, 2): what `reference` gave of the trials learned from.
    The first subtask may be cropped to any length, so it is never called squeezed.
    """
    for k in range(1, len(names)):
        cells = float(alignment.smoothed[:, k].sum())
        if not optional[k] and typical[k] >= MEASURABLE and cells < max(SQUEEZED * typical[k], 2.0):
            return Failure(k, names[k], None, "is squeezed to almost nothing: it does not happen")
    worse, poorer = (scores(log_likelihoods, mean_cells, alignment) - usual[:, 0]) / usual[:, 1]
    if worse > WIDTHS:
        path = ergodic.viterbi(*_free(log_likelihoods, mean_cells)).path
        k, reason = _first_departure(path, names, optional)
        return Failure(k, names[k], None, reason)
    if poorer > WIDTHS:
        excess = log_likelihoods.max(1) - np.median(log_likelihoods.max(1))
        k = min(int(alignment.path[np.argmin(np.convolve(excess, np.ones(9), "same"))]), len(names) - 1)
        return Failure(k, names[k], None, "looks like nothing the model has learned")
    return None


def _free(log_likelihoods: np.ndarray, mean_cells: np.ndarray) -> tuple:
    """Arguments of the ergodic model: same durations, any state next."""
    num_states = log_likelihoods.shape[1]
    leave = 1 / np.maximum(mean_cells, 1.5)
    transition = np.tile(np.log(leave / max(num_states - 1, 1))[:, None], (1, num_states))
    np.fill_diagonal(transition, np.log1p(-leave) if num_states > 1 else 0.0)
    return log_likelihoods, np.full(num_states, -np.log(num_states)), transition


def _first_departure(path: np.ndarray, names: Sequence[str], optional: Sequence[bool]) -> tuple[int, str]:
    """Where the freely switching path first breaks the order."""
    runs = np.minimum(path[np.r_[True, np.diff(path) != 0]], len(names) - 1)
    at = -1
    for state in runs:
        missing = [k for k in range(at + 1, state) if not optional[k]]
        if missing:
            return missing[0], f"is passed over: {names[state]} comes first"
        if state < at:
            return at, f"is broken off: {names[state]} comes again"
        at = int(state)
    missing = [k for k in range(at + 1, len(names)) if not optional[k]]
    return (missing[0], "never happens") if missing else (at, "does not keep the task's order")
