"""Free runs of a servo over logs of a gain or mass that was left out: our model against BAM's M6.

    python -m experiments.real.bam FOLDER [--output FILE.json]

FOLDER as for `experiments.real.sts3215`. Three models are fitted to the same logs, with all parameters at
once, by the same least squares of the angle (soft_l1, 10 mrad) from the same starts, with masses, lengths and
registers as stated:

    ours    experiments/real/servo.py
    m6      Rhoban/bam's friction model M6 (Duclusaud, Passault, Padois & Ly, Extended friction models for the
            physics simulation of servo actuators, 2024/2025: directional and quadratic in the load, Stribeck
            with an exponent), with its authors' drive: duty in proportion to the error
    m6+     the same friction with the drive of `ours`: limited speed of the goal, dead zone, least duty

One gain at a time is left out, then one mass; each of its logs is run freely from the first sample to the
last. The difference between two models' root mean squares is given with a 95 % interval from a paired
bootstrap over the motions of configurations (both repeats together).
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numba import njit
from scipy.optimize import least_squares

from experiments.real.servo import DEAD, STEP, SUPPLY, UNIT, G, Servo, asked, sent_in, slowed, turn
from experiments.real.sts3215 import read
from experiments.saving import save
from simgap.robots.unchanged import without_broken
from simgap.simulators.recording import Recording
from simgap.simulators.user import checked

SOFT = 0.01  # chosen: rad
EVERY = 3  # numerics: a fit sees one of this many repeats of a motion
DRAWS = 2000  # numerics: of the bootstrap
M6 = {  # start, least, most, usual size
    "stall": (6.0, 0.1, 20, 2), "emf": (1.0, 0, 5, 0.4), "viscous": (0.02, 0, 1, 0.05),
    "base": (0.1, 0, 0.5, 0.1), "stribeck": (0.02, 0, 0.5, 0.05), "motor": (0.05, 0, 0.5, 0.1),
    "external": (0.05, 0, 0.5, 0.1), "motor_stribeck": (0.05, 0, 1, 0.1),
    "external_stribeck": (0.05, 0, 1, 0.1), "motor_quad": (0.001, 0, 0.05, 0.01),
    "external_quad": (0.001, 0, 0.05, 0.01), "speed": (0.2, 0.05, 1, 0.2), "alpha": (1.35, 1, 10, 1),
    "armature": (0.02, 1e-4, 0.2, 0.02), "zero": (0.0, -0.1, 0.1, 0.03), "unit": (UNIT, 0.01, 1, 0.1),
    "delay": (0.02, 0, 0.05, 0.01), "age": (0.004, -0.03, 0.03, 0.005), "start": (0.012, 0, 0.1, 0.02),
    "pace": (5.0, 0.5, 50, 2), "switch": (0.02, 0, 0.05, 0.01),
}  # fmt: skip
DRIVE = ("start", "pace")  # what BAM's drive has not


@njit(cache=True)
def turn_m6(p, t, goal, volts, on, mass, length, register, q, w):
    """Angles (num_timesteps,) of the model M6, by the step of `servo.turn`."""
    (stall, emf, viscous, base, stribeck, motor_load, external_load, motor_extra, external_extra, motor_quad,
     external_quad, speed, alpha, armature, zero, unit, delay, _, start, pace, switch) = p  # fmt: skip
    inertia = mass * length**2 + armature
    out = np.empty(t.size)
    follow, sent, switched = goal[0], 0, 0
    for i in range(t.size):
        out[i] = q
        if i == t.size - 1:
            break
        steps = max(1, int(np.ceil((t[i + 1] - t[i]) / STEP - 1e-9)))
        h = (t[i + 1] - t[i]) / steps
        for k in range(steps):
            target, sent = sent_in(t, goal, sent, t[i] + k * h, h, delay)
            drive, switched = sent_in(t, on, switched, t[i] + k * h, h, switch)
            follow += min(max(target - follow, -pace * h), pace * h)
            duty = asked(unit * register, start, follow - q, DEAD if start > 0 else 0.0)
            weight = -mass * G * length * np.sin(q - zero)
            push = drive * (stall * duty * volts[i] / SUPPLY - emf * w)
            slow = np.exp(-((abs(w) / speed) ** alpha))
            hold = base + abs(weight * external_load - push * motor_load) + slow * stribeck
            hold += slow * abs(weight * external_extra - push * motor_extra)
            if weight * push < 0:
                if abs(weight) < abs(push):
                    hold += slow * external_quad * weight**2
                else:
                    hold += slow * motor_quad * push**2
            each, drag = h / inertia, viscous + drive * emf
            w = slowed(w + each * (push + drive * emf * w + weight), each * drag, each * hold)
            q += h * w
    return out


def angles(model: str, names: list[str], x: np.ndarray, log: Recording, stated: tuple) -> np.ndarray:
    """A log run freely (num_timesteps,) [rad]."""
    mass, length, register = stated
    t, q = log.t, log["position"]
    seen = np.flatnonzero(np.isfinite(q))
    begin = float(np.mean(q[seen[:5]]))
    columns = [np.ascontiguousarray(log[n], float) for n in ("goal", "volts", "on")]
    values = dict(zip(names, x, strict=True))
    if model == "ours":
        full = np.array([
            {"mass": mass, "length": length, "gain": values["unit"] * register}.get(n) or values[n]
            for n in Servo().parameters
        ])  # fmt: skip
        out = turn(full, t, *columns, np.interp(t, t[seen], q[seen]), begin, 0.0)[0]
    else:
        full = np.array([values.get(n, {"start": 0.0, "pace": 1e6}.get(n, np.nan)) for n in M6])
        out = turn_m6(full, t, *columns, mass, length, register, begin, 0.0)
    return np.interp(t - values["age"], t, out)


def fitted(model: str, logs: list[tuple[Recording, tuple]]) -> tuple[list[str], np.ndarray]:
    """Names and values of all parameters of a model."""
    if model == "ours":
        known = {
            n: (p["nominal"], p.get("low", -np.inf), p.get("high", np.inf), p["sd"])
            for n, p in Servo().parameters.items() if n not in ("mass", "length", "gain")
        } | {"unit": M6["unit"]}  # fmt: skip
    else:
        known = {n: v for n, v in M6.items() if model == "m6+" or n not in DRIVE}
    names = [*known]
    start, low, high, size = np.array([known[n] for n in names]).T

    def left(z: np.ndarray) -> np.ndarray:
        out = []
        for log, stated in logs:
            off = angles(model, names, z * size, log, stated) - log["position"]
            out.append(np.nan_to_num(off[np.isfinite(log["position"])], nan=10.0)[::EVERY])
        return np.concatenate(out) / SOFT

    found = least_squares(
        left, start / size, bounds=(low / size - 1e-12, high / size + 1e-12), loss="soft_l1", diff_step=0.003,
        max_nfev=40,
    )  # fmt: skip
    return names, found.x * size


def compared(errors: dict[str, np.ndarray], group: np.ndarray, one: str, other: str) -> dict[str, Any]:
    """By how much one model's root mean square is less than another's, of logs drawn by groups."""
    rng = np.random.default_rng(0)
    number = np.unique(group)
    sums = {m: np.bincount(np.searchsorted(number, group), e**2) for m, e in errors.items()}
    count = np.bincount(np.searchsorted(number, group))
    drawn = rng.integers(number.size, size=(DRAWS, number.size))
    rms = {m: np.sqrt(s[drawn].sum(1) / count[drawn].sum(1)) for m, s in sums.items()}
    low, high = np.quantile(rms[other] - rms[one], (0.025, 0.975))
    less = float(np.sqrt(np.mean(errors[other] ** 2)) - np.sqrt(np.mean(errors[one] ** 2)))
    return {"one": one, "other": other, "less": less, "interval_95": [float(low), float(high)]}


def main() -> None:
    """Fit, predict what was left out, compare and save."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--output", type=Path)
    given = parser.parse_args()
    index = pd.read_csv(given.folder / "index.csv")
    logs = []
    for row in index.to_dict("records"):
        (log,), _ = without_broken(checked(Servo(), "servo.py:Servo"), [read(given.folder / row["file"])])
        logs.append((row, log, (row["mass"], row["length"], row["kp"])))
    rows, out = [], {}
    for by in ("kp", "mass"):
        for value in sorted(index[by].unique()):
            seen = [(log, s) for row, log, s in logs if row[by] != value and row["repeat"] == 1]
            held = [(row, log, s) for row, log, s in logs if row[by] == value]
            for model in ("ours", "m6", "m6+"):
                names, x = fitted(model, seen)
                for row, log, s in held:
                    off = angles(model, names, x, log, s) - log["position"]
                    rms = float(np.sqrt(np.nanmean(off**2)))
                    group = f"{row['mass']}/{row['length']}/{row['kp']}/{row['trajectory']}"
                    rows.append({"left_out": by, "value": float(value), "model": model, "file": row["file"],
                                 "group": group, "rms": rms})  # fmt: skip
                mine = [
                    r["rms"] for r in rows if (r["left_out"], r["value"], r["model"]) == (by, value, model)
                ]
                whole = np.sqrt(np.mean(np.square(mine)))
                print(by, value, model, f"{1e3 * whole:.1f} mrad", dict(zip(names, x.round(4), strict=True)),
                      flush=True)  # fmt: skip
        table = pd.DataFrame(rows)
        table = table[table.left_out == by].pivot(index=["file", "group"], columns="model", values="rms")
        errors = {m: table[m].to_numpy() for m in table}
        group = table.index.get_level_values("group").to_numpy()
        pairs = [compared(errors, group, "ours", "m6"), compared(errors, group, "ours", "m6+")]
        out[by] = {"rms": {m: float(np.sqrt(np.mean(e**2))) for m, e in errors.items()}, "compared": pairs}
        print(by, out[by], flush=True)
        if given.output is not None:
            save(given.output, {**out, "logs": rows})


if __name__ == "__main__":
    main()
