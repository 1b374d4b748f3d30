"""Exact fits come to planted values from wrong starts, and sets are judged by the discrepancy they leave."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats
from simgap_swing import Swing, log

from simgap.attribution.posterior import fitted, forms
from simgap.robot_effects import candidates
from simgap.robot_effects.base import Setting
from simgap.robots.discrepancy import learned
from simgap.robots.fit import _prior, _slope, moved_to
from simgap.robots.gap import gap_of
from simgap.robots.judged import Judge
from simgap.robots.linear import base_at, linearise, vary
from simgap.robots.model import Composed
from simgap.robots.noise import noises
from simgap.robots.phases import phases_of
from simgap.robots.settle import SETTLED, settled
from simgap.robots.whiten import covariances
from simgap.simulators.recording import Recording
from simgap.simulators.user import checked

VISCOUS = 0.02


def composed(robot, logs) -> Composed:
    simulator = checked(robot, "robot")
    return Composed.of(simulator, logs, candidates(Setting(simulator, logs)), noises(simulator, logs))


def fit(model: Composed, point):
    linear = linearise(model, {}, [])
    return moved_to(model, linear, covariances(model, linear).whitener(), point)


@pytest.fixture(scope="module")
def damped() -> Composed:
    return composed(Swing(), [log(s, viscous=VISCOUS) for s in range(2)])


@pytest.mark.parametrize("start", [0.0, 0.001, 0.1])
def test_a_planted_value_is_found_from_wrong_starts(damped, start):
    found = fit(damped, {"viscous": {"viscous": start}})
    assert found.point["viscous"]["viscous"] == pytest.approx(VISCOUS, rel=0.05)
    assert found.gained > 100


def test_a_fit_comes_back_from_where_the_simulator_diverges():
    class Brittle(Swing):
        def simulate(self, parameters, recording, start=None):
            out = super().simulate(parameters, recording, start)
            return {"angle": out["angle"] * (np.nan if parameters["viscous"] > 0.05 else 1.0)}

    model = composed(Brittle(), [log(0, viscous=VISCOUS)])
    found = fit(model, {"viscous": {"viscous": 0.2}})
    assert found.point["viscous"]["viscous"] == pytest.approx(VISCOUS, rel=0.05)


def test_what_is_settled_stays(damped):
    first = settled(damped, {"viscous": {"viscous": 0.0}})
    assert first.gained > 100
    again = settled(damped, first.point)
    assert again.point == first.point and again.gained < SETTLED


class Two:
    """Two pendulums that do not act on each other."""

    parameters = {f"{n}_{side}": p for side in "ab" for n, p in Swing.parameters.items()}  # noqa: RUF012
    channels = {f"{n}_{side}": c for side in "ab" for n, c in Swing.channels.items()}  # noqa: RUF012

    def simulate(self, parameters, recording, start=None):
        """Both angles."""
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
        one = log(2 * seed + number, **mine)
        sides |= {f"{n}_{side}": v for n, v in one.columns.items()}
    return Recording(f"log{seed}.csv", one.t, sides)


def test_a_set_is_judged_by_the_discrepancy_that_it_leaves():
    """By the discrepancy that is left without it, a cause seems to gain a third of what it does: what nothing
    explains is as large as the cause's own doing. Once judged, none is left where it acts."""
    model = composed(Two(), [two(s, viscous_a=0.004, viscous_b=0.0005) for s in range(4)])
    parts, names = phases_of(model.simulator, model.recordings), ["viscous_a", "viscous_b"]
    linear = linearise(model, {}, names)
    at = vary(model, base_at(model, {}), linear.starts, "viscous_a", {"viscous_a": 0.004})
    assert at is not None
    linear = linear.with_moved({"viscous_a": at})
    cov = covariances(model, linear)
    off = learned(cov, linear.residual)
    assert {*off.scale} == {"angle_a", "angle_b"}
    f = forms(gap_of(model, linear, cov.whitener(off), parts, names))
    hidden = fitted(f, (0,)).score - fitted(f, ()).score
    judge = Judge(model, parts, linear, cov, off, f.log_odds)
    none, large, small, both = (judge(one) for one in ((), names[:1], names[1:], names))
    assert large.score - none.score > 3 * hidden > 300
    assert both.score > large.score + 100 > small.score + 200
    assert {*large.discrepancy.scale} == {"angle_b"} and {*small.discrepancy.scale} == {"angle_a"}
    assert both.discrepancy.scale.get("angle_a", 0.0) < 0.01 * off.scale["angle_a"]


def test_priors_are_cauchy_and_of_what_was_calibrated_normal():
    x = np.array([-30.0, -2.0, -1e-7, 0.0, 0.5, 4.0, 200.0])
    for calibrated, density in ((False, stats.cauchy), (True, stats.norm)):
        root = _prior(x, np.full(x.size, calibrated))
        np.testing.assert_allclose(-0.5 * root**2, density.logpdf(x) - density.logpdf(0.0), atol=1e-12)
    for at in (-30.0, -2.0, 0.5, 4.0):
        step, loose = 1e-5, np.zeros(2, bool)
        low, high = _prior(np.array([at - step, at + step]), loose)
        assert _slope(np.array([at]))[0] == pytest.approx((high - low) / (2 * step), rel=1e-6)
