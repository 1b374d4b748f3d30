"""Emissions of contact are densities; EM finds planted parameters from wrong starts; the driver is exact."""

import itertools
from dataclasses import dataclass, replace

import numpy as np
import pytest
from scipy import optimize, stats
from scipy.stats import norm

from hmmseg.contact.decompose import ABOVE_GROUND, FREE, ON_GROUND, SLIDING, Subtask, subtasks
from hmmseg.contact.equations import Pads
from hmmseg.densities import log_student_below
from hmmseg.hmm import Chain, em
from hmmseg.io.task import BlockTask, Move
from hmmseg.levels import MOVED, TAIL
from hmmseg.segmentation import fit as contact_fit
from hmmseg.segmentation.emissions import RUNG, Features, Parameters, _log_ungripped, log_likelihoods
from hmmseg.segmentation.fit import fit

STACK = BlockTask({"block1": "block2", "block2": "ground"},
                  (Move("block1", "ground"), Move("block2", "block1")))  # fmt: skip
STEPS = subtasks(STACK)
GRAVITY, COMPLIANCE, SQUEEZE = 9.81, 2e-4, 2.5e-4
PADS = Pads(SQUEEZE, SQUEEZE, 2 * COMPLIANCE, 2 * COMPLIANCE)
LEVELS = {1: 0.022, 3: 0.008, 5: 0.006, 7: 0.02}
PICK = BlockTask({"block": "ground"}, (Move("block", "ground"),))
SLIDE = BlockTask({"block": "ground"}, (Move("block", "ground", slide=True),))
SPAN = {"vx": 0.4, "vy": 0.3, "y": 0.06, "d": 0.04, "force": 6.0, "press": 6.0}
PARAMETERS = Parameters(bias=np.array([0.02, -0.01, 0.0, 0.03]), weight={"block": 0.4}, width={"block": 0.02},
                        scale={"force": 0.01, "carry": 0.02, "net_x": 0.05, "shear": 0.05, "velocity": 0.003,
                               "level": 1e-4, "width": 1e-4},
                        levels=({1: 0.01, 2: 0.01, 3: 0.01},))  # fmt: skip
STAY = 0.8


@dataclass(frozen=True)
class Planted:
    bias: tuple[float, ...] = (0.02, -0.03, 0.01, 0.0)
    weight: tuple[float, float] = (0.35, 0.55)
    width: tuple[float, float] = (0.016, 0.025)
    noise: float = 0.012


PLANTED = Planted()


def planted(seed: int, planted: Planted = PLANTED, dt: float = 0.05):
    """Features and true subtask index (num_timesteps,) of one trial of two moves."""
    rng = np.random.default_rng(seed)
    lengths = rng.integers(14, 26, size=len(STEPS))
    labels = np.repeat(np.arange(len(STEPS)), lengths)
    num = labels.size
    force = np.array(planted.bias) + planted.noise * rng.normal(size=(num, 4))
    vx, vy, ay, y, d = (np.zeros(num) for _ in range(5))
    for s in STEPS:
        inside = np.flatnonzero(labels == s.index)
        m, noise = inside.size, lambda sd, m=inside.size: sd * rng.normal(size=m)
        if s.state == FREE:
            vx[inside], vy[inside] = rng.uniform(-0.2, 0.2, m), rng.uniform(-0.15, 0.15, m)
            y[inside], d[inside] = rng.uniform(0, 0.06, m), rng.uniform(0.03, 0.06, m)
            continue
        block = 0 if s.object == "block1" else 1
        grip = rng.uniform(1.5, 3.0, m)
        d[inside] = planted.width[block] - 2 * grip * SQUEEZE + noise(6e-5)
        if s.state == ABOVE_GROUND:
            ay[inside] = rng.normal(size=m)
            fy = planted.weight[block] * (1 + ay[inside] / GRAVITY)
            vx[inside], vy[inside] = rng.uniform(-0.2, 0.2, m), rng.uniform(-0.15, 0.15, m)
            y[inside] = rng.uniform(0.02, 0.06, m)
        else:
            assert s.state == ON_GROUND
            fy = rng.uniform(-0.8, 0.6 * planted.weight[block], m)
            vx[inside], vy[inside] = noise(2e-3), noise(2e-3)
            y[inside] = LEVELS[s.index] + fy * COMPLIANCE + noise(5e-5)
        force[inside] += np.stack([grip, fy / 2, -grip, fy / 2], axis=1)
    spans = {"vx": np.ptp(vx), "vy": np.ptp(vy), "y": np.ptp(y), "d": np.ptp(d), "force": 6.0, "press": 6.0}
    noises = {"sd_y": 5e-5, "sd_d": 6e-5, "sd_vx": 2e-3, "sd_vy": 2e-3}
    f = Features(t=np.arange(num) * dt, force=force, vx=vx, vy=vy, ay=ay, y=y, d=d,
                 **{k: np.full(num, v) for k, v in noises.items()}, pads=PADS, gravity=GRAVITY,
                 span={k: float(v) for k, v in spans.items()})  # fmt: skip
    return f, labels


def test_students_edges_are_exact_and_em_ends_at_the_maximum_of_the_evidence():
    z = np.array([-1e5, -60.0, -4.0, -0.3, 0.0, 0.3, 4.0, 60.0])
    np.testing.assert_allclose(log_student_below(z), stats.t.logcdf(z, TAIL), rtol=1e-12, atol=1e-15)
    rng = np.random.default_rng(0)
    sizes = ((3, 6), (4, 5), (6, 3), (2, 3))
    trials = [np.r_[rng.normal(size=before), rng.normal(2.0, 1.0, size=after)] for before, after in sizes]
    fit = learn_level(trials, 0.7, max_iterations=500, tolerance=1e-10)
    assert fit.converged
    best = optimize.minimize_scalar(lambda at: -by_enumeration(trials, at), bounds=(-1, 4), method="bounded")
    assert fit.model == pytest.approx(best.x, abs=1e-3)
    assert fit.log_evidence == pytest.approx(by_enumeration(trials, fit.model), abs=1e-9)


def features(num, **columns):
    blank = {name: np.zeros(num) for name in ("vx", "vy", "ay", "y", "d")}
    values = {name: np.broadcast_to(np.asarray(v, float), (num,)) for name, v in columns.items()
              if name != "force"}  # fmt: skip
    force = np.broadcast_to(np.asarray(columns.get("force", np.zeros(4)), float), (num, 4))
    noise = {name: np.full(num, sd) for name, sd in
             (("sd_y", 3e-5), ("sd_d", 6e-5), ("sd_vx", 2e-3), ("sd_vy", 2e-3))}  # fmt: skip
    return Features(np.arange(num) * 0.05, force, **(blank | values), **noise,
                    pads=Pads(2.5e-4, 2.5e-4, 4e-4, 4e-4), gravity=9.81, span=SPAN)  # fmt: skip


def step(state: str) -> tuple[Subtask, ...]:
    task = SLIDE if state == SLIDING else PICK
    return tuple(s for s in subtasks(task) if s.state == state)[:1]


def score(f: Features, state: str) -> np.ndarray:
    return log_likelihoods(f, step(state), PARAMETERS, 0)[:, 0]


def test_ungripped_force_density_integrates_to_one():
    # Importance sampling with a proposal of the same three parts, heavier at the edges.
    rng, num, scale, span = np.random.default_rng(0), 400_000, 0.1, 6.0
    part, silent = rng.integers(3, size=num), stats.t(3, scale=0.15)
    x = silent.rvs(size=(num, 4), random_state=rng)
    wide = np.stack([rng.uniform(-1, 7, num), rng.uniform(-7, 7, num)], axis=1)
    x[part == 1, :2] = wide[part == 1]
    mirrored = wide * np.array([-1.0, 1.0])
    x[part == 2, 2:] = mirrored[part == 2]
    quiet, box = silent.logpdf(x), -np.log(8.0 * 14.0)
    one = np.where((x[:, 0] > -1) & (x[:, 0] < 7) & (np.abs(x[:, 1]) < 7), box, -np.inf)
    two = np.where((x[:, 2] < 1) & (x[:, 2] > -7) & (np.abs(x[:, 3]) < 7), box, -np.inf)
    proposal = np.logaddexp.reduce([quiet.sum(axis=1), one + quiet[:, 2:].sum(axis=1),
                                    quiet[:, :2].sum(axis=1) + two]) - np.log(3)  # fmt: skip
    ratio = np.exp(_log_ungripped(x, scale, span, 0.0) - proposal)
    assert abs(ratio.mean() - 1) < 4 * ratio.std() / np.sqrt(num) + 1e-3


def test_how_loud_a_sample_rings_is_as_likely_by_its_logarithm():
    """P(|f| < a) = log(1 + a / scale) / log(1 + span / scale), signs alike, each channel by itself."""
    scale, span = 0.01, 6.0
    rest = np.array([-1.0, 5.0, 5.0])  # no contact and no single finger explains these
    share = np.linspace(0.3, 0.9, 7)  # of the loudness in logarithms; silence is another thing
    edges = scale * np.expm1(share * np.log1p(span / scale))
    inside = []
    for low, high in itertools.pairwise(edges):
        f = np.linspace(low, high, 4001)
        every = np.stack([np.full(f.size, rest[0]), f, *(np.full(f.size, r) for r in rest[1:])], axis=1)
        inside.append(np.trapezoid(np.exp(_log_ungripped(every, scale, span, RUNG)), f))
    there = np.array([[rest[0], np.nan, *rest[1:]]])
    one_sign = 0.5 * 0.1 * np.exp(_log_ungripped(there, scale, span, RUNG)[0])
    np.testing.assert_allclose(inside, one_sign, rtol=0.02)


@pytest.mark.parametrize("state", [FREE, ON_GROUND, SLIDING, ABOVE_GROUND])
@pytest.mark.parametrize("name", ["vx", "vy", "y", "d"])
def test_density_over_one_feature_integrates_to_one(state, name):
    """The joint density factorises over these features, so its ratio to one point's is a density."""
    centre = {"vx": 0.0, "vy": 0.0, "y": 0.01, "d": 0.019}[name]
    half = 0.5 * SPAN[name]
    grid = centre + np.linspace(-half, half, 40_001)
    base = {"force": PARAMETERS.bias + np.array([2.0, 0.0, -2.0, 0.0]), "y": 0.01, "d": 0.019}
    # Every other sample is the one before, from which a block that halts does not move.
    values = np.stack([np.full(grid.size, base.get(name, 0.0)), grid], axis=1).ravel()
    table = score(features(2 * grid.size, **(base | {name: values})), state)[1::2]
    without = score(features(2, **(base | {name: np.array([base.get(name, 0.0), np.nan])})), state)[1]
    total = np.trapezoid(np.exp(table - without), grid)
    np.testing.assert_allclose(total, 1.0, rtol=2e-3)  # heavy tails beyond the range


@pytest.mark.parametrize("state", [FREE, ON_GROUND, SLIDING, ABOVE_GROUND])
def test_a_sample_without_values_says_nothing(state):
    f = features(3, force=np.full(4, np.nan), vx=np.nan, vy=np.nan, ay=np.nan, y=np.nan, d=np.nan)
    np.testing.assert_allclose(score(f, state), np.zeros(3), atol=1e-12)


def test_a_block_held_still_above_its_place_hangs_by_its_weight_and_inertia():
    still = PARAMETERS.bias + np.array([2.0, 0.2, -2.0, 0.2])
    hover = features(200, force=still, d=0.019, y=0.014 + 0.4 * 2e-4)
    assert score(hover, ABOVE_GROUND).sum() > score(hover, ON_GROUND).sum() + 200
    unknown = replace(PARAMETERS, levels=({1: 0.014},))  # the level may have been learned from the hover
    learned = log_likelihoods(hover, step(ON_GROUND), unknown, 0)[:, 0]
    assert score(hover, ABOVE_GROUND).sum() > learned.sum()
    force = PARAMETERS.bias + np.array([2.0, 0.3, -2.0, 0.3])  # 0.6 N: 0.4 N at half a g upwards
    still, rising = (score(features(1, force=force, d=0.019, ay=a), ABOVE_GROUND)[0] for a in (0.0, 4.905))
    assert rising > still + 5


def test_what_strays_on_its_support_is_on_it_while_it_stays_near_it():
    resting = PARAMETERS.bias + np.array([2.0, 0.15, -2.0, 0.15])
    pushed = features(10, force=resting, d=0.019, y=0.01 + 0.3 * 2e-4, vx=0.03)
    assert score(pushed, ON_GROUND).sum() > score(pushed, ABOVE_GROUND).sum() + 20
    ring = PARAMETERS.bias + np.array([2.0, -0.05, -2.0, -0.05])
    off = np.array([0.003, 0.025])
    moving = features(2, force=ring, d=0.019, y=0.01 - 0.1 * 2e-4 + off, vy=0.1)
    near, far = score(moving, ON_GROUND)
    assert near - far == pytest.approx(np.diff(stats.t.logpdf(off[::-1], TAIL, scale=MOVED))[0], rel=1e-4)
    assert near - far > 6


def test_otsu_against_trying_every_split():
    rng = np.random.default_rng(0)
    for _ in range(20):
        values = np.concatenate([rng.normal(0, 1, rng.integers(3, 30)),
                                 rng.normal(6, 2, rng.integers(3, 30))])  # fmt: skip
        v = np.sort(values)

        def between(i, v=v):
            low, high = v[:i], v[i:]
            return low.size * high.size * (high.mean() - low.mean()) ** 2

        best = max(range(1, v.size), key=between)
        assert contact_fit.otsu(rng.permutation(values)) == pytest.approx((v[best - 1] + v[best]) / 2)
    assert contact_fit.otsu(np.array([0.0, np.nan, 1.0, 1.1, 0.1])) == pytest.approx(0.55)


def test_location_and_scale_maximise_the_weighted_student_likelihood():
    rng = np.random.default_rng(1)
    values, weights = 3.0 + 0.2 * rng.standard_t(3, size=400), rng.uniform(size=400)

    def loss(p):
        return -weights @ stats.t.logpdf(values, TAIL, loc=p[0], scale=np.exp(p[1]))

    at_scale = optimize.minimize_scalar(lambda m: loss([m, np.log(0.2)]), bounds=(2, 4), method="bounded")
    assert contact_fit._location(values, weights, 0.2, 2.5) == pytest.approx(at_scale.x, abs=2e-3)
    # The pull towards the start has the weight of one sample of about 200.
    at_location = optimize.minimize_scalar(lambda s: loss([3.0, s]), bounds=(-4, 0), method="bounded")
    found = 0.5
    for _ in range(20):
        found = contact_fit._scale(values - 3.0, weights, found, 1e-6)
    assert found == pytest.approx(np.exp(at_location.x), rel=0.02)


def test_shares_are_the_mean_of_their_dirichlet_and_transitions_have_the_mean_duration():
    stay, advance = contact_fit.chain_of(np.array([0.25, 0.5, 0.25]), 200).bands
    np.testing.assert_allclose(np.exp(stay[:2]) + np.exp(advance), 1.0)
    np.testing.assert_allclose(np.exp(-advance), [50, 100])
    stay, advance = contact_fit.chain_of(np.array([1e-9, 1.0]), 5).bands
    assert np.isfinite(stay).all() and np.isfinite(advance).all()
    rng = np.random.default_rng(5)
    gammas = [rng.dirichlet(np.ones(4), size=n) * [1, 1, 1, 0] for n in (30, 50)]  # a subtask nobody saw
    gammas = [g / g.sum(axis=1, keepdims=True) for g in gammas]
    counts = sum(g.mean(axis=0) for g in gammas)
    expected = stats.dirichlet(np.full(4, 1 / 4) + counts).mean()
    found = contact_fit.mean_shares(gammas)
    np.testing.assert_allclose(found, expected, rtol=1e-12)
    assert found[3] > 0


def check_recovery(found, trials):
    p = found.parameters
    np.testing.assert_allclose([p.weight["block1"], p.weight["block2"]], PLANTED.weight, rtol=0.03)
    np.testing.assert_allclose([p.width["block1"], p.width["block2"]], PLANTED.width, atol=6e-5)
    np.testing.assert_allclose(p.bias, PLANTED.bias, atol=0.006)
    assert p.scale["force"] == pytest.approx(PLANTED.noise, rel=0.25)
    for levels in p.levels:
        np.testing.assert_allclose([levels[k] for k in LEVELS], list(LEVELS.values()), atol=6e-5)
    for posterior, (_, labels) in zip(found.posteriors, trials, strict=True):
        path = posterior.smoothed.argmax(axis=1)
        assert np.mean(path == labels) > 0.985


@pytest.mark.parametrize("wrong", ["nothing", "weights", "scales", "biases"])
def test_planted_parameters_are_recovered_from_wrong_starts(wrong, monkeypatch):
    trials, usual = [planted(seed) for seed in range(2)], contact_fit.initial_parameters

    def start(features, steps):
        right = usual(features, steps)
        if wrong == "weights":
            return replace(right, weight={"block1": 0.9, "block2": 0.12})
        if wrong == "scales":
            return replace(right, scale={name: 4 * value for name, value in right.scale.items()})
        return replace(right, bias=right.bias + 0.15 * (wrong == "biases"))

    monkeypatch.setattr(contact_fit, "initial_parameters", start)
    check_recovery(fit([f for f, _ in trials], STEPS), trials)


def test_a_scale_is_not_learned_from_readings_that_rounding_makes_equal():
    trial, labels = planted(1, replace(PLANTED, bias=(0.0,) * 4))
    step = 5 * PLANTED.noise
    rounded = replace(trial, force=step * np.round(trial.force / step))
    assert np.mean(rounded.force[labels == 0] == 0) > 0.9
    assert contact_fit._least_force([rounded]) == pytest.approx(step / np.sqrt(12))
    found = fit([rounded], STEPS)
    assert found.parameters.scale["force"] == pytest.approx(step / np.sqrt(12))
    assert np.mean(np.asarray(found.posteriors[0].path) == labels) > 0.95
    assert contact_fit._least_force([trial]) < 0.3 * PLANTED.noise


def learn_level(trials, start, **settings):
    chain = Chain(np.log([STAY, 1.0]), np.log([1 - STAY]))

    def tables(level):
        return [norm.logpdf(x[:, None], [0.0, level]) for x in trials], [chain] * len(trials)

    def updated(level, responsibilities):
        weight = np.concatenate([r[:, 1] for r in responsibilities])
        return float(weight @ np.concatenate(trials) / weight.sum())

    return em(start, tables, updated, **settings)


def by_enumeration(trials, level):
    """Log evidence of trials under two levels, every boundary tried."""
    total = 0.0
    for x in trials:
        terms = [
            norm.logpdf(x[:cut]).sum() + norm.logpdf(x[cut:], level).sum() + (cut - 1) * np.log(STAY)
            + np.log(1 - STAY) for cut in range(1, x.size)]  # fmt: skip
        total += np.logaddexp.reduce(terms)
    return total
