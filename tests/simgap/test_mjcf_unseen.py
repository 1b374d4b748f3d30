"""What no column shows of a MuJoCo model: loops that bodies close, and logs of efforts alone."""

import numpy as np
import pytest

from hmmseg.errors import InputError
from simgap.simulators.protocol import Job
from simgap.simulators.recording import Recording

mujoco = pytest.importorskip("mujoco")

from simgap.simulators.mjcf.load import load_mjcf  # noqa: E402


@pytest.fixture
def files(tmp_path):
    def write(xml: str, described: str):
        (tmp_path / "robot.xml").write_text(xml)
        (tmp_path / "map.toml").write_text(described)
        return tmp_path / "robot.xml", tmp_path / "map.toml"

    return write


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


def test_a_wrong_unit_of_a_slide_shows_and_joints_without_a_column_can_be_at_fault(tmp_path):
    (tmp_path / "robot.xml").write_text(CART)
    model = mujoco.MjModel.from_xml_string(CART)
    data, rows = mujoco.MjData(model), []
    for step in range(1500):
        data.ctrl[0] = 4 * np.sin(0.01 * (step - step % 5))
        if step % 5 == 0:
            rows.append([step * 0.002, data.qpos[0], data.ctrl[0]])
        mujoco.mj_step(model, data)
    np.savetxt(tmp_path / "log.csv", rows, delimiter=",", header="t,x,u", comments="")
    columns = '[columns.u]\nactuator = "belt"\nunit = "N"\n[columns.x]\njoint = "rail"\nunit = '
    (tmp_path / "map.toml").write_text(columns + '"mm"\n')
    with pytest.raises(InputError, match=r"column x: moves .* expected unit = .m."):
        load_mjcf(tmp_path / "robot.xml", tmp_path / "map.toml").read(tmp_path / "log.csv")
    (tmp_path / "map.toml").write_text(columns + '"m"\n')
    loaded = load_mjcf(tmp_path / "robot.xml", tmp_path / "map.toml")
    loaded.effects([loaded.read(tmp_path / "log.csv")])
    assert {"joint:pivot.frictionloss", "body:pole.mass"} <= {*loaded.simulator.parameters}
