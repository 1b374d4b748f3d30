"""Intervals hold the scatter between logs, and what a set leaves open."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from simgap_swing import Swing, log

from hmmseg.errors import InputError
from simgap.attribution.posterior import fitted, forms
from simgap.attribution.problem import Candidate, Gap, Rows
from simgap.robots.borne_out import folds_of
from simgap.robots.diagnose import diagnose
from simgap.robots.linear import Linear
from simgap.robots.scatter import over_rivals, scattering
from simgap.simulators.user import checked

LOGS, N = 6, 60


def gap(sizes, noise: float = 1.0, names=("slope", "other")) -> tuple[Gap, np.ndarray]:
    """Logs in which the first effect has these sizes, and a second one that has none."""
    rng = np.random.default_rng(5)
    of = np.repeat(np.arange(LOGS), N)
    zeros, time = np.zeros(LOGS * N, int), np.tile(np.arange(N) * 0.01, LOGS)
    rows = Rows(of, zeros, zeros, time, tuple("abcdef"), ("y",), ("whole",))
    shapes = [np.sin(40 * time), np.cos(23 * time)]
    residual = np.repeat(sizes, N) * shapes[0] + noise * rng.standard_normal(of.size)
    one, none, far = np.ones(1), np.zeros(1), np.full(1, 50.0)
    made = tuple(
        Candidate(n, ("size",), none, none, one, np.zeros(of.size), s[:, None], -far, far)
        for n, s in zip(names, shapes, strict=True)
    )
    return Gap(rows, residual, np.zeros((of.size, 0)), made), of


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


def test_what_a_set_leaves_open_widens_intervals():
    made, _ = gap(np.full(LOGS, 4.0))
    both = fitted(forms(made), (0, 1))
    rival = (forms(made), replace(both, x=both.x + np.array([0.6, 0.0])))
    wide = over_rivals(forms(made), both, [rival])
    assert wide.covariance[0, 0] == pytest.approx(both.covariance[0, 0] + 0.6**2 / 2)
    assert wide.covariance[1, 1] == both.covariance[1, 1]
    assert over_rivals(forms(made), both, []).covariance == pytest.approx(both.covariance)


def test_logs_of_one_group_are_held_out_together():
    rows = SimpleNamespace(log=np.repeat(np.arange(4), 3))
    linear = object.__new__(Linear)
    object.__setattr__(linear, "rows", rows)  # all that folds are made of
    fold = folds_of(linear, 4, groups=[100, 200, 100, 200])
    assert fold.tolist() == [0] * 3 + [1] * 3 + [0] * 3 + [1] * 3


@pytest.mark.parametrize("groups", [[1, 2, 1], [4, 4]])
def test_groups_that_nothing_can_be_held_out_by_are_refused(groups):
    with pytest.raises(InputError, match=r"groups: are \d in \d groups for 2 logs; expected"):
        diagnose(checked(Swing(), "Swing"), [log(1), log(2)], groups=groups)
