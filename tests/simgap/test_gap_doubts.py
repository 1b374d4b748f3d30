"""What corrections leave in doubt: slides, dead bands, late and slow forces, rings, supports."""

import numpy as np
import pytest
from scipy.signal import lfilter, lsim
from scipy.stats import multivariate_normal

from simgap.channels import play
from simgap.effects.base import LATE, SMOOTH, YIELDING
from simgap.effects.geometry import within
from simgap.gap.diagnose import _summary
from simgap.gap.residuals import ANYWHERE, contact, doubt_between, driven, sensed, shifted, sunk
from simgap.recursions import tracked
from tests.simgap.test_gap_effects import performance, world_of

STEP = 0.05  # s


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


def test_new_grips_unknown_samples_and_choices_that_show_nowhere_tell_nothing():
    values = np.array([0.0, 0.0, 3e-3, 3e-3, 9.0, 3e-3])
    known = np.array([1.0, 1.0, 1.0, 1.0, 0.0, 1.0])
    of, weight = _alone(values, 3)
    new = (np.arange(6) == 2)[:, None]
    assert _cost(_tracked(of, 2e-5, weight=known[:, None] * weight, new=new), 2e-5, 3) < 1.5
    n = 30
    joints = np.zeros((n, 4, 2)), np.zeros((n, 2), bool), np.zeros((n, 2)), 4 / 3
    values = np.random.default_rng(0).standard_normal((n, 4))
    cost = _tracked(values, 1.0, joints=joints, shares=(0.0, 1.0), chance=(0.9, 0.1))[2]
    assert cost == pytest.approx(0.0, abs=1e-9)


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


def test_the_ring_of_a_straight_load_is_exact_and_is_taken_out_again():
    rng = np.random.default_rng(0)
    world = world_of(performance())._replace(ring=np.array([6.0, 0.05, 0.3]))  # frequency, damping, drive
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


def _slow(force, time: float):
    """A world whose forces (N,) are all the same and pass a low-pass of `time` [s]."""
    world = world_of(performance(10 * len(force)))
    every = np.repeat(np.asarray(force)[None, :, None], 4, axis=2)
    return world._replace(force=every, smoothing=np.asarray(time), modes=np.eye(6)[SMOOTH])


def _recorded(force_of, time: float, n: int) -> np.ndarray:
    """Forces (n,) after an exact low-pass on a grid a hundred times finer."""
    fine, keep = np.arange(100 * n) * STEP / 100, np.exp(-STEP / 100 / time)
    return np.asarray(lfilter([1 - keep], [1, -keep], force_of(fine)))[::100]


@pytest.mark.parametrize("time", [0.06, 0.15])
def test_smooth_forces_are_found_behind_a_low_pass(time):
    t = np.arange(80) * STEP

    def force(at):
        return 1.5 + np.sin(2 * np.pi * 1.5 * at)

    recorded = _recorded(force, time, 80)
    found = np.asarray(contact(_slow(recorded, time)))[0, :, 0]
    three = recorded + time * np.gradient(recorded, STEP)
    off, plain = (np.abs(z - force(t))[20:-5] for z in (found, three))
    slope = np.abs(np.diff(recorded, prepend=0))[20:-5]
    steep = slope > 0.6 * slope.max()
    assert np.sqrt((off[steep] ** 2).mean()) < 0.7 * np.sqrt((plain[steep] ** 2).mean())
    assert off.max() < 0.08  # beside a crest that falls unevenly on its samples


def test_a_corner_behind_a_low_pass_is_in_doubt_and_no_force_comes_before_its_contact():
    t, onset = np.arange(60) * STEP, 20.4 * STEP

    def force(at):
        return 4.0 * np.maximum(at - onset, 0.0)

    found = np.asarray(contact(_slow(_recorded(force, 0.1, 60), 0.1)))[0, :, 0]
    assert np.abs(found[:21]).max() < 0.02 and np.abs(found - force(t))[24:-5].max() < 0.05
    ramp = 3.0 * np.maximum(np.arange(60) - 20, 0.0) * STEP
    variance = np.asarray(doubt_between(_slow(ramp, 0.1)))[0, :, 0]
    assert variance[18:23].max() > 1e-3 and variance[25:-5].max() < 1e-6


@pytest.mark.parametrize("share", [0.1, 0.5, 0.9])
def test_a_contact_between_two_samples_is_read_on_either_side_of_it(share):
    t = np.arange(40.0)
    force = 0.8 * np.maximum(t - 19.6, 0.0)
    found = np.asarray(shifted(np.asarray(force)[None, :, None], np.asarray(share)))[0, :, 0]
    true = 0.8 * np.maximum(t + share - 19.6, 0.0)
    assert np.abs(found - true)[:-3].max() < 0.03


def test_values_between_samples_are_cubic_and_at_their_own_samples_themselves():
    # A grip that closes within one sample and goes on to close: its sides meet nowhere between the two.
    force = np.repeat([0.0, 0.01, 2.7, 3.1, 3.1, 0.4, 0.0], 2)
    for share in (0.0, 1e-9):
        found = np.asarray(shifted(np.asarray(force)[None, :, None], np.asarray(share)))[0, :, 0]
        np.testing.assert_allclose(found, force, atol=1e-6)
    jump = np.array([0.0, 0.0, 0.0, 2.7, 3.1, 3.1])
    found = np.asarray(shifted(np.asarray(jump)[None, :, None], 0.2))[0, 2, 0]
    assert found == pytest.approx(0.2 * 2.7, abs=0.05)
    t = np.arange(60.0)
    found = np.asarray(shifted(np.asarray(np.sin(0.4 * t))[None, :, None], 0.5))[0, 3:-3, 0]
    wave = np.sin(0.4 * (t + 0.5))[3:-3]
    off = np.abs(found - wave)
    assert off.max() < 0.05  # a crest between two samples is taken for a blunt corner
    assert off[np.abs(wave) < 0.8].max() < 0.001


@pytest.mark.parametrize("steps", [0.4, 2.4])
def test_a_late_force_is_in_doubt_where_it_is_read(steps):
    world, force = world_of(performance(600)), np.where(np.arange(60) >= 30, 2.0, 0.0)
    world = world._replace(force=np.repeat(force[None, :, None], 4, axis=2),
                           delay=np.asarray(steps) * np.median(world.t[:, 1:] - world.t[:, :-1]),
                           modes=np.eye(6)[LATE])  # fmt: skip
    variance = np.asarray(doubt_between(world))[0, :, 0]
    assert variance.argmax() == 29 - int(steps)
    # It came at any moment between the two samples: at least the variance of one that came midway.
    assert variance.max() > 0.3**2 and variance[:20].max() == 0.0


def test_a_support_settles_like_a_spring_beside_a_damper():
    n, time, give = 60, 0.04, 4e-4
    world, t = world_of(performance(10 * n)), np.arange(n) * STEP
    carry = ((t > 1.0) & (t < 2.0)).astype(float)
    world = world._replace(give_support=np.asarray(give), support_time=np.asarray(time),
                           carry=np.asarray(carry)[None], free=np.zeros((1, n)),
                           ground=np.asarray(1 - carry)[None], modes=np.eye(6)[YIELDING])  # fmt: skip
    load = np.where(t >= 2.0, np.minimum(3.0 * (t - 2.0 + STEP), 0.8), 0.5)
    depth = np.asarray(sunk(world, np.asarray(load)[None]))[0]
    borne = load * (1 - carry)
    after = t > 1.5  # what is in the air weighs on nothing: the oracle starts from rest
    oracle = lsim(([give], [time, 1.0]), borne[after], t[after] - t[after][0])[1]
    np.testing.assert_allclose(depth[after], oracle, atol=1e-9)
    np.testing.assert_allclose(depth[t < 1.0], give * 0.5, atol=1e-9)


def test_a_parameter_whose_inverse_was_fitted_has_the_spread_of_its_interval():
    """The inverse of a normal compliance that reaches zero has no standard deviation of its own."""
    draws = 1 / np.random.default_rng(0).normal(5e-5, 1.5e-5, 2000)
    found = _summary(draws, "N/m")
    low, high = found["interval_90"]
    assert 0.1 < found["sd"] / (high - low) < 0.5
