"""Laws of friction and drives beyond MuJoCo's: one joint against closed forms."""

from dataclasses import replace

import numpy as np
import pytest

mujoco = pytest.importorskip("mujoco")

from simgap.simulators.mjcf.engine import rollout  # noqa: E402
from simgap.simulators.mjcf.laws import Laws, run  # noqa: E402
from simgap.simulators.mjcf.transmission import Motion, periods  # noqa: E402

INERTIA, REACH, MASS = 0.02, 0.1, 0.5
ROTOR = INERTIA - MASS * REACH**2 - 1e-4
LAWFUL = f"""<mujoco><option timestep="0.0005" integrator="implicitfast" gravity="0 0 -9.81"/>
<worldbody><body><joint name="hinge" type="hinge" axis="0 -1 0" armature="{ROTOR}"/>
<inertial pos="0 0 -{REACH}" mass="{MASS}" diaginertia="1e-4 1e-4 1e-4"/></body></worldbody>
<actuator><motor name="motor" joint="hinge" ctrllimited="true" ctrlrange="-2 2"/></actuator>
<sensor><jointpos joint="hinge"/><jointvel joint="hinge"/></sensor></mujoco>"""


def swung(gravity=True, angle=0.0, rate=0.0, torque=0.0, seconds=0.2, **laws):
    model = mujoco.MjModel.from_xml_string(LAWFUL)
    if not gravity:
        model.opt.gravity[:] = 0.0
    data, steps = mujoco.MjData(model), round(seconds / model.opt.timestep)
    spec = int(mujoco.mjtState.mjSTATE_FULLPHYSICS)
    first = np.zeros((1, mujoco.mj_stateSize(model, spec)))
    first[0, 1:3] = angle, rate
    control = np.full((1, steps, 1), torque)
    names = {n: f"actuator:motor.{n}" if n == "fade" else f"joint:hinge.{n}" for n in laws}
    mine = Laws.of(model, [(names[n], v) for n, v in laws.items()])
    if mine:
        found = run(model, data, mine, first, control)
    else:
        found = rollout.rollout(model, data, first, control, nstep=steps)[1]
    return *found[0].T, np.arange(steps) * model.opt.timestep


def test_friction_by_load_holds_at_rest_up_to_its_limit():
    weight = MASS * 9.81 * REACH * np.sin(0.5)
    held, _, _ = swung(
        angle=0.5, load_friction=2.1
    )  # half of that of the weight: 1.05 times as much as holds
    assert np.abs(held - 0.5).max() < 3e-3  # MuJoCo's friction creeps, by 12 mrad/s here
    _, rate, t = swung(angle=0.5, load_friction=1.5, seconds=0.02)
    assert rate[-1] / t[-1] == pytest.approx(-(weight - 0.75 * weight) / INERTIA, rel=0.03)
    # A motor that lifts loads the gears by its own torque and by the weight.
    _, rate, t = swung(angle=0.5, torque=2 * weight, load_friction=0.5, seconds=0.02)
    assert rate[-1] / t[-1] == pytest.approx((1.0 - 0.5 * 0.5 * 3) * weight / INERTIA, rel=0.03)


def test_laws_brake_as_stated_and_those_that_do_nothing_run_as_the_plain_model():
    for way, torque in ((1.0, 0.05), (-1.0, 0.0)):  # 0.05 N m one way, and as nothing holds it back, none
        _, rate, t = swung(gravity=False, rate=way, direction_friction=0.05)
        assert rate[-1] == pytest.approx(way * (1 - torque / INERTIA * t[-1]), rel=0.01)
    _, rate, t = swung(gravity=False, rate=0.5, stribeck_extra=0.02, stribeck_speed=0.4, seconds=0.05)
    assert rate[-1] == pytest.approx(0.5 - 0.02 * np.exp(-((0.5 / 0.4) ** 2)) / INERTIA * t[-1], rel=0.01)
    _, rate, t = swung(gravity=False, rate=5.0, quadratic_drag=0.01)
    np.testing.assert_allclose(rate, 5 / (1 + 0.01 * 5 / INERTIA * t), rtol=1e-3)
    _, rate, t = swung(gravity=False, torque=1.0, fade=0.3, seconds=0.05)  # half of the most: 15 % less
    assert rate[-1] / t[-1] == pytest.approx(0.85 / INERTIA, rel=1e-3)
    plain, acting = (swung(angle=1.0, torque=0.1, **laws)[0] for laws in ({}, {"load_friction": 1e-12}))
    np.testing.assert_allclose(acting, plain, atol=1e-12)


def test_cogging_and_ripple_come_and_go_with_the_angle():
    wave = 0.02 * np.cos(7 * 0.5) + 0.05 * np.sin(7 * 0.5)
    for law, torque, gives in (("cogging", 0.0, wave), ("ripple", 0.2, 0.2 * (1 + wave))):
        named = zip(("per_turn", "cos", "sin"), (7.0, 0.02, 0.05), strict=True)
        laws = {f"{law}_{part}": value for part, value in named}
        _, rate, t = swung(gravity=False, angle=0.5, torque=torque, seconds=0.01, **laws)
        assert rate[-1] / t[-1] == pytest.approx(gives / INERTIA, rel=0.01)


@pytest.mark.parametrize("scaled", [False, True])
def test_how_often_a_torque_comes_and_goes_is_read_off_the_logs(scaled):
    rng, t = np.random.default_rng(2), np.arange(0, 6, 0.01)
    q, motor = np.sin(1.7 * t), 0.2 * np.cos(2.9 * t)
    lost = 0.1 * np.sin(7 * q + 1) * (motor if scaled else 0.2)
    torque = motor + lost + 0.01 * q + 0.004 * rng.standard_normal(t.size)
    motion = Motion(t, np.arange(t.size), {0: q}, {0: np.gradient(q, t)}, {}, {0: torque}, {0: motor})
    assert periods([motion], 0, scaled) == pytest.approx(7, abs=0.5)
    still = replace(motion, position={0: 0.01 * q}, rate={0: 0 * q})
    even = replace(motion, torque={0: motor + 0.004 * rng.standard_normal(t.size)})
    exact = replace(motion, torque={0: motor})
    assert not any(periods([one], 0, scaled) for one in (still, even, exact))
