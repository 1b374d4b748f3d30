"""Planted parameters come back from a data sheet's, and what logs do not tell is said."""

import json

import numpy as np
import pytest
from refusals import refused
from simgap_swing import Swing, log

from hmmseg_cli.main import main
from simgap.robot_effects import effects_of
from simgap.robots.calibrate import LEAVES, calibrate
from simgap.robots.linear import linearise
from simgap.robots.model import Composed
from simgap.robots.rows import noises
from simgap.robots.whiten import covariances
from simgap.robots.windows import JUMPS
from simgap.simulators.user import checked


class Guessed(Swing):
    """A pendulum of which all is guessed but its weight."""

    parameters = {  # noqa: RUF012
        "inertia": {"nominal": 0.01, "sd": 0.01, "unit": "kg m^2", "low": 0.001, "fitted": True},
        "gravity_torque": {"nominal": 0.5, "sd": 0.05, "unit": "N m", "low": 0.0},
        "viscous": {"nominal": 0.0, "sd": 0.05, "unit": "N m s/rad", "low": 0.0, "fitted": True},
        "torque_scale": {"nominal": 1.0, "sd": 0.5, "unit": "1", "low": 0.1, "fitted": True},
    }


def found_of(robot, logs):
    simulator = checked(robot, "robot")
    return calibrate(simulator, logs, effects_of(simulator, logs))


def test_planted_values_are_found_with_their_errors_and_held_out_logs_are_nearer():
    true = {"inertia": 0.014, "viscous": 0.02, "torque_scale": 1.3}
    found = found_of(Guessed(), [log(s, seconds=1.5, **true) for s in range(2)])
    body = found.body()
    assert found.left["angle"] < 1.1
    for name, value in true.items():
        told = body["parameters"][name]
        assert told["mean"] == pytest.approx(value, rel=0.01)
        assert abs(told["mean"] - value) < 5 * told["sd"] < 0.1 * value
        assert told["interval_90"][0] < told["mean"] < told["interval_90"][1]
    assert set(body["parameters"]) == {*true} and not body["combinations"] and not body["reasons"]
    assert body["heldout"]["after"]["angle"] < 0.05 * body["heldout"]["before"]["angle"]  # the start is read
    json.dumps(body, allow_nan=False)


def test_what_acts_only_together_is_told_as_a_sum_and_what_does_nothing_not_at_all():
    class Twice(Guessed):
        parameters = Guessed.parameters | {
            "more": {"nominal": 0.0, "sd": 0.03, "unit": "N m s/rad", "fitted": True},
            "idle": {"nominal": 1.0, "sd": 0.3, "unit": "K", "fitted": True},
        }

        def simulate(self, parameters, recording, start=None):
            drag = parameters["viscous"] + 2 * parameters["more"]
            return super().simulate({**parameters, "viscous": drag}, recording, start)

    body = found_of(Twice(), [log(s, seconds=1.5, viscous=0.03) for s in range(2)]).body()
    untold = {n for n, p in body["parameters"].items() if p["mean"] is None}
    assert untold == {"viscous", "more", "idle"} == set(body["reasons"])
    assert "told only together with more" in body["reasons"]["viscous"]
    assert "add little" in body["reasons"]["idle"]
    (one,) = body["combinations"]
    assert set(one["of"]) == {"viscous", "more"}
    assert one["of"]["more"] / one["of"]["viscous"] == pytest.approx(2.0, rel=1e-3)
    assert one["mean"] / one["of"]["viscous"] == pytest.approx(0.03, rel=0.02)


def test_one_log_is_held_out_by_halves_and_what_nothing_explains_is_told():
    body = found_of(Guessed(), [log(0, seconds=2.0, viscous=0.02)]).body()
    assert body["heldout"]["after"]["angle"] < 0.2 * body["heldout"]["before"]["angle"]
    refused("nothing of the model is uncertain", found_of, Swing(), [log(0)])
    logs = [log(s, seconds=1.5) for s in range(2)]
    found = found_of(Guessed(), [each.with_columns({"angle": each["angle"] + 0.05}) for each in logs])
    assert found.left["angle"] > LEAVES**0.5


ROBOT = """<mujoco><compiler angle="radian"/><option timestep="0.002" integrator="implicitfast"/>
<worldbody><body name="arm">
<joint name="hinge" axis="0 1 0" damping="0.1" range="-3 3"/>
<geom name="rod" type="capsule" fromto="0 0 0 0 0 -0.3" size="0.02" mass="0.5"/></body></worldbody>
<actuator><position name="servo" joint="hinge" kp="20" kv="1"/></actuator></mujoco>"""
MAP = '[columns.q]\njoint = "hinge"\n[columns.u]\nactuator = "servo"\nunit = "rad"\n'


def test_the_command_patches_the_model_and_tells_how_commands_were_held(tmp_path):
    """A servo that followed lines between the targets that were logged, its gain other than stated."""
    mujoco = pytest.importorskip("mujoco")
    (tmp_path / "robot.xml").write_text(ROBOT)
    (tmp_path / "map.toml").write_text(MAP)
    model = mujoco.MjModel.from_xml_string(ROBOT.replace('kp="20"', 'kp="15"'))
    rng, files = np.random.default_rng(0), []
    t = np.arange(0.0, 3.0, 0.02)
    for k in range(3):
        u = np.interp(t, np.arange(0, 3.2, 0.2), rng.uniform(-1, 1, 16))
        data, rows = mujoco.MjData(model), []
        for step in range(t.size * 10):
            if step % 10 == 0:
                rows.append([t[step // 10], data.qpos[0] + 1e-4 * rng.standard_normal(), u[step // 10]])
            data.ctrl[0] = np.interp(step * 0.002 + 0.001, t, u)
            mujoco.mj_step(model, data)
        files.append(str(tmp_path / f"{k}.csv"))
        np.savetxt(files[-1], rows, delimiter=",", header="t,q,u", comments="")
    robot = ["--model", str(tmp_path / "robot.xml"), "--map", str(tmp_path / "map.toml")]
    told = ["--json", str(tmp_path / "out.json"), "--patch", str(tmp_path / "new"), "--quiet"]
    assert main(["calibrate", *files, *robot, *told]) == 0
    body = json.loads((tmp_path / "out.json").read_text())
    assert body["format"] == "hmmseg.calibrate/1"
    assert body["parameters"]["actuator:servo.gain"]["mean"] == pytest.approx(-0.25, abs=0.01)
    assert body["numerics"]["option.hold"]["mean"] == pytest.approx(1.0, abs=0.1)
    assert not {*body["numerics"]} & {*body["parameters"]}
    patched = mujoco.MjModel.from_xml_path(str(tmp_path / "new/robot.xml"))
    assert patched.actuator_gainprm[0, 0] == pytest.approx(15.0, rel=0.01)
    ranges = json.loads((tmp_path / "new/ranges.json").read_text())
    assert ranges["fitted"]["actuator:servo.gain"]["nominal"] == 0.0
    (line,) = ranges["not_in_xml"]  # and no law that was not fitted
    assert line.startswith("command.delay") and any(line in warning for warning in body["warnings"])


def test_a_command_that_jumps_between_two_samples_is_no_gap(tmp_path):
    """A drive that took its commands at 500 Hz, logged at 50 Hz: when a jump came is not in the log."""
    mujoco = pytest.importorskip("mujoco")
    from simgap.simulators.mjcf.load import load_mjcf

    (tmp_path / "robot.xml").write_text(ROBOT)
    (tmp_path / "map.toml").write_text(MAP)
    jumps = (0.513, 1.262, 2.447)
    robot = mujoco.MjModel.from_xml_string(ROBOT)
    data, rows = mujoco.MjData(robot), []
    for step in range(1500):
        t = 0.002 * step
        u = 0.3 * np.sin(2 * t) + 0.5 * (sum(t >= at for at in jumps) % 2)
        if step % 10 == 0:
            rows.append([t, data.qpos[0], u])
        data.ctrl[0] = u
        mujoco.mj_step(robot, data)
    noise = 4e-4 * np.random.default_rng(0).standard_normal(len(rows))
    np.savetxt(tmp_path / "log.csv", np.array(rows) + np.outer(noise, [0, 1, 0]), delimiter=",",
               header="t,q,u", comments="")  # fmt: skip
    loaded = load_mjcf(tmp_path / "robot.xml", tmp_path / "map.toml")
    log = loaded.read(tmp_path / "log.csv")
    effects = effects_of(loaded.simulator, [log], loaded.effects([log]))
    model = Composed.of(loaded.simulator, [log], effects, noises(loaded.simulator, [log]))
    held = {"option.hold": {"hold": 1.0}}
    linear = linearise(model, held, [])
    mean = np.mean(covariances(model, linear).whitener()(linear.residual) ** 2)
    doubted = [w for w in model.windows if JUMPS in w.doubt]
    assert len(doubted) <= len(jumps)
    assert all(any(log.t[w.begin] - 0.02 < at < log.t[w.end - 1] for at in jumps) for w in doubted)
    for window in model.windows:
        window.doubt.pop(JUMPS, None)
    without = linearise(model, held, [])
    plain = np.mean(covariances(model, without).whitener()(without.residual) ** 2)
    assert mean < 0.1 * plain
