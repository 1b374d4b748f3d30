"""Intervals hold the scatter between logs, and a solver's step is no gap of the robot's."""

from __future__ import annotations

import numpy as np
import pytest

from simgap.attribution.posterior import fitted, forms
from simgap.attribution.problem import Candidate, Gap, Rows
from simgap.robots.scatter import scattering
from simgap.robots.verdict import _beside_numerics

LOGS, N = 6, 60


def gap(sizes, noise: float = 1.0, names=("slope", "other")) -> tuple[Gap, np.ndarray]:
    """Logs in which the first effect has these sizes, and a second one that has none."""
    rng = np.random.default_rng(5)
    log = np.repeat(np.arange(LOGS), N)
    zeros, time = np.zeros(LOGS * N, int), np.tile(np.arange(N) * 0.01, LOGS)
    rows = Rows(log, zeros, zeros, time, tuple("abcdef"), ("y",), ("whole",))
    shapes = [np.sin(40 * time), np.cos(23 * time)]
    residual = np.repeat(sizes, N) * shapes[0] + noise * rng.standard_normal(log.size)
    one, none, far = np.ones(1), np.zeros(1), np.full(1, 50.0)
    made = tuple(
        Candidate(n, ("size",), none, none, one, np.zeros(log.size), s[:, None], -far, far)
        for n, s in zip(names, shapes, strict=True)
    )
    return Gap(rows, residual, np.zeros((log.size, 0)), made), log


def test_logs_that_agree_leave_the_interval_and_others_widen_it():
    sizes = np.array([3.0, 6.0, 4.0, 2.0, 7.0, 5.0])
    for told, wanted in ((np.full(LOGS, 4.0), None), (sizes, sizes.std(ddof=1) / np.sqrt(LOGS))):
        made, fold = gap(told)
        f = forms(made)
        model = fitted(f, (0,))
        wide = scattering(f, model, fold)
        before, after = (float(np.sqrt(m.covariance[0, 0])) for m in (model, wide))
        if wanted is None:
            assert after < 1.6 * before
        else:
            assert after == pytest.approx(wanted, rel=0.3) and after > 2 * before
        assert wide.x is model.x
    assert scattering(f, fitted(f, ()), fold).effects == ()
    assert scattering(f, model, fold % 2) is model


def test_what_a_solver_s_step_explains_is_no_gap():
    made, _ = gap(np.full(LOGS, 4.0))
    f = forms(made)
    assert _beside_numerics(f, (0,), ()) > 50
    assert _beside_numerics(f, (0,), (1,)) > 50
    assert _beside_numerics(f, (), (0,)) < 3
    assert _beside_numerics(f, (0,), (0, 1)) < 3
