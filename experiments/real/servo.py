"""A hobby servo that turns a weight on a rod, as a plain Python simulator: an example to copy.

Torques at the shaft; q is the angle from hanging down, w its rate, V the supply, g the goal that the drive
follows: the command, delayed by `delay` and limited to the rate `pace`. `on` is 1 while the drive is on,
delayed by `switch`, as it is another register, written at another time of the cycle.

    duty = on clip(sign(g - q) (gain max(|g - q| - DEAD, 0) + start), -1, 1), 0 within DEAD
    J w' = stall duty V / 12 - on emf w - viscous w - friction(w, load) - W sin(q - zero)
    W = (m l + arm l^2 / 2) G
    J = m l^2 + arm l^3 / 3 + armature

`gain` includes the firmware's register of the P gain, as duty per radian. The firmware ignores the first
count of an error (its dead zone) and adds a least duty (its starting force). `arm` is the mass per metre of
the uniform rod. All torques except the weight's scale with the motor's, which was never measured, and
armature adds to every inertia: the robot in its original state moves the same with any arm if these grow as
its weight does. So `stall`, `emf`, `viscous`, `coulomb`, `stribeck` and `armature` are defined for a
weightless arm and grow with it. Logs of one configuration then carry no information on `arm`, and a change of
mass or length is known no better than `arm`.

Friction is Coulomb's, larger near standstill (Stribeck) and under load, the torque transmitted by the gears:
Duclusaud et al., Extended friction models for the physics simulation of servo actuators (2024), model 4. It
is one law, of the gears: switching the drive off removes only the motor's torque and the back-EMF. The duty
is computed from the recorded angle, so it depends on the drive alone. Mass and length are stated; everything
else was never measured and is fitted along.
"""

from __future__ import annotations

import numpy as np
from numba import njit

G = 9.80665
STEP = 5e-3  # s, at most
SUPPLY = 12.0  # V
DEAD = 2 * np.pi / 4096  # data sheet: rad; the dead zone, one count of the encoder
UNIT = 4096 / (2 * np.pi) / 4000  # duty per radian and unit of the gain's register

TORQUES = ("stall", "emf", "viscous", "coulomb", "stribeck")


def _wide(nominal: float, sd: float, unit: str, low: float = 0.0, high: float = np.inf) -> dict:
    return {"nominal": nominal, "sd": sd, "unit": unit, "low": low, "high": high, "fitted": True}


class Servo:
    """Read-outs `position` and `duty`; commands `goal`, `volts` and `on`. `mass` [kg], `length` [m] and the
    gain's `register` are those of the original robot."""

    channels = {  # noqa: RUF012
        "position": {"unit": "rad", "kind": "position"},
        "duty": {"unit": "1", "kind": "torque"},
        "goal": {"unit": "rad", "kind": "command"},
        "volts": {"unit": "V", "kind": "command"},
        "on": {"unit": "1", "kind": "command"},
    }
    states = ("position",)

    def __init__(self, mass: float = 0.5, length: float = 0.1, register: float = 16.0) -> None:
        self.parameters = {
            "mass": {"nominal": mass, "sd": 0.02 * mass, "unit": "kg", "low": 0.01},
            "length": {"nominal": length, "sd": 0.02 * length, "unit": "m", "low": 0.01},
            "gain": _wide(UNIT * register, UNIT * register, "1/rad", 0.01),
            "stall": _wide(6.0, 2.0, "N m"),
            "emf": _wide(1.0, 0.4, "N m s/rad"),
            "viscous": _wide(0.02, 0.05, "N m s/rad"),
            "coulomb": _wide(0.1, 0.1, "N m"),
            "load": _wide(0.05, 0.1, "1"),
            "load_stribeck": _wide(0.05, 0.1, "1"),
            "stribeck": _wide(0.02, 0.05, "N m"),
            "stribeck_speed": _wide(0.3, 0.3, "rad/s", 0.03),
            "armature": _wide(0.02, 0.02, "kg m^2", 1e-4),
            "arm": _wide(0.6, 0.6, "kg/m", high=2.5),  # printed: 0.3; a bar of aluminium, 20 by 20 mm: 1.1
            "zero": _wide(0.0, 0.03, "rad", -0.5),
            "start": _wide(0.016, 0.001, "1"),  # data sheet: a starting force of 16 of 1000
            "delay": _wide(0.02, 0.01, "s"),
            "switch": _wide(0.02, 0.01, "s"),
            "pace": _wide(5.0, 2.0, "rad/s", 0.5),
            "age": _wide(0.004, 0.005, "s", -0.03),
        }  # fmt: skip

    def with_arm(self, parameters):
        """Parameters of the equations: those of a weightless arm scaled to the weight of the original
        robot."""
        mass, length = (self.parameters[n]["nominal"] for n in ("mass", "length"))
        more = 1 + parameters["arm"] * length / (2 * mass)
        rod = mass * length**2 + parameters["arm"] * length**3 / 3
        out = {n: more * v if n in TORQUES else v for n, v in parameters.items()}
        return out | {"armature": more * (mass * length**2 + parameters["armature"]) - rod}

    def simulate(self, parameters, recording, start=None):
        """Integrate by semi-implicit Euler at 5 ms or less, with stiction."""
        begin = (0.0, 0.0) if start is None else (start["position"], start["position_rate"])
        values = np.array([self.with_arm(parameters)[n] for n in self.parameters])
        columns = [np.ascontiguousarray(recording[n], dtype=float) for n in ("goal", "volts", "on")]
        t = recording.t
        seen = np.isfinite(recording["position"])
        angle = np.interp(t, t[seen], recording["position"][seen])
        position, duty = turn(values, t, *columns, angle, *begin)
        return {"position": np.interp(t - parameters["age"], t, position), "duty": duty}


@njit(cache=True)
def asked(gain, start, error, dead=DEAD):
    """The firmware's duty for an error [rad]."""
    more = max(abs(error) - dead, 0.0)
    return np.sign(error) * min(1.0, gain * more + start * min(1.0, more / DEAD))


@njit(cache=True)
def sent_in(t, command, sent, begin, h, delay):
    """The mean of a command over a step from `begin` [s], and the number of the last one sent before it. One
    that arrives within the step acts for the rest of it, so that angles are differentiable in the delay."""
    while sent + 1 < t.size and t[sent + 1] + delay <= begin:
        sent += 1
    value = command[sent]
    if sent + 1 < t.size and t[sent + 1] + delay < begin + h:
        part = (begin + h - t[sent + 1] - delay) / h
        value += part * (command[sent + 1] - value)
    return value, sent


@njit(cache=True)
def slowed(w, drag, hold):
    """The rate [rad/s] after a step of viscous drag (implicit) and stiction; both in units of the inertia
    over the step."""
    w /= 1 + drag
    return 0.0 if abs(w) <= hold else w - np.sign(w) * hold


@njit(cache=True)
def turn(p, t, goal, volts, on, angle, q, w):
    """Angles, and duties at the recorded `angle`, (num_timesteps,) at times t; parameters in the order of
    `Servo.parameters`."""
    (mass, length, gain, stall, emf, viscous, coulomb, load, load_extra, extra, speed, armature, arm, zero,
     start, delay, switch, pace, _) = p  # fmt: skip
    inertia = mass * length**2 + arm * length**3 / 3 + armature
    heavy = G * (mass * length + arm * length**2 / 2)
    position, duties = np.empty(t.size), np.empty(t.size)
    follow, sent, switched = goal[0], 0, 0
    for i in range(t.size):
        position[i] = q
        duties[i] = asked(gain, start, follow - angle[i]) if on[i] > 0.5 else 0.0
        if i == t.size - 1:
            break
        steps = max(1, int(np.ceil((t[i + 1] - t[i]) / STEP - 1e-9)))
        h = (t[i + 1] - t[i]) / steps
        for k in range(steps):
            target, sent = sent_in(t, goal, sent, t[i] + k * h, h, delay)
            drive, switched = sent_in(t, on, switched, t[i] + k * h, h, switch)
            follow += min(max(target - follow, -pace * h), pace * h)
            weight = -heavy * np.sin(q - zero)
            slow = np.exp(-((w / speed) ** 2))
            motor = stall * drive * asked(gain, start, follow - q) * volts[i] / SUPPLY
            pressed = abs(motor - drive * emf * w - weight)
            hold = coulomb + extra * slow + (load + load_extra * slow) * pressed
            each = h / inertia
            w = slowed(w + each * (motor + weight), each * (viscous + drive * emf), each * hold)
            q += h * w
    return position, duties
