"""What changed between two sets of logs: a small servo whose changes are planted, as oracle."""

from dataclasses import replace
from functools import cache
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.special import logsumexp
from scipy.stats import ttest_1samp, ttest_ind

from experiments.real.servo import Servo
from hmmseg.errors import InputError
from simgap.robot_effects import effects_of
from simgap.robots.calibrate import Calibration, calibrate
from simgap.robots.changes import (
    Changes,
    Comparison,
    Hypothesis,
    _chances,
    _unlike,
    added_by_drift,
    by_chance,
    changes,
    jackknife,
)
from simgap.robots.unchanged import without_broken
from simgap.simulators.recording import Recording
from simgap.simulators.user import checked

KNOWN = ("mass", "length", "gain", "coulomb")
TRUE = {"mass": 0.5, "length": 0.12, "gain": 2.6, "coulomb": 0.15}
SIMULATOR = checked(Servo(0.5, 0.12, 16.0), "servo.py:Servo")


def recorded(motion: str, seed: int, changed: dict[str, float]) -> Recording:
    """A log of 2 s at 50 Hz of the servo with its true parameters."""
    t = np.arange(100) / 50
    goal = {
        "slow": 1.2 * np.sin(1.5 * t),
        "slower": 0.9 * t / 2,
        "slowest": -0.7 * np.sin(0.8 * t), "fast": 0.8 * np.sin(7 * t), "step": np.where(t > 0.4, 1.3, 0.0),
        "drop": np.where(t < 1, 1.4 * np.minimum(t / 0.8, 1), 1.4),
    }[motion]  # fmt: skip
    on = np.where((motion == "drop") & (t > 1), 0.0, 1.0)
    columns = {"goal": goal, "volts": np.full(t.size, 12.0), "on": on, "position": np.zeros(t.size)}
    nominal = {n: p.nominal for n, p in SIMULATOR.parameters.items()} | TRUE | changed
    start, rng = {"position": 0.0, "position_rate": 0.0}, np.random.default_rng(seed)
    log = Recording(f"{motion}_{seed}.csv", t, columns)
    angle = SIMULATOR.simulate(nominal, log, start)["position"] + 0.001 * rng.normal(size=t.size)
    log = log.with_columns({"position": angle})
    duty = SIMULATOR.simulate(nominal, log, start)["duty"] + 0.002 * rng.normal(size=t.size)
    return log.with_columns({"duty": duty})


def logs(seed: int, motions: tuple[str, ...] = ("slow", "fast", "step", "drop"),
         **changed: float) -> list[Recording]:  # fmt: skip
    return [recorded(m, seed + k, changed) for k, m in enumerate(motions)]


@cache
def healthy() -> tuple[dict, list[Recording], Calibration]:
    old = logs(0)
    every = effects_of(SIMULATOR, old)
    effects = {n: replace(e, fitted=n in ("gain", "coulomb")) for n, e in every.items() if n in KNOWN}
    return effects, old, calibrate(SIMULATOR, old, effects)


@cache
def compared(**changed: float) -> Changes:
    effects, old, calibration = healthy()
    before = compared().old if changed else None
    return changes(SIMULATOR, old, logs(100, **changed), effects, calibration=calibration, known=before)


def test_nothing_changed_is_none_and_one_old_log_is_too_few():
    found = compared()
    body = found.body()
    assert (body["verdict"], body["causes"]) == ("none", [])
    assert sum(body["probabilities"].values()) == pytest.approx(1.0)
    with pytest.raises(InputError, match="--healthy: has 1 log; expected two"):
        changes(SIMULATOR, logs(0, ("slow",)), logs(1, ("slow",)), {})


def test_a_gain_doubled_is_named_with_its_ratio():
    found = compared(gain=5.2)
    assert found.verdict == "named" and found.best.effects == ("gain",)
    size = found.sizes()["gain"]
    low, high = size["ratio_90"]
    assert low <= 2.0 <= high and size["ratio"] == pytest.approx(2.0, rel=0.03)
    body = found.body()
    assert body["changes"][0].startswith("gain +") and body["effects"]["gain"]["parameters"].keys() == {
        "gain"
    }
    pair = replace(found.best, effects=("gain", "mass"), **{n: np.repeat(getattr(found.best, n), 2) for n in
                   ("x", "sd", "freedom")})  # fmt: skip
    both = replace(found, best=pair).body()["effects"]
    assert {n: {*e["parameters"]} for n, e in both.items()} == {
        "gain+mass": {"gain.gain", "mass.mass"}, "gain": {"gain"}, "mass": {"mass"},
    }  # fmt: skip


def test_next_experiments_are_motions_that_differ_most_and_logs_of_old_tell_nothing_of_the_arm():
    found = compared(gain=5.2)
    apart = 0.1 * np.arange(found.best.left.size)
    other = replace(found.best, effects=("mass",), left=found.best.left + apart)
    asked = replace(found, verdict="set", others=(other,)).body()["next_experiment"]
    unit = found.runs.units[-1]
    rows = found.runs.unit == unit
    assert asked["log"] == found.composed.recordings[int(found.runs.log[rows][0])].name
    assert asked["expected_gain_nats"] == pytest.approx(apart[-1] * rows.sum() / found.old.dependence)
    assert asked["separates"] == ["gain", "mass"]
    nominal = {n: p.nominal for n, p in SIMULATOR.parameters.items()} | TRUE
    log, start = recorded("fast", 0, {}), {"position": 0.0, "position_rate": 0.0}

    def angles(**changed: float) -> np.ndarray:
        return SIMULATOR.simulate(nominal | {"mass": 0.5} | changed, log, start)["position"]

    np.testing.assert_allclose(angles(arm=2.0), angles(), atol=1e-9)
    assert np.abs(angles(arm=2.0, mass=0.9) - angles(mass=0.9)).max() > 1e-3


@pytest.mark.slow
def test_what_no_log_can_tell_apart_is_a_set_whose_intervals_hold():
    found = compared(mass=0.7)
    members = {c.effects for c in (found.best, *found.others)}
    assert ("mass",) in members and members <= {("mass",), ("length",)}
    mass = next(c for c in (found.best, *found.others) if c.effects == ("mass",))
    low, high = found.sizes(mass)["mass"]["interval_90"]
    assert low <= 0.7 <= high
    old, new = logs(0), logs(50, mass=0.7)
    every = effects_of(SIMULATOR, old)
    effects = {n: replace(every[n], fitted=n == "coulomb") for n in ("mass", "coulomb")}
    effects["twin"] = replace(every["mass"], name="twin")
    found = changes(SIMULATOR, old, new, effects)
    assert found.verdict == "set"
    assert {c.effects for c in (found.best, *found.others)} == {("mass",), ("twin",)}


def test_a_single_wild_sample_is_found_and_is_no_cause_and_the_end_of_a_log_is_not_broken():
    (log,) = logs(3, ("fast",))
    wild = log["position"].copy()
    wild[57] = -3.14
    (clean,), broken = without_broken(SIMULATOR, [log.with_columns({"position": wild})])
    assert [(b.channel, b.time, b.value) for b in broken] == [("position", 1.14, -3.14)]
    assert np.isnan(clean["position"][57]) and np.isfinite(np.delete(clean["position"], 57)).all()
    assert without_broken(SIMULATOR, [log])[1] == []
    (log,) = logs(3, ("step",))
    ends = log["duty"].copy()
    ends[[0, -1]] = 0.9
    assert without_broken(SIMULATOR, [log.with_columns({"duty": ends})])[1] == []


def test_leaving_one_out_of_means_is_welchs_test():
    rng = np.random.default_rng(0)
    a, b = rng.normal(size=5), 3 * rng.normal(size=4)
    without = [np.array([[np.delete(v, k).mean()] for k in range(v.size)]) for v in (a, b)]
    sd, freedom = jackknife(without)
    welch = ttest_ind(a, b, equal_var=False)
    assert (a.mean() - b.mean()) / sd[0] == pytest.approx(welch.statistic)
    assert freedom[0] == pytest.approx(welch.df)
    more, many = jackknife(without, np.array([4.0]))  # what a prior leaves open adds to what motions say
    assert more[0] == pytest.approx(np.hypot(sd[0], 2.0)) and many[0] > freedom[0]
    assert np.isinf(jackknife([without[0], np.zeros((1, 1))])[0][0])  # of one unit nothing is sure


def test_a_size_takes_in_that_all_else_may_have_drifted():
    """Drifts as parameters of their own, with the prior that they have, leave the same variances."""
    rng = np.random.default_rng(0)
    p, k, drift = 3, 2, np.array([0.1, 0.0, 0.4])
    before, new = (a.T @ a for a in (rng.normal(size=(6, p)), rng.normal(size=(9, p + k))))
    total = new.copy()
    total[:p, :p] += before
    whole = np.zeros((2 * p + k, 2 * p + k))  # OLD's theta, changes, drifts
    whole[: p + k, : p + k] = total
    whole[: p + k, p + k :] = new[:, :p]
    whole[p + k :] = np.hstack([new[:p], new[:p, :p] + np.diag(1 / np.maximum(drift, 1e-12))])
    wanted = np.diag(np.linalg.inv(whole))[p : p + k] - np.diag(np.linalg.inv(total))[p:]
    np.testing.assert_allclose(added_by_drift(total, before, drift)[p:], wanted, rtol=1e-6)


def test_an_explanations_energy_is_minus_the_log_of_its_evidence():
    """By quadrature over the change, with nothing fitted along."""
    every = effects_of(SIMULATOR, logs(0))
    found = changes(SIMULATOR, logs(0), logs(100, gain=3.5), {"gain": replace(every["gain"], fitted=False)})
    one = next(c for c in found.tried if c.effects == ("gain",))
    of = Hypothesis.about(Comparison(found.composed, found.old, [], found.runs.unit).runs, found.old,
                          ("gain",))  # fmt: skip
    x = one.x[0] + np.linspace(-0.1, 0.1, 401)
    costs = np.array([of.cost(np.array([v])) for v in x]) / found.old.dependence
    evidence = logsumexp(-costs - np.log(np.pi * (1 + x**2))) + np.log(x[1] - x[0])
    assert one.energy == pytest.approx(-evidence, abs=0.1) and found.p_value < 1e-6


def test_gains_and_unlike_motions_are_judged_by_chance():
    gains = np.array([0.3, 0.1, 0.5, -0.1])
    assert by_chance(gains) == pytest.approx(ttest_1samp(gains, 0, alternative="greater").pvalue)
    rng = np.random.default_rng(0)
    found = np.array([_unlike(np.exp(rng.normal(size=2)), np.exp(rng.normal(size=3))) for _ in range(2000)])
    assert np.mean(found < 0.1) == pytest.approx(0.1, abs=0.02)


@pytest.mark.parametrize(("p", "likelier"),
                         [(1e-6, "unknown"), (0.007, "unknown"), (0.02, "none"), (0.6, "none")])  # fmt: skip
def test_unknown_is_likelier_than_none_where_it_is_the_verdict(p, likelier):
    found = _chances(SimpleNamespace(effects=()), {}, 1.0, p)
    assert max(found, key=lambda n: found[n]) == likelier and sum(found.values()) == pytest.approx(1.0)
