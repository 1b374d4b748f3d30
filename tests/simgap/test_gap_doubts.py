"""What corrections leave in doubt: slides, dead bands, forces between samples, rings; against oracles."""

import numpy as np
import pytest
from scipy.signal import lsim
from scipy.stats import multivariate_normal

from simgap.channels import play
from simgap.effects.geometry import within
from simgap.gap.residuals import ANYWHERE, driven, sensed
from simgap.recursions import tracked
from tests.simgap.test_gap_effects import performance, world_of


def _tracked(values, sd, *, weight=1.0, walk=0.0, new=False, joints=None, shares=(0.0,), chance=(1.0,)):
    """What the filter makes of one trial's values (N, 4). `joints`: levers, pinned, place and jump of two."""
    n = len(values)
    levers, pinned, place, jump = joints or (np.zeros((n, 4, 0)), np.zeros((n, 0)) > 0, np.zeros((n, 0)), 0.0)
    still = np.zeros((1, *place.shape))
    return tracked(values[None], np.broadcast_to(weight, (1, n, 4)) * 1.0, np.full((1, n, 4), sd),
                   levers[None], np.broadcast_to(np.reshape(walk, (-1, 1)), (1, n, 3)) * 1.0,
                   np.broadcast_to(new, (1, n, 3)) > 0, ANYWHERE**2, pinned[None], place[None], still,
                   still + 1e-6, np.full((1, place.shape[1]), jump), np.asarray(shares),
                   np.asarray(chance))  # fmt: skip


def _cost(found, sd, channel) -> float:
    out, factor = (z[0, :, channel] for z in found[:2])
    return float(0.5 * ((out / sd) ** 2 / factor + np.log(factor)).sum()) + found[2]


def _alone(values, channel):
    """One channel's values, the others of no weight."""
    return np.outer(values, np.eye(4)[channel]), np.eye(4)[channel]


def test_a_constant_that_walks_is_marginalised_exactly():
    rng = np.random.default_rng(0)
    n, sd = 12, 2e-5
    walk = np.where(np.isin(np.arange(n), (4, 5, 6)), 2e-3, 0.0)
    for values in (rng.normal(0, sd, n), np.where(np.arange(n) > 4, 1e-3, 0.0) + rng.normal(0, sd, n)):
        # The oracle: the joint normal density of all samples but the first, given the first.
        steps = np.cumsum(walk**2 * (np.arange(n) > 0))
        covariance = np.minimum.outer(steps, steps) + ANYWHERE**2 + sd**2 * np.eye(n)
        whole = multivariate_normal(np.full(n, values[0]), covariance).logpdf(values)
        first = multivariate_normal(values[0], ANYWHERE**2 + sd**2).logpdf(values[0])
        plain = -0.5 * (n - 1) * np.log(2 * np.pi * sd**2)
        for channel in (0, 1, 3):  # a block that is taken along, pads that slide
            of, weight = _alone(values, channel)
            cost = _cost(_tracked(of, sd, weight=weight, walk=walk**2), sd, channel)
            assert cost == pytest.approx(-(whole - first - plain), abs=2e-3)


def test_a_new_grip_and_unknown_samples_tell_nothing():
    values = np.array([0.0, 0.0, 3e-3, 3e-3, 9.0, 3e-3])
    known = np.array([1.0, 1.0, 1.0, 1.0, 0.0, 1.0])
    of, weight = _alone(values, 3)
    new = (np.arange(6) == 2)[:, None]
    assert _cost(_tracked(of, 2e-5, weight=known[:, None] * weight, new=new), 2e-5, 3) < 1.5


def test_a_joint_lies_where_it_was_pushed_to():
    rng = np.random.default_rng(0)
    t, width = np.arange(200) / 20, 4e-3
    true = 0.05 * np.sin(2 * np.pi * 0.2 * t)[:, None] * np.ones(4)
    played = np.stack([play(each, width) for each in true.T], 1)
    recorded = played + 1e-4 * rng.standard_normal(true.shape)
    half, inner = width / 2, slice(10, -10)
    world = world_of(performance())._replace(t=t[None], joints=recorded[None])
    # An encoder's speeds say nothing of the dead band.
    band = within(world._replace(rates=np.gradient(recorded, t, axis=0)[None]), half, 1.0)
    off, pinned = (((true - recorded) - band.place[0]) / half)[inner], band.pinned[0, inner]
    assert pinned.mean() > 0.6 and np.sqrt(np.mean(off[pinned] ** 2)) < 0.15
    assert np.abs(off[~pinned]).max() < 2.2 and (band.jump > 0).all() and not band.wander.any()
    # A tachometer's say how the joint crosses it.
    rates = np.gradient(true, t, axis=0) + 2e-3 * rng.standard_normal(true.shape)
    band = within(world._replace(rates=rates[None]), half, 0.0)
    off = (((true - recorded) - band.place[0]) / half)[inner]
    assert np.sqrt(np.mean(off**2)) < 0.15 and not band.jump.any() and (band.wander > 0).all()


def test_joints_in_dead_bands_are_marginalised_exactly():
    """Without jumps: the joint normal density of all values, given the first of each constant."""
    rng = np.random.default_rng(0)
    n, sd, jump = 7, 0.03, 0.5
    levers, values = rng.standard_normal((n, 4, 2)), rng.standard_normal((n, 4))
    pinned = np.zeros((n, 2), bool)
    pinned[3, 0] = True
    place = rng.standard_normal((n, 2))
    out, factor, cost = _tracked(values, sd, joints=(levers, pinned, place, jump))
    assert cost == 0.0
    # The oracle: states as sums of steps, one joint set anew at the fourth sample.
    mean, covariance = np.zeros((n, 2)), np.zeros((2, n, n))
    for j in range(2):
        start, first = (3, 0.0) if j == 0 else (0, jump)
        for k in range(n):
            mean[k, j] = place[3, 0] if j == 0 and k >= 3 else place[0, j]
            for m in range(n):
                if (k >= 3) == (m >= 3) or j == 1:
                    since = min(k, m) - (start if j == 1 or min(k, m) >= 3 else 0)
                    covariance[j, k, m] = (jump if j == 0 and min(k, m) < 3 else first) + 1e-6 * since
    lever = levers.reshape(-1, 2)
    sample, constant = np.repeat(np.arange(n), 4), np.tile([0, 1, 3, 2], n)
    whole = sum(np.outer(lever[:, j], lever[:, j]) * covariance[j][np.ix_(sample, sample)] for j in range(2))
    same = (constant[:, None] == constant) & (constant != 3)
    whole = whole + ANYWHERE**2 * same + sd**2 * np.eye(4 * n)
    expected = (lever * mean[sample]).sum(1)
    told = ~((sample == 0) & (constant != 3))  # constants of which nothing is known at first
    full = multivariate_normal(expected, whole).logpdf(values.ravel())
    known = multivariate_normal(expected[~told], whole[np.ix_(~told, ~told)]).logpdf(values.ravel()[~told])
    z = out[0].ravel()[told] ** 2 / (sd**2 * factor[0].ravel()[told])
    got = -0.5 * float((z + np.log(factor[0].ravel()[told]) + np.log(2 * np.pi * sd**2)).sum())
    assert got == pytest.approx(full - known, rel=0.05)


def test_a_joint_that_jumps_unseen_costs_one_choice_and_is_followed():
    n, sd = 30, 0.01
    place = np.where(np.arange(n) < 12, -1.0, 1.0)[:, None] * np.ones(2)
    levers = np.zeros((n, 4, 2))
    levers[:, 2] = 1.0
    rng = np.random.default_rng(0)
    values = (levers * place[:, None]).sum(-1) + sd * rng.standard_normal((n, 4))
    start = np.full((n, 2), -1.0)
    joints = levers, np.zeros((n, 2), bool), start, 4 / 3
    out, factor, cost = _tracked(values, sd, joints=joints, shares=(0.0, 1.0), chance=(0.9, 0.1))
    assert cost == pytest.approx(-(n - 1) * np.log(0.9) - np.log(0.1), abs=2.5)  # at the start it may as well
    jumped = np.flatnonzero(factor[0, :, 2] > 1e3)
    assert 12 in jumped and jumped.size <= 2
    others = np.setdiff1d(np.arange(2, n), jumped)
    assert np.sqrt(np.mean(out[0, others, 2] ** 2 / factor[0, others, 2])) < 1.5 * sd


def test_choices_that_show_in_no_value_cost_nothing():
    n = 30
    joints = np.zeros((n, 4, 2)), np.zeros((n, 2), bool), np.zeros((n, 2)), 4 / 3
    values = np.random.default_rng(0).standard_normal((n, 4))
    cost = _tracked(values, 1.0, joints=joints, shares=(0.0, 1.0), chance=(0.9, 0.1))[2]
    assert cost == pytest.approx(0.0, abs=1e-9)


def _ringing(frequency=6.0, damping=0.05, drive=0.3):
    world = world_of(performance())
    return world._replace(ring=np.array([frequency, damping, drive]))


def test_the_ring_of_a_straight_load_is_exact_and_is_taken_out_again():
    rng = np.random.default_rng(0)
    world = _ringing()
    load = np.asarray(rng.standard_normal(world.force.shape)).cumsum(1)
    read = driven(world, load, back=False)
    np.testing.assert_allclose(driven(world, read, back=True), load, atol=1e-9)
    # The oracle: the mode's response to the load's rate, piecewise constant, on a far finer grid.
    t = np.asarray(world.t[0])
    fine = np.linspace(t[0], t[-1], 40 * (t.size - 1) + 1)
    w, zeta, drive = 2 * np.pi * 6.0, 0.05, 0.3
    damped = w * np.sqrt(1 - zeta**2)
    rate = np.diff(np.interp(fine, t, load[0, :, 0]), append=0) / (fine[1] - fine[0])
    system = ([damped], [1, 2 * zeta * w, w**2])
    ring = lsim(system, rate, fine, interp=False)[1]
    np.testing.assert_allclose(read[0, :, 0] - load[0, :, 0], drive * ring[::40], atol=0.01)


def test_late_forces_are_in_doubt_between_samples_only():
    world = world_of(performance())
    step = float(world.t[0, 1] - world.t[0, 0])
    force = np.repeat(np.where(world.t > 1.0, 2.0, 0.0)[..., None], 4, axis=2)
    for delay, doubtful in ((2.0, False), (2.5, True)):
        late = world._replace(delay=np.asarray(delay * step), modes=np.eye(6)[0])
        out, variance = sensed(late, force)
        assert (float(variance.max()) > 0.1) == doubtful
        assert float(np.abs(out[:, 3:] - force[:, :-3]).max()) <= 2.0
