"""Sensitivities against analytic ones; what the recording determines and what it does not."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from estimation.design import UNLIKE, PadDoubt, _combined, build, simplest_combinations, unexpected_bias
from estimation.observations import aligned_weights
from estimation.posterior import find_mode, posterior
from experiments.worlds import simulated_cases
from hmmseg.io.rig import Fingertip, Rig, Systematic
from hmmseg.segmentation.align import align

EVERY = Systematic(force_bias=(0.01,) * 4, force_gain=(0.02,) * 4, joint_offset=(0.001,) * 4,
                   link_length=(0.001,) * 4, pad_stiffness=(0.1, 0.1))  # fmt: skip
NAMES = ("a", "b", "c", "d")


@pytest.fixture(scope="module")
def case():
    return simulated_cases(1, trials=2, seed=20_900)[0]


@pytest.fixture(scope="module")
def aligned(case):
    found = align(case.trials, case.task, case.rig)
    return (*aligned_weights(found, np.random.default_rng(0)), found)


@pytest.fixture(scope="module")
def design(case, aligned):
    weighed, noise, found = aligned
    return build(replace(found, rig=case.rig.model_copy(update={"systematic": EVERY})), weighed, noise)


def shift(design, name, channel=None):
    """What a deviation of one unit shifts, (K,), or in one channel (num_trials, num_moves)."""
    j = [n.name for n in design.nuisances].index(name)
    found = design.shifts[:, j] / design.nuisances[j].sd
    mine = ~design.slope & (design.channel == channel)
    return found if channel is None else found[mine].reshape(2, 2)


def mean_over_grip(aligned, i, move, key, values):
    """The mean of `values` (num_timesteps,) of trial i that a grip's observation takes."""
    return float((aligned[0][i].grips[move][key] @ np.nan_to_num(values)).mean())


def test_a_force_bias_shows_in_free_motion_and_adds_to_forces_and_through_the_pads_to_lengths(design, case):
    k_n = case.rig.fingertip.normal_stiffness
    np.testing.assert_allclose(shift(design, "force_bias.fy1", 0), 1.0, rtol=1e-6)
    np.testing.assert_allclose(shift(design, "force_bias.fy1", 1), 0.0, atol=1e-9)
    np.testing.assert_allclose(shift(design, "force_bias.fy1", 2), 0.0, atol=1e-9)  # alike on both grounds
    np.testing.assert_allclose(shift(design, "force_bias.fx1", 0), 0.0, atol=1e-9)
    np.testing.assert_allclose(shift(design, "force_bias.fx1", 1), 1 / k_n, rtol=1e-5)
    for j, n in enumerate(design.nuisances):
        kind, _, channel = n.name.partition(".")
        expected = np.zeros(4)
        if kind == "force_bias":
            expected[("fx1", "fy1", "fx2", "fy2").index(channel)] = n.sd
        # A gain acts on noise about zero: a thousandth of it.
        np.testing.assert_allclose(design.free_shifts[0, :, j], expected, atol=2e-4)


def test_a_force_gain_scales_what_that_finger_carries_and_a_softer_pad_gives_more(design, case, aligned):
    gain = shift(design, "force_gain.fy1", 0) + shift(design, "force_gain.fy2", 0)
    carried = design.mean[design.channel == 0].reshape(2, 2)
    np.testing.assert_allclose(gain, carried, rtol=2e-3)  # both fingers: the whole weight; steps of 1e-3
    grip = shift(design, "force_gain.fx1", 1)
    for i, a in enumerate(aligned[0]):
        for m in (0, 1):
            mean = mean_over_grip(aligned, i, m, "distance", a.signals.fx1)
            assert grip[i, m] == pytest.approx(mean / case.rig.fingertip.normal_stiffness, rel=2e-3)
    pad = shift(design, "pad_normal.1", 1)
    for i, a in enumerate(aligned[0]):
        for m in (0, 1):
            grip = mean_over_grip(aligned, i, m, "distance", a.signals.fx1)
            assert pad[i, m] == pytest.approx(-grip / case.rig.fingertip.normal_stiffness, rel=3e-3)


def test_slopes_show_a_pads_compliance_itself(design):
    """One finger's pad makes half of what both give; bent pads show at the force where they are bent."""
    j = {n.name: k for k, n in enumerate(design.nuisances)}
    for c, kind, sign in ((1, "pad_normal", -1), (2, "pad_shear", 1)):
        mine = design.slope & (design.channel == c)
        # Two blocks, two trials; of heights what shows within a grip and from its landing.
        assert mine.sum() == (4 if c == 1 else 8) and (design.unit[mine] == 1).all()
        # Most of what the rig admits both pads have alike.
        alike, own = 0.1 * np.sqrt(1 - UNLIKE**2), 0.1 * UNLIKE
        np.testing.assert_allclose(design.shifts[mine][:, j[kind]] / alike, sign, rtol=1e-6)
        both = design.shifts[mine][:, [j[f"{kind}.1"], j[f"{kind}.2"]]].sum(axis=1) / own
        np.testing.assert_allclose(both, sign, rtol=1e-6)
        np.testing.assert_allclose(design.mean[mine] / np.sqrt(design.variance[mine]), 0.0, atol=3.0)


@pytest.mark.parametrize(("name", "lever"), [("joint_offset.q11", np.sin), ("link_length.11", np.cos)])
def test_joints_and_links_move_the_tip_by_the_jacobian(design, case, aligned, name, lever):
    """dx1/dq11 = -L1 sin q11, dx1/de = L1 cos q11 of a link (1 + e) L1 long; distances are x2 - x1."""
    found, length = shift(design, name, 1), case.rig.finger(1).links[0]
    for i in range(2):
        q = case.trials[i].channels["q11"]
        for m in (0, 1):
            expected = mean_over_grip(aligned, i, m, "distance", length * lever(q))
            assert found[i, m] == pytest.approx(expected, rel=1e-3)


def test_observations_agree_with_the_truth_and_shares_are_taken_of_the_pads_give(design, case):
    tip = case.rig.fingertip
    unit = [design.unit[(design.channel == c) & ~design.slope] for c in range(3)]
    np.testing.assert_allclose(unit[0], design.mean[design.channel == 0], rtol=1e-12)
    hanging = unit[0] / (2 * tip.shear_stiffness)
    assert (np.abs(unit[2]) >= hanging * (1 - 1e-12)).all() and (np.abs(unit[2]) < 6 * hanging).all()
    give = unit[1] * tip.normal_stiffness / 2
    assert ((give > 1.0) & (give < 5.0)).all()  # N, a pinch
    true = np.array([case.blocks[obj][prop][0] for obj, prop in design.names])
    residual = ((design.mean - design.coefficients @ true) / np.sqrt(design.variance))[~design.slope]
    assert np.sqrt(np.mean(residual**2)) < 2.0
    assert {p for _, p in design.names} == {"weight", "width", "height"} and len(design.names) == 6


def test_trials_that_fail_and_rigid_pads_that_give_leave_out_or_allow_for_what_they_show(case, aligned):
    weighed, noise, found = aligned
    cut = []
    for a in weighed:
        grips, counts = dict(a.grips), dict(a.counts)
        grips[1] = {k: np.zeros_like(v) for k, v in grips[1].items()}
        counts[1] = {k: np.zeros_like(v) for k, v in counts[1].items()}
        cut.append(replace(a, grips=grips, counts=counts))
    design = build(found, cut, noise)
    # Block 1 moved down from block 2 onto the ground: its rise tells block 2's height.
    assert set(design.names) == {("block1", "weight"), ("block1", "width"), ("block2", "height")}
    assert np.isfinite(design.mean).all() and np.isfinite(design.variance).all()
    rig = case.rig.model_copy(update={"systematic": EVERY, "fingertip": Fingertip()})
    found = align(case.trials, case.task, rig)
    weighed, noise = aligned_weights(found, np.random.default_rng(0))
    design = build(found, weighed, noise)
    assert design.doubts["normal"].share == pytest.approx(1.0, abs=0.2)  # in units of pads of 4000 N/m
    names = {n.name for n in design.nuisances if n.name.startswith("pad")}
    assert names >= {"pad_normal.1", "pad_normal.2", "pad_normal_exponent"}
    mode, i = find_mode(posterior(design)), design.names.index(("block1", "width"))
    error = mode.unknowns[i] - case.blocks["block1"]["width"][0]
    assert abs(error) < 3 * np.sqrt(mode.unknowns_covariance[i, i]) < 2e-3


def test_unexpected_biases_and_pads_that_may_be_wrong_count_beyond_noise_and_the_rig():
    mean = np.tile([0.05, 0.002, -0.05, 0.0], (3, 1))
    variance = np.full((3, 4), 0.003**2)
    plain = unexpected_bias(mean, variance, Rig())
    np.testing.assert_allclose(plain, [0.05, 0.0, 0.05, 0.0])
    admitted = Rig(systematic=Systematic(force_bias=(0.05, 0.0, 0.0, 0.0)))
    np.testing.assert_allclose(unexpected_bias(mean, variance, admitted), [0.0, 0.0, 0.05, 0.0])
    np.testing.assert_array_equal(unexpected_bias(np.zeros((3, 4)), np.full((3, 4), np.inf), Rig()), 0.0)
    doubt = PadDoubt(share=-0.4, odds=0.25)
    draws = np.where(np.random.default_rng(0).uniform(size=100_000) < 0.25, -0.4, 0.0)
    assert doubt.extra_sd == pytest.approx(np.sqrt(np.mean(draws**2)), rel=0.01)


def test_alignments_are_combined_by_rubins_rule():
    """Within one alignment plus (1 + 1/S) times the unbiased variance between them."""
    rng, draws = np.random.default_rng(3), 7
    raw = 1.0 + 0.2 * rng.standard_normal((1, draws, 2, 1))
    valid = np.ones(raw.shape, bool)
    valid[0, 2, 1, 0] = False
    variance = np.full(raw.shape, 0.01) * (1 + np.arange(draws))[None, :, None, None]
    where = (np.zeros(2, int), np.arange(2), np.zeros(2, int))
    mean, total, row = _combined(raw, variance, valid, np.ones((*raw.shape, 1)), where)
    for k in range(2):
        mine = valid[0, :, k, 0]
        values = raw[0, mine, k, 0]
        between = (1 + 1 / values.size) * np.var(values, ddof=1)
        assert mean[k] == pytest.approx(values.mean())
        assert total[k] == pytest.approx(variance[0, mine, k, 0].mean() + between)
    assert row == pytest.approx(np.ones((2, 1)))


@settings(max_examples=100, deadline=None)
@given(st.lists(st.lists(st.integers(-2, 2), min_size=4, max_size=4), max_size=6))
def test_they_span_what_the_rises_span_and_single_out_what_is_determined(values):
    rises = [{name: v for name, v in zip(NAMES, row, strict=True) if v} for row in values]
    found = simplest_combinations(rises, NAMES)
    given_rows, rows = (np.array([[row.get(n, 0) for n in NAMES] for row in each], float).reshape(-1, 4)
                        for each in (rises, found))  # fmt: skip
    rank = np.linalg.matrix_rank(given_rows) if len(given_rows) else 0
    assert len(found) == rank and np.linalg.matrix_rank(np.concatenate([given_rows, rows])) == rank
    _, singular, vt = np.linalg.svd(given_rows, full_matrices=True)
    null = vt[int((singular > 1e-9).sum()) :]
    determined = {n for n, column in zip(NAMES, null.T, strict=True)
                  if np.abs(column).max(initial=0.0) < 1e-9}  # fmt: skip
    assert {n for row in found if len(row) == 1 for n in row} == determined
    assert all(math.gcd(*row.values()) == 1 and next(iter(row.values())) > 0 for row in found)
