"""A scikit-learn estimator that labels the samples of ordered sequences by their state."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from sklearn.base import BaseEstimator, ClusterMixin
from sklearn.utils.validation import check_is_fitted, validate_data

from hmmseg.errors import InputError
from hmmseg.io.task import SequenceTask, parse_task
from hmmseg.io.trial import Trial
from hmmseg.sequence.fit import fit_sequence
from hmmseg.sequence.segment import segment_sequence


class OrderedSegmenter(ClusterMixin, BaseEstimator):  # type: ignore[misc]  # untyped
    """Segments sequences whose states follow one another in a known order, with or without labels.

    X is one sequence (num_timesteps, num_channels) or a list of several.

    Args:
        n_states: number of states, each visited once and in order.
        rate: of the samples [Hz].
        random_state: accepted for scikit-learn's sake; nothing is drawn.

    Attributes:
        model_: the fitted model.
        labels_: (num_timesteps,) states 0 to n_states - 1 of X.
    """

    def __init__(self, n_states: Any = 2, rate: Any = 1.0, random_state: Any = None) -> None:
        self.n_states = n_states
        self.rate = rate
        self.random_state = random_state

    def fit(self, X: Any, y: Any = None) -> OrderedSegmenter:
        """Fit to one sequence or several.

        Args:
            X: the sequences.
            y: for a list, states (num_timesteps,) of each sequence, None where unknown; ignored for one.

        Returns:
            The estimator itself.

        Raises:
            ValueError: a sequence is too short, not finite or has another number of channels.
        """
        several = _several(X)
        sequences = self._checked(X, reset=True)
        trials = self._trials(sequences)
        labels = {} if y is None or not several else self._boundaries(trials, y)
        self.model_ = fit_sequence(trials, self._order(sequences[0].shape[1]), labels or None)
        self.labels_ = self.predict(X) if not several else np.concatenate(self.predict(X))
        return self

    def predict(self, X: Any) -> Any:
        """States (num_timesteps,) of one sequence, or a list of those of several."""
        check_is_fitted(self, "model_")
        sequences = self._checked(X, reset=False)
        order = self._order(sequences[0].shape[1])
        out = []
        for trial in self._trials(sequences):
            spans = segment_sequence([trial], order, self.model_)[0].spans
            starts, ahead = np.array([span.start for span in spans[1:]]), np.arange(1, len(spans))
            first = np.searchsorted(trial.t, starts) - ahead  # leaves each earlier state at least one sample
            first = np.clip(np.maximum.accumulate(first), 0, trial.t.size - len(spans)) + ahead
            out.append(np.searchsorted(first, np.arange(trial.t.size), side="right"))
        return out if _several(X) else out[0]

    def _order(self, channels: int) -> SequenceTask:
        task = parse_task({"sequence": [f"state{k}" for k in range(self.n_states)],
                           "channels": [f"x{k}" for k in range(channels)]})  # fmt: skip
        assert isinstance(task, SequenceTask)
        return task

    def _checked(self, X: Any, reset: bool) -> list[np.ndarray]:
        least = max(8, 2 * self.n_states)
        found: list[Any] = [
            validate_data(self, each, reset=reset and k == 0, dtype=float, ensure_min_samples=least)
            for k, each in enumerate(X if _several(X) else [X])
        ]
        return found

    def _trials(self, sequences: Sequence[np.ndarray]) -> list[Trial]:
        return [Trial(f"sequence{k}", np.arange(len(x)) / self.rate, {f"x{c}": v for c, v in enumerate(x.T)})
                for k, x in enumerate(sequences)]  # fmt: skip

    def _boundaries(self, trials: Sequence[Trial], y: Any) -> dict[str, list[float]]:
        out = {}
        for trial, states in zip(trials, y, strict=True):
            if states is None:
                continue
            states = np.asarray(states)
            if states.shape != trial.t.shape or (np.diff(states) < 0).any():
                raise InputError("y", f"{trial.file} has states that go back or are not one a sample")
            out[trial.file] = [float(trial.t[np.argmax(states >= k)]) for k in range(1, self.n_states)]
        return out


def _several(X: Any) -> bool:
    return isinstance(X, list | tuple) and len(X) > 0 and np.ndim(X[0]) == 2
