"""Phases of a robot's logs by a task, and what of a simulator cannot be run."""

import numpy as np
import pytest
from simgap_swing import Swing, log

from hmmseg.errors import InputError
from hmmseg.io.task import BlockTask, SequenceTask, parse_task
from simgap.robots.linear import linearise
from simgap.robots.model import Composed
from simgap.robots.phases import phases_by_task
from simgap.robots.rows import noises, rows_of
from simgap.simulators.protocol import Parameter
from simgap.simulators.user import checked


def still_then_swinging(seed: int, begin: float):
    """A pendulum at rest until its motor begins."""
    found = log(seed, seconds=6.0)
    torque = np.where(found.t < begin, 0.0, found["torque"])
    empty = found.with_columns({"torque": torque})
    robot = Swing()
    angle = robot.simulate({n: p["nominal"] for n, p in robot.parameters.items()}, empty)["angle"]
    noise = 5e-4 * np.random.default_rng(seed).standard_normal(angle.size)
    return empty.with_columns({"angle": angle + noise})


@pytest.mark.slow
def test_a_task_names_the_phases_of_logs():
    begins = [2.0, 2.6, 3.1]
    logs = [still_then_swinging(k, b) for k, b in enumerate(begins)]
    phases = phases_by_task(logs, SequenceTask(("rest", "swing")))
    assert phases.names == ("rest", "swing")
    for starts, number, begin in zip(phases.starts, phases.number, begins, strict=True):
        assert list(number) == [0, 1] and starts[1] == pytest.approx(begin, abs=0.1)
    simulator = checked(Swing(), "Swing")
    composed = Composed.of(simulator, logs, {}, noises(simulator, logs))
    rows = rows_of(logs, composed.windows, composed.noise)
    told = phases.of(rows)
    assert (told == 1)[rows.time > 3.3].all() and not (told == 1)[rows.time < 1.8].any()


def test_what_is_no_sequence_and_what_is_no_column_is_said():
    logs = [log(0)]
    blocks = parse_task(
        {"objects": {"block1": {"on": "ground"}}, "moves": [{"object": "block1", "to": "ground"}]}
    )
    assert isinstance(blocks, BlockTask)
    with pytest.raises(InputError, match="task of blocks"):
        phases_by_task(logs, blocks)
    with pytest.raises(InputError, match="no column force; expected torque, angle"):
        phases_by_task(logs, SequenceTask(("a", "b"), channels=("force",)))


def test_a_model_that_explodes_at_a_candidate_is_said_and_the_others_go_on():
    from simgap.robot_effects import candidates
    from simgap.robot_effects.base import Setting

    class Explosive(Swing):
        parameters = Swing.parameters | {"charge": Parameter(0.0, 1.0)}

        def simulate(self, parameters, recording, start=None):
            found = super().simulate(parameters, recording, start)
            return found if parameters["charge"] == 0 else {n: v * np.inf for n, v in found.items()}

    simulator, logs = checked(Explosive(), "Explosive"), [log(0, seconds=2.0)]
    effects = candidates(Setting(simulator, logs))
    composed = Composed.of(simulator, logs, effects, noises(simulator, logs))
    linear = linearise(composed, {}, ["charge", "viscous"])
    assert linear.diverged == ("charge",) and set(linear.moved) == {"viscous"}
