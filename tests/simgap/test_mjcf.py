"""MuJoCo models as simulators: maps, rollouts against closed forms, what is set, patched or unseen."""

import tomllib

import numpy as np
import pytest
from refusals import refused

from simgap.simulators.protocol import Job
from simgap.simulators.recording import Recording

mujoco = pytest.importorskip("mujoco")

from simgap.robot_effects import UNMEASURED, candidates, effects_of  # noqa: E402
from simgap.robot_effects.base import Setting  # noqa: E402
from simgap.robots.model import Composed  # noqa: E402
from simgap.robots.patch import patched  # noqa: E402
from simgap.robots.rows import noises  # noqa: E402
from simgap.simulators.mjcf.engine import warned  # noqa: E402
from simgap.simulators.mjcf.load import load_mjcf  # noqa: E402
from simgap.simulators.mjcf.map import proposed_map  # noqa: E402
from simgap.simulators.mjcf.runs import Held, _carried_out, _commanded  # noqa: E402
from simgap.simulators.mjcf.setting import FIELDS, changed_model, setting_of  # noqa: E402

XML = """<mujoco model="swing">
  <compiler angle="radian"/>
  <option timestep="0.001" integrator="RK4"/>
  <worldbody>
    <body name="bob">
      <joint name="pivot" axis="0 1 0" range="-3 3"/>
      <geom name="ball" type="sphere" size="0.01" pos="0 0 -0.2" mass="0.5"/>
    </body>
  </worldbody>
  <actuator><motor name="m" joint="pivot"/></actuator>
</mujoco>
"""
MAP = """[columns.q]
joint = "pivot"
noise = 1e-4
[columns.u]
actuator = "m"
unit = "Nm"
"""
TURN = '[columns.q]\njoint = "turn"\nnoise = 1e-4\n[columns.u]\nactuator = "servo"\nunit = "rad"\n'
SET = ("joint:turn.damping", "joint:turn.armature", "body:arm.mass", "body:arm.com_x", "body:arm.payload",
       "actuator:servo.gain", "actuator:servo.damping", "option.tilt_x", "option.timestep",
       "joint:nod.tie")  # fmt: skip
TIE = """<body name="head" pos="1 0 0"><joint name="nod" axis="0 0 1"/><geom size="0.02" mass="0.1"/></body>
  </worldbody><equality><joint joint1="nod" joint2="turn"/></equality>"""
SERVO = """<mujoco>
  <option timestep="0.001" integrator="implicitfast" gravity="0 0 0"/>
  <worldbody><body name="arm"><joint name="turn" axis="0 0 1" armature="0.02" damping="0.1"/>
    <geom type="capsule" fromto="0 0 0 0.3 0 0" size="0.02" mass="0.8" contype="0" conaffinity="0"/>
    <site name="tool" pos="0.2 0 0"/>%s</body></worldbody>
  <actuator><position name="servo" joint="turn" kp="40" kv="2"/></actuator>
</mujoco>
"""
FINGERS = """<mujoco>
  <worldbody>
    <body><joint name="left" type="slide" axis="1 0 0"/><geom size="0.01" mass="0.1"/></body>
    <body pos="0.1 0 0"><joint name="right" type="slide" axis="-1 0 0"/><geom size="0.01" mass="0.1"/></body>
    <body pos="0.2 0 0"><joint name="tip"/><geom size="0.01" mass="0.1"/></body>
  </worldbody>
  <equality>
    <joint joint1="right" joint2="left" polycoef="0.01 2 0 0 0"/>
    <joint joint1="tip" joint2="right" polycoef="0 0 3 0 0"/>
  </equality>
</mujoco>
"""
TIED = """<mujoco>
  <option timestep="0.002" integrator="implicitfast" gravity="0 0 0"/>
  <worldbody>
    <body><joint name="left" type="slide" axis="1 0 0" armature="0.1"/>
      <geom pos="0.01 0 0" size="0.01" mass="0.1"/></body>
    <body pos="1 0 0"><joint name="right" type="slide" damping="20" axis="1 0 0"/>
      <geom pos="0.01 0 0" size="0.01" mass="0.1"/></body>
  </worldbody>
  <equality><joint joint1="right" joint2="left"/></equality>
  <actuator><position name="servo" joint="left" kp="200" kv="10"/></actuator>
</mujoco>
"""
URDF = """<robot name="swing">
  <link name="base"/>
  <link name="bob"><inertial><origin xyz="0 0 -0.2"/><mass value="0.5"/>
    <inertia ixx="1e-3" ixy="0" ixz="0" iyy="1e-3" iyz="0" izz="1e-3"/></inertial></link>
  <joint name="pivot" type="continuous"><parent link="base"/><child link="bob"/><axis xyz="0 1 0"/></joint>
</robot>
"""


@pytest.fixture
def files(tmp_path):
    def write(xml: str = XML, described: str = MAP, name: str = "swing.xml"):
        (tmp_path / name).write_text(xml)
        (tmp_path / "map.toml").write_text(described)
        return tmp_path / name, tmp_path / "map.toml"

    return write


def loaded(files, *candidates: str):
    found, t = load_mjcf(*files(), candidates), np.arange(0, 2, 0.01)
    log = Recording("a.csv", t, {"q": 0.1 * np.cos(6.9 * t), "u": np.zeros(t.size)})
    return found, log, found.effects([log])


def stepped(model, commands, nstep=1, rate=0.0, given="ctrl"):
    """Positions and rates (n, 2 n_q) before each step of a loop of MuJoCo given these commands."""
    data, run = mujoco.MjData(model), []
    data.qvel[:] = rate
    for command in commands:
        run.append([*data.qpos, *data.qvel])
        getattr(data, given)[:] = command
        mujoco.mj_step(model, data, nstep)
    return np.array(run)


def read_back(found, folder, angle, command):
    rows = np.column_stack([np.arange(0, 2, 0.01), angle, command])
    np.savetxt(folder / "log.csv", rows, "%.6f", ",", header="t,q,u", comments="")
    return found.read(folder / "log.csv")


@pytest.mark.parametrize("share", [0.0, 0.6])
def test_a_window_is_the_linear_pendulum(files, share):
    """Small swings at omega^2 = m g l / (m l^2 + I), of the weight that no drive carries."""
    found, log, _ = loaded(files)
    simulator = found.simulator
    nominal = {n: p.nominal for n, p in simulator.parameters.items()}
    window = Recording("a.csv", log.t[7:60], {n: v[7:60] for n, v in log.columns.items()}, 7)
    heavy = nominal | {"body:bob.mass": 0.6, "joint:pivot.damping": 0.01}
    simulator.simulate(heavy, log, {"q": 0.1, "q_rate": 0.0})  # leaves no trace
    nominal["drive.gravity_compensation"] = share
    (channels,) = simulator.simulate_many([Job(nominal, window, {"q": 1e-3, "q_rate": -2e-3})])
    inertia = 0.5 * 0.2**2 + 0.4 * 0.5 * 0.01**2
    omega = np.sqrt((1 - share) * 0.5 * 9.81 * 0.2 / inertia)
    t = window.t - window.t[0]
    np.testing.assert_allclose(channels["q"], 1e-3 * np.cos(omega * t) - 2e-3 / omega * np.sin(omega * t),
                               atol=2e-8)  # fmt: skip


def test_steps_and_lines_between_samples_are_held_as_the_steps_have_them():
    held = Held(np.array([0.0, 0.005, 0.01]), np.arange(0, 0.012, 0.002))
    np.testing.assert_allclose(held(np.array([1.0, 3.0, 0.0])), [1, 1, 2, 3, 3, 0])
    held = Held(np.array([0.0, 0.01, 0.02]), np.arange(0, 0.02, 0.005))  # a line is half a sample sooner
    np.testing.assert_allclose(held(np.array([0.0, 2.0, 1.0]), 1.0), [0.5, 1.5, 1.75, 1.25])
    np.testing.assert_allclose(held(np.array([0.0, 2.0, 1.0]), 0.5), [0.25, 0.75, 1.875, 1.625])
    held = Held(np.array([0.0, 0.01]), np.arange(0, 0.02, 0.005))  # and goes on where samples end
    np.testing.assert_allclose(held(np.array([0.0, 2.0]), 1.0), [0.5, 1.5, 2.5, 3.5])
    np.testing.assert_allclose(Held(np.zeros(1), np.arange(0, 0.02, 0.005))(np.ones(1), 1.0), np.ones(4))


@pytest.mark.parametrize(("described", "line"), [
    (MAP.replace('"pivot"', '"pivott"'),
     r"columns\.q: the model has no joint pivott.*did you mean pivot"),
    (MAP.replace("joint =", "joints ="), r"columns\.q\.joints: unknown key.*did you mean joint"),
    (MAP.replace('joint = "pivot"', 'kind = "position"'), "columns.q: names no thing of the model"),
    (MAP.replace("1e-4", "-1"), r"columns\.q\.noise: Input should be greater than 0 .found -1"),
    (MAP.replace('"Nm"', '"furlong"'), "columns.u.unit: unknown unit 'furlong'"),
    (MAP.replace('joint = "pivot"', 'joint = "pivot"\nunit = "kg"'),
     r"columns\.q\.unit: 'kg' of a position that is read in rad; expected a unit of angle"),
    (f'{MAP}[columns.v]\nactuator = "m"', "columns: u and v are both the command of actuator m"),
    (MAP.replace('[columns.u]\nactuator = "m"\nunit = "Nm"', "[colums.u]"), "colums: unknown key"),
    *((f"{said}\n{MAP}", line) for said, line in [
        ("window = 0", "window.*greater than 0"), ("window = -1", "window.*greater than 0"),
        ("window = 1e9", "window.*equal to 1000000"), ('window = "long"', "window"),
        ("window = nan", "window"), ("time = 3", "time"), ("time = []", "time"),
        ('time = {column = "t", unit = "parsec"}', "unit"), ("keyframe = 3", "keyframe.*valid string"),
        ('keyframe = "home"', "no keyframe home; expected no name"), ("windw = 1", "windw")])])  # fmt: skip
def test_a_map_at_fault_is_said_in_a_line(files, described, line):
    refused(line, load_mjcf, *files(described=described))


@pytest.mark.parametrize("step", ["0", "-0.001", "1e-12", "nan", "5"])
def test_a_model_whose_time_step_is_none(files, step):
    refused(r"swing\.xml", load_mjcf, *files(XML.replace('"0.001"', f'"{step}"')))


@pytest.mark.parametrize(("xml", "line"), [
    (XML.replace('axis="0 1 0" range="-3 3"', 'type="ball"').replace("motor name", 'motor gear="1 0 0" name'),
     "columns.q.joint: pivot is no hinge or slide; expected the seven columns"),
    (XML.replace("</worldbody>", ""), "does not read it: .*line number=.*worldbody")])  # fmt: skip
def test_a_model_at_fault_is_said_in_a_line(files, xml, line):
    refused(f"(?i){line}", load_mjcf, *files(xml))


def test_loads_are_carried_by_the_tool_of_the_last_link_or_where_they_are_said_to_be(files):
    refused("no joint elbow", loaded, files, "joint:elbow.damping")
    refused("has no dampin that can be", loaded, files, "joint:pivot.dampin")
    for at, line in (('"tol"', "the model has no site tol.*tool"), ("3", ".*name of a site")):
        model = files(SERVO % "", f"payload_at = {{arm = {at}}}\n{TURN}")
        refused(f"payload_at.arm: {line}", load_mjcf, *model)
    tool = '<body name="hand" pos="0.3 0 0"><geom size="0.01" mass="0.2" contype="0" conaffinity="0"/></body>'
    offered = turning(files, TURN, tool)[0].simulator.parameters
    assert {"body:arm.mass", "body:hand.mass", "body:hand.com_x", "body:hand.payload"} <= {*offered}
    assert "body:arm.payload" not in offered
    stated = turning(files, 'payload_at = {arm = "tool"}\n' + TURN, tool)[0].simulator.parameters
    assert "body:arm.payload" in stated and "body:hand.payload" not in stated


def test_degrees_of_angles_and_of_rates_are_named(files, tmp_path):
    found, log, _ = loaded(files)
    refused(r"column q: .* rad, beyond joint pivot's -3 to 3; expected unit = .deg", read_back, found,
            tmp_path, np.degrees(20 * log["q"]), 0 * log.t)  # fmt: skip
    servo = XML.replace('<motor name="m" joint="pivot"/>', '<velocity name="m" joint="pivot" kv="9"/>')
    found = load_mjcf(*files(servo, MAP.replace('unit = "Nm"', 'unit = "rad/s"')))
    t = np.arange(0, 2, 0.01)
    assert not read_back(found, tmp_path, np.sin(t), np.cos(t)).warnings
    line = "column u: .* rad/s of column q; expected unit = .deg/s. of u"
    refused(line, read_back, found, tmp_path, np.sin(t), np.degrees(np.cos(t)))


@pytest.mark.parametrize("unit", ["", 'unit = "rad"\n'])
def test_a_wheel_turns_as_often_as_it_does_if_its_unit_is_stated(files, tmp_path, unit):
    table = MAP.replace('joint = "pivot"\n', f'joint = "pivot"\n{unit}')
    found = load_mjcf(*files(XML.replace('range="-3 3"', ""), table))
    t = np.arange(0, 5, 0.01)
    np.savetxt(tmp_path / "a.csv", np.c_[t, 12 * t, 0 * t], delimiter=",", header="t,q,u", comments="")
    if unit:
        assert found.read(tmp_path / "a.csv")["q"][-1] == pytest.approx(59.88)
    else:
        refused(r"expected unit = .deg. in the map", found.read, tmp_path / "a.csv")


def test_goals_in_degrees_turns_and_commands_beyond_their_range_are_reported(files, tmp_path):
    servo = '<position name="m" joint="pivot" kp="9" ctrlrange="-0.5 0.5" ctrllimited="true"/>'
    goals = MAP.replace('unit = "Nm"', 'unit = "rad"')
    found = load_mjcf(*files(XML.replace('<motor name="m" joint="pivot"/>', servo), goals))
    t = np.arange(0, 2, 0.01)
    line = "column u: .* of column q; expected unit = .deg. of u"
    refused(line, read_back, found, tmp_path, np.sin(t), np.degrees(np.sin(t - 0.02)))
    (clipped,) = read_back(found, tmp_path, np.sin(t), np.sin(t)).warnings
    share = f"({100 * np.mean(np.sin(t) > 0.5):.2g} %"
    assert "beyond its actuator's ctrlrange -0.5 to 0.5" in clipped and share in clipped
    log = read_back(found, tmp_path, (2.0 * t + np.pi) % (2 * np.pi) - np.pi, 0.0 * t)
    assert "jumps by whole turns" in log.warnings[0]
    np.testing.assert_allclose(log["q"], 2.0 * t, atol=1e-5)


@pytest.mark.parametrize("moves", ['joint="pivot" gear="57.3"', 'tendon="belt"'])
def test_goals_are_checked_in_what_the_actuator_moves(files, tmp_path, moves):
    """A gear, or a pulley on a tendon, of which goals are as large as degrees would be."""
    belt = '</worldbody><tendon><fixed name="belt"><joint joint="pivot" coef="57.3"/></fixed></tendon>'
    servo = XML.replace('<motor name="m" joint="pivot"/>', f'<position name="m" {moves} kp="9"/>')
    model = servo.replace("</worldbody>", belt)
    found, t = load_mjcf(*files(model, MAP.replace('unit = "Nm"', 'unit = "rad"'))), np.arange(0, 2, 0.01)
    assert not read_back(found, tmp_path, np.sin(t), np.degrees(np.sin(t))).warnings


@pytest.mark.parametrize(("kind", "units"), [("hinge", ["N m", "N m"]), ("slide", ["N", "N"])])
def test_what_a_slide_s_actuator_gives_is_a_force(files, kind, units):
    servo = '<position name="m" joint="pivot" kp="9" kv="1" forcerange="-2 2"/>'
    xml = XML.replace('<motor name="m" joint="pivot"/>', servo).replace('axis="0 1 0"', f'type="{kind}"')
    model = load_mjcf(*files(xml, f'{MAP}[columns.f]\nactuator = "m"\nkind = "force"')).simulator
    found = [model.channels["f"].unit, setting_of(model.model, "actuator:m.limit").unit]
    assert found == units and setting_of(model.model, "actuator:m.damping").unit.startswith(f"{units[0]} s")


@pytest.mark.parametrize(("unit", "si"), [("deg", "rad"), ("mNm", "Nm"), ("%", "1"), ("V", "1")])
def test_a_command_has_the_unit_of_its_values(files, unit, si):
    """Of goals in degrees an offset in rad was called one in deg; commands in mNm had no candidates."""
    found = load_mjcf(*files(described=MAP.replace('"Nm"', f'"{unit}"')))
    assert found.simulator.channels["u"].unit == si


def test_delayed_commands_step_when_they_are_carried_out(files):
    """The mean over each solver's step of what was commanded 12.3 ms before, by brute force."""
    found, log, effects = loaded(files)
    rng = np.random.default_rng(3)
    t = log.t + 1e-3 * rng.uniform(-1, 1, log.t.size)
    log = Recording("a.csv", t, {"q": log["q"], "u": rng.normal(size=t.size)})
    late = effects_of(found.simulator, [log], effects)["command.delay"].command
    window = late(log, {"delay": 0.0123}).window(40, 80)
    times = np.arange(0, float(window.t[-1] - window.t[0]), 1e-3)
    since = np.array([window.t - window.t[0]])
    held = Held(_carried_out([window], since, 0.0), times)
    acted = held(np.array([_commanded(window, "u")]))[0]
    fine = window.t[0] + times[:, None] + 1e-3 * (np.arange(200) + 0.5) / 200
    asked = log["u"][np.searchsorted(log.t, fine - 0.0123, side="right") - 1].mean(1)
    np.testing.assert_allclose(acted, asked, atol=0.02)
    line = held(np.array([_commanded(window, "u")]), 1.0)[0]
    asked = np.interp(fine - 0.0123, log.t, log["u"]).mean(1)
    np.testing.assert_allclose(line, asked, atol=0.02)


def test_masses_stay_within_what_a_robot_can_have_and_numerics_are_no_candidates(files):
    found, log, effects = loaded(files)
    mass = effects_of(found.simulator, [log], effects)["body:bob.mass"].parameters["mass"]
    assert (mass.low, mass.high) == pytest.approx((0.5 / 3, 1.5))
    found, log, _ = loaded(files)
    made = candidates(Setting(found.simulator, [log]))
    assert {n for n, e in made.items() if e.fitted} == found.simulator.numerics
    known = "timestep", "integrator", "iterations", "hold", "smooth", "late"
    assert found.simulator.numerics == {f"option.{n}" for n in known}
    refused("option has no integratr", loaded, files, "option.integratr")


@pytest.mark.parametrize(
    ("own", "name", "other"),
    [("RK4", "timestep", "Euler"), ("RK4", "integrator", "implicit"), ("Euler", "integrator", "implicit"),
     ("implicit", "integrator", "Euler")])  # fmt: skip
def test_another_integrator_errs_as_the_numerics_say(files, own, name, other):
    """Whole it is that integrator's run; a third of Euler's error is what it errs at a third of the step."""

    def run(integrator: str, step: float = 0.003, **options: float) -> np.ndarray:
        xml = XML.replace("RK4", integrator).replace('"0.001"', f'"{step}"')
        found, log, _ = loaded(lambda: files(xml))
        values = {n: s.nominal for n, s in found.simulator.settings.items()} | options
        return found.simulator.simulate(values, log.window(0, 60), {"q": 0.5, "q_rate": 0.0})["q"]

    np.testing.assert_allclose(run(own, **{f"option.{name}": 1.0}), run(other), atol=1e-12)
    if name == "timestep":
        error = run(other, 0.001) - run(own)
        left = run(own, **{f"option.{name}": 1 / 3}) - run(own) - error
        assert np.abs(error).max() > 1e-4 and np.abs(left).max() < 0.05 * np.abs(error).max()


@pytest.mark.parametrize("name", SET)
def test_a_patched_model_is_the_one_that_was_simulated(files, name):
    paths = files(SERVO.replace('gravity="0 0 0"', "").replace("</worldbody>", TIE) % "", TURN)
    found, t = load_mjcf(*paths), np.arange(0, 2, 0.01)
    log = Recording("a.csv", t, {"q": 0.3 * np.sin(6 * t), "u": 0.3 * np.sin(6 * t)})
    effects, simulator = effects_of(found.simulator, [log], found.effects([log])), found.simulator
    composed = Composed.of(simulator, [log], effects, noises(simulator, [log]))
    effect = next(n for n, e in composed.effects.items() if name in e.model.values())
    short = next(k for k, v in composed.effects[effect].model.items() if v == name)
    value = simulator.parameters[name].nominal + 0.1
    text, lacking = patched(paths[0], composed, {effect: {short: value}}, [effect])
    again = mujoco.MjModel.from_xml_string(text)
    assert not lacking
    with changed_model(simulator.model, simulator.settings, ((name, value),)):
        for field in FIELDS:
            np.testing.assert_allclose(getattr(again, field), getattr(simulator.model, field), 1e-5, 1e-9)
        np.testing.assert_allclose(again.opt.gravity, simulator.model.opt.gravity, rtol=1e-5)
        assert again.opt.timestep == pytest.approx(simulator.model.opt.timestep)


def turning(files, described: str = TURN, more: str = "", u: np.ndarray | None = None):
    """The servo's simulator and a log in which its command swings."""
    found = load_mjcf(*files(SERVO % more, described))
    t = np.arange(0, 2, 0.01)
    log = Recording("a.csv", t, {"q": 0.3 * np.sin(6 * t), "u": 0.3 * np.sin(6 * t) if u is None else u})
    found.effects([log])
    nominal = {n: p.nominal for n, p in found.simulator.parameters.items()}

    def run(**changed: float) -> np.ndarray:
        values = nominal | {n.replace("__", ".").replace("_of_", ":"): v for n, v in changed.items()}
        return found.simulator.simulate(values, log, {"q": 0.0, "q_rate": 1.8})["q"]

    return found, run


@pytest.mark.parametrize(("kind", "number"), [
    ("muscle", 'lengthrange="-1 1" force="%s"'), ("damper", 'kv="%s" ctrlrange="0 1"'),
    ("dcmotor", 'motorconst="%s" resistance="20"'), ("position", 'kp="%s"'), ("velocity", 'kv="%s"'),
])  # fmt: skip
def test_the_gain_of_any_actuator_is_its_strength_or_how_stiffly_it_follows(files, kind, number):
    """The first of a muscle's numbers is a length, of a motor's a resistance, and a damper's is zero."""
    if kind == "dcmotor" and not hasattr(mujoco.mjtGain, "mjGAIN_DCMOTOR"):
        pytest.skip("not in this MuJoCo")
    driven = XML.replace('<motor name="m" joint="pivot"/>', f'<{kind} name="m" joint="pivot" {number}/>')
    unit = {"position": 'unit = "rad"', "velocity": 'unit = "rad/s"'}.get(kind, "")
    log = Recording("a.csv", np.arange(0, 0.5, 0.01), {"q": np.zeros(50), "u": np.full(50, 0.5)})

    def run(strength: float, **changed: float) -> np.ndarray:
        found = load_mjcf(*files(driven % strength, MAP.replace('unit = "Nm"', unit)))
        found.effects([log])
        return found.simulator.simulate(changed, log, {"q": 0.5, "q_rate": 2.0})["q"]

    assert np.ptp(run(0.5) - run(0.4)) > 1e-3
    np.testing.assert_allclose(run(0.5, **{"actuator:m.gain": -0.2}), run(0.4), atol=1e-9)


def test_lines_are_those_of_a_loop_that_sets_a_command_and_makes_a_step(files):
    found, run = turning(files)
    model, t = found.simulator.model, np.arange(0, 2, 0.01)
    times = model.opt.timestep * np.arange(round(1.99 / model.opt.timestep) + 1)
    asked = stepped(model, np.interp(times, t, 0.3 * np.sin(6 * t)), rate=1.8)[:, 0]
    np.testing.assert_allclose(run(option__hold=1.0), np.interp(t, times, asked), atol=1e-5)
    assert np.abs(run(option__hold=1.0, option__late=0.5) - run(option__hold=1.0)).max() > 1e-4


def test_smoothed_commands_are_means_and_play_lags_at_turns(files):
    u = np.random.default_rng(0).uniform(-0.3, 0.3, 200)
    mean = u.copy()
    mean[1:-1] = 0.7 * u[1:-1] + 0.15 * (u[2:] + u[:-2])
    _, plain = turning(files, u=mean)
    _, run = turning(files, u=u)
    np.testing.assert_allclose(run(option__smooth=0.3), plain(), atol=1e-12)
    assert np.abs(run() - plain()).max() > 1e-3
    found, run = turning(files)
    assert found.simulator.parameters["joint:turn.width"].effect == "command:u.backlash"
    plain = run()
    assert np.abs(run(joint_of_turn__width=1e-7) - plain).max() < 1e-3
    apart = run(joint_of_turn__width=0.02) - plain
    assert 3e-3 < np.abs(apart).max() < 0.06 and np.abs(run() - plain).max() == 0.0


def test_commands_that_follow_a_curve_between_samples_are_in_reach(files):
    """A loop at 1 kHz whose commands are logged at 100 Hz: lines lie off its curve, always to one side."""
    wanted = lambda t: 0.3 * np.sin(20 * t)  # noqa: E731
    t = np.arange(0, 2, 0.01)
    found, run = turning(files, u=wanted(t))
    model = found.simulator.model
    times = model.opt.timestep * np.arange(round(1.99 / model.opt.timestep) + 1)
    true = np.interp(t, times, stepped(model, wanted(times), rate=1.8)[:, 0])
    low = found.simulator.parameters["option.smooth"].low
    lines, curve = (np.abs(run(option__hold=1.0, option__smooth=s) - true)[1:-2].max() for s in (0.0, low))
    assert curve < 0.1 * lines
    np.testing.assert_array_equal(run(option__smooth=low), run())  # steps have none


@pytest.mark.parametrize("seen", ["left", "right"])
def test_joints_without_a_column_follow_their_equality(files, seen):
    found = load_mjcf(*files(FINGERS, f'[columns.w]\njoint = "{seen}"\n'))
    t, (left, right) = np.arange(0, 1, 0.01), (0.02, 0.05)
    start = {"left": (left, 0.1), "right": (right, 0.2)}[seen]
    job = Job({}, Recording("a.csv", t, {"w": np.zeros(t.size)}),
              dict(zip(("w", "w_rate"), start, strict=True)))  # fmt: skip
    _, *state = found.simulator._states([job])[0]
    np.testing.assert_allclose(state, [left, right, 3 * right**2, 0.1, 0.2, 6 * right * 0.2])
    assert not found.warnings


@pytest.mark.parametrize("tie", [0.02, 0.01])
def test_a_joint_that_follows_starts_as_far_off_its_tie_as_loads_have_it(files, tie):
    """The second of two tied fingers lags by what its damping stretches the tie, in plain MuJoCo."""
    columns = '[columns.w]\njoint = "left"\n[columns.u]\nactuator = "servo"\nunit = "m"\n'
    found, model = load_mjcf(*files(TIED, columns)), mujoco.MjModel.from_xml_string(TIED)
    model.eq_solref[:, 0] = tie
    t = np.arange(0, 1, 0.01)
    u = 0.05 * np.sin(6 * t)
    run = stepped(model, u, 5)
    log = Recording("a.csv", t, {"w": run[:, 0], "u": u})
    found.effects([log])
    left, right, rate, other = run[60]
    job = Job({}, log.window(60, 90), {"w": left, "w_rate": rate})
    _, *state = found.simulator._states([job], (("joint:right.tie", tie),))[0]
    assert abs(left - right) > 1e-4
    found.simulator.prepare([Recording("a.csv", t, {"w": 0 * t + left, "u": 0 * u + left})])  # of that name
    still = Job({}, log.window(60, 90), {"w": left, "w_rate": 0.0})
    at_rest = found.simulator._states([still], (("joint:right.tie", tie),))[0]
    assert abs(at_rest[1] - at_rest[2]) < 0.1 * abs(left - right)
    np.testing.assert_allclose(state, [left, right, rate, other], atol=0.02 * abs(left - right))


def test_a_joint_pushed_on_past_a_stop_starts_where_it_came_to_rest(files):
    """The tie stretches from the log's beginning, as in plain MuJoCo."""
    xml = TIED.replace('damping="20"', 'damping="20" range="-1 0.03" limited="true"')
    columns = '[columns.w]\njoint = "right"\n[columns.u]\nactuator = "servo"\nunit = "m"\n'
    found, model = load_mjcf(*files(xml, columns)), mujoco.MjModel.from_xml_string(xml)
    data, t = mujoco.MjData(model), np.arange(0, 1, 0.01)
    data.ctrl[:] = 0.08
    mujoco.mj_step(model, data, nstep=2000)
    left, right = data.qpos
    assert left - right > 0.002
    log = Recording("a.csv", t, {"w": np.full(t.size, right), "u": np.full(t.size, 0.08)})
    found.effects([log])
    at_rest = {"w": right, "w_rate": 0.0}
    states = found.simulator._states([Job({}, log.window(k, 30), at_rest) for k in (0, 20)])
    np.testing.assert_allclose(states[:, 1:3], [[left, right]] * 2, atol=0.02 * (left - right))


@pytest.fixture
def urdf(files):
    torques = MAP.replace('"m"', '"pivot"')
    return lambda described=torques: files(URDF, described, "swing.urdf")


def test_a_column_of_torques_drives_a_urdf(urdf):
    found, t = load_mjcf(*urdf()), np.arange(0, 1, 0.01)
    log = Recording("a.csv", t, {"q": np.zeros(t.size), "u": 0.3 * np.sin(5 * t)})
    more = found.effects([log])
    values = {n: p.nominal for n, p in found.simulator.parameters.items()}
    asked = stepped(mujoco.MjModel.from_xml_string(URDF), log["u"], 5, given="qfrc_applied")[:, 0]
    got = found.simulator.simulate(values, log, {"q": 0.0, "q_rate": 0.0})["q"]
    np.testing.assert_allclose(got, asked, atol=1e-6)
    effects = effects_of(found.simulator, [log], more)
    composed, gain = Composed.of(found.simulator, [log], effects, {"q": 1e-4}), "actuator:pivot.gain"
    text, lacking = patched(urdf()[0], composed, {gain: {"gain": 0.1}}, [gain])
    assert "<mujoco" in text and len(lacking) == 1 and lacking[0].startswith(gain)


def test_maps_of_a_urdf_leave_goals_to_their_user_and_say_what_cannot_be_asked(urdf, tmp_path):
    columns = [("pivot_pos", None), ("pivot_effort", None), ("pivot_cmd", None)]
    text, left = proposed_map(urdf()[0], columns, {})
    described = tomllib.loads(text)["columns"]
    assert described == {"pivot_pos": {"joint": "pivot"}, "pivot_effort": {"actuator": "pivot", "unit": "Nm"}}
    assert left == ["pivot_cmd"]
    angle = MAP.partition("[columns.u]")[0]
    for column, line in (
        ('actuator = "pivot"\nunit = "rad"', "no servo to be commanded.*<position joint=.pivot"),
        ('actuator = "pivot"', "no servo to be commanded"),
        ('actuator = "pivott"\nunit = "Nm"', "no joint pivott.*did you mean pivot"),
        ('actuator = "pivot"\nkind = "force"', "no actuator to give a force.*unit = .Nm"),
        ('joint = "pivot"\nkind = "torque"', "no actuator to give a torque.*unit = .Nm"),
    ):
        refused(rf"columns\.u: .*{line}", load_mjcf, *urdf(f"{angle}[columns.u]\n{column}\n"))
    assert "no column drives the model" in load_mjcf(*urdf(angle)).warnings[0]


@pytest.mark.parametrize(("name", "value", "stated"), [
    (None, None, ()), ("joint:left.armature", 0.5, ('armature="0.3"', 'armature="0.5"')),
    ("body:left.mass", 0.2, ('mass="0.1"', 'mass="0.2"')),
    ("body:left.payload", 0.1, ('mass="0.1"', 'mass="0.2"'))])  # fmt: skip
def test_what_only_slides_is_held_as_softly_as_in_mujoco_s_own_run(files, name, value, stated):
    finger = (
        '<body name="{0}" pos="0 {1} 0"><joint name="{0}" type="slide" axis="0 1 0" damping="6"'
        ' armature="{2}" frictionloss="0.6"/><geom type="box" size="0.01 0.005 0.03" mass="{3}"/></body>'
    )
    xml = (
        '<mujoco><option timestep="0.001"/><worldbody>'
        + finger.format("left", 0.1, 0.3, 0.1) + finger.format("right", -0.1, 0.25, 0.15)
        + '</worldbody><equality><joint joint1="right" joint2="left" polycoef="0 -1 0 0 0"/></equality>'
        '<actuator><position name="grip" joint="left" kp="400" kv="10"/></actuator></mujoco>')  # fmt: skip
    described = ('[columns.l]\njoint = "left"\n[columns.r]\njoint = "right"\n'
                 '[columns.u]\nactuator = "grip"\nunit = "m"\n')  # fmt: skip
    found, t = load_mjcf(*files(xml, described)), np.arange(0, 0.5, 0.001)
    log = Recording("a.csv", t, {"l": 0 * t, "r": 0 * t, "u": 0.02 * np.sin(9 * t)})
    found.effects([log])
    begun = {"l": 0.0, "l_rate": 0.0, "r": 0.0, "r_rate": 0.0}
    read = found.simulator.simulate({name: value} if name else {}, log, begun)
    model = mujoco.MjModel.from_xml_string(xml.replace(*stated) if stated else xml)
    own = stepped(model, log["u"])[:, :2]
    assert np.abs(np.column_stack([read["l"], read["r"]]) - own).max() < 1e-9


def test_warnings_are_of_joints_that_nothing_shows_and_of_mujoco_counted(files, tmp_path, monkeypatch):
    found = load_mjcf(*files(FINGERS, '[columns.w]\njoint = "tip"\n'))
    assert "no column shows left, right, which the model moves as it runs freely" in found.warnings[0]
    monkeypatch.chdir(tmp_path)
    warned()
    found, log, _ = loaded(files)
    values = {n: p.nominal for n, p in found.simulator.parameters.items()}
    pushed = log.with_columns({"u": np.full(len(log), 1e300)})
    found.simulator.simulate_many([Job(values, pushed, {"q": 0.1, "q_rate": 0.0})] * 3)
    (line,) = warned()
    assert line.startswith("MuJoCo: ") and line.endswith(" times)") and warned() == []
    assert not list(tmp_path.glob("*.TXT"))


@pytest.mark.parametrize(("place", "at"), [("", 0.2), ('payload_at = {arm = "tool"}\n', 0.2),
                                           ("payload_at = {arm = [0.1, 0.0, 0.0]}\n", 0.1)])  # fmt: skip
def test_a_payload_is_a_point_mass_where_it_is_said_to_be(files, place, at):
    _, run = turning(files, place + TURN)
    ball = f'<geom size="1e-4" pos="{at} 0 0" mass="0.3" contype="0" conaffinity="0"/>'
    _, other = turning(files, place + TURN, ball)
    np.testing.assert_allclose(run(body_of_arm__payload=0.3), other(), atol=1e-7)
    assert np.abs(run() - other()).max() > 1e-3


def test_what_is_uncertain_is_fitted_along_and_what_is_measured_as_the_map_says(files):
    found, log, more = loaded(files)

    def made(described: str):
        again = load_mjcf(*files(described=described + MAP))
        return effects_of(again.simulator, [log], again.effects([log]))

    usual = effects_of(found.simulator, [log], more)
    stated = made('uncertain = ["joint:*.damping"]\n[sd]\n"body:bob.mass" = 0.002\n')
    assert not usual["joint:pivot.damping"].fitted and stated["joint:pivot.damping"].fitted
    assert not stated["joint:pivot.frictionloss"].fitted
    assert stated["body:bob.mass"].parameters["mass"].sd == 0.002
    wide = effects_of(found.simulator, [log], more, UNMEASURED)
    assert wide["joint:pivot.frictionloss"].fitted and not wide["body:bob.mass"].fitted
    line = r"uncertain: nothing is called joint:pivot\.dampin.*did you mean"
    refused(line, made, 'uncertain = ["joint:pivot.dampin"]\n')
    for text in ("sd = 1\n", '[sd]\n"body:bob.mass" = -1\n', "uncertain = 3\n"):
        refused("", made, text)


def test_a_law_acts_with_its_own_numbers_where_these_are_as_it_came(files):
    """Stribeck's speed is read off the logs, and not 1 rad/s."""
    (found, log, _), at = loaded(files), {"q": 0.1, "q_rate": 0.3}
    own = {n: p.nominal for n, p in found.simulator.parameters.items()} | {"joint:pivot.stribeck_extra": 0.1}
    near = own | {"joint:pivot.stribeck_speed": own["joint:pivot.stribeck_speed"] * (1 + 1e-9)}
    jobs = [Job(p, log.window(0, end), at) for p, end in ((own, 60), (near, 60), (own, 20))]
    one, *two = (channels["q"] for channels in found.simulator.simulate_many(jobs))
    np.testing.assert_allclose(np.concatenate(two), [*one, *one[:20]], atol=1e-9)


FOUR_BARS = """<mujoco><worldbody>
  <body><joint name="crank" axis="0 1 0"/><geom type="capsule" fromto="0 0 0 .1 0 0" size=".01" contype="0"/>
    <body pos=".1 0 0" name="bar"><joint name="knee" axis="0 1 0"/>
      <geom type="capsule" fromto="0 0 0 .3 0 0" size=".01" contype="0"/></body></body>
  <body pos=".35 0 -.05" name="rocker"><joint name="rock" axis="0 1 0"/>
    <geom type="capsule" fromto="0 0 0 .05 0 .05" size=".01" contype="0"/></body>
  </worldbody><equality><connect body1="bar" body2="rocker" anchor=".3 0 0"/></equality></mujoco>"""
COLUMNS = '[columns.c]\njoint = "crank"\n[columns.r]\njoint = "rock"\n'


def close(model, data, rate: float) -> None:
    """Close the loop at the crank's angle, and at its rate."""
    for _ in range(20):
        mujoco.mj_fwdPosition(model, data)
        jacobian = np.array([column(model, data, one) for one in np.eye(3)[1:]]).T
        data.qpos[1:] -= np.linalg.lstsq(jacobian, data.efc_pos, rcond=None)[0]
    drawn = column(model, data, np.array([rate, 0.0, 0.0]))
    data.qvel[:] = [rate, *-np.linalg.lstsq(jacobian, drawn, rcond=None)[0]]


def test_windows_begin_with_closed_loops(files):
    """What no column shows follows from what they show, and moves as the loop does."""
    simulator = load_mjcf(*files(FOUR_BARS, COLUMNS)).simulator
    model, data = simulator.model, mujoco.MjData(simulator.model)
    data.qpos[0] = 0.2
    close(model, data, 1.0)  # the rocker that goes with this crank, by the loop itself
    log = Recording("a", np.arange(3) / 100, {"c": np.full(3, data.qpos[0]), "r": np.full(3, data.qpos[2])})
    start = {"c": data.qpos[0], "c_rate": 1.0, "r": data.qpos[2], "r_rate": data.qvel[2]}
    state = simulator._state(Job({}, log, start))
    np.testing.assert_allclose(state[1:4], data.qpos, atol=1e-7)
    np.testing.assert_allclose(state[4:7], data.qvel, atol=1e-7)


def column(model, data, rates: np.ndarray) -> np.ndarray:
    """Rates of the constraints at rates of the joints."""
    out = np.zeros(data.nefc)
    mujoco.mj_mulJacVec(model, data, out, rates)
    return out


def test_loops_stay_closed_as_the_log_has_them_where_the_model_itself_strays(files):
    """Nothing drives the model, so that it falls, as one driven by torques drifts away."""
    found = load_mjcf(*files(FOUR_BARS, COLUMNS))
    simulator, t = found.simulator, np.arange(0, 1, 0.01)
    model, data, seen = simulator.model, mujoco.MjData(simulator.model), []
    for crank, rate in zip(0.2 + 0.4 * np.sin(5 * t), 2.0 * np.cos(5 * t), strict=True):
        data.qpos[0] = crank
        close(model, data, rate)
        seen.append(np.concatenate([data.qpos, data.qvel]))
    seen = np.array(seen)
    log = Recording("a", t, {"c": seen[:, 0], "r": seen[:, 2]})
    found.effects([log])
    for row in (30, 60, 90):
        names = {"c": 0, "c_rate": 3, "r": 2, "r_rate": 5}
        start = {name: float(seen[row, k]) for name, k in names.items()}
        (state,) = simulator._states([Job({}, log.window(row, row + 10), start)])
        np.testing.assert_allclose(state[1:7], seen[row], atol=1e-6)


def test_efforts_alone_can_be_compared(files):
    xml = """<mujoco><worldbody><body><joint name="ankle" axis="0 1 0"/><geom size=".05" pos=".1 0 0"/></body>
      </worldbody><actuator><position name="servo" joint="ankle" kp="50" kv="5"/></actuator></mujoco>"""
    described = (
        '[columns.u]\nactuator = "servo"\nunit = "rad"\n[columns.i]\nactuator = "servo"\nkind = "force"\n'
    )
    found, t = load_mjcf(*files(xml, described)), np.arange(0, 1, 0.01)
    log = Recording("a", t, {"u": 0.1 * np.sin(5 * t), "i": np.zeros(t.size)})
    found.effects([log])
    given = found.simulator.simulate({}, log)["i"]
    model = mujoco.MjModel.from_xml_string(xml)
    data, told = mujoco.MjData(model), []
    for k in range(round(0.99 / 0.002) + 1):
        data.ctrl[0] = log["u"][min(int(k * 0.002 / 0.01 + 1e-9), 99)]
        mujoco.mj_step(model, data)
        told.append(float(data.actuator_force[0]))
    np.testing.assert_allclose(given, told[::5], atol=1e-6)


CART = """<mujoco><option timestep="0.002"/><default><geom contype="0" conaffinity="0"/></default><worldbody>
<body name="cart"><joint name="rail" type="slide" axis="1 0 0" damping="1" armature="0.1"/>
<geom type="box" size=".1 .05 .05" mass="0.8"/>
<body name="pole"><joint name="pivot" axis="0 1 0" damping="0.02"/>
<geom type="capsule" fromto="0 0 0 0 0 -.5" size=".01" mass="0.2"/></body></body></worldbody>
<actuator><motor name="belt" joint="rail"/></actuator></mujoco>"""


def test_a_wrong_unit_of_a_slide_shows_and_joints_without_a_column_can_be_at_fault(files):
    model = mujoco.MjModel.from_xml_string(CART)
    data, rows = mujoco.MjData(model), []
    for step in range(1500):
        data.ctrl[0] = 4 * np.sin(0.01 * (step - step % 5))
        if step % 5 == 0:
            rows.append([step * 0.002, data.qpos[0], data.ctrl[0]])
        mujoco.mj_step(model, data)
    columns = '[columns.u]\nactuator = "belt"\nunit = "N"\n[columns.x]\njoint = "rail"\nunit = '
    xml, map_file = files(CART, columns + '"mm"\n')
    log = xml.with_name("log.csv")
    np.savetxt(log, rows, delimiter=",", header="t,x,u", comments="")
    refused(r"column x: moves .* expected unit = .m.", load_mjcf(xml, map_file).read, log)
    map_file.write_text(columns + '"m"\n')
    loaded = load_mjcf(xml, map_file)
    loaded.effects([loaded.read(log)])
    assert {"joint:pivot.frictionloss", "body:pole.mass"} <= {*loaded.simulator.parameters}
