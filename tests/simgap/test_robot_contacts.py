"""Robots that touch things: when; poses that one instrument reads; what each log has of its own."""

from dataclasses import replace

import numpy as np
import pytest

from simgap.robot_effects import effects_of, readouts
from simgap.robot_effects.base import Setting
from simgap.robots.linear import base_at, linearise, with_wobble
from simgap.robots.model import Composed
from simgap.robots.rows import phases_of, rows_of
from simgap.robots.whiten import CONTACTS, LIES, Discrepancy, covariances
from simgap.robots.windows import AT_REST, FLIES, REGIMES, RESTS, STRIKES, cut, resting
from simgap.simulators.protocol import Channel, Parameter
from simgap.simulators.recording import Recording

POSE = {a: a for a in ("x", "y", "z", "qw", "qx", "qy", "qz")}


class Posed:
    """A body whose pose is read."""

    parameters = {}  # noqa: RUF012
    channels = {a: Channel("1" if a[0] == "q" else "m", "position") for a in POSE}  # noqa: RUF012
    poses = {"cube": POSE}  # noqa: RUF012
    by_log = {"shift": Parameter(0.0, 0.3, "s"), "offset": Parameter(0.0, 0.01, "m")}  # noqa: RUF012

    def simulate(self, parameters, recording, start=None):
        raise AssertionError("only read, never run")


def tumbling(name: str = "log.csv") -> Recording:
    t = np.arange(0.0, 0.5, 0.01)
    half, axis = 1.5 * t, np.array([0.6, 0.0, 0.8])
    turn = {"qw": np.cos(half)} | {f"q{a}": axis[k] * np.sin(half) for k, a in enumerate("xyz")}
    return Recording(name, t, {"x": 0.3 * t, "y": 0.1 + 0 * t, "z": 1 - 4.9 * t**2} | turn)


@pytest.mark.parametrize(("name", "theta"), [
    ("pose:cube.lag", {"delay": 0.02}),
    ("pose:cube.turned", {"about_x": 0.03, "about_y": -0.02, "about_z": 0.05}),
    ("pose:cube.offset", {"x": 0.01, "y": 0.0, "z": -0.02}),
])  # fmt: skip
def test_what_a_pose_is_read_through_is_undone(name, theta):
    log = tumbling()
    effects = {e.name: e for e in readouts.candidates(Setting(Posed(), [log]))}
    read = log.with_columns(effects[name].alter(log, log.columns, theta))
    assert max(np.abs(read[a] - log[a]).max() for a in POSE) > 1e-3
    back = effects[name].restore(read, theta)
    inside = slice(0, -3)  # a lag's last samples are not recorded
    assert all(np.allclose(back[a][inside], log[a][inside], atol=2e-4) for a in POSE)
    turn = np.array([read[a] for a in ("qw", "qx", "qy", "qz")])
    assert np.allclose((turn**2).sum(0), 1.0, atol=1e-4)


def test_offsets_turn_with_the_body_and_each_log_has_its_own_shift():
    turn = np.array([[np.cos(np.pi / 2)], [0.0], [0.0], [np.sin(np.pi / 2)]])
    assert np.allclose(readouts.rotated(turn, np.array([0.1, 0.0, 0.2]))[:, 0], [-0.1, 0.0, 0.2])
    logs = [tumbling("a.csv"), tumbling("b.csv")]
    setting = Setting(Posed(), logs)
    shift, offset = readouts.by_log(setting)
    assert list(shift.parameters) == ["a.csv", "b.csv"] and shift.fitted and shift.by_log
    assert list(offset.parameters)[:3] == ["a.csv.x", "a.csv.y", "a.csv.z"]
    late = shift.alter(logs[1], logs[1].columns, {"a.csv": 0.3, "b.csv": 0.1})
    assert np.allclose(late["x"][10:], logs[1]["x"][:-10]) and np.allclose(late["x"][:10], 0.0)
    assert setting.alone() == ["x", "y", "z"] and setting.late_alone() == []


def test_brief_touches_count_but_breaks_do_not_and_what_slows_down_does_not_rest():
    pytest.importorskip("mujoco")
    from simgap.simulators.mjcf.model import closed

    t = np.arange(12) * 0.01
    pair, none = frozenset({"cube on board"}), frozenset()
    sets = [none, none, pair, none, none, none, none, none, pair, none, pair, none]
    told = closed(t, sets)
    assert [bool(s) for s in told] == [bool(i in (2, 8, 9, 10)) for i in range(12)]
    t = np.arange(0, 1.0, 0.01)
    log = Recording("log.csv", t, {"q": np.where(t < 0.5, 1 - np.exp(-t / 0.1), 1 - np.exp(-5))})
    rests, rate = resting(log, {"q": 1.0}), np.exp(-t / 0.1) / 0.1
    assert rests[t > 0.53].all() and not rests[(rate * 0.04 > AT_REST) & (t < 0.47)].any()


DROP = """<mujoco><option timestep="0.002"/><worldbody>
<geom name="board" type="plane" size="2 2 .1"/>
<body name="cube" pos="0 0 .5"><freejoint/><geom name="box" type="box" size=".05 .05 .05" mass=".4"/></body>
</worldbody></mujoco>"""


@pytest.fixture(scope="module")
def dropped(tmp_path_factory):
    """A model of a cube and a log of its fall and rest, read on a scale of 0.97."""
    mujoco = pytest.importorskip("mujoco")
    from simgap.simulators.mjcf.load import load_mjcf

    folder = tmp_path_factory.mktemp("drop")
    (folder / "cube.xml").write_text(DROP, encoding="utf-8")
    text = "".join(f'[columns.{a}]\nbody = "cube"\naxis = "{a}"\n' for a in POSE)
    (folder / "map.toml").write_text(text, encoding="utf-8")
    model = mujoco.MjModel.from_xml_string(DROP)
    data, rows = mujoco.MjData(model), []
    for _ in range(100):
        rows.append([data.time, *data.qpos])
        mujoco.mj_step(model, data, 5)
    table = np.array(rows)
    table[:, 1:4] *= 0.97
    head = "t," + ",".join(POSE)
    np.savetxt(folder / "log.csv", table, delimiter=",", header=head, comments="")
    loaded = load_mjcf(folder / "cube.xml", folder / "map.toml")
    return loaded.simulator, loaded.read(folder / "log.csv")


def test_flight_and_contact_are_told_apart(dropped):
    simulator, log = dropped
    times, what = simulator.contact_states(log)
    fall, first = np.sqrt(2 * 0.45 / 9.81), times[what.index(frozenset({(0, 1)}))]
    assert fall - 0.03 < first < fall + 0.01 and not what[0]
    noise = dict.fromkeys(POSE, 1e-3)
    windows = cut(simulator, [log], noise, 0.2)
    assert windows[0].regime == FLIES and windows[-1].regime == RESTS
    assert {w.regime for w in windows} <= {FLIES, STRIKES, RESTS}
    assert any(abs(log.t[w.begin] - first) < 0.011 for w in windows)
    phases, rows = phases_of(simulator, [log], windows), rows_of([log], windows, noise)
    names = np.array(phases.names)[phases.of(rows)]
    assert {*names} == {w.regime for w in windows} and all(names == np.array(REGIMES)[rows.regime])


def test_a_fall_alone_tells_the_scale_and_impacts_are_no_measurement(dropped):
    """Windows that admit that each impact differs by a usual size: their weight on the scale is small."""
    simulator, log = dropped
    every = readouts.candidates(Setting(simulator, [log]))
    (scale,) = [e for e in every if e.name == "readout.scale"]
    noise = dict.fromkeys(POSE, 1e-4)
    composed = Composed.of(simulator, [log], {scale.name: scale}, noise, 0.2)
    composed = with_wobble(composed, linearise(composed, {}, [scale.name]))
    linear = linearise(composed, {}, [scale.name])
    usual = {CONTACTS: 1.0, "z, lying": 2e-2 * 0.05}
    whiten = covariances(composed, linear).whitener(Discrepancy(usual))
    slope = whiten(linear.moved[scale.name].jacobian)[:, 0]
    residual = whiten(linear.residual)
    free = composed.rows.regime == REGIMES.index(FLIES)
    told = slope[free] @ residual[free] / (slope[free] @ slope[free])
    assert told == pytest.approx(-0.03, abs=0.004)
    each = [float(slope[w] @ slope[w]) for w in composed.rows.of if not free[w.start]]
    assert max(each) <= 1.01 / 0.02**2  # no window in contact tells more than the scale's usual size


def test_a_body_at_rest_is_compared_where_it_lies_which_differs_from_time_to_time(dropped):
    simulator, log = dropped
    composed = Composed.of(simulator, [log], {}, dict.fromkeys(POSE, 1e-4), 0.2)
    rows, base = composed.rows, base_at(composed, {})
    still = (rows.regime == REGIMES.index(RESTS)) & (rows.channel == 2)
    assert still.any()
    settled = rows.observed[still][20:]  # the body itself sinks in for a while, by less than a millimetre
    np.testing.assert_allclose(settled / base.rows[still][20:], 0.97, atol=2e-3)
    calm = composed.calm()
    assert {w.regime for w in calm.windows} == {FLIES, RESTS} and calm.calm() is calm
    linear = linearise(composed, {}, [])
    cov = covariances(composed, linear)
    for block in cov.blocks:
        lying = {n: s for n, s in block.sources.items() if n.endswith(LIES)}
        assert len(lying) == (len(POSE) if composed.windows[block.window].regime == RESTS else 0)
        for name, source in lying.items():
            column = np.zeros(block.rows.size)
            column[source.rows] = 1.0
            channel = composed.rows.channels.index(name.split(",")[0])
            assert (column == (composed.rows.channel[block.rows] == channel)).all()
            assert (source.covariance == 1.0).all()


ARM = """<mujoco><option timestep="{}" integrator="{}" gravity="0 0 0"/>
  <worldbody><body><joint name="turn" axis="0 0 1" armature="0.02" damping="0.1"/>
    <geom type="capsule" fromto="0 0 0 0.3 0 0" size="0.02" mass="0.8"/></body></worldbody>
  <actuator><position name="servo" joint="turn" kp="40" kv="2"/></actuator></mujoco>"""
TURN = '[columns.q]\njoint = "turn"\n[columns.u]\nactuator = "servo"\nunit = "rad"\n'


def test_in_contact_a_fourth_of_the_step_by_another_integrator_is_the_run_itself(tmp_path):
    pytest.importorskip("mujoco")
    from simgap.simulators.mjcf.load import load_mjcf

    def load(step: float, integrator: str):
        (tmp_path / "arm.xml").write_text(ARM.format(step, integrator))
        (tmp_path / "map.toml").write_text(TURN)
        return load_mjcf(tmp_path / "arm.xml", tmp_path / "map.toml")

    found, t = load(0.008, "implicitfast"), np.arange(0, 1, 0.008)
    goal = np.where(t > 0.3, 1.0, 0.0)
    log = Recording("a.csv", t, {"q": 0.3 * np.cos(3.0 * t), "u": goal})
    effects = effects_of(found.simulator, [log], found.effects([log]))
    point = {"option.timestep": {"timestep": -0.75}, "option.integrator": {"integrator": 1.0}}
    composed = Composed.of(found.simulator, [log], effects, {"q": 1e-4}).moved(point)
    composed = replace(composed, windows=tuple(replace(w, regime=STRIKES) for w in composed.windows))
    starts, finer = composed.starts(point), load(0.002, "Euler")
    finer.effects([log])
    for window, start, ours in zip(composed.windows, starts, composed.rolled(point, starts), strict=True):
        own = finer.simulator.simulate({}, log.window(window.first, window.end), start)
        np.testing.assert_allclose(ours["q"], own["q"], atol=1e-9)
