"""What could stand in for a named cause is found where it fits best, and told with it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from simgap.attribution.posterior import fitted, forms
from simgap.attribution.problem import Candidate, Gap, Rows
from simgap.robot_effects import candidates
from simgap.robot_effects.base import Setting
from simgap.robots.describe import body
from simgap.robots.diagnose import diagnose
from simgap.robots.linear import base_at, linearise
from simgap.robots.model import Composed
from simgap.robots.noise import noises
from simgap.robots.phases import phases_of
from simgap.robots.stand_ins import _Asked, _Fit, _Place, _told_apart, log_prior
from simgap.robots.whiten import covariances
from simgap.simulators.recording import Recording
from simgap.simulators.user import checked

RATE, WIDTH = 50.0, 0.03


class Servo:
    """A joint that follows its command but for a band: of errors that the controller does not see, or of
    friction, which are one and the same here."""

    parameters = {  # noqa: RUF012
        n: {"nominal": 0.0, "sd": 0.01, "unit": "rad", "low": 0.0, "high": 0.2} for n in ("band", "friction")
    }
    channels = {  # noqa: RUF012
        "cmd": {"unit": "rad", "kind": "command"},
        "pos": {"unit": "rad", "kind": "position", "noise": 1e-4},
    }
    window = 2.0

    def simulate(self, parameters, recording, start=None):
        """Positions."""
        return {
            "pos": follow(
                parameters["band"] + parameters["friction"], recording["cmd"], start["pos"] if start else 0.0
            )
        }


def follow(width: float, command: np.ndarray, begin: float, pushed: np.ndarray | None = None) -> np.ndarray:
    """A first-order lag towards the command outside of the band."""
    out = np.full(command.size, begin)
    for i in range(command.size - 1):
        error = command[i] - out[i]
        out[i + 1] = out[i] + 0.2 * np.sign(error) * max(abs(error) - width, 0.0)
        out[i + 1] += 0.0 if pushed is None else pushed[i]
    return out


def logs(count: int = 4) -> list[Recording]:
    """Triangles of several paces, and pushes that no candidate explains."""
    rng, t, out = np.random.default_rng(3), np.arange(0, 8, 1 / RATE), []
    for k in range(count):
        command = 0.1 * np.abs(((0.2 + 0.1 * k) * t) % 2 - 1)
        pushed = np.convolve(2e-4 * rng.standard_normal(t.size), np.ones(5), "same")
        pos = follow(WIDTH, command, command[0], pushed) + 1e-4 * rng.standard_normal(t.size)
        out.append(Recording(f"log_{k}.csv", t, {"cmd": command, "pos": pos}))
    return out


def test_two_that_do_the_same_are_a_set_wherever_the_search_ended():
    found = diagnose(checked(Servo(), "servo"), logs())
    told = body(found)
    assert told["verdict"] == "set"
    assert {*told["causes"], *told["indistinguishable"]} == {"band", "friction"}
    for name in ("band", "friction"):
        (width,) = told["effects"][name]["parameters"].values()
        assert abs(width["mean"] - WIDTH) < 0.2 * WIDTH, name


class Geared(Servo):
    """The same, or a joint that lags behind its motor by half of a play."""

    parameters = Servo.parameters | {"play": Servo.parameters["band"]}

    def simulate(self, parameters, recording, start=None):
        """Positions."""
        pos, play = super().simulate(parameters, recording, start)["pos"], parameters["play"]
        if not play:
            return {"pos": pos}
        begin, out = start["pos"] if start else 0.0, np.empty(pos.size)
        motor = follow(0.0, recording["cmd"], float(np.clip(recording["cmd"][0], begin - play, begin + play)))
        joint = begin
        for i, at in enumerate(motor):
            out[i] = joint = min(max(joint, at - play), at + play)
        return {"pos": out}


def test_an_effect_is_begun_where_it_does_what_the_cause_does():
    """Straight lines from no play at all, about which a play moves little, do not lead there."""
    simulator, recorded = checked(Geared(), "geared"), logs()
    noise = noises(simulator, recorded)
    composed = Composed.of(
        simulator, recorded, candidates(Setting(simulator, recorded)), noise, length=Geared.window
    )
    linear = linearise(composed, {}, ["play"])
    sensor = covariances(composed, linear).whitener()
    asked = _Asked(
        composed,
        phases_of(simulator, recorded),
        linear.rows.log,
        np.ones(linear.rows.log.size),
        sensor,
        sensor,
        0,
    )
    place = _Place.of(asked, {"band": {"band": WIDTH}}, linear)
    point = place.nearest("play")
    assert abs(point["play"]["play"] - WIDTH) < 0.2 * WIDTH
    target = place.linear.rows.observed
    left = np.sum((target - base_at(composed, point).rows) ** 2)
    assert left < 0.1 * np.sum((target - base_at(composed, {}).rows) ** 2)


def fit(left: float, size: float = 1.0, held_out: float = 0.0) -> _Fit:
    rows = Rows(*(np.zeros(4, int),) * 3, np.arange(4.0), ("a",), ("y",), ("whole",))
    one, none, far = np.ones(1), np.zeros(1), np.full(1, 1e3)
    column = np.ones((4, 1))
    made = Candidate("c", ("size",), none, none, one, np.zeros(4), column, -far, far)
    f = forms(Gap(rows, size * column[:, 0], np.zeros((4, 0)), (made,)))
    model = replace(fitted(f, (0,)), x=np.array([size]))
    return _Fit({}, f, model, np.arange(4), held_out + np.array([0.0, 0.1, -0.1, 0.05]), left)


def test_what_is_told_apart():
    """Of a gap of 1000 the cause leaves 100."""
    cause, lacking = fit(100.0), fit(1000.0)
    assert not _told_apart(cause, fit(250.0), lacking)
    assert _told_apart(cause, fit(250.0, held_out=-50.0), lacking)  # as held-out logs say
    assert not _told_apart(cause, fit(250.0, held_out=50.0), lacking)
    assert _told_apart(cause, fit(600.0), lacking)  # most of what the cause explains is left
    assert _told_apart(cause, fit(100.0, size=200.0), lacking)  # two hundred usual sizes
    assert not _told_apart(cause, fit(100.0, size=200.0, held_out=10.0), lacking)  # but held-out logs


def test_how_far_out_an_effect_lies_does_not_hang_on_how_many_parameters_it_has():
    one, none, far = np.ones(1), np.zeros(1), np.full(1, 1e3)
    rows = Rows(*(np.zeros(4, int),) * 3, np.arange(4.0), ("a",), ("y",), ("whole",))
    priors = []
    for k in (1, 3):
        made = Candidate("c", ("size",) * k, *(np.repeat(v, k) for v in (none, none, one)), np.zeros(4),
                         np.ones((4, k)), np.repeat(-far, k), np.repeat(far, k))  # fmt: skip
        f = forms(Gap(rows, np.zeros(4), np.zeros((4, 0)), (made,)))
        x = np.zeros(k)
        x[0] = 7.0
        priors.append(log_prior(f, replace(fitted(f, (0,)), x=x)))
    assert priors == pytest.approx([-np.log(50.0)] * 2)
