"""The generic diagnosis: features with known values, planted effects named, alike ensembles called alike."""

from itertools import pairwise

import numpy as np
import pytest

from experiments.generic_ensembles import PLANTED, TASK, Scatter, ensemble
from experiments.generic_ensembles import made as case_of
from hmmseg.errors import InputError
from hmmseg.io.task import SequenceTask
from hmmseg.io.trial import Trial
from simgap.generic.diagnose import diagnose, gap_of, whitening
from simgap.generic.effects import predicted, scene
from simgap.generic.ring import Ring, fit_ring, from_swing
from simgap.generic.trials import FAST, SLOW, _sub_bands, align, bin_edges, both, layout, means, transformed


def made(seed=1, effects=None, count=6):
    rng = np.random.default_rng(seed)
    real, first = ensemble(rng, count, effects)
    sim, second = ensemble(rng, count, None, name="sim")
    return real, sim, first | second


@pytest.fixture(scope="module")
def alike():
    real, sim, boundaries = made()
    return layout(align(real, sim, TASK, boundaries=boundaries))


def test_means_are_those_of_straight_lines():
    t = np.array([0.0, 1.0, 3.0])
    values = np.array([0.0, 2.0, 0.0])
    found = means(t, values, np.array([0.0, 0.5, 2.0, 3.0]))
    np.testing.assert_allclose(found, [0.5, (0.75 + 1.5) / 1.5, 0.5])


def test_white_noise_has_its_variance_in_every_coefficient():
    power = (transformed(0.3 * np.random.default_rng(0).standard_normal((4000, 50))) ** 2).mean(0)
    np.testing.assert_allclose(power[2:], 0.09, rtol=0.12)
    assert power[:2] == pytest.approx(0.0, abs=2e-2)  # the straight line is out


def test_parts_cover_a_subtask_and_follow_its_event_in_seconds(alike):
    edges, first = np.array([0.0, 1.0, 3.0, 5.0]), int(alike.bins[0])
    short, long = (bin_edges(alike, edges + np.array([0, 0, d, d])) for d in (0.0, 1.0))
    assert short.size == alike.bins.sum() + 1 and (np.diff(short) > 0).all()
    assert short[np.cumsum([0, *alike.bins])] == pytest.approx(edges)
    assert short[first + 6] == long[first + 6] == pytest.approx(1.0 + alike.event[1])
    assert alike.event[0] == 0 and alike.event[1] > 0.2


def test_every_feature_belongs_to_one_channel_or_is_a_duration(alike):
    found = np.concatenate([alike.of_channel(c) for c in (0, 1, -1)])
    assert sorted(found) == list(range(alike.kind.size)) and np.isfinite(np.concatenate(both(alike))).all()


def test_whitened_rows_of_alike_trials_have_the_squares_that_are_stated():
    squares, stated = [], []
    for seed in range(8):
        lay = layout(align(*made(seed)[:2], TASK, boundaries=made(seed)[2]))
        features = both(lay)
        gap = gap_of(lay, whitening(scene(lay), *features), *features, ())
        squares.append([(gap.residual**2)[gap.rows.channel == c].sum() for c in range(5)])
        stated.append([gap.mean_square[gap.rows.channel == c].sum() for c in range(5)])
    np.testing.assert_allclose(np.sum(squares, 0) / np.sum(stated, 0), 1.0, atol=0.3)


@pytest.mark.parametrize("window", [9, 10, 14, 30, 61, 200, 1999])
def test_sub_bands_cover_the_spectrum_without_gaps(window):
    found = _sub_bands(6, window)
    assert found[0].start == 6 and found[-1].stop == window
    assert all(a.stop == b.start for a, b in pairwise(found)) and min(s.stop - s.start for s in found) >= 3
    assert _sub_bands(6, 8) == ()


@pytest.mark.parametrize(("name", "shift"), [("bias", 0.3), ("gain", 0.2), ("rate", 0.1)])
def test_predicted_shifts_are_those_of_changed_simulated_trials(name, shift):
    """Against features of simulated trials that were changed sample by sample."""
    real, sim, boundaries = made(count=4)

    def changed(trial: Trial) -> Trial:
        x = trial.channels["fa"]
        new = {"bias": x + shift, "gain": (1 + shift) * x, "rate": x + shift * trial.t}[name]
        return Trial(trial.file, trial.t, trial.channels | {"fa": new})

    plain = layout(align(real, sim, TASK, boundaries=boundaries))
    other = layout(align(real, [changed(t) for t in sim], TASK, boundaries=boundaries))
    given, effect = scene(plain), {"rate": "force_drift"}.get(name, f"force_{name}")
    guess = predicted(given, 0, {effect: {name: shift}}) - predicted(given, 0, {})
    slow = plain.of_channel(0)[: plain.bins.sum()]
    truth = (both(other)[1] - both(plain)[1]).mean(0)[slow]
    tolerance = 0.02 if name == "rate" else 0.03  # trials differ in pace; the prediction is of their mean
    np.testing.assert_allclose(guess[: slow.size], truth, atol=tolerance)


def test_lag_and_filter_reach_the_spectrum(alike):
    given = scene(alike)
    fast = slice(int((alike.kind[alike.channel == 0] == SLOW).sum()), None)
    plain = predicted(given, 0, {})[fast]
    assert (predicted(given, 0, {"force_lowpass": {"time_constant": 0.1}})[fast] - plain).min() < -2
    loud = predicted(given, 0, {"noise_level": {"sd": 0.2}})[fast].reshape(3, 8)[
        :, 4:
    ]  # above what contacts hold
    np.testing.assert_allclose(loud, np.log(0.04 + 0.0004), atol=0.1)
    assert np.abs(predicted(given, 0, {"force_lag": {"delay": 0.08}})[fast] - plain).max() > 0.2


def test_a_gain_and_a_filter_leave_the_noise_that_comes_after_them(alike):
    given = scene(alike)
    fast = slice(int((alike.kind[alike.channel == 0] == SLOW).sum()), None)
    plain = predicted(given, 0, {})[fast].reshape(3, 8)[:, -1]  # nothing but noise in the highest band
    # Were it read through them, too, its log power would be off by 0.8 and by -7.
    for effect in ({"force_gain": {"gain": 0.5}}, {"force_lowpass": {"time_constant": 0.05}}):
        np.testing.assert_allclose(predicted(given, 0, effect)[fast].reshape(3, 8)[:, -1], plain, atol=0.2)


def test_a_ring_is_recovered_with_its_interval():
    rng, t, rings = np.random.default_rng(3), np.arange(400) / 200, []
    for _ in range(7):
        phase, size = rng.uniform(0, 6), rng.uniform(0.5, 1.0)
        wave = size * np.exp(-0.06 * 2 * np.pi * 7.4 * t) * np.sin(2 * np.pi * 7.4 * t + phase)
        rings.append(wave + 0.3 * t - 0.1 * t**2 + 0.02 * rng.standard_normal(t.size))
    found = fit_ring(from_swing(rings), 200.0)
    assert found is not None and found.frequency_90[0] < 7.4 < found.frequency_90[1]
    assert found.damping_90[0] < 0.06 < found.damping_90[1]
    assert found.frequency_90[1] - found.frequency_90[0] < 0.1
    assert fit_ring(np.tile(np.exp(-3 * t), (4, 1)), 200.0) is None  # a course is no ring


def test_alike_ensembles_are_called_alike():
    found = [diagnose(align(*made(seed)[:2], TASK, boundaries=made(seed)[2])).body for seed in range(8)]
    assert sum(body["verdict"] != "none" for body in found) <= 1


@pytest.mark.parametrize("name", list(PLANTED))
def test_a_planted_effect_is_named_with_its_parameters(name):
    real, sim, boundaries = made(5, {name: PLANTED[name]})
    body = diagnose(align(real, sim, TASK, boundaries=boundaries)).body
    assert body["verdict"] in ("named", "set") and name in {*body["causes"], *body["indistinguishable"]}
    assert sum(body["probabilities"].values()) == pytest.approx(1.0)
    best = body["effects"]["+".join(body["causes"])]["parameters"]
    prefix = f"{name}." if len(body["causes"]) > 1 else ""
    key, true = {
        "timing": ("press", 1.3), "structural_vibration": ("frequency", 7.5),
    }.get(name, ("fa", PLANTED[name].get("value")))  # fmt: skip
    if name in body["causes"]:
        p = best[prefix + key]
        low, high = p["interval_90"]
        wide = 2 * (high - low)
        assert low - wide < true < high + wide and p["mean"] == pytest.approx(true, rel=0.25)
    assert body["shrinkage"]["fraction"] > 0.5
    assert {row["channel"] for row in body["where"]} <= {"fa", "fb", "duration"}
    assert sum(row["share"] for row in body["where"]) == pytest.approx(1.0)


@pytest.mark.parametrize("pair", [("force_gain", "force_lag"), ("force_bias", "force_gain")])
def test_two_planted_effects_are_both_named(pair):
    """What a gain does to noise, and a lag by parts of a sample, must not stand in for one of them."""
    ensembles = case_of(101, {name: PLANTED[name] for name in pair}, False)
    assert diagnose(ensembles).body["causes"] == list(pair)


def test_an_effect_can_be_forced_and_an_unknown_one_is_refused():
    real, sim, boundaries = made(2, count=4)
    found = diagnose(align(real, sim, TASK, boundaries=boundaries), forced=["force_bias"])
    assert found.body["causes"] == ["force_bias"]
    with pytest.raises(InputError, match="needs the virtual model or is unknown"):
        diagnose(align(real, sim, TASK, boundaries=boundaries), forced=["grip_slip"])


def test_one_real_trial_says_that_it_is_weaker():
    real, sim, boundaries = made(4, {"force_bias": {"value": 1.0}})
    found = diagnose(align(real[:1], sim, TASK, boundaries=boundaries))
    assert any("nothing is held out" in w for w in found.warnings) and "force_bias" in found.leading


def test_trials_that_do_not_go_together_are_refused():
    real, sim, boundaries = made(4)
    with pytest.raises(InputError, match="one real and one simulated"):
        align(real[:1], sim[:1], TASK, boundaries=boundaries)
    with pytest.raises(InputError, match="2 increasing times"):
        align(real, sim, TASK, boundaries=boundaries | {real[0].file: np.array([1.0])})
    with pytest.raises(InputError, match=r"sim_00.csv: column fc: missing|column fc: missing"):
        align(real, sim, SequenceTask(TASK.sequence, ("fa", "fc")))


def test_missing_samples_are_bridged(alike):
    real, sim, boundaries = made()
    holed = real[0].channels["fa"].copy()
    holed[50:60] = np.nan
    real[0] = Trial(real[0].file, real[0].t, real[0].channels | {"fa": holed})
    found = both(layout(align(real, sim, TASK, boundaries=boundaries)))[0]
    assert np.isfinite(found).all()
    changed = ~np.isclose(found[0], both(alike)[0][0])
    assert 0 < changed.sum() < found.shape[1] / 3


def test_rates_may_differ():
    """Simulated at ten times the rate: compared at the real one's."""
    rng = np.random.default_rng(6)
    real, first = ensemble(rng, 5)
    sim, second = ensemble(rng, 5, None, Scatter(rate=1000.0, noise=0.02 * np.sqrt(10)), "sim")
    lay = layout(align(real, sim, TASK, boundaries=first | second))
    assert lay.rate == pytest.approx(100, rel=1e-3)
    found = both(lay)
    top = lay.kind == FAST
    assert np.abs(found[0].mean(0) - found[1].mean(0))[top].mean() < 0.6  # averaged, not picked


def test_rings_begin_at_their_event():
    waves = Ring(5.0, 0.1, 0.0, 0.0, (0.0, 0.0), (0.0, 0.0)).waves(np.array([-0.1, 0.0, 0.05]))
    np.testing.assert_allclose(waves[:, 0], 0.0)
    np.testing.assert_allclose(waves[:, 1], [0.0, 1.0])
    assert waves[0, 2] == pytest.approx(np.exp(-0.1 * 2 * np.pi * 5 * 0.05))


@pytest.mark.slow
def test_the_hmm_finds_the_subtasks_by_itself():
    real, sim, boundaries = made(7, {"force_bias": {"value": 1.0}})
    given = align(real, sim, TASK)
    # Without labels a boundary may settle anywhere in the course, but in all trials of both kinds alike.
    late = [cut.edges[1] - boundaries[cut.trial.file][0] for cut in (*given.real, *given.sim)]
    assert np.std(late) < 0.1 and "force_bias" in diagnose(given).body["causes"]
