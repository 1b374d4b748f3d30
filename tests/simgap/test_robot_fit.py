"""Exact fits come to planted values from wrong starts, and sets are judged by the discrepancy they leave."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy import stats
from simgap_swing import Swing, log

from simgap.robot_effects import candidates
from simgap.robot_effects.base import Setting
from simgap.robots.fit import _prior, _slope, fit_effects
from simgap.robots.linear import linearise
from simgap.robots.model import Composed
from simgap.robots.rows import noises, phases_of
from simgap.robots.search import BETTER, Search
from simgap.robots.sets import point_of
from simgap.robots.verdict import Shrinkage, verdict_on
from simgap.robots.whiten import covariances
from simgap.simulators.protocol import Channel, Parameter
from simgap.simulators.recording import Recording
from simgap.simulators.user import checked

VISCOUS = 0.02


def composed(robot, logs) -> Composed:
    simulator = checked(robot, "robot")
    return Composed.of(simulator, logs, candidates(Setting(simulator, logs)), noises(simulator, logs))


def fit(model: Composed, point):
    linear = linearise(model, {}, [])
    return fit_effects(model, linear, covariances(model, linear).whitener(), point)


@pytest.fixture(scope="module")
def damped() -> Composed:
    return composed(Swing(), [log(s, viscous=VISCOUS) for s in range(2)])


@pytest.mark.parametrize("start", [0.0, 0.001, 0.1])
def test_a_planted_value_is_found_from_wrong_starts(damped, start):
    found = fit(damped, {"viscous": {"viscous": start}})
    assert found["viscous"]["viscous"] == pytest.approx(VISCOUS, rel=0.05)


def test_a_fit_and_a_search_come_back_from_where_the_simulator_diverges(damped):
    class Brittle(Swing):
        def simulate(self, parameters, recording, start=None):
            out = super().simulate(parameters, recording, start)
            return {"angle": out["angle"] * (np.nan if parameters["viscous"] > 0.05 else 1.0)}

    model = composed(Brittle(), [log(0, viscous=VISCOUS)])
    found = fit(model, {"viscous": {"viscous": 0.2}})
    assert found["viscous"]["viscous"] == pytest.approx(VISCOUS, rel=0.05)
    search = Search(damped, tuple(damped.effects), damped.rows.log)
    nothing, names = search.nothing(), tuple(damped.effects)
    best = replace(nothing, names=names, point={n: e.neutral() for n, e in damped.effects.items()})
    for out in names:
        rest = tuple(n for n in names if n != out)
        search.fitted[frozenset(rest)] = replace(
            nothing, names=rest, linear=replace(nothing.linear, moved={}, diverged=rest), score=-np.inf
        )
    assert search._exchange(best) is None


def test_causes_are_proposed_near_their_size_and_twins_are_judged_too():
    model = composed(Swing(), [log(s, viscous=0.1) for s in range(2)])
    search = Search(model, tuple(model.effects), model.rows.log)
    sets, _ = search.propose(search.nothing(), search.wanted)
    found = point_of(model.effects, sets.fit(("viscous",), 0), ("viscous",), search.along)
    assert found["viscous"]["viscous"] == pytest.approx(0.1, rel=0.1)
    model = composed(Swing(), [log(s, torque_scale=1.4) for s in range(2)])
    search = Search(model, tuple(model.effects), model.rows.log)
    best = search.forced(("torque_scale",))
    search._judge_twins(best, "torque_scale")
    (twin,) = {*search.fitted} - {frozenset(), frozenset(best.names)}
    assert twin == {"command:torque.gain"} and search.fitted[twin].score == pytest.approx(best.score, abs=2.0)
    assert search.fitted[twin].point["command:torque.gain"]["gain"] == pytest.approx(0.4, abs=0.01)


def test_a_set_is_fitted_again_from_a_larger_one_that_promises_more(damped, monkeypatch):
    search = Search(damped, tuple(damped.effects), damped.rows.log)
    one = search.fit(("viscous",), {"viscous": {"viscous": 0.0}}, [search.nothing().whiten])
    other = next(n for n, e in damped.effects.items() if not e.fitted and n != "viscous")
    both = search.fit(("viscous", other), {**one.point, other: damped.effects[other].neutral()}, [one.whiten])
    search.fitted[frozenset(one.names)] = replace(one, score=one.score - 50.0)  # stuck elsewhere
    assert search._without(both, other).score == pytest.approx(one.score, abs=2 * BETTER)
    monkeypatch.setattr(search, "fit", lambda *_: pytest.fail("fitted though nothing is promised"))
    assert search._without(both, other).names == ("viscous",)


def test_what_is_settled_stays_and_lines_from_starts_hide_in_no_discrepancy(damped):
    search = Search(damped, tuple(damped.effects), damped.rows.log)
    nothing = search.nothing()
    loud, quiet = (replace(nothing, discrepancy=d) for d in ({"angle": 1e3}, {}))
    assert search._begun_anew(loud, quiet)[2] > 2 * search._begun_anew(loud, loud)[2] > 0
    search = Search(damped, tuple(damped.effects), damped.rows.log)
    nothing = search.nothing()
    first = search.fit(("viscous",), {"viscous": {"viscous": 0.0}}, [nothing.whiten])
    assert first.score > nothing.score + 100
    again = search.fit(("viscous",), first.point, [first.whiten])
    assert abs(again.score - first.score) < 2 * BETTER


def test_searches_thin_windows_of_many_rows_and_fit_rivals_to_the_end(damped, monkeypatch):
    every = damped.thinned()
    monkeypatch.setattr("simgap.robots.model.MOST_ROWS", -(-damped.rows.log.size // 2))
    assert damped.thinned() == every[::2]
    none = tuple(slice(0, 0) for _ in every)  # readings that are missing throughout
    assert replace(damped, rows=replace(damped.rows, of=none)).thinned() == every
    search, again = Search(damped, tuple(damped.effects), damped.rows.log), []
    best = search.nothing()
    for name, score, promise in (("near", -4.0, -1.0), ("far", -9.0, -4.0), ("settled", -2.0, -2.0)):
        one = replace(best, names=(name,), score=best.score + score, promise=best.score + promise)
        search.fitted[frozenset(one.names)] = one
    monkeypatch.setattr(search, "fit", lambda names, *_: again.append(names))
    assert search._settled(best) is best and again == [("near",)]


@pytest.mark.parametrize(("gain", "better"), [(0.0, True), (9.0, True), (-9.0, False)])
def test_of_what_explains_alike_the_simpler_is_preferred(damped, monkeypatch, gain, better):
    search = Search(damped, tuple(damped.effects), damped.rows.log)
    held_out = {"coulomb": np.full(4, gain), "stribeck": np.zeros(4)}
    monkeypatch.setattr(search, "_held_out", lambda one, _: held_out[one.names[0]])
    one, two = (SimpleNamespace(names=(n,), score=score, sets=SimpleNamespace(size=size), discrepancy={})
                for n, score, size in (("coulomb", 0.5, (1,)), ("stribeck", 0.0, (2,))))  # fmt: skip
    assert search._is_better(one, two) is better and not search._is_better(two, one)


def test_a_small_gap_whose_only_cause_is_doubted_is_none():
    model = composed(Swing(), [log(s) for s in range(3)])
    search = Search(model, tuple(model.effects), model.rows.log)
    nothing = search.nothing()
    best = search.fit(("viscous",), {"viscous": {"viscous": 0.0}}, [nothing.whiten])
    best = replace(best, score=nothing.score + 20)
    far = Shrinkage(1.0, 1.0, 1.0, 0.0, (0.0, 0.0), {}, *np.zeros((3, 1)))
    phases = phases_of(model.simulator, model.recordings, model.windows)
    found = verdict_on(search, best, far, phases, 0, False)
    assert found.detection.p_value < 0.01 and found.doubts and (found.verdict, found.causes) == ("none", ())


class Two:
    """Two pendulums that do not act on each other."""

    parameters = {f"{n}_{side}": p for side in "ab" for n, p in Swing.parameters.items()}  # noqa: RUF012
    channels = {f"{n}_{side}": c for side in "ab" for n, c in Swing.channels.items()}  # noqa: RUF012

    def simulate(self, parameters, recording, start=None):
        out = {}
        for side in "ab":
            mine = {n: parameters[f"{n}_{side}"] for n in Swing.parameters}
            driven = Recording("", recording.t, {"torque": recording[f"torque_{side}"]})
            begun = None
            if start is not None:
                begun = {n: start[n.replace("angle", f"angle_{side}", 1)] for n in ("angle", "angle_rate")}
            out[f"angle_{side}"] = Swing().simulate(mine, driven, begun)["angle"]
        return out


def two(seed: int, **changed: float) -> Recording:
    sides = {}
    for number, side in enumerate("ab"):
        mine = {n[:-2]: v for n, v in changed.items() if n.endswith(f"_{side}")}
        one = log(2 * seed + number, seconds=3.0, **mine)
        sides |= {f"{n}_{side}": v for n, v in one.columns.items()}
    return Recording(f"log{seed}.csv", one.t, sides)


@pytest.mark.slow
def test_a_set_is_judged_by_the_discrepancy_that_it_leaves():
    """By the discrepancy that is left without it, a cause seems to gain a third of what it does."""
    model = composed(Two(), [two(s, viscous_a=0.004, viscous_b=0.0005) for s in range(4)])
    search, names = Search(model, tuple(model.effects), model.rows.log), ("viscous_a", "viscous_b")
    none = search.nothing()
    assert {*none.discrepancy} >= {"angle_a", "angle_b"}
    sets, levels = search.propose(none, names)
    hidden = float(sets.scores([names[:1]], 0)[0] - sets.scores([()], 0)[0])
    large, small, both = (search.fit(one, {n: {n: 0.004 if n[-1] == "a" else 0.0005}
                                           for n in one}, [levels[-1]])
                          for one in (names[:1], names[1:], names))  # fmt: skip
    assert large.score - none.score > 1.5 * hidden > 30 and both.score > large.score + 20 > small.score + 40
    left = [one.discrepancy for one in (large, small, both)]
    assert left[0].get("angle_a", 0.0) < 0.02 * none.discrepancy["angle_a"] < left[1]["angle_a"]
    assert "angle_b" in left[0] and "angle_b" not in left[1] and not left[2]


class Tipping:
    """What stands on its end and falls, theta'' = 25 sin(theta): errors of a start grow a hundredfold."""

    parameters = {"pull": Parameter(25.0, 1.0)}  # noqa: RUF012
    channels = {"angle": Channel("rad", "position")}  # noqa: RUF012

    def simulate(self, parameters, recording, start=None):
        fall = lambda x: np.array([x[1], parameters["pull"] * np.sin(x[0])])  # noqa: E731
        x = np.array([start["angle"], start["angle_rate"]] if start else [0.01, 0.0])
        out = [x]
        for h in np.diff(recording.t):
            a = fall(x)
            b = fall(x + 0.5 * h * a)
            c = fall(x + 0.5 * h * b)
            x = x + h / 6 * (a + 2 * b + 2 * c + fall(x + h * c))
            out.append(x)
        return {"angle": np.array(out)[:, 0]}


def test_a_start_that_says_much_of_what_follows_is_no_gap():
    """A fall is far from linear about the start that the first samples show alone."""
    t, logs = np.arange(0, 1, 0.01), []
    for seed in range(4):
        still = Recording("", t, {})
        angle = Tipping().simulate({"pull": 25.0}, still, {"angle": 0.05 - 0.02 * seed, "angle_rate": 0.0})
        noisy = angle["angle"] + 1e-3 * np.random.default_rng(seed).standard_normal(t.size)
        logs.append(Recording(f"{seed}.csv", t, {"angle": noisy}))
    simulator = checked(Tipping(), "robot")
    model = Composed.of(simulator, logs, candidates(Setting(simulator, logs)), {"angle": 1e-3}, 1.0)
    linear = linearise(model, {}, [])
    white = covariances(model, linear).whitener()(linear.residual)
    search = Search(model, tuple(model.effects), model.rows.log)
    nothing = search.nothing()
    assert np.mean(white**2) > 2 and nothing.squares.mean() < 1.2 and not nothing.discrepancy


def test_priors_are_cauchy_and_of_what_is_fitted_along_normal():
    x = np.array([-30.0, -2.0, -1e-7, 0.0, 0.5, 4.0, 200.0])
    for tails, density in ((1.0, stats.cauchy()), (30.0, stats.cauchy(scale=1 / 30)), (0.0, stats.norm())):
        root = _prior(x, np.full(x.size, tails))
        np.testing.assert_allclose(-0.5 * root**2, density.logpdf(x) - density.logpdf(0.0), atol=1e-12)
        for at in (-30.0, -2.0, 0.5, 4.0):
            step, both = 1e-5, np.full(2, tails)
            low, high = _prior(np.array([at - step, at + step]), both)
            assert _slope(np.array([at]), both[:1])[0] == pytest.approx((high - low) / (2 * step), rel=1e-6)
