"""MuJoCo models as simulators: maps, rollouts against closed forms, what is set and taken back, patches."""

from __future__ import annotations

import numpy as np
import pytest

from hmmseg.errors import InputError
from simgap.simulators.protocol import Job
from simgap.simulators.recording import Recording

mujoco = pytest.importorskip("mujoco")

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


@pytest.fixture
def files(tmp_path):
    def write(xml: str = XML, described: str = MAP):
        (tmp_path / "swing.xml").write_text(xml)
        (tmp_path / "map.toml").write_text(described)
        return tmp_path / "swing.xml", tmp_path / "map.toml"

    return write


def loaded(files, *candidates: str):
    from simgap.simulators.mjcf.load import load_mjcf

    found = load_mjcf(*files(), candidates)
    t = np.arange(0, 2, 0.01)
    log = Recording("a.csv", t, {"q": 0.1 * np.cos(6.9 * t), "u": np.zeros(t.size)})
    effects = found.effects([log])
    return found, log, effects


def test_a_window_is_the_linear_pendulum(files):
    """Small swings at omega^2 = m g l / (m l^2 + I) from a start between samples of the grid."""
    found, log, _ = loaded(files)
    simulator = found.simulator
    nominal = {n: p.nominal for n, p in simulator.parameters.items()}
    window = Recording("a.csv", log.t[7:60], {n: v[7:60] for n, v in log.columns.items()}, 7)
    (channels,) = simulator.simulate_many([Job(nominal, window, {"q": 1e-3, "q_rate": -2e-3})])
    assert channels is not None
    inertia = 0.5 * 0.2**2 + 0.4 * 0.5 * 0.01**2
    omega = np.sqrt(0.5 * 9.81 * 0.2 / inertia)
    t = window.t - window.t[0]
    np.testing.assert_allclose(
        channels["q"], 1e-3 * np.cos(omega * t) - 2e-3 / omega * np.sin(omega * t), atol=2e-8
    )


def test_what_is_set_is_taken_back(files):
    found, log, _ = loaded(files)
    simulator = found.simulator
    nominal = {n: p.nominal for n, p in simulator.parameters.items()}
    start = {"q": 0.1, "q_rate": 0.0}
    before, heavy, after = (
        simulator.simulate_many([Job({**nominal, **change}, log, start)])[0]["q"]
        for change in ({}, {"joint:pivot.damping": 0.01, "body:bob.mass": 0.7}, {})
    )
    assert np.abs(before - heavy).max() > 1e-3
    np.testing.assert_array_equal(before, after)


def test_a_step_of_torque_is_held_as_the_steps_have_it():
    from simgap.simulators.mjcf.signals import Held

    held = Held(np.array([0.0, 0.005, 0.01]), np.arange(0, 0.012, 0.002))
    np.testing.assert_allclose(held(np.array([1.0, 3.0, 0.0])), [1, 1, 2, 3, 3, 0])


@pytest.mark.parametrize(
    ("described", "line"),
    [
        (
            MAP.replace('"pivot"', '"pivott"'),
            r"columns\.q: the model has no joint pivott.*did you mean pivot",
        ),
        (MAP.replace("joint =", "joints ="), r"columns\.q\.joints: unknown key.*did you mean joint"),
        (MAP.replace('joint = "pivot"', 'kind = "position"'), "columns.q: names no thing of the model"),
        (MAP.replace("1e-4", "-1"), "noise: -1; expected above 0"),
        (MAP.replace('"Nm"', '"furlong"'), "'furlong' is no known unit"),
        (
            MAP.replace('joint = "pivot"', 'joint = "pivot"\nunit = "kg"'),
            r"columns\.q\.unit: 'kg' of a position that is read in rad; expected a unit of angle",
        ),
        (MAP.replace('[columns.u]\nactuator = "m"\nunit = "Nm"', "[colums.u]"), "colums: unknown key"),
    ],
)
def test_a_map_at_fault_is_said_in_a_line(files, described, line):
    from simgap.simulators.mjcf.load import load_mjcf

    with pytest.raises(InputError, match=line):
        load_mjcf(*files(described=described))


def test_a_candidate_that_is_none_is_said(files):
    with pytest.raises(InputError, match="no joint elbow"):
        loaded(files, "joint:elbow.damping")
    with pytest.raises(InputError, match="has no dampin that can be"):
        loaded(files, "joint:pivot.dampin")


def test_degrees_where_radians_are_declared_are_named(files, tmp_path):
    found, log, _ = loaded(files)
    path = tmp_path / "log.csv"
    rows = "".join(f"{t:.3f},{np.degrees(20 * q):.4f},0\n" for t, q in zip(log.t, log["q"], strict=True))
    path.write_text("t,q,u\n" + rows)
    with pytest.raises(
        InputError, match=r"column q: .* rad, beyond joint pivot's -3 to 3; expected unit = .deg"
    ):
        found.read(path)


def test_a_patch_touches_only_what_changes(files):
    from simgap.simulators.mjcf.patch import attribute_set, option_set

    text = attribute_set(XML, "joint", "pivot", {"damping": "0.02"})
    assert text is not None
    changed = [(a, b) for a, b in zip(XML.splitlines(), text.splitlines(), strict=True) if a != b]
    assert changed == [
        ('      <joint name="pivot" axis="0 1 0" range="-3 3"/>',
         '      <joint name="pivot" axis="0 1 0" range="-3 3" damping="0.02"/>')
    ]  # fmt: skip
    again = option_set(text, {"timestep": "0.002"})
    assert again is not None and 'timestep="0.002"' in again
    mujoco.MjModel.from_xml_string(again)


def test_a_share_of_another_integrator_is_that_one_at_a_finer_step(files):
    """What a method of first order is off by goes with its step: a third of it at a third of the step."""
    from simgap.simulators.mjcf.load import load_mjcf
    from simgap.simulators.mjcf.patch import SPELT

    def swung(xml: str, **change: float) -> np.ndarray:
        found = load_mjcf(*files(xml.replace('name="pivot"', 'name="pivot" damping="0.2"')))
        t = np.arange(0, 2, 0.01)
        log = Recording("a.csv", t, {"q": 0.1 * np.cos(6.9 * t), "u": np.sin(5 * t)})
        found.effects([log])
        values = {n: p.nominal for n, p in found.simulator.parameters.items()}
        values |= {f"option.{n}": v for n, v in change.items()}
        (channels,) = found.simulator.simulate_many([Job(values, log, {"q": 0.1, "q_rate": 0.0})])
        assert channels is not None
        return channels["q"]

    coarse = XML.replace('timestep="0.001"', 'timestep="0.01"')
    plain = swung(coarse)
    for name in ("euler", "implicit", "implicitfast"):
        fine = XML.replace('"0.001" integrator="RK4"', f'"0.0025" integrator="{SPELT[name]}"')
        true = swung(fine)
        off, left = np.abs(plain - true).max(), np.abs(swung(coarse, **{name: 0.25}) - true).max()
        assert off > 1e-4 and left < 0.1 * off, name
    np.testing.assert_allclose(swung(coarse.replace("RK4", "Euler"), rk4=1.0), plain, atol=1e-12)


def test_the_model_s_own_integrator_is_no_candidate(files):
    found, _, _ = loaded(files)
    mine = {"euler", "rk4", "implicit", "implicitfast"} & {n[7:] for n in found.simulator.parameters}
    assert mine == {"euler", "implicit", "implicitfast"}
    with pytest.raises(InputError, match=r"option\.rk4: is the model's own integrator"):
        loaded(files, "option.rk4")
    with pytest.raises(InputError, match="option has no integratr"):
        loaded(files, "option.integratr")
