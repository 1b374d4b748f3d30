"""What held-out logs bear out, what is lost without a cause, and in which regime."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from simgap_swing import Swing, log

from simgap.attribution.problem import Candidate, Gap, Rows
from simgap.robot_effects import candidates
from simgap.robot_effects.base import Setting
from simgap.robots.asked import Asked
from simgap.robots.borne_out import borne_out, held_out_scores, weakest
from simgap.robots.explained import Explained, explained
from simgap.robots.linear import linearise
from simgap.robots.model import Composed
from simgap.robots.noise import noises
from simgap.robots.phases import phases_of
from simgap.robots.search import _Place
from simgap.robots.verdict import open_where
from simgap.robots.whiten import covariances
from simgap.robots.windows import FLIES, REGIMES, STRIKES
from simgap.simulators.user import checked

FOLDS, EACH = 6, 300


def gap_of(sizes, columns, rng) -> tuple[Gap, np.ndarray]:
    """Folds of rows in which the first candidate acts, as strongly as `sizes` (FOLDS,) say."""
    fold = np.repeat(np.arange(FOLDS), EACH)
    n = fold.size
    rows = Rows(fold, np.zeros(n, int), np.zeros(n, int), np.tile(np.arange(EACH) / 100, FOLDS),
                tuple(f"log {k}" for k in range(FOLDS)), ("q",), ("whole",))  # fmt: skip
    first = np.array(sizes)[fold] * rng.standard_normal(n)
    every = [first, *(rng.standard_normal(n) for _ in range(columns - 1))]
    one = np.ones(1)
    made = tuple(
        Candidate(f"e{k}", ("size",), 0 * one, 0 * one, one, np.zeros(n), c[:, None], -9 * one, 9 * one)
        for k, c in enumerate(every)
    )
    return Gap(rows, first + rng.standard_normal(n), np.zeros((n, 0)), made), fold


def test_a_cause_that_one_log_shows_a_hundred_times_as_well_is_borne_out():
    """Its gains scatter by as much as their mean, and every one of them is a gain."""
    gap, fold = gap_of([5.0, 0.3, 0.3, 0.3, 0.3, 0.3], 1, np.random.default_rng(0))
    assert borne_out(gap, (0,), fold) == (0,)


def test_what_no_log_bears_out_goes_and_the_least_first():
    gap, fold = gap_of([0.5] * FOLDS, 4, np.random.default_rng(1))
    assert weakest(gap, (0, 1, 2, 3), fold) in (1, 2, 3)
    assert borne_out(gap, (0, 1, 2, 3), fold) == (0,)
    assert weakest(gap, (0,), fold) is None


@pytest.fixture(scope="module")
def damped() -> Composed:
    """Logs of a pendulum with damping that its model lacks."""
    simulator, logs = checked(Swing(), "Swing"), [log(s, viscous=0.02) for s in range(2)]
    return Composed.of(simulator, logs, candidates(Setting(simulator, logs)), noises(simulator, logs))


def told(model: Composed, point, causes):
    linear = linearise(model, point, [])
    sensor = covariances(model, linear).whitener()
    return explained(model, linear, sensor, {}, causes, model)


def test_a_planted_effect_explains_the_gap_and_another_does_not(damped):
    there = {"viscous": {"viscous": 0.02}, "readout:angle.bias": {"bias": 1e-5}}
    found = told(damped, there, tuple(there))
    assert found.left[0] < 0.02
    assert found.part[:, 0] == pytest.approx([1.0, 0.0], abs=0.02)


def test_only_what_is_large_enough_to_be_told_is_exchanged(damped):
    there = {"viscous": {"viscous": 0.02}, "readout:angle.bias": {"bias": 1e-5}}
    names, count = tuple(there), damped.rows.log.size
    plain = linearise(damped, {}, names)
    parts = phases_of(damped.simulator, damped.recordings)
    ask = Asked(damped, parts, names, (), np.ones(count), damped.rows.log, plain)
    place = _Place.of(ask, there, names, names)
    assert {*place.held} == {*names} and place.large == ("viscous",)


def test_what_contacts_leave_does_not_deny_what_flight_bears_out(damped):
    """The second half of the windows are said to touch, and there something else acts as well."""
    rows = damped.rows
    late = rows.window >= np.median(rows.window)
    rough = rows.observed + np.where(late, 0.3 * np.sin(40 * rows.time), 0.0)
    model = replace(
        damped, rows=replace(rows, regime=np.where(late, REGIMES.index(STRIKES), 0), observed=rough)
    )
    found = told(model, {"viscous": {"viscous": 0.02}}, ("viscous",))
    assert found.regimes == (FLIES, STRIKES)
    assert found.left[0] < 0.05 and found.left[1] > 0.5


def test_a_cause_is_judged_by_the_channels_in_which_it_acts():
    """It takes nine tenths of the first channel's gap; most of the regime's is in the second."""
    before, floor = np.array([[1000.0, 9000.0]]), np.array([[10.0, 10.0]])
    after, other = np.array([[109.0, 9000.0]]), np.array([[200.0, 8000.0]])
    found = Explained(
        ("a", "b"), ("whole",), before, after, np.stack([before, after + other]), floor, np.ones(1, bool)
    )
    assert found.left == pytest.approx([(109 + 9000 - 20) / (10000 - 20)])
    assert found.where_it_acts[0] == pytest.approx([0.1], abs=1e-3)
    assert found.where_it_acts[1, 0] == pytest.approx((200 * 0.1 + 8000) / 8200, abs=2e-3)


@pytest.mark.parametrize(("left", "expected"), [(0.0, [0.0, 0.0]), (50.0, [0.005, 1.0])])
def test_a_small_cause_is_told_where_it_takes_nearly_all_that_there_is_besides(left, expected):
    """It takes 100 of 10 000, within an error in the form of the large one, of which as much is left."""
    floor = np.array([[10.0]])
    before, after = floor + 10_000.0, floor + left
    without = np.stack([before, after + 100.0])
    found = Explained(("large", "small"), ("whole",), before, after, without, floor, np.ones(1, bool))
    assert open_where(found, np.array([True, True])) == pytest.approx(expected, abs=1e-3)
    assert open_where(found, np.array([True, False]))[1] == 1.0


def test_what_each_log_has_of_its_own_is_fitted_to_the_logs_held_out():
    """Every log is off by a constant of its own, which is no cause, and the planted effect is borne out."""
    rng = np.random.default_rng(2)
    gap, fold = gap_of([1.0] * FOLDS, 2, rng)
    own = (fold[:, None] == np.arange(FOLDS)) * 3.0
    shifted = replace(gap, residual=gap.residual + own @ rng.standard_normal(FOLDS), nuisance=own,
                      own=tuple(range(FOLDS)))  # fmt: skip
    assert borne_out(shifted, (0, 1), fold) == (0,)
    assert min(held_out_scores(shifted, [(0,)], fold)) > -2 * EACH
