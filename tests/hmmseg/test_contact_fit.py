"""EM on features with planted parameters, from wrong starts; its pieces against brute force."""

from dataclasses import replace

import numpy as np
import pytest
from contact_scene import LEVELS, PLANTED, STEPS, planted
from scipy import optimize, stats

from hmmseg.levels import TAIL
from hmmseg.segmentation import fit as contact_fit
from hmmseg.segmentation.fit import (
    MeanShares,
    _location,
    _scale,
    fit,
    initial_parameters,
    otsu,
)


def test_otsu_against_trying_every_split():
    rng = np.random.default_rng(0)
    for _ in range(20):
        values = np.concatenate(
            [rng.normal(0, 1, rng.integers(3, 30)), rng.normal(6, 2, rng.integers(3, 30))]
        )
        v = np.sort(values)

        def between(i, v=v):
            low, high = v[:i], v[i:]
            return low.size * high.size * (high.mean() - low.mean()) ** 2

        best = max(range(1, v.size), key=between)
        assert otsu(rng.permutation(values)) == pytest.approx((v[best - 1] + v[best]) / 2)
    assert otsu(np.array([0.0, np.nan, 1.0, 1.1, 0.1])) == pytest.approx(0.55)


def test_location_and_scale_maximise_the_weighted_student_likelihood():
    rng = np.random.default_rng(1)
    values = 3.0 + 0.2 * rng.standard_t(3, size=400)
    weights = rng.uniform(size=400)

    def loss(p):
        return -weights @ stats.t.logpdf(values, TAIL, loc=p[0], scale=np.exp(p[1]))

    at_scale = optimize.minimize_scalar(lambda m: loss([m, np.log(0.2)]), bounds=(2, 4), method="bounded")
    assert _location(values, weights, 0.2, 2.5) == pytest.approx(at_scale.x, abs=2e-3)
    # The pull towards the start has the weight of one sample of about 200.
    at_location = optimize.minimize_scalar(lambda s: loss([3.0, s]), bounds=(-4, 0), method="bounded")
    found = 0.5
    for _ in range(20):
        found = _scale(values - 3.0, weights, found, 1e-6)
    assert found == pytest.approx(np.exp(at_location.x), rel=0.02)


def test_pieces_without_data_keep_what_they_had():
    nothing = np.full(3, np.nan)
    assert _location(nothing, np.ones(3), 1.0, 0.7) == 0.7
    assert _scale(nothing, np.ones(3), 0.3, 0.1) == 0.3
    assert _scale(np.zeros(100), np.ones(100), 0.3, 0.1) == 0.1  # never below its floor


def test_transitions_are_probabilities_with_the_mean_duration():
    stay, advance = MeanShares((200,), np.array([0.25, 0.5, 0.25])).chain(0).bands
    np.testing.assert_allclose(np.exp(stay[:2]) + np.exp(advance), 1.0)
    np.testing.assert_allclose(np.exp(-advance), [50, 100])
    stay, advance = MeanShares((5,), np.array([1e-9, 1.0])).chain(0).bands
    assert np.isfinite(stay).all() and np.isfinite(advance).all()


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


def test_planted_parameters_are_recovered():
    trials = [planted(seed) for seed in range(3)]
    check_recovery(fit([f for f, _ in trials], STEPS), trials)


@pytest.mark.parametrize("wrong", ["weights", "scales", "biases"])
def test_planted_parameters_are_recovered_from_wrong_starts(wrong, monkeypatch):
    trials = [planted(seed) for seed in range(2)]

    def start(features, steps):
        right = initial_parameters(features, steps)
        if wrong == "weights":
            return replace(right, weight={"block1": 0.9, "block2": 0.12})
        if wrong == "scales":
            return replace(right, scale={name: 4 * value for name, value in right.scale.items()})
        return replace(right, bias=right.bias + 0.15)

    monkeypatch.setattr(contact_fit, "initial_parameters", start)
    check_recovery(fit([f for f, _ in trials], STEPS), trials)


def test_shares_of_a_trial_are_the_mean_of_their_dirichlet_posterior():
    rng = np.random.default_rng(5)
    gammas = [rng.dirichlet(np.ones(4), size=n) * [1, 1, 1, 0] for n in (30, 50)]  # a subtask nobody saw
    gammas = [g / g.sum(axis=1, keepdims=True) for g in gammas]
    counts = sum(g.mean(axis=0) for g in gammas)
    expected = stats.dirichlet(np.full(4, 1 / 4) + counts).mean()
    found = MeanShares((30, 50), np.full(4, 0.25)).updated(gammas).shares
    np.testing.assert_allclose(found, expected, rtol=1e-12)
    assert found[3] > 0
