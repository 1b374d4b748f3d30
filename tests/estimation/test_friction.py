"""Friction: the bound covers planted ratios, slip is found where it was planted and nowhere else."""

import numpy as np
import pytest

from estimation.friction import (
    FrictionPosterior,
    Stretch,
    friction_posteriors,
    ground_friction,
    largest_ratio,
    slip_evidence,
)
from estimation.observations import WeighedTrial, subtask_masks
from hmmseg.contact.decompose import FREE, subtasks
from hmmseg.hand.signals import Signals
from hmmseg.io.rig import Fingertip, Rig, Systematic
from hmmseg.io.task import BlockTask, parse_task

SD = 0.012  # N
RIG = Rig(fingertip=Fingertip(normal_stiffness=4000.0, shear_stiffness=2500.0))
LIFT = parse_task({"objects": {"cup": {"on": "ground"}}, "moves": [{"object": "cup", "to": "ground"}]})
SLIDE = {"object": "cup", "to": "ground", "slide": True}
SLID = parse_task({"objects": {"cup": {"on": "ground"}}, "moves": [SLIDE]})
BOTH = parse_task({"objects": {"cup": {"on": "ground"}}, "moves": [SLIDE, {"object": "cup", "to": "ground"}]})
DURATION, RATE = 1.0, 20.0  # s of each subtask, samples per second
NUM = int(5 * DURATION * RATE)


def aligned(signals: Signals, task: BlockTask, boundaries: np.ndarray) -> WeighedTrial:
    """A trial of given boundaries (num_alignments, num_subtasks - 1) [s], its weights plain means."""
    steps = subtasks(task)
    masks = subtask_masks(signals.t, boundaries, len(steps))
    free = masks[0][[s.index for s in steps if s.state == FREE]].any(axis=0)
    grips, counts = {}, {}
    for s in steps:
        if s.name == "carry":
            inside = masks[:, s.index].astype(float)
            grips[s.move] = {"force": inside / np.maximum(inside.sum(axis=1, keepdims=True), 1)}
            counts[s.move] = {"force": inside.sum(axis=1)}
    uniform = free / max(free.sum(), 1)
    robust = np.tile(uniform, (4, 1))
    return WeighedTrial(signals, masks, grips, counts, uniform, robust, float(free.sum()))


def planted(
    task: BlockTask, ratio: np.ndarray, rng: np.random.Generator, *, normal: float = 1.5, bias: float = 0.0,
    slip: np.ndarray | None = None,
) -> WeighedTrial:  # fmt: skip
    """A trial with true ratios (num_timesteps,) while held; `slip` [m] moves the anchors."""
    steps = subtasks(task)
    boundaries = DURATION * np.arange(1, len(steps))[None]
    t = np.arange(int(len(steps) * DURATION * RATE)) / RATE
    state = np.array([s.state != FREE for s in steps])[np.minimum((t / DURATION).astype(int), len(steps) - 1)]
    grip, shear = np.where(state, normal, 0.0), np.where(state, ratio * normal, 0.0)
    y = 0.02 + shear / RIG.fingertip.shear_stiffness + (np.zeros(t.size) if slip is None else slip)

    def noisy(values: np.ndarray, sd: float = SD, offset: float = 0.0) -> np.ndarray:
        return values + offset + sd * rng.standard_normal(t.size)

    zero, sd_y = np.zeros(t.size), np.full(t.size, 2.5e-5)
    signals = Signals(t=t, x1=zero, y1=noisy(y, 2.5e-5), vx1=zero, vy1=zero, fx1=noisy(grip, offset=bias),
                      fy1=noisy(shear, offset=bias), x2=zero, y2=noisy(y, 2.5e-5), vx2=zero, vy2=zero,
                      fx2=noisy(-grip, offset=bias), fy2=noisy(shear, offset=bias), sd_x=sd_y, sd_y=sd_y,
                      sd_vx=zero, sd_vy=zero, sd_force=SD)  # fmt: skip
    return aligned(signals, task, boundaries)


@pytest.mark.parametrize("limit", [np.inf, 0.3])
def test_lower_bound_covers_the_largest_true_ratio_and_is_close(limit):
    """The naive maximum exceeds the truth nearly always; the 5 % quantile hardly ever."""
    rng = np.random.default_rng(1)
    below, gap, naive = [], [], []
    for _ in range(60):
        paths = [np.abs(0.2 + np.cumsum(rng.normal(0, 0.02, 20))) for _ in range(10)]
        ratio = np.minimum(np.concatenate(paths), limit)
        sd = 0.0085 * rng.uniform(0.7, 1.5, ratio.size)
        seen = np.abs(ratio + sd * rng.standard_normal(ratio.size))
        bound = np.quantile(largest_ratio(seen, sd, np.ones((1, ratio.size), bool), rng, 500), 0.05)
        below.append(bound <= ratio.max())
        gap.append(ratio.max() - bound)
        naive.append(seen.max() > ratio.max())
    assert np.mean(below) >= 0.9 and np.mean(naive) > 0.6 and np.median(gap) < 0.045


def test_one_sample_does_not_carry_the_bound_and_alignments_are_marginalised():
    rng = np.random.default_rng(2)
    ratio, sd = np.abs(0.2 + 0.01 * rng.standard_normal(100)), np.full(100, 0.01)
    ratio[50] = 0.9
    draws = largest_ratio(ratio, sd, np.ones((1, 100), bool), rng, 1000)
    assert np.quantile(draws, 0.05) < 0.3 and draws.max() > 0.8
    rng = np.random.default_rng(3)
    ratio = np.concatenate([np.full(40, 0.2), np.full(10, 0.5)]) + 0.005 * rng.standard_normal(50)
    held = np.ones((16, 50), bool)
    held[::2, 40:] = False
    draws = largest_ratio(ratio, np.full(50, 0.005), held, rng, 2000)
    assert np.mean(draws > 0.45) == pytest.approx(0.5, abs=0.1)
    assert np.median(draws[draws < 0.45]) == pytest.approx(0.2, abs=0.01)


def test_bias_is_removed_uncertain_gain_widens_the_bound_and_nothing_held_gives_a_reason():
    rng = np.random.default_rng(4)
    ratio = np.where(np.arange(NUM) % 20 < 10, 0.25, 0.1)
    found = friction_posteriors([planted(LIFT, ratio, rng, bias=0.15)], LIFT, RIG, SD, rng)["cup"]
    assert found.bound_draws is not None and np.median(found.bound_draws) == pytest.approx(0.25, abs=0.006)
    assert found.lower_bound == np.quantile(found.bound_draws, 0.05) <= 0.25
    rng = np.random.default_rng(5)
    trial = planted(LIFT, np.full(NUM, 0.25), rng)
    rig = RIG.model_copy(update={"systematic": Systematic(force_gain=(0.05,) * 4)})
    found = friction_posteriors([trial], LIFT, rig, SD, rng)["cup"].bound_draws
    assert found.std() / found.mean() == pytest.approx(np.hypot(0.05, 0.05), rel=0.15)
    rng = np.random.default_rng(6)
    trial = planted(LIFT, np.full(NUM, 0.25), rng, normal=0.0)
    found = friction_posteriors([trial], LIFT, RIG, SD, rng)["cup"]
    assert found == FrictionPosterior(None, reason="the recording never shows cup held firmly")
    assert found.to_json() == {"unit": "1", "lower_bound": None}


def stretches(rng: np.random.Generator, num: int, mu: float | None, drift: float = 0.0,
              scale: float = 2.5e-5) -> list[Stretch]:  # fmt: skip
    """Fingers on a resting block under growing shear; beyond `mu` they slip at 3 mm/s."""
    out = []
    for _ in range(num):
        t = np.arange(12) * 0.05
        ratio = -np.linspace(0.1, rng.uniform(0.3, 0.5), 12)
        anchor = drift * np.cumsum(rng.standard_normal(12)) * np.sqrt(0.05)
        if mu is not None:
            anchor = anchor - 3e-3 * 0.05 * np.cumsum(np.abs(ratio) > mu)
            ratio = np.maximum(ratio, -mu)
        noise = rng.standard_normal((2, 12))
        out.append(Stretch(t, anchor + scale * noise[0], np.full(12, scale), 1.5 * ratio,
                           ratio + 0.008 * noise[1], np.full(12, 0.008), 4e-4))  # fmt: skip
    return out


@pytest.mark.parametrize(("mu", "drift", "seen"), [(0.25, 0.0, True), (0.25, 3e-5, True), (None, 0.0, False),
                                                  (None, 2e-4, False)])  # fmt: skip
def test_slip_is_seen_where_it_was_planted(mu, drift, seen):
    rng = np.random.default_rng(7)
    for _ in range(6):
        own = stretches(rng, 8, mu, drift)
        bound = np.full(100, mu or max(np.abs(s.ratio).max() for s in own))
        found = slip_evidence(own, stretches(rng, 8, None, drift), bound)
        assert found.seen is seen and (found.probability > 0.5) is seen


def test_one_odd_stretch_is_no_slip():
    """A jump that comes back, at the highest ratio, as a wrong boundary makes it."""
    rng = np.random.default_rng(8)
    own = stretches(rng, 8, None)
    best = int(np.argmax([np.abs(s.ratio).max() for s in own]))
    own[best].anchor[-3:] += [5e-4, -3e-4, 6e-4]
    bound = np.full(100, np.abs(own[best].ratio).max())
    assert not slip_evidence(own, [], bound).seen


def test_planted_slip_tells_mu():
    rng, mu = np.random.default_rng(9), 0.3
    trials, others = [], []
    for _ in range(4):
        free = -np.tile(np.linspace(0.1, rng.uniform(0.35, 0.45), 20), 5)
        moved = -2e-3 / RATE * np.cumsum(np.abs(free) > mu)
        trials.append(planted(LIFT, np.maximum(free, -mu), rng, slip=moved))
        others.append(planted(LIFT, free, rng))
    slipped = friction_posteriors(trials, LIFT, RIG, SD, rng)["cup"]
    assert slipped.slip.seen and slipped.reason is None
    low, high = slipped.to_json()["interval_95"]
    assert low < mu < high and high - low < 0.05
    assert slipped.lower_bound is not None and slipped.lower_bound <= mu
    stuck = friction_posteriors(others, LIFT, RIG, SD, rng)["cup"]
    assert stuck.mu_draws is None and "mean" not in stuck.to_json()
    assert stuck.reason == "no finger was seen to slip on cup: a bound is all it tells"


@pytest.mark.parametrize(("task", "close"), [(SLID, 0.12), (BOTH, 0.03)])
def test_sliding_tells_the_friction_of_the_support(task, close):
    rng, mu, weight = np.random.default_rng(10), 0.5, 0.6
    z = []
    for _ in range(8):
        wander = np.abs(0.15 + np.cumsum(rng.normal(0, 0.015, len(subtasks(task)) * 20)))
        trial = planted(task, wander, rng)
        s, steps = trial.signals, subtasks(task)
        index = np.minimum((s.t / DURATION).astype(int), len(steps) - 1)
        sliding = np.array([step.name == "slide" for step in steps])[index]
        carried = np.array([step.name == "carry" for step in steps])[index]
        down = np.where(carried, weight, np.where(sliding, 0.25 * np.sin(9 * s.t), 0.0))
        push = np.where(sliding, mu * (weight - down), 0.0)
        noise = SD * rng.standard_normal((4, s.t.size))
        held = trial.masks[0][[step.index for step in steps if step.state != FREE]].any(axis=0) * 1.5
        vars(s).update(fx1=held + push + noise[0], fx2=-held + noise[1], fy1=down / 2 + noise[2],
                       fy2=down / 2 + noise[3], vx1=sliding * 0.1, vx2=sliding * 0.1)  # fmt: skip
        known = {"cup": rng.normal(weight, 0.01, 500)} if carried.any() else {}
        ground = friction_posteriors([trial], task, RIG, SD, rng, known)["cup"].ground
        assert ground.support == "ground" and ground.mu_draws.mean() == pytest.approx(mu, abs=close)
        z.append((ground.mu_draws.mean() - mu) / ground.mu_draws.std())
    assert 0.3 < np.sqrt(np.mean(np.square(z))) < 2.0


def test_intervals_hold_however_few_samples_a_slide_has(monkeypatch):
    rng, mu, weight, inside = np.random.default_rng(3), 0.5, 0.6, []
    down, lag = 0.3 * np.linspace(-1, 1, 6), 0.05 * np.array([1, -1, 0, 0, -1, 1])
    for _ in range(400):
        push = mu * (weight - down) + weight * lag + 0.01 * rng.standard_normal(6)
        monkeypatch.setattr("estimation.friction._rows", lambda *_, p=push: np.stack([p, lag, down], axis=1))
        found = ground_friction([planted(SLID, np.zeros(100), rng)], SLID, subtasks(SLID), "cup", RIG, None,
                                rng)  # fmt: skip
        low, high = np.percentile(found.mu_draws, [2.5, 97.5])
        inside.append(low < mu < high)
    assert np.mean(inside) > 0.92
