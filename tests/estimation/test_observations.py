"""Robust means, their sampling variance against Monte Carlo, autocorrelation times."""

import numpy as np
import pytest
from estimation_scene import ar1
from hand_signals import signals_of

from estimation import observations
from hmmseg.contact.decompose import ABOVE_GROUND, FREE, ON_GROUND, Subtask
from hmmseg.io.rig import Fingertip, Rig
from hmmseg.levels import TAIL
from hmmseg.segmentation.align import TrialAlignment
from hmmseg.segmentation.boundaries import BoundaryPosterior


def test_robust_weights_are_those_of_the_student_location_and_zero_without_residuals():
    rng = np.random.default_rng(0)
    values = 5 + rng.normal(size=60)
    values[[3, 40]] = [40.0, np.nan]
    mask = np.ones(60, bool)
    mask[50:] = False
    weights, residual, centre = observations.robust_weights(values, mask, 1.0)
    inside = mask & np.isfinite(values)
    # The location solves sum w (v - m) = 0 over the masked values.
    assert weights[inside] @ residual[inside] == pytest.approx(0.0, abs=1e-5)
    assert centre == pytest.approx(5.0, abs=0.4)
    np.testing.assert_allclose(weights[inside], (TAIL + 1) / (TAIL + residual[inside] ** 2))
    assert weights[40] == 0 and weights[3] < 0.02 * np.median(weights[inside])
    weights, residual, centre = observations.robust_weights(np.full(4, np.nan), np.ones(4, bool), 1.0)
    assert not weights.any() and np.isnan(residual).all() and np.isnan(centre)
    assert observations.autocorrelation_time([np.array([1.0, -0.5])]) == 1.0
    noise = observations.estimated_noise({"force": [(np.array([np.nan]), np.array([1.0]))]}, {"force": 0.3},
                                         {})  # fmt: skip
    assert noise.variance["force"] == pytest.approx(0.09) and noise.count["force"] == 1.0
    rng = np.random.default_rng(3)
    series = list(np.diff(rng.normal(size=(40, 101)), axis=1))
    assert observations.autocorrelation_time(series) == observations.MIN_STRETCH


@pytest.mark.parametrize("noise", ["gaussian", "student"])
def test_sampling_variance_of_the_mean_against_monte_carlo(noise):
    rng, per_grip, scale = np.random.default_rng(1), 25, 1.0
    centres, pairs = [], []
    for _ in range(3000):
        v = rng.normal(size=per_grip) if noise == "gaussian" else rng.standard_t(3, size=per_grip)
        weights, residual, centre = observations.robust_weights(v, np.ones(per_grip, bool), scale)
        centres.append(centre)
        pairs.append((residual, weights))
    predicted = (
        observations.estimated_noise({"force": pairs}, {"force": scale}, {}).variance["force"] / per_grip
    )
    assert predicted == pytest.approx(np.var(centres), rel=0.1)


@pytest.mark.parametrize(("rho", "expected"), [(0.0, 1.0), (0.3, 13 / 7), (0.5, 3.0)])
def test_autocorrelation_time_of_a_known_process(rho, expected):
    """(1 + rho) / (1 - rho) for an AR(1); the sum is cut where it drowns in noise."""
    series = list(ar1(60, 200, rho, np.random.default_rng(2)))
    assert observations.autocorrelation_time(series) == pytest.approx(expected, rel=0.12)


def test_few_residuals_are_no_less_noisy_than_the_rig_states_but_by_chance():
    quiet, loud = ([(size * np.array([-1.0, 1.0, 0.0]), np.ones(3))] for size in (0.01, 3.0))
    shy = observations.estimated_noise({"force": quiet}, {"force": 1.0}, {"force": 1.0})
    alone = observations.estimated_noise({"force": quiet}, {"force": 1.0}, {})
    own = alone.count["force"]
    expected = (observations.STATED + own * alone.variance["force"]) / (observations.STATED + own)
    assert (shy.variance["force"] == pytest.approx(expected)
            and shy.count["force"] == observations.STATED + own)  # fmt: skip
    # What is recorded may be noisier than its sensors.
    heard, told = ({"force": loud}, {"force": 3.0}), observations.estimated_noise
    assert told(*heard, {"force": 1.0}) == told(*heard, {})
    none = observations.estimated_noise({"force": [(np.array([0.1]), np.ones(1))]}, {"force": 1.0},
                                        {"force": 0.2})  # fmt: skip
    assert none.variance["force"] == pytest.approx(0.04) and none.count["force"] == observations.STATED


def test_samples_belong_to_one_subtask_and_means_across_a_boundary_to_none():
    times = np.arange(10) * 0.1
    masks = observations.subtask_masks(times, np.array([[0.25, 0.6], [0.0, 0.9]]), 3)
    assert masks.shape == (2, 3, 10)
    np.testing.assert_array_equal(masks.sum(axis=1), 1)
    np.testing.assert_array_equal(masks[0, 0], times < 0.25)
    np.testing.assert_array_equal(masks[1].argmax(axis=0), [1] * 9 + [2])  # half-open: 0.0 starts the second
    boundaries, times = np.array([[0.26, 0.58]]), np.arange(10) / 10
    alone, wide = (observations.subtask_masks(times, boundaries, 3, reach)[0] for reach in (0.0, 0.05))
    assert alone.any(axis=0).all() and not (wide & ~alone).any()
    np.testing.assert_array_equal(np.flatnonzero(~wide.any(axis=0)), [3, 6])


def test_drawn_boundaries_follow_their_posterior_and_keep_order():
    rng, times = np.random.default_rng(4), np.linspace(0, 1, 501)
    density = np.exp(-0.5 * ((times - 0.4) / 0.05) ** 2)
    one = BoundaryPosterior(times, density / density.sum())
    trial = TrialAlignment.__new__(TrialAlignment)
    object.__setattr__(trial, "boundaries", (one, one))
    drawn = observations.draw_boundaries(trial, rng, 20_000)
    assert (np.diff(drawn, axis=1) >= 0).all()
    assert drawn[:, 0].mean() == pytest.approx(0.4, abs=2e-3)
    assert drawn[:, 0].std() == pytest.approx(0.05, rel=0.03)


def test_pads_give_is_taken_out_and_gravity_grows_by_the_acceleration():
    rig = Rig(fingertip=Fingertip(normal_stiffness=4000.0, shear_stiffness=2500.0))
    t = np.arange(6) * 0.05
    # A block 20 mm wide held with 2 N: each pad gives 0.5 mm; its weight of 0.5 N shears both pads.
    signals = signals_of(t, x1=0.1005, x2=0.1195, fx1=2.0, fx2=-2.0, y1=0.05, y2=0.05, fy1=0.25, fy2=0.25)
    values = observations.channel_values(signals, rig)
    np.testing.assert_allclose(values["distance"], 0.02)
    np.testing.assert_allclose(values["pickup"], 0.05 - 0.25 / 2500)
    rigid = observations.channel_values(signals, Rig())
    np.testing.assert_allclose(rigid["distance"], 0.019)
    np.testing.assert_allclose(rigid["pickup"], 0.05)
    t = np.arange(30) * 0.05
    signals = signals_of(t, vy1=2.0 * t, vy2=2.0 * t)
    np.testing.assert_allclose(observations.gravity_factor(signals, Rig()), 1 + 2.0 / 9.80665)


def test_a_grip_before_a_carry_that_never_came_tells_nothing():
    states = [FREE, *2 * (ON_GROUND, ABOVE_GROUND, ON_GROUND, FREE)]
    steps = tuple(Subtask(i, "", "block", s, (i - 1) // 4) for i, s in enumerate(states))
    present = np.arange(9) < 6  # the second grip is there, its carry is not
    assert observations.held_as_described(present, steps).tolist() == [True] * 5 + [False] * 4
    assert observations.held_as_described(np.ones(9, bool), steps).all()
