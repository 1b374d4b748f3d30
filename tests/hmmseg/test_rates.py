"""Velocities that are late differences of positions: found, replaced, and taken from the right side."""

from dataclasses import replace

import numpy as np
import pytest

from hmmseg import Rig, Trial, example_folder
from hmmseg.hand.signals import late_differences, one_sided, task_space, timely


def _trial() -> tuple[Trial, Rig]:
    folder = example_folder()
    rig = Rig.read(folder / "rig.toml")
    return Trial.read(folder / "trial_01.csv", rig), rig


def _with_differences(trial: Trial, over: int) -> Trial:
    channels = dict(trial.channels)
    for name in ("q11", "q12", "q21", "q22"):
        q = channels[name]
        first = np.zeros(over)
        channels[f"d{name}"] = np.concatenate(
            [first, (q[over:] - q[:-over]) / (trial.t[over:] - trial.t[:-over])]
        )
    return replace(trial, channels=channels)


@pytest.mark.parametrize("over", [1, 2, 3])
def test_velocities_that_repeat_the_positions_are_replaced_by_central_differences(over):
    trial, rig = _trial()
    late = _with_differences(trial, over)
    found = timely(task_space(late, rig), late, rig)
    assert found.derived
    truth, raw = task_space(trial, rig), task_space(late, rig)
    moving = slice(5, -5)
    error = [np.sqrt(np.mean((s.vy - truth.vy)[moving] ** 2)) for s in (found, raw)]
    assert error[0] < 0.6 * error[1]


def test_velocities_of_their_own_stay():
    trial, rig = _trial()
    signals = task_space(trial, rig)
    assert timely(signals, trial, rig) is signals


def test_positions_that_never_change_prove_nothing():
    still = np.zeros(50)
    assert not late_differences(np.arange(50) * 0.05, still, still)


def test_rates_beside_a_kink_are_those_of_their_own_side():
    t = np.arange(40) * 0.05
    kink = t[20]
    left, right = one_sided(t, np.where(t < kink, 0.3 * t + 0.1 * t**2, 0.3 * kink + 0.1 * kink**2))[0]
    assert left[20] == pytest.approx(0.3 + 0.2 * kink, rel=1e-6)
    assert right[20] == pytest.approx(0.0, abs=1e-9)


def test_noise_of_one_sided_rates():
    t, rng = np.arange(20_000) * 0.05, np.random.default_rng(1)
    rates, noise = one_sided(t, rng.standard_normal(t.size))
    assert rates[:, 5:-5].std() == pytest.approx(noise, rel=0.03)
