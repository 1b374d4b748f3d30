"""What is nobody's fault: linear unknowns, the noise and what effects carry of it, blocks that turn."""

from dataclasses import replace

import numpy as np
import pytest
from demo_recordings import recorded

from hmmseg.segmentation.align import align
from simgap.attribution.posterior import fitted, forms, of_noise, products
from simgap.attribution.problem import Candidate, Gap, Rows, cosines, spectrum
from simgap.effects import catalogue
from simgap.effects.base import gradient, swung, tips
from simgap.gap import assemble
from simgap.gap.assemble import SIZES, _density, _likeliest, carried, gap_of, on_other, redrawn, with_noise
from simgap.gap.assemble import _turning as turned_variance
from simgap.gap.frame import CHANNELS, OFFSET, _one_finger, build
from simgap.gap.nuisances import BEYOND, _inertial, _late_rates, _settling, with_nuisances
from simgap.gap.problem import Nuisances, fit, neutral, problem
from simgap.gap.residuals import _misread_moment, residuals, turned
from simgap.gap.rounding import rounding_error, rounding_step
from simgap.phases import Phase


def test_products_are_marginal_and_a_finger_that_presses_on_is_no_gap():
    rng = np.random.default_rng(0)
    columns, a, b = rng.normal(size=(30, 4)), rng.normal(size=(30, 3)), rng.normal(size=30)
    columns[:, 3] = columns[:, 2]  # the same unknown twice
    inverse = np.linalg.inv(np.eye(30) + columns @ columns.T)
    nuisances = Nuisances(columns)
    np.testing.assert_allclose(nuisances.product(a, b), a.T @ inverse @ b, atol=1e-10)
    np.testing.assert_allclose(nuisances.product(a, a), a.T @ inverse @ a, atol=1e-10)
    np.testing.assert_allclose(nuisances.left(b), inverse @ b, atol=1e-10)
    t, force = np.arange(10) / 20.0, np.zeros((10, 4))
    force[0] = -0.065, 0.02, -0.30, -0.41  # the right finger leaves last, while the left one rings
    force[1] = 0.3, 0.2, -0.3, 0.2  # late forces of both
    found = _one_finger(t, force, np.zeros(10, int), np.ones(10, bool), np.array([0.0]), np.full(10, 0.01))
    np.testing.assert_array_equal(np.flatnonzero(found), [0])


@pytest.mark.parametrize(("level", "colour"), [(1.0, 0.0), (1.3, 0.0), (0.8, 0.3)])
def test_level_and_colour_are_found_beside_a_loud_stretch(level, colour):
    rng = np.random.default_rng(1)
    turn = np.tile(np.pi * (np.arange(200) + 0.5) / 200, 10)
    square = level**2 * _density(turn, colour) * rng.standard_normal(turn.size) ** 2
    square[turn < 0.3] *= 50.0  # an effect: slow and large
    found = _likeliest(turn, square)
    assert found[0] == pytest.approx(level, rel=0.08) and found[1] == pytest.approx(colour, abs=0.08)


@pytest.fixture(scope="module")
def given():
    return problem(build(align(*recorded("none_1", 2))))


def test_noise_is_as_stated_in_the_mean_where_it_is_white_noise(given):
    there = given.there
    trial, sample, channel = np.nonzero(there)
    rows = Rows(trial, channel, given.frame.arrays.subtask[trial, sample], given.frame.world.t[trial, sample],
                given.frame.files, CHANNELS, tuple(map(str, range(len(given.frame.steps)))))  # fmt: skip
    sd = with_noise(given, rows, np.random.default_rng(2).standard_normal(trial.size)).sd
    for c, name in enumerate(CHANNELS):
        low, high = (0.55, 1.5) if name in ("vx", "vy") else (0.9, 1.1)
        assert low < np.sqrt(np.mean(sd[channel == c] ** 2)) < high, name
    slow = (channel == CHANNELS.index("vy")) & (sd > np.median(sd[channel == CHANNELS.index("vy")]))
    assert slow.any()  # three samples averaged: louder at low frequencies


def test_blocks_settle_in_the_offset_and_height_alone_and_turn_once_loads_leave_their_feet(given):
    channel, settling = np.nonzero(given.there)[2], _settling(given)
    assert len(settling) == 3 * given.frame.num_trials * given.frame.arrays.onehot.shape[2]
    for column in settling:
        assert set(channel[np.abs(column[:, 0]) > 1e-9]) <= {CHANNELS.index("offset"), CHANNELS.index("y")}
    world, one = given.frame.world._replace(carry=np.zeros((1, 1))), np.ones((1, 1))
    for apart, tips_over in ((1e-4, False), (3e-3, True)):
        force = np.array([[[4.0, 0.05, -4.0, 0.05]]])
        turn, rise, _ = turned(world, 0.4 * one, 0.02 * one, np.array([5.0, 0.0]), force, apart * one)
        assert (turn[0, 0] > 0) == (rise[0, 0] > 0) == tips_over


@pytest.mark.parametrize("off", [0.0, 0.004, -0.002])
def test_a_lifted_block_turns_until_its_moments_balance(given, off):
    """Oracle: the linear equations of a block between two springs that shear and turn, solved by hand."""
    weight, width, give, grip, heights, compliance = 0.4, 0.02, 1 / 2000, 3.0, 0.003, 8.0
    apart = heights + 0.0005  # of the tips; what the contacts are not apart is shear of the pads
    # turn / compliance = grip (heights + width turn) + width / 2 (fy2 - fy1) - weight off,
    # fy2 - fy1 = (apart - heights - width turn) / give
    rate = 1 / compliance - grip * width + width**2 / (2 * give)
    turn = (grip * heights + width / 2 * (apart - heights) / give - weight * off) / rate
    lift = (apart - heights - width * turn) / give
    force = np.array([[[grip, (weight - lift) / 2, -grip, (weight + lift) / 2]]])
    world = given.frame.world._replace(couple=np.asarray(off), carry=np.ones((1, 1)))
    one = np.ones((1, 1))
    found, rise, ease = turned(world, weight * one, width * one, np.array([0.3, 0.7]) * compliance, force,
                               one * (heights + width * turn))  # fmt: skip
    assert found[0, 0] == pytest.approx(turn) and rise[0, 0] == 0.0
    assert ease[0, 0] == pytest.approx(compliance)


@pytest.mark.parametrize("compliance", [0.0, 5.0, 15.0])
def test_an_offset_is_as_noisy_as_the_moment_that_turns_its_block(given, compliance):
    """Monte Carlo: noise of heights and shears through the equation itself."""
    rng, n, world = np.random.default_rng(3), 20_000, given.frame.world
    width, grip, heights, give = 0.02, 3.0, 1e-3, float(np.mean(world.give_shear))
    of_place, of_force = 2e-5, 0.02  # each finger's
    one, zero = np.ones((1, n)), np.zeros((1, n))
    plain = np.zeros((1, n, len(CHANNELS)))
    plain[..., OFFSET] = np.sqrt(2) * np.hypot(of_place, give * of_force)
    plain[..., CHANNELS.index("shear")] = of_force / np.sqrt(2)
    fy1, fy2 = (0.2 + of_force * rng.standard_normal((1, n)) for _ in range(2))
    force = np.stack([grip * one, fy1, -grip * one, fy2], -1)
    apart = heights + np.sqrt(2) * of_place * rng.standard_normal((1, n)) - give * (fy2 - fy1)
    world = world._replace(carry=one)
    turn, _, ease = turned(world, 0.4 * one, width * one, np.array([0.0, compliance]), force, apart)
    arrays = given.frame.arrays._replace(plain=plain)
    sd = np.hypot(plain[..., OFFSET], 3e-5)  # of which a part is no noise
    wider = _misread_moment(world, arrays, width * one, ease, force, sd)
    noise = np.sqrt(np.mean(np.square(wider * sd) - 3e-5**2 + zero))
    assert noise == pytest.approx(np.std(apart - width * turn), rel=0.03)


def test_columns_of_late_speeds_hold_no_noise_of_the_speeds(given):
    """Fitted to it they would smooth it, and its level would come out too low."""
    world, shape = given.frame.world, given.frame.world.rates.shape
    noise = 0.03 * np.random.default_rng(0).standard_normal(shape)
    louder = replace(given, frame=replace(given.frame, world=world._replace(rates=world.rates + noise)))
    arrays, step = given.frame.arrays, float(np.median(np.diff(world.t[0])))
    place, speed = (np.median(arrays.sample[..., CHANNELS.index(c)]) for c in ("x", "vx"))
    assert place / step < speed  # here positions are the quieter
    for before, after in zip(_late_rates(given)[1:], _late_rates(louder)[1:], strict=True):
        np.testing.assert_array_equal(before, after)


def test_a_block_that_turns_frees_all_but_where_it_stands(given):
    free, there = np.zeros(given.weight.shape), given.there
    free[there] = turned_variance(given, 0.02)
    phase = given.frame.arrays.phase
    for c, name in enumerate(CHANNELS):
        cells = (free[..., c] > 0) & there[..., c]
        assert cells.any() == (name in ("y", "distance", "offset"))
        assert not (cells & (phase[..., 1] + phase[..., 3] == 0)).any()
    y = there[..., CHANNELS.index("y")] & (free[..., CHANNELS.index("y")] == 0)
    standing = phase[..., 1] + phase[..., 3] > 0
    grips = {(t, s) for t, n in zip(*np.nonzero(y & standing), strict=True)
             for s in [int(given.frame.arrays.subtask[t, n])]}  # fmt: skip
    assert (y & standing).sum() == len(grips)  # one coefficient of a cell, its mean
    np.testing.assert_allclose(turned_variance(given, 0.04), 4 * turned_variance(given, 0.02))


def test_a_tared_pads_inertia_is_its_mass_times_acceleration_in_free_motion_and_no_weight(given):
    a, (column,) = given.frame.arrays, _inertial(given)
    there, free = given.there, a.phase[..., Phase.FREE] > 0
    world = given.frame.world
    acceleration = np.asarray(gradient(world.t, tips(world)[1]))
    net = BEYOND * (acceleration[..., :2] + acceleration[..., 2:])
    out = np.zeros(there.shape)
    out[there] = column[:, 0]
    for k, name in enumerate(("fx", "fy")):
        c = CHANNELS.index(name)
        mine = there[..., c] & free
        assert mine.sum() > 100
        expected = (net[..., k] * given.weight[..., c])[mine]
        np.testing.assert_allclose(out[..., c][mine], expected, atol=0.02 * np.abs(expected).max())


def test_a_block_that_a_moving_hand_takes_along_stays_there(given):
    world, arrays, step = given.frame.world, given.frame.arrays, 4e-4
    x, stands = CHANNELS.index("x"), arrays.phase[0, :, Phase.PICKUP] * arrays.there[0, :, 0] > 0
    mine = np.flatnonzero(stands)[: np.flatnonzero(np.diff(np.flatnonzero(stands)) > 1)[0] + 1]
    at, by = mine[mine.size // 2], np.zeros(world.t.shape)
    by[0, at:] = step
    (jx, jy), joints = swung(world), world.joints.copy()
    for k in (0, 2):  # both fingers' tips move to the right
        across = jx[..., k] * jy[..., k + 1] - jx[..., k + 1] * jy[..., k]
        joints[..., k] += by * jy[..., k + 1] / across
        joints[..., k + 1] -= by * jy[..., k] / across
    left, moved = {}, world._replace(joints=joints)
    for seen in (0.0, step):
        pushed = arrays.pushed.copy()
        pushed[0, at] += seen
        other = arrays._replace(pushed=pushed)
        raw, factor, _ = residuals(moved, other, given.centre, np.zeros(2), given.noise)
        usual, _, _ = residuals(world, other, given.centre, np.zeros(2), given.noise)
        after = mine[mine > at]  # a filter is off where the step is, and knows it
        left[seen] = float(np.abs(raw - usual)[0, after, x].max())
        assert (factor[0, at, x] > 5) == (seen > 0)
    assert left[0.0] > 0.5 * step and left[step] < 0.1 * step


def test_a_block_that_stood_on_a_slope_turns_back_as_it_is_lifted(given):
    world, arrays = given.frame.world, given.frame.arrays
    tilted = catalogue()["table_tilt"].correct(world, {"angle": 0.02, "turned": 0.8}, 1.0)
    offset, width = CHANNELS.index("offset"), arrays.onehot @ (arrays.objects @ given.centre[:, 1])
    change = [residuals(w, arrays, given.centre, np.zeros(2), given.noise)[0][..., offset]
              for w in (world, tilted)]  # fmt: skip
    change = (change[1] - change[0])[0] * (arrays.there[0, :, offset] > 0)
    held, move = arrays.onehot[0, :, 0] > 0, width[0][arrays.onehot[0, :, 0] > 0][0]
    there = held & (arrays.there[0, :, offset] > 0)
    # Predictions from the samples before miss it once, at the first that is in the air.
    first = np.flatnonzero(there & (arrays.phase[0, :, Phase.CARRY] > 0))[0]
    assert change[first] == pytest.approx(0.02 * 0.8 * move, rel=0.05) and np.abs(change[:first]).max() < 1e-9


GIVE, FORCE_SD, PLACE_SD, TRIALS, SAMPLES = 1.0, 1.0, 0.3, 4, 150


def softer(true: float, swing: float, seed: int = 0, error: float = 0.0) -> Gap:
    """A place that a force moves, place = (GIVE + true) force, with noise; the effect is another give."""
    rng, n = np.random.default_rng(seed), TRIALS * SAMPLES
    trial, k = np.divmod(np.arange(n), SAMPLES)
    nothing = np.zeros(n, int)
    rows = Rows(trial, nothing, nothing, k / 20.0, tuple(f"t{i}" for i in range(TRIALS)), ("c",), ("p",))
    force = swing * rng.standard_normal(n)
    place = (GIVE + true) * force + error * rng.standard_normal(n)
    sd = np.hypot(PLACE_SD, GIVE * FORCE_SD)
    draws, columns = [], None
    for kept in (True, False, False, False, False):
        f_noise, p_noise = FORCE_SD * rng.standard_normal(n), PLACE_SD * rng.standard_normal(n)
        # residual, shift, derivative
        one = np.stack([p_noise - GIVE * f_noise, np.zeros(n), f_noise], 1) / sd
        if kept:
            columns = np.stack([place - GIVE * force, np.zeros(n), force], 1) / sd + one
        else:
            draws.append(one)
    far, zero = np.full(1, np.inf), np.zeros(1)
    pad = Candidate("softer", ("give",), zero, zero, np.ones(1), columns[:, 1], columns[:, 2:], -far, far)
    return Gap(rows, columns[:, 0], np.zeros((n, 0)), (pad,), carried=np.stack(draws) / np.sqrt(len(draws)))


def linearised(gap: Gap) -> Gap:
    """The gap about the effect's own least squares, as a fit would give it."""
    (pad,) = gap.candidates
    own = pad.jacobian[:, 0]
    at = np.array([own @ gap.residual / (own @ own)])
    more, noise = replace(pad, at=at, shift=own * at[0]), gap.carried.copy()
    noise[:, :, 1] = at[0] * noise[:, :, 2]
    return replace(gap, candidates=(more,), carried=noise)


def test_products_of_noise_are_their_expectations():
    gap = linearised(softer(0.0, 0.0))
    s, (pad,) = spectrum(gap), gap.candidates
    found, variance = of_noise(gap, s)[:, :, :].sum(0), np.hypot(PLACE_SD, GIVE * FORCE_SD) ** 2
    n, at = gap.residual.size, pad.at[0]
    with_residual, square = -GIVE * FORCE_SD**2 / variance * n, FORCE_SD**2 / variance * n
    # About `at`: d0'J stays, the constant part is at J - at J, and no curvature is taken off.
    assert found[0, 0] == 0 and found[2, 2] == 0 and found[0, 2] == pytest.approx(with_residual, rel=0.15)
    assert found[0, 1] == pytest.approx(0.0, abs=0.02 * n)
    assert found[1, 2] == pytest.approx(at * square, rel=0.15)
    assert found[1, 1] == pytest.approx(-(at**2) * square, rel=0.15)
    assert products(s.columns, s.group).sum(0)[0, 0] == pytest.approx(gap.residual @ gap.residual)


@pytest.mark.parametrize("error", [0.0, 1.0])
def test_noise_alone_is_no_effect_and_an_effect_has_its_own_size(error):
    gap = linearised(softer(0.0, 1.0, error=error))
    blind, told = forms(replace(gap, carried=None)), forms(gap)
    gained = [fitted(f, (0,)).score - fitted(f, ()).score for f in (blind, told)]
    assert gained[0] > 25.0  # stiffer pads leave less of the force's noise
    assert gained[1] < 2.0
    found = []
    for seed in range(6):
        gap = linearised(softer(0.5, 4.0, seed, error))
        found.append([fitted(forms(g), (0,)).x[0] for g in (replace(gap, carried=None), gap)])
    blind, told = np.mean(found, axis=0)
    assert blind < 0.45  # 1.5 / (1 + 1/16) - 1
    assert told == pytest.approx(0.5, abs=0.02)


@pytest.fixture(scope="module")
def marginal():
    return with_nuisances(problem(build(align(*recorded("none_1", 4)))))


def test_residuals_of_redrawn_recordings_have_the_noise_that_they_are_measured_by(marginal):
    healthy = fit(marginal, (), neutral(marginal))
    noise = carried(healthy.residual[:, None], redrawn(marginal),
                    lambda other: on_other(other, healthy).residual[:, None])  # fmt: skip
    there, arrays = marginal.there, marginal.frame.arrays
    channel, doubted = np.nonzero(there)[2], (arrays.sd / arrays.plain)[there]
    square = np.square(noise[..., 0] * doubted).sum(0)
    for c in range(1, 10):  # of sensors alone, what is in doubt besides left out; x has its grips' mean taken
        assert square[channel == c].mean() == pytest.approx(1.0, abs=0.2)


@pytest.mark.parametrize("shown", [0.9999, 1.0001])
def test_which_measured_properties_show_does_not_depend_on_the_noise_redrawn(marginal, shown, monkeypatch):
    """The most visible one is hardly a candidate, or the least visible one just is."""
    healthy = fit(marginal, (), neutral(marginal))
    measured = replace(marginal, measured=np.ones_like(marginal.measured))
    size = [np.square(c.jacobian * c.scale).sum() for c in assemble._measured(measured, healthy)]
    monkeypatch.setattr(assemble, "SHOWN", (min(size) if shown > 1 else max(size)) / shown)
    gap = gap_of(measured, healthy, [], (), redrawn(measured))
    names = [p for c in gap.candidates for p in c.parameters]
    assert gap.carried.shape[2] == gap.raw_columns.shape[1]
    assert len(names) == (marginal.sd.size if shown > 1 else 0)


def test_what_does_not_act_in_proportion_is_missing():
    force = np.array([[0.5], [-0.9], [3.0]])
    contact = lambda step: np.maximum(force + step, 0.0)  # noqa: E731 - noise makes the second contact, at full size
    noise = carried(contact(0.0), SIZES * 2, contact)
    np.testing.assert_allclose(np.square(noise[..., 0]).sum(0), [1.0, 0.0, 1.0], rtol=1e-6)


@pytest.mark.parametrize("size", [0.3, 1.5, 8.0, 20.0])
@pytest.mark.parametrize("rate", [0.02, 0.2])
def test_most_of_the_rounding_of_a_moving_force_shows_whatever_its_speed(size, rate):
    """A string pulled tight within half a step of each reading cuts corners and errs more than readings."""
    t = np.arange(600)
    force = size * np.sin(rate * t + 1) + 0.37 + 0.1 * np.random.default_rng(0).standard_normal(t.size)
    read = np.round(force)
    left = read - force - rounding_error(read[:, None], 1.0)[:, 0]
    assert np.var(left) < 0.5 * np.var(read - force)
    assert size < 2 or rounding_step([read[:500], read[500:]]) == pytest.approx(1.0, rel=1e-3)
    # nothing shows of what rests or jumps
    flat = np.stack([np.full(600, 3.0), np.where(t < 300, -2.0, 5.0)], 1)
    assert rounding_step([force[:, None]]) == 0.0 and np.abs(rounding_error(flat, 1.0)).max() < 1e-9


@pytest.mark.parametrize("true", [0.0, 0.5])
def test_rounding_alone_is_no_effect_and_hides_none(true):
    """Pads are softer by `true`; the force moves by some steps, to which it is rounded."""
    gained, size, step = [], [], 1.0
    for seed in range(6):
        rng = np.random.default_rng(seed)
        trial, k = np.divmod(np.arange(TRIALS * SAMPLES), SAMPLES)
        force = 0.7 * step * np.sin(0.2 * k + 6 * rng.random(TRIALS)[trial])
        force += step * rng.random(TRIALS)[trial] + 0.05 * rng.standard_normal(k.size)  # no two rounded alike
        read = step * np.round(force / step)
        error = np.concatenate([rounding_error(read[trial == r, None], step)[:, 0] for r in range(TRIALS)])
        sd = np.hypot(PLACE_SD, GIVE * step / np.sqrt(12))
        left = (GIVE + true) * force + PLACE_SD * rng.standard_normal(k.size) - GIVE * read
        nothing = np.zeros(k.size)
        columns = np.stack([left, nothing, read], 1) / sd
        noise = np.stack([-GIVE * error, nothing, error], 1) / sd
        gap = softer(0.0, 1.0)
        (pad,) = gap.candidates
        pad = replace(pad, shift=nothing, jacobian=columns[:, 2:])
        gap = replace(gap, residual=columns[:, 0], candidates=(pad,), carried=None)
        fs = forms(gap), forms(replace(gap, carried=cosines(gap.rows, noise)[0][None]))
        gained.append([fitted(f, (0,)).score - fitted(f, ()).score for f in fs])
        size.append([fitted(f, (0,)).x[0] for f in fs])
    (blind, told), (small, right) = np.mean(gained, axis=0), np.mean(size, axis=0)
    if true == 0:
        assert blind > 20 and told < 2
    else:
        assert abs(right - true) < 0.5 * abs(small - true)
