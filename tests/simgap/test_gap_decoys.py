"""Decoys: they take probability for "unknown" and are never named."""

from __future__ import annotations

from types import SimpleNamespace

import pytest

from simgap.effects import decoys
from simgap.gap.judge import Calibration, probabilities
from simgap.gap.verdict import choose, likelihoods


def _candidate(name: str, evidence: float) -> SimpleNamespace:
    fitted = SimpleNamespace(columns=SimpleNamespace(size=8), cost=-evidence)
    return SimpleNamespace(
        name=name, evidence=evidence, effects=tuple(name.split("+")), fitted=fitted, spread=None
    )


@pytest.mark.parametrize("decoy", sorted(decoys()))
def test_what_a_decoy_explains_best_is_unknown(decoy):
    found = probabilities({decoy: 80.0, "force_gain": 40.0}, 0.0, 1.0, Calibration())
    assert set(found) == {"none", "unknown", "force_gain"}
    assert found["unknown"] > 0.99
    assert sum(found.values()) == pytest.approx(1.0)


def test_a_decoy_that_does_no_better_takes_nothing_away():
    found = probabilities({"force_gain": 80.0, "force_nonlinearity": 60.0}, 0.0, 1.0, Calibration())
    assert found["force_gain"] > 0.99


def test_the_verdict_never_names_a_decoy():
    ranked = [_candidate("force_nonlinearity", 41.0), _candidate("force_gain", 40.0)]
    found = SimpleNamespace(candidates=ranked, temperature=1.0)
    probability = likelihoods({c.name: c.evidence for c in ranked}, 1e-9, 0.0, 1.0, Calibration())
    assert probability["unknown"] > 0.5
    assert choose(probability, found, True, False) == ("unknown", [], [])
    close = {"none": 0.0, "unknown": 0.4, "force_gain": 0.6}
    assert choose(close, found, True, False)[:2] == ("named", ["force_gain"])
