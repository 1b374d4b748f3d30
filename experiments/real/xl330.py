"""A servo that swings a mass, as a plain Python simulator: an example to copy for your own robot.

    hmmseg diagnose LOGS/xl330_*.csv --simulator experiments/real/xl330.py:Pendulum

The drive's recorded duty (`pwm`) drives the model, and the encoder's angle is compared. Torques at the shaft;
q is the angle from hanging down, w its rate, u = pwm / 885:

    k = stall u - emf w,  J w' = k - m g l sin q - viscous w - friction(w, torques) - spring q

k is the torque of the motor's current. stall, emf and the viscous and Coulomb parts of friction were never
measured: they are fitted along with every cause (`fitted`). Mass and length are stated by the owners.
Friction that depends on load, constant and near standstill, follows Duclusaud et al., Extended friction
models for the physics simulation of servo actuators (2024), models 3 and 4: it depends on the motor's torque
minus the weight's.
"""

from __future__ import annotations

import numpy as np
from numba import njit

G = 9.81
STEP = 1e-3  # s, at most
FULL = 885.0  # counts of pwm at full duty
EARLIER = 1.5e-3  # s


class Pendulum:
    """Driven pendulum: read-out `position`, commands `pwm`, `torque_enable` and `input_voltage`."""

    channels = {  # noqa: RUF012
        "position": {"unit": "rad", "kind": "position", "noise": 2 * np.pi / 4096 / np.sqrt(12)},
        "pwm": {"unit": "1", "kind": "command"},
        "torque_enable": {"unit": "1", "kind": "command"},
        "input_voltage": {"unit": "V", "kind": "command"},
    }
    parameters = {  # noqa: RUF012
        "stall": {"nominal": 0.9, "sd": 0.3, "unit": "N m", "low": 0.1, "fitted": True},
        "emf": {"nominal": 0.06, "sd": 0.05, "unit": "N m s/rad", "low": 0.0, "fitted": True},
        "viscous": {"nominal": 0.005, "sd": 0.01, "unit": "N m s/rad", "low": 0.0, "fitted": True},
        "coulomb": {"nominal": 0.05, "sd": 0.05, "unit": "N m", "low": 0.0, "fitted": True},
        "mass": {"nominal": 0.49, "sd": 0.01, "unit": "kg", "low": 0.1},
        "length": {"nominal": 0.1, "sd": 0.002, "unit": "m", "low": 0.02},
        "armature": {"nominal": 0.0, "sd": 0.002, "unit": "kg m^2", "low": 0.0},
        "load_friction": {"nominal": 0.0, "sd": 0.2, "unit": "1", "low": 0.0},
        "load_stribeck.extra": {"nominal": 0.0, "sd": 0.2, "unit": "1", "low": 0.0,
                                "effect": "load_stribeck"},
        "load_stribeck.speed": {"nominal": 0.3, "sd": 0.2, "unit": "rad/s", "low": 0.02,
                                "effect": "load_stribeck"},
        "stribeck.extra": {"nominal": 0.0, "sd": 0.03, "unit": "N m", "low": 0.0, "effect": "stribeck"},
        "stribeck.speed": {"nominal": 0.3, "sd": 0.2, "unit": "rad/s", "low": 0.02, "effect": "stribeck"},
        "direction_friction": {"nominal": 0.0, "sd": 0.02, "unit": "N m"},
        "current_fade": {"nominal": 0.0, "sd": 0.2, "unit": "1", "low": -0.9, "high": 0.9},
        "quadratic_drag": {"nominal": 0.0, "sd": 1e-3, "unit": "N m s^2/rad^2", "low": 0.0},
        "spring": {"nominal": 0.0, "sd": 0.02, "unit": "N m/rad", "low": 0.0},
        "joint_zero": {"nominal": 0.0, "sd": 0.01, "unit": "rad"},
    }  # fmt: skip
    says = {  # noqa: RUF012
        "load_friction": "Coulomb friction grows by this share of what motor and weight press on the gears",
        "load_stribeck": "loaded gears rub more near standstill, by extra exp(-(w / speed)^2) of the load",
        "stribeck": "friction is larger near standstill by extra exp(-(w / speed)^2)",
        "direction_friction": "friction is larger one way round than the other",
        "current_fade": "torque = k (1 - fade |k| / stall), k = stall u - emf w, in proportion to current",
        "quadratic_drag": "drag in proportion to the rate's square",
        "spring": "a cable pulls back to 0",
        "joint_zero": "gravity's zero is not the encoder's",
    }

    def simulate(self, parameters, recording, start=None):
        """Integrate by semi-implicit Euler at 1 ms or less, with stiction."""
        begin = (0.0, 0.0) if start is None else (start["position"], start["position_rate"])
        values = np.array([parameters[n] for n in self.parameters])
        columns = [np.ascontiguousarray(recording[n]) for n in ("pwm", "torque_enable")]
        angle = swing(values, recording.t, *columns, *begin)
        # The encoder is the first of five reads, so its value is older than its time stamp.
        return {"position": angle - EARLIER * np.gradient(angle, recording.t)}


@njit()
def swing(p, t, pwm, enabled, q, w):
    """Angles (num_timesteps,) at times t; parameters in the order of `Pendulum.parameters`."""
    (
        stall,
        emf,
        viscous,
        coulomb,
        mass,
        length,
        armature,
        load,
        load_extra,
        load_speed,
        extra,
        speed,
        skew,
        fade,
        quadratic,
        spring,
        zero,
    ) = p
    inertia = mass * length**2 + armature
    out = np.empty(t.size)
    out[0] = q
    for i in range(t.size - 1):
        steps = max(1, int(np.ceil((t[i + 1] - t[i]) / STEP - 1e-9)))
        h = (t[i + 1] - t[i]) / steps
        duty = pwm[i] / FULL
        for _ in range(steps):
            motor, drag = 0.0, viscous
            if enabled[i] > 0.5:
                motor = stall * duty
                drag += emf
                current = motor - emf * w
                motor -= fade * abs(current) / stall * current
            weight = -mass * G * length * np.sin(q - zero)
            motor_side = motor - emf * w if enabled[i] > 0.5 else 0.0  # what the gears transmit
            share = load + load_extra * np.exp(-((w / load_speed) ** 2))
            hold = coulomb + share * abs(motor_side - weight)
            hold += extra * np.exp(-((w / speed) ** 2)) + np.sign(w) * skew
            hold = max(hold, 0.0)
            w += h * (motor + weight - spring * q - quadratic * w * abs(w)) / inertia
            w /= 1 + h * drag / inertia
            brake = h * hold / inertia
            w = 0.0 if abs(w) <= brake else w - np.sign(w) * brake
            q += h * w
        out[i + 1] = q
    return out
