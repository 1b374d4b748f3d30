"""Evidence of a candidate against numerical integration, and starts that a search cannot do without."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import trapezoid
from scipy.optimize import lsq_linear
from scipy.special import logsumexp

from hmmseg.example import example_folder
from hmmseg.io.rig import read_rig
from hmmseg.io.task import read_task
from hmmseg.io.trial import Trial, read_trial
from simgap.effects import catalogue
from simgap.gap.diagnose import diagnose
from simgap.gap.fit import Fitted, Problem, limits, slots
from simgap.gap.judge import SCALES, TIED, coincidence, heldout, log_evidence, newton

NOTHING = object.__new__(Problem)  # a problem of no blocks: evidence reads no more of it
object.__setattr__(NOTHING, "centre", np.zeros((0, 3)))


def _columns(effect: str) -> np.ndarray:
    slot = next(s for s in slots(0)[0] if s.effect.name == effect)
    return np.arange(slot.start, slot.stop)


def _fitted(effect: str, bend: np.ndarray, centre: np.ndarray, floor: float) -> Fitted:
    """A candidate whose likelihood is exp(-floor - (u - centre)' bend (u - centre) / 2)."""
    columns, u = _columns(effect), np.zeros(slots(0)[1])
    low, high = limits(NOTHING)
    best = np.linalg.solve(bend + np.eye(len(columns)), bend @ centre)
    u[columns] = np.clip(best, low[columns], high[columns])
    at = u[columns]
    square = 2 * floor + (at - centre) @ bend @ (at - centre)
    cost = 0.5 * square + 0.5 * at @ at
    gradient = bend @ (at - centre)
    return Fitted((effect,), u, columns, bend[None, None], gradient[None, None], np.array([[square]]), cost)


def _none() -> Fitted:
    empty = np.zeros((1, 1, 0))
    return Fitted((), np.zeros(slots(0)[1]), np.arange(0), empty[..., None], empty, np.zeros((1, 1)), 0.0)


@pytest.mark.parametrize(("centre", "precision"), [(0.02, 400.0), (0.3, 2500.0), (2.0, 100.0)])
def test_one_amplitude_of_unknown_size(centre, precision):
    found = _fitted("force_gain", np.array([[precision]]), np.array([centre]), -3.0)
    u = np.linspace(-6, 6, 400_001)
    prior = np.mean([np.exp(-0.5 * (u / s) ** 2) / s / np.sqrt(2 * np.pi) for s in SCALES], axis=0)
    expected = np.log(trapezoid(np.exp(3.0 - 0.5 * precision * (u - centre) ** 2) * prior, u))
    assert log_evidence(NOTHING, found, _none()) == pytest.approx(expected, abs=1e-3)


def test_four_amplitudes_share_their_size():
    rng = np.random.default_rng(3)
    root = rng.normal(size=(4, 4))
    bend, centre = 300 * (root @ root.T + np.eye(4)), np.array([0.1, -0.05, 0.08, 0.02])
    found = _fitted("force_bias", bend, centre, -5.0)
    each = []
    for s in SCALES:  # the normal density of the centre, measured with precision bend, drawn at size s
        cov = np.linalg.inv(bend) + s**2 * np.eye(4)
        inside = -0.5 * centre @ np.linalg.solve(cov, centre)
        each.append(inside - 0.5 * (np.linalg.slogdet(cov)[1] + np.linalg.slogdet(bend)[1]))
    expected = 5.0 + np.log(np.mean(np.exp(each)))
    assert log_evidence(NOTHING, found, _none()) == pytest.approx(expected, abs=1e-6)


def test_small_amplitudes_cost_less_than_their_prior_would_have_it():
    count = len(_columns("structural_vibration"))
    bend, centre = np.eye(count) * 2500.0, np.full(count, 0.05)
    found = _fitted("structural_vibration", bend, centre, -40.0)
    alone = 40.0 - 0.5 * np.linalg.slogdet(np.eye(count) + bend)[1]
    assert log_evidence(NOTHING, found, _none()) > alone + 20


def _tied(rows, bend, centre):
    """Log density of a centre measured with precision `bend`, of amplitudes in the space of `rows`."""
    basis = np.linalg.qr(np.array(rows).T)[0]
    inside = basis @ basis.T
    each = []
    for s in SCALES:
        cov = np.linalg.inv(bend) + s**2 * (inside + TIED**2 * (np.eye(len(centre)) - inside))
        each.append(-0.5 * centre @ np.linalg.solve(cov, centre) - 0.5 * np.linalg.slogdet(cov)[1])
    return logsumexp(each) - np.log(len(each))


@pytest.mark.parametrize(
    ("name", "centre", "alike"),
    [
        ("joint_offset", (1.5, 1.5, 1.5, 1.5), True),
        ("joint_offset", (0.15, 0.05, 0.16, 0.04), True),
        ("joint_offset", (1.5, 0.3, -0.8, 0.4), False),
        ("force_drift", (-0.4, 0.0, 0.4, 0.0), True),
        ("force_bias", (0.5, 0.0, 0.0, 0.3), False),
    ],
)
def test_parts_that_err_alike_against_their_closed_form(name, centre, alike):
    rng = np.random.default_rng(5)
    root, centre = rng.normal(size=(4, 4)), np.array(centre)
    precise = 2000 * (root @ root.T / 4 + np.eye(4))
    columns = _columns(name)
    bend, at = np.eye(len(columns)), np.zeros(len(columns))  # a drift's bend is of its own
    bend[:4, :4], at[:4] = precise, centre
    found = _fitted(name, bend, at, -50.0)
    ties = [_tied(rows, precise, centre) for rows in catalogue()[name].ties]
    expected = logsumexp(ties) - np.log(len(ties)) - _tied(np.eye(4), precise, centre)
    assert coincidence(NOTHING, found) == pytest.approx(expected, abs=1e-6)
    assert (expected > 1.5) == alike and (expected < -5) != alike


def test_an_effect_of_one_part_cannot_err_alike():
    found = _fitted("force_gain", np.array([[900.0]]), np.array([1.0]), 0.0)
    assert coincidence(NOTHING, found) == -np.inf


def test_what_a_limit_keeps_out_gains_nothing():
    delay = _columns("force_lag")
    assert limits(NOTHING)[0][delay] == 0.0 and catalogue()["force_lag"].parameters[0].amplitude
    found = _fitted("force_lag", np.array([[400.0]]), np.array([-0.5]), 0.0)
    assert found.u[delay] == 0.0
    nothing = -0.5 * 400.0 * 0.5**2
    assert log_evidence(NOTHING, found, _none()) <= nothing + 1e-6


def test_what_lies_past_a_limit_gains_nothing():
    # A search that stopped a step before the limit, where its slope still said that there was much to gain.
    low = float(limits(NOTHING)[0][_columns("force_lowpass")][0])
    found = _fitted("force_lowpass", np.array([[3e5]]), np.array([low - 0.01]), 0.0)
    stopped = found.u.copy()
    stopped[found.columns] = low + 1e-3
    slope = np.full_like(found.gradient, 2500.0)
    stuck = replace(found, u=stopped, gradient=slope, square=np.zeros((1, 1)), cost=0.5 * low**2)
    assert log_evidence(NOTHING, stuck, _none()) < 2500.0 * 1e-3 + 1.0  # what the slope gains up to the limit

    trials = {k: np.repeat(getattr(stuck, k), 2, axis=0) for k in ("hessian", "gradient")}
    both = replace(stuck, **trials, square=np.full((2, 1), 20.0))
    step = low - stopped[found.columns]  # each trial, told by the other alone, would go far past the limit
    expected = 20.0 + 2 * 2500.0 * step + 3e5 * step**2
    np.testing.assert_allclose(heldout(NOTHING, both, np.array([[0], [1]]), 2), np.full((2, 1), expected))


@pytest.mark.parametrize("seed", range(6))
def test_a_bounded_step_against_a_solver_of_bounded_least_squares(seed):
    rng = np.random.default_rng(seed)
    root, u = rng.normal(size=(8, 4)), rng.uniform(-0.5, 0.5, 4)
    low, high = np.full(4, -1.0), np.full(4, 1.0)
    wanted = root @ rng.normal(size=4) * 1.5
    hessian, slope = root.T @ root, root.T @ (root @ u - wanted)
    step = newton(hessian, slope, u, low, high)
    assert (u + step >= low - 1e-12).all() and (u + step <= high + 1e-12).all()
    best = lsq_linear(root, wanted, (low, high)).x - u

    def gain(d):
        return -slope @ d - 0.5 * d @ hessian @ d

    free = -np.linalg.solve(hessian, slope)
    assert 0.85 * gain(best) <= gain(step) <= gain(best) + 1e-9 <= gain(free) + 1e-8


def _ringing(trial: Trial, events: np.ndarray) -> Trial:
    """A mode of 3.2 Hz, rung by every contact change; `events` [s]."""
    since, omega = trial.t[:, None] - events, 2 * np.pi * 3.2
    ring = np.where(since >= 0, np.exp(-0.08 * omega * since.clip(0)) * np.sin(omega * since), 0.0).sum(1)
    changed = {c: trial.channels[c] + 0.2 * ring for c in ("fy1", "fy2")}
    return replace(trial, channels=trial.channels | changed)


def test_a_vibration_is_sought_with_its_amplitudes():
    # Without amplitudes a frequency has no slope: searches ended 2 Hz away.
    folder = example_folder()
    rig, task = read_rig(folder / "rig.toml"), read_task(folder / "task.toml")
    quiet = [read_trial(folder / f"trial_{k:02d}.csv", rig) for k in (1, 2, 3, 4)]
    events = np.asarray(diagnose(quiet, task, rig).problem.frame.world.events)
    body = diagnose([_ringing(t, events[k]) for k, t in enumerate(quiet)], task, rig).body
    assert body["causes"] == ["structural_vibration"]
    found = body["effects"]["structural_vibration"]["parameters"]["frequency"]
    assert found["mean"] == pytest.approx(3.2, rel=0.03)
