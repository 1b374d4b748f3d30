"""A model's error is the same each time the same motion is made, and repeats of it tell no more of it."""

from dataclasses import replace

import numpy as np
import pytest

from simgap.robot_effects import candidates
from simgap.robot_effects.base import Setting
from simgap.robots.linear import linearise
from simgap.robots.model import Composed
from simgap.robots.sets import Sets
from simgap.robots.whiten import TAU, Discrepancy, covariances
from simgap.simulators.recording import Recording
from simgap.simulators.user import checked

NOISE, SIZE, LOGS = 0.01, 0.1, 8
T = np.arange(0.0, 4.0, 0.02)


class Course:
    """A course that no start tells of, of a size, as often faster as a log's column `pace` says."""

    parameters = {"size": {"nominal": 1.0, "sd": 0.3, "unit": "1"}}  # noqa: RUF012
    channels = {  # noqa: RUF012
        "pace": {"unit": "1", "kind": "command"},
        "y": {"unit": "m", "kind": "position", "noise": NOISE},
    }

    def simulate(self, parameters, recording):
        return {"y": parameters["size"] * np.sin(3 * recording["pace"] * recording.t)}


def composed(errors: np.ndarray, rng: np.random.Generator, paces=None) -> Composed:
    """Logs with these errors (LOGS, n) of the model and the sensor's noise."""
    simulator, logs = checked(Course(), "a test"), []
    for k, error in enumerate(errors):
        bare = Recording(f"log{k}", T, {"pace": np.full(T.size, 1.0 if paces is None else paces[k])})
        y = simulator.simulate({"size": 1.0}, bare)["y"] + error + NOISE * rng.standard_normal(T.size)
        logs.append(bare.with_columns({"y": y}))
    effects = {n: e for n, e in candidates(Setting(simulator, logs)).items() if n == "size" or e.fitted}
    return Composed.of(simulator, logs, effects, {"y": NOISE})


def misses(seed: int, shared: bool, repeats: bool) -> float:
    """By how many of its own sd the size is missed."""
    rng = np.random.default_rng(seed)
    factor = SIZE * np.linalg.cholesky(np.exp(-np.abs(T[:, None] - T) / TAU) + 1e-9 * np.eye(T.size))
    own = factor @ rng.standard_normal((T.size, 1 if shared else LOGS))
    made = composed(np.broadcast_to(own.T, (LOGS, T.size)), rng)
    made = made if repeats else replace(made, motion=())
    linear = linearise(made, {"size": {"size": 1.0}}, ["size"])
    whiten = covariances(made, linear).whitener(Discrepancy({"y": SIZE}))
    sets = Sets.of(made.effects, linear, [whiten], ["size"], linear.rows.log, 0.0)
    found = sets.fit(("size",), 0)
    return float(found.x[0] / np.sqrt(found.covariance[0, 0]))


@pytest.mark.parametrize("repeats", [True, False])
def test_what_repeats_share_makes_an_interval_as_wide_as_one_log_would(repeats: bool):
    missed = np.array([misses(seed, True, repeats) for seed in range(60)])
    scatter = float(np.sqrt(np.mean(missed**2)))
    assert (0.8 < scatter < 1.2) if repeats else scatter > 2


def test_logs_are_repeats_where_commands_are_alike_and_count_each_where_the_model_is_right():
    rng, still = np.random.default_rng(0), np.zeros((LOGS, T.size))
    made = composed(still, rng, [1.0, 1.0, 2.0, 1.0, 2.0, 1.0005, 3.0, 1.0])
    assert made.motion == (0, 0, 1, 0, 1, 0, 2, 0) and made.repeats() == [5, 5, 2, 5, 2, 5, 1, 5]
    of_three = [k for k, w in enumerate(made.windows) if w.log in (0, 1, 6)]
    assert made.among(of_three).repeats() == [2, 2, 1]
    rng = np.random.default_rng(1)
    made = composed(np.zeros((LOGS, T.size)), rng)
    linear = linearise(made, {}, ["size"])
    cov = covariances(made, linear)
    least = cov.whitener(Discrepancy({"y": 1e-9}))
    assert least.half_log_det == pytest.approx(cov.whitener().half_log_det)
