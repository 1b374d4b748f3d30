"""A small arm's six position servos, each by itself, as a plain Python simulator.

    hmmseg diagnose LOGS/so101_*.csv --simulator experiments/real/so101.py:Arm

Nothing is known of the servos but commands and positions, so a joint is an inertia behind a P controller with
damping, held off its command by a load; all of these were never measured and are fitted along. What holds a
joint short of its command by the way it comes from is one of three: friction, as large as the P gain times an
angle; a band of errors that the controller does not see; or play between the gears. Each is one cause with a
width [rad] for every joint.
"""

from __future__ import annotations

import numpy as np
from numba import njit

JOINTS = ("Rotation", "Pitch", "Elbow", "Wrist_Pitch", "Wrist_Roll")
STEP = 2e-3  # s, at most
COUNT = 1.534e-3  # rad of an encoder's count
CAUSES = ("friction", "dead_band", "backlash")


def _parameters():
    out = {}
    for joint in JOINTS:
        known = {"unit": "rad/s", "low": 2.0, "fitted": True, "effect": "servo"}
        out[f"servo.{joint}"] = {"nominal": 20.0, "sd": 10.0, **known}
    for cause in CAUSES:
        for joint in JOINTS:
            width = {"nominal": 0.0, "sd": 0.01, "unit": "rad", "low": 0.0, "high": 0.2}
            out[f"{cause}.{joint}"] = {**width, "effect": cause}
    for joint in JOINTS:
        load = {"nominal": 0.0, "sd": 0.05, "unit": "rad", "fitted": True, "effect": "sag"}
        out[f"sag.{joint}"] = load
    return out


class Arm:
    """Commands `cmd_*` drive, positions `pos_*` are compared."""

    channels = {  # noqa: RUF012
        **{f"cmd_{j}": {"unit": "rad", "kind": "command"} for j in JOINTS},
        **{f"pos_{j}": {"unit": "rad", "kind": "position", "noise": COUNT / np.sqrt(12)} for j in JOINTS},
    }
    parameters = _parameters()
    window = 2.0  # s: a servo forgets its start, and what sticks shows itself where the motion turns
    says = {  # noqa: RUF012
        "friction": "Coulomb friction holds a joint within this angle of where the P gain would have it",
        "dead_band": "the controller does not see errors below this",
        "backlash": "the joint lags behind its motor by this either way, half of the play",
        "sag": "a constant load holds a joint off its command",
    }

    def simulate(self, parameters, recording, start=None):
        """Every joint by itself: q'' = w^2 (error - friction) - 2 w q', semi-implicit Euler."""
        out = {}
        for joint in JOINTS:
            values = [parameters[f"{n}.{joint}"] for n in ("servo", *CAUSES, "sag")]
            command = np.ascontiguousarray(recording[f"cmd_{joint}"], float)
            name = f"pos_{joint}"
            begin = (command[0], 0.0) if start is None else (start[name], start[f"{name}_rate"])
            out[name] = follow(np.array(values), recording.t, command, *begin)
        return out


@njit(cache=True)
def follow(p, t, command, q, v):
    """Angles (num_timesteps,) of one joint; p: servo, friction, dead band, backlash, sag. Widths are half of
    what lies between one way and the other."""
    servo, friction, band, play, sag = p
    out = np.empty(t.size)
    out[0] = q
    # A motor rests where its controller has it, or pushes on the side of the gears that is towards there.
    motor = min(max(command[0] + sag, q - play), q + play)
    for i in range(t.size - 1):
        steps = max(1, int(np.ceil((t[i + 1] - t[i]) / STEP - 1e-9)))
        h = (t[i + 1] - t[i]) / steps
        for _ in range(steps):
            error = command[i] + sag - motor
            error = np.sign(error) * max(abs(error) - band, 0.0)
            v = (v + h * servo**2 * error) / (1 + 2 * h * servo)
            brake = h * servo**2 * friction
            v = 0.0 if abs(v) <= brake else v - np.sign(v) * brake
            motor += h * v
            q = min(max(q, motor - play), motor + play)
        out[i + 1] = q
    return out
