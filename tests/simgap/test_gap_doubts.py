"""What corrections leave in doubt: slides, dead bands, forces between samples, rings; against oracles."""

import numpy as np
import pytest
from scipy.signal import lsim
from scipy.stats import multivariate_normal

from simgap.channels import play
from simgap.effects.geometry import within
from simgap.gap.residuals import ANYWHERE, SLIDE, _followed, driven, sensed
from tests.simgap.test_gap_effects import performance, world_of


def _cost(values, weight, sd, slip, grips) -> float:
    out, factor = _followed(*(np.asarray(z)[None] for z in (values, weight, sd, SLIDE * slip, grips)))
    out, factor = np.asarray(out)[0], np.asarray(factor)[0]
    return float(0.5 * ((out / sd) ** 2 / factor + np.log(factor)).sum())


def test_a_slide_is_a_random_walk_marginalised_exactly():
    rng = np.random.default_rng(0)
    n, sd = 12, 2e-5
    slip = np.zeros(n)
    slip[[4, 5]] = 1.0
    walk = np.maximum(slip, np.concatenate([slip[:1], slip[:-1]])) * SLIDE
    for values in (rng.normal(0, sd, n), np.where(np.arange(n) > 4, 1e-3, 0.0) + rng.normal(0, sd, n)):
        # The oracle: the joint normal density of all samples but the first, given the first.
        steps = np.cumsum(walk**2 * (np.arange(n) > 0))
        covariance = np.minimum.outer(steps, steps) + ANYWHERE**2 + sd**2 * np.eye(n)
        whole = multivariate_normal(np.full(n, values[0]), covariance).logpdf(values)
        first = multivariate_normal(values[0], ANYWHERE**2 + sd**2).logpdf(values[0])
        plain = -0.5 * (n - 1) * np.log(2 * np.pi * sd**2)
        cost = _cost(values, np.ones(n), np.full(n, sd), slip, np.ones((n, 1)))
        assert cost == pytest.approx(-(whole - first - plain), abs=2e-3)


def test_a_new_grip_and_unknown_samples_tell_nothing():
    values = np.array([0.0, 0.0, 3e-3, 3e-3, 9.0, 3e-3])
    grips = np.eye(2)[[0, 0, 1, 1, 1, 1]]
    weight = np.array([1.0, 1.0, 1.0, 1.0, 0.0, 1.0])
    assert _cost(values, weight, np.full(6, 2e-5), np.zeros(6), grips) < 1.5


def test_a_joint_lies_where_it_was_pushed_to():
    rng = np.random.default_rng(0)
    t, width = np.arange(200) / 20, 4e-3
    true = 0.05 * np.sin(2 * np.pi * 0.2 * t)[:, None] * np.ones(4)
    played = np.stack([play(each, width) for each in true.T], 1)
    recorded = played + 1e-4 * rng.standard_normal(true.shape)
    half, inner = width / 2, slice(10, -10)

    def off_and_variance(rates, unseen: float) -> tuple[np.ndarray, np.ndarray]:
        world = world_of(performance())._replace(
            t=np.asarray(t)[None], joints=np.asarray(recorded)[None], rates=np.asarray(rates)[None]
        )
        place, variance = (
            np.asarray(z)[0, inner] for z in within(world, np.asarray(half), np.asarray(unseen))
        )
        return ((true - recorded)[inner] - place) / half, variance / half**2

    # An encoder's speeds say nothing of the dead band.
    off, blind = off_and_variance(np.gradient(recorded, t, axis=0), 1.0)
    sure = blind < 0.02
    assert sure.mean() > 0.7
    assert np.sqrt(np.mean(off[sure] ** 2)) < 0.15
    assert 0.3 < np.sqrt(np.mean(off[~sure] ** 2 / blind[~sure])) < 1.5
    # A tachometer's say how the joint crosses it.
    off, variance = off_and_variance(
        np.gradient(true, t, axis=0) + 2e-3 * rng.standard_normal(true.shape), 0.0
    )
    assert variance.sum() < 0.2 * blind.sum()
    assert np.sqrt(np.mean(off**2)) < 0.15


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
