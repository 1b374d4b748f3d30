"""Noise that effects carry along, taken off the products of columns: closed forms and planted effects."""

from dataclasses import replace

import numpy as np
import pytest
from demo_recordings import recorded

from hmmseg.io.trial import Trial
from hmmseg.segmentation.align import align
from simgap.attribution.posterior import fitted, forms, of_noise, products
from simgap.attribution.problem import Candidate, Gap, Rows, cosines, spectrum
from simgap.gap import assemble
from simgap.gap.assemble import SIZES, carried, gap_of, on_other, redrawn
from simgap.gap.frame import build, without_dropouts
from simgap.gap.nuisances import with_nuisances
from simgap.gap.problem import fit, neutral, problem
from simgap.gap.rounding import rounding_error, rounding_step

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
        one = (
            np.stack([p_noise - GIVE * f_noise, np.zeros(n), f_noise], 1) / sd
        )  # residual, shift, derivative
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
def given():
    return with_nuisances(problem(build(align(*recorded("none_1", 4)))))


def test_residuals_of_redrawn_recordings_have_the_noise_that_they_are_measured_by(given):
    healthy = fit(given, (), neutral(given))
    noise = carried(healthy.residual[:, None], redrawn(given),
                    lambda other: on_other(other, healthy).residual[:, None])  # fmt: skip
    there, arrays = given.there, given.frame.arrays
    channel, doubted = np.nonzero(there)[2], (arrays.sd / arrays.plain)[there]
    square = np.square(noise[..., 0] * doubted).sum(0)
    for c in range(1, 10):  # of sensors alone, what is in doubt besides left out; x has its grips' mean taken
        assert square[channel == c].mean() == pytest.approx(1.0, abs=0.2)


@pytest.mark.parametrize("shown", [0.9999, 1.0001])
def test_which_measured_properties_show_does_not_depend_on_the_noise_redrawn(given, shown, monkeypatch):
    """The most visible one is hardly a candidate, or the least visible one just is."""
    healthy = fit(given, (), neutral(given))
    measured = replace(given, measured=np.ones_like(given.measured))
    size = [np.square(c.jacobian * c.scale).sum() for c in assemble._measured(measured, healthy)]
    monkeypatch.setattr(assemble, "SHOWN", (min(size) if shown > 1 else max(size)) / shown)
    gap = gap_of(measured, healthy, [], (), redrawn(measured))
    names = [p for c in gap.candidates for p in c.parameters]
    assert gap.carried.shape[2] == gap.raw_columns.shape[1]
    assert len(names) == (given.sd.size if shown > 1 else 0)


def test_what_is_lost_or_does_not_act_in_proportion_is_missing():
    force = np.array([[0.5], [-0.9], [3.0]])
    contact = lambda step: np.maximum(force + step, 0.0)  # noqa: E731 - noise makes the second contact, at full size
    noise = carried(contact(0.0), SIZES * 2, contact)
    np.testing.assert_allclose(np.square(noise[..., 0]).sum(0), [1.0, 0.0, 1.0], rtol=1e-6)
    t = np.arange(12) / 100
    grip = np.array([0, 0, 2.0, 2.1, 0.01, 2.0, 2.0, 0, 0, 0.5, 0, 3.0])
    channels = {"fx1": grip, "fy1": 0.2 * grip, "fx2": -grip, "fy2": 0.2 * grip, "x1": t}
    found = without_dropouts(Trial("trial.csv", t, channels))
    np.testing.assert_array_equal(np.flatnonzero(np.isnan(found.channels["fx1"])), [4])
    np.testing.assert_array_equal(np.flatnonzero(np.isnan(found.channels["fy2"])), [4])
    np.testing.assert_array_equal(found.channels["x1"], t)


def test_rounding_shows_in_a_force_that_moves_and_not_in_one_that_rests_or_jumps():
    t = np.arange(800) / 200
    force = 2 + np.stack([0.5 * np.sin(2 * t), 0.2 * t, 0.06 + 0 * t, np.where(t < 2, -2.0, 0.5)], 1)
    force += 2e-3 * np.random.default_rng(0).standard_normal(force.shape)
    read = 0.05 * np.round(force / 0.05)
    step = rounding_step([read[:500], read[500:]])
    assert step == pytest.approx(0.05, rel=1e-3) and rounding_step([force]) == 0.0
    true, shown = read - force, rounding_error(read, step)
    left = np.std(true - shown, axis=0) / np.std(true, axis=0)
    assert (left[:2] < 0.5).all() and np.abs(shown[:, 2:]).max() < 1e-9


@pytest.mark.parametrize("size", [0.3, 1.5, 8.0, 20.0])
@pytest.mark.parametrize("rate", [0.02, 0.2])
def test_most_of_the_rounding_of_a_moving_force_shows_whatever_its_speed(size, rate):
    """A string pulled tight within half a step of each reading cuts corners and errs more than readings."""
    t = np.arange(600)
    force = size * np.sin(rate * t + 1) + 0.37 + 0.1 * np.random.default_rng(0).standard_normal(t.size)
    read = np.round(force)
    left = read - force - rounding_error(read[:, None], 1.0)[:, 0]
    assert np.var(left) < 0.5 * np.var(read - force)


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
