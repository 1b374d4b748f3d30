"""Diagnoses from logs to verdict, and how logs are held out."""

import numpy as np
import pytest
from simgap_swing import Swing, log

from hmmseg.errors import InputError
from simgap.robots.describe import body
from simgap.robots.diagnose import diagnose
from simgap.robots.rows import Rows, folds_of
from simgap.simulators.recording import Recording
from simgap.simulators.user import checked

RATE, WIDTH = 50.0, 0.03


class Servo:
    """A joint that follows its command but for a band of unseen errors, or of friction."""

    parameters = {  # noqa: RUF012
        n: {"nominal": 0.0, "sd": 0.01, "unit": "rad", "low": 0.0, "high": 0.2} for n in ("band", "friction")
    }
    channels = {  # noqa: RUF012
        "cmd": {"unit": "rad", "kind": "command"},
        "pos": {"unit": "rad", "kind": "position", "noise": 1e-4},
    }
    window = 2.0

    def simulate(self, parameters, recording, start=None):
        return {"pos": follow(parameters["band"] + parameters["friction"], recording["cmd"], start["pos"]
                              if start else 0.0)}  # fmt: skip


def follow(width: float, command: np.ndarray, begin: float, pushed: np.ndarray | None = None) -> np.ndarray:
    out = np.full(command.size, begin)
    for i in range(command.size - 1):
        error = command[i] - out[i]
        out[i + 1] = out[i] + 0.2 * np.sign(error) * max(abs(error) - width, 0.0)
        out[i + 1] += 0.0 if pushed is None else pushed[i]
    return out


def logs(count: int = 4) -> list[Recording]:
    rng, t, out = np.random.default_rng(3), np.arange(0, 8, 1 / RATE), []
    for k in range(count):
        command = 0.1 * np.abs(((0.2 + 0.1 * k) * t) % 2 - 1)
        pushed = np.convolve(2e-4 * rng.standard_normal(t.size), np.ones(5), "same")
        pos = follow(WIDTH, command, command[0], pushed) + 1e-4 * rng.standard_normal(t.size)
        out.append(Recording(f"log_{k}.csv", t, {"cmd": command, "pos": pos}))
    return out


def test_what_does_the_same_is_a_set_and_logs_of_one_group_are_held_out_together():
    found = diagnose(checked(Servo(), "servo"), logs())
    told = body(found)
    assert told["verdict"] == "set" and {*told["causes"], *told["indistinguishable"]} == {"band", "friction"}
    for name in ("band", "friction"):
        (width,) = told["effects"][name]["parameters"].values()
        assert abs(width["mean"] - WIDTH) < 0.2 * WIDTH, name
    rows = object.__new__(Rows)
    object.__setattr__(rows, "log", np.repeat(np.arange(4), 3))  # all that folds are made of
    fold = folds_of(rows, 4, groups=[100, 200, 100, 200])
    assert fold.tolist() == [0] * 3 + [1] * 3 + [0] * 3 + [1] * 3


@pytest.mark.parametrize("groups", [[1, 2, 1], [4, 4]])
def test_groups_that_nothing_can_be_held_out_by_are_refused(groups):
    with pytest.raises(InputError, match=r"groups: are \d in \d groups for 2 logs; expected"):
        diagnose(checked(Swing(), "Swing"), [log(1), log(2)], groups=groups)
