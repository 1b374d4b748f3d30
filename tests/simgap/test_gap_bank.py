"""Banks for other rigs: the linearised bootstrap, what it moves, and the bank learned on one's own rig."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import gumbel_r
from simgap_scenes import HAND, STACK

from hmmseg.errors import InputError
from hmmseg.io.rig import Rig, read_rig
from hmmseg.io.task import GROUND, BlockTask, Move, read_task
from hmmseg.io.trial import read_trial
from simgap.gap import own_bank
from simgap.gap.adapt import adapted, fingerprint, moved
from simgap.gap.bank import Bank, Reference, load_bank, parse_bank
from simgap.gap.bootstrap import distribution, gumbel, largest_scores, refitted, statistics
from simgap.gap.calibrate import fitted, frames, healthy_cases, learned, steps
from simgap.gap.fit import residual_at
from simgap.gap.frame import CHANNELS
from simgap.gap.judge import Calibration
from simgap.gap.locate import STATISTICS, Detection, raised
from simgap.gap.noise import NoiseModel


def healthy_fit(shared, count=4):
    folder = shared / "recordings/none_1"
    rig, task = read_rig(folder / "rig.toml"), read_task(folder / "task.toml")
    trials = [read_trial(folder / f"trial_{k:02d}.csv", rig) for k in range(1, count + 1)]
    (frame,) = frames([trials], task, rig, lambda text: None)
    return trials, *fitted(frame, load_bank().noise)


@pytest.fixture(scope="module")
def healthy(shared):
    return healthy_fit(shared)


@pytest.fixture(scope="module")
def drawn(healthy):
    _, given, found = healthy
    return statistics(given, found, draws=1000, seed=5)


def test_a_refit_takes_out_what_properties_absorb():
    """One column, by hand: d = -a'z / (1 + a'a). Many, by least squares with the prior as further rows."""
    rng = np.random.default_rng(2)
    a, z = np.array([[1.0], [2.0], [2.0]]), np.array([[1.0, 0.0, 0.0], [0.0, 3.0, -3.0]])
    np.testing.assert_allclose(refitted(z, a), [[1 - 0.1, -0.2, -0.2], [0.0, 3.0, -3.0]])
    push, z = rng.standard_normal((12, 3)), rng.standard_normal((4, 12))
    rows, zero = np.vstack([push, np.eye(3)]), np.zeros(3)
    for one, left in zip(z, refitted(z, push), strict=True):
        step = np.linalg.lstsq(rows, -np.concatenate([one, zero]), rcond=None)[0]
        np.testing.assert_allclose(left, one + push @ step)


def test_scores_of_many_draws_are_those_of_each(healthy):
    _, given, _ = healthy
    z = 1.3 * np.random.default_rng(3).standard_normal((3, given.size))
    found = largest_scores(given, z)
    for k, one in enumerate(z):
        alone = np.zeros(given.whitening.weight.shape)
        alone[given.whitening.weight > 0] = one
        assert {n: float(v[k]) for n, v in found.items()} == pytest.approx(raised(given, alone))


def test_what_recurs_adds_up_and_what_does_not_cancels(healthy):
    _, given, _ = healthy
    z = np.random.default_rng(6).standard_normal(given.whitening.weight.shape)
    carry = next(k for k, s in enumerate(given.frame.steps) if s.name == "carry")
    inside = given.frame.arrays.subtask[..., None] == carry
    shift = np.where(inside, 0.8, 0.0) * (np.arange(z.shape[2]) == CHANNELS.index("fy"))
    sign = np.array([1.0, -1.0] * z.shape[0])[: z.shape[0], None, None]
    plain, same, other = (raised(given, z + add)["coherent"] for add in (0.0, shift, sign * shift))
    assert same > plain + 2
    assert other == pytest.approx(plain, abs=0.5)
    assert load_bank().detection.p_values({"coherent": same})["coherent"] < 1e-3


def test_quartiles_tell_a_gumbel_distribution():
    location, scale = gumbel(gumbel_r.rvs(3.0, 0.6, size=20_000, random_state=np.random.default_rng(4)))
    assert location == pytest.approx(3.0, abs=0.02)
    assert scale == pytest.approx(0.6, abs=0.02)


def test_p_values_are_uniform_on_its_own_draws(drawn):
    found = distribution(drawn)
    for name in STATISTICS:
        p = gumbel_r.sf(drawn[name], *getattr(found, name))
        assert np.mean(p < 0.5) == pytest.approx(0.5, abs=0.03)
        assert np.mean(p < 0.05) < 0.07
        assert np.mean(p < 0.01) < 0.02
        if name != "gain":  # whose middle is narrower than its tail
            assert np.mean(p < 0.2) == pytest.approx(0.2, abs=0.05)


def test_the_nominal_rig_gives_the_reference(healthy, drawn):
    """Both are Monte Carlo: 1000 draws on one recording against the bank's own cases."""
    trials, given, found = healthy
    bank = load_bank()
    assert bank.reference is not None
    assert adapted(bank, given, found, trials) is bank
    here = distribution(drawn)
    for name in STATISTICS:
        (location, scale), (a, b) = getattr(here, name), getattr(bank.reference.bootstrap, name)
        assert location == pytest.approx(a, abs=0.12)
        assert scale == pytest.approx(b, rel=0.2)


def test_distributions_move_as_the_bootstrap_does():
    learned_there = Detection((3.0, 0.6), (2.5, 0.5), (2.0, 0.4), (-0.9, 1.0), 1.25)
    there = Detection((2.0, 0.3), (2.0, 0.3), (1.5, 0.2), (-0.5, 0.4))
    here = Detection((2.5, 0.45), (1.5, 0.15), (1.6, 0.3), (0.0, 4.0))
    found = moved(learned_there, there, here)
    assert found.cell == pytest.approx((3.5, 0.9))
    assert found.pooled == pytest.approx((2.0, 0.25))
    assert found.coherent == pytest.approx((2.1, 0.6))
    assert found.gain == pytest.approx((-0.4, 2.0))  # ten times as wide is not believed
    assert found.margin == 1.25


def test_another_number_of_trials_moves_the_nominal_bank(shared, healthy):
    """A bank learned on four trials, met by two of them: fewer cells, smaller largest scores."""
    trials, given, found = healthy
    bootstrap = distribution(statistics(given, found))
    mark = fingerprint(given.frame.task, given.frame.rig, 20.0, 4)
    bank = replace(load_bank(), reference=Reference(mark, given.frame.world.t.shape[1], bootstrap))
    assert adapted(bank, given, found, trials) is bank
    assert adapted(replace(bank, reference=None), *healthy_fit(shared, 2)[1:], trials[:2]).source == "nominal"
    fewer = adapted(bank, *healthy_fit(shared, 2)[1:], trials[:2])
    assert fewer.source == "bootstrap"
    assert fewer.detection.cell[0] < bank.detection.cell[0] - 0.05
    assert fewer.noise is bank.noise


def test_a_fingerprint_knows_the_rig_and_not_the_names():
    renamed = BlockTask({"a": "b", "b": GROUND}, (Move("a", GROUND), Move("b", "a")))
    same = fingerprint(STACK, HAND, 20.0, 4)
    assert fingerprint(renamed, HAND.model_copy(update={"rate": None}), 20.0, 4) == same
    soft = HAND.fingertip.model_copy(update={"normal_stiffness": 1500.0})
    others = {
        fingerprint(STACK, HAND, 21.0, 4),
        fingerprint(STACK, HAND, 20.0, 3),
        fingerprint(STACK, HAND.model_copy(update={"fingertip": soft}), 20.0, 4),
        fingerprint(replace(STACK, repeat=2), HAND, 20.0, 4),
    }
    assert len(others | {same}) == 5


def test_a_bank_is_written_and_read_again():
    reference = Reference("abc", 240, Detection((2.9, 0.3), (2.5, 0.3), (2.1, 0.3), (-0.7, 0.3)))
    bank = replace(load_bank(), reference=reference)
    again = parse_bank(bank.to_json())
    assert (again.detection, again.reference) == (bank.detection, reference)
    assert parse_bank(replace(bank, reference=None).to_json()).reference is None


def test_ones_own_bank_is_learned_once(shared, tmp_path, monkeypatch):
    folder = shared / "recordings/none_1"
    trials = [read_trial(folder / f"trial_{k:02d}.csv", HAND) for k in (1, 2)]
    asked = []

    def instead(task: BlockTask, rig: Rig, count: int, calibration: Calibration, tell) -> Bank:
        asked.append((rig.rate, count))
        return Bank(
            NoiseModel.plain(), Detection((1.0, 0.5), (1.0, 0.5), (1.0, 0.5), (0.0, 1.0)), calibration
        )

    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(own_bank, "learned", instead)
    hand = HAND.model_copy(update={"rate": 100.0})  # the recordings' rate counts
    first, second = (own_bank.own_bank(trials, STACK, hand, lambda text: None) for _ in range(2))
    assert asked == [(20.0, 2)]
    assert first.detection == second.detection
    assert first.source == second.source == "calibrated"
    own_bank.own_bank(trials[:1], STACK, hand, lambda text: None)
    assert asked == [(20.0, 2), (20.0, 1)]
    for file in (tmp_path / "hmmseg/banks").iterdir():
        file.write_text("{spoiled")
    assert own_bank.own_bank(trials, STACK, hand, lambda text: None).detection == first.detection
    assert len(asked) == 3


def test_what_cannot_be_simulated_is_refused():
    refused = [
        (STACK, HAND.model_copy(update={"fingers": None}), "Cartesian hand"),
        (STACK, HAND.model_copy(update={"noise": HAND.noise.model_copy(update={"force": None})}),
         "noise.force: missing"),
        (replace(STACK, repeat="unknown"), HAND, "how often the moves are repeated"),
    ]  # fmt: skip
    for task, rig, text in refused:
        with pytest.raises(InputError, match=text):
            own_bank.own_bank([], task, rig, lambda told: None)


@pytest.mark.slow
def test_a_bank_learned_on_a_noisy_rig_takes_its_recordings_for_healthy():
    noise = HAND.noise.model_copy(update={"angle": 8e-4, "velocity": 0.12, "force": 0.048})
    hand, told = HAND.model_copy(update={"noise": noise}), []
    bank = learned(STACK, hand, 2, Calibration(), told.append, healthy=8, catalogued=4)
    assert len(told) <= steps(8)
    assert 0.8 < bank.calibration.floor < 1.1
    fresh = healthy_cases(STACK, hand, 2, 2, lambda text: None, first=500)
    for frame in frames(fresh, STACK, hand, lambda text: None):
        given, found = fitted(frame, bank.noise)
        p = bank.detection.p_values(raised(given, residual_at(given, (), found.u)))
        assert min(p.values()) > 0.01
        assert 0.8 < found.square.sum() / given.size < 1.2
