"""A pendulum in a few lines, as a user would bring it: driven by a torque, exact to integrator error."""

import numpy as np

from simgap.simulators.recording import Recording


class Swing:
    """Torque-driven pendulum; read-outs `angle` and, if wanted, `speed`."""

    parameters = {  # noqa: RUF012
        "inertia": {"nominal": 0.01, "sd": 0.001, "unit": "kg m^2", "low": 0.001},
        "gravity_torque": {"nominal": 0.5, "sd": 0.05, "unit": "N m", "low": 0.0},
        "viscous": {"nominal": 0.0, "sd": 0.01, "unit": "N m s/rad", "low": 0.0},
        "torque_scale": {"nominal": 1.0, "sd": 0.1, "unit": "1", "low": 0.1},
    }
    channels = {  # noqa: RUF012
        "torque": {"unit": "N m", "kind": "command"},
        "angle": {"unit": "rad", "kind": "position", "noise": 5e-4},
    }

    def simulate(self, parameters, recording, start=None):
        """Semi-implicit Euler at 1 ms or less."""
        p, t = parameters, recording.t
        q, v = (0.0, 0.0) if start is None else (start["angle"], start["angle_rate"])
        out = np.empty(t.size)
        out[0] = q
        for i in range(t.size - 1):
            steps = max(1, int(np.ceil((t[i + 1] - t[i]) / 1e-3 - 1e-9)))
            h = (t[i + 1] - t[i]) / steps
            for _ in range(steps):
                drive = p["torque_scale"] * recording["torque"][i]
                v += h * (drive - p["gravity_torque"] * np.sin(q) - p["viscous"] * v) / p["inertia"]
                q += h * v
            out[i + 1] = q
        return {"angle": out}


def log(seed: int, seconds: float = 6.0, rate: float = 100.0, noise: float = 5e-4,
        **changed: float) -> Recording:  # fmt: skip
    """A recording of a Swing with some parameters changed."""
    rng, t = np.random.default_rng(seed), np.arange(0.0, seconds, 1 / rate)
    waves = rng.uniform(0.2, 1.5, 4), rng.uniform(0, 2 * np.pi, 4)
    torque = 0.15 * np.sin(2 * np.pi * waves[0] * t[:, None] + waves[1]).sum(1)
    robot = Swing()
    values = {n: p["nominal"] for n, p in robot.parameters.items()} | changed
    empty = Recording(f"log{seed}.csv", t, {"torque": torque})
    angle = robot.simulate(values, empty)["angle"] + noise * rng.standard_normal(t.size)
    return empty.with_columns({"angle": angle})
