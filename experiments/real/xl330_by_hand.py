"""The servo's causes by plain least squares, without anything of the diagnosis but the start of windows.

    python -m experiments.real.xl330_by_hand FOLDER [--output FILE.json]

Windows of 0.4 s of all logs; what was never measured is fitted in each step, and the effect that leaves the
smallest rms residual joins those before it. Nothing is held out and nothing whitened: an oracle to hold the
diagnosis against, not a diagnosis.
"""

from __future__ import annotations

import numpy as np
from scipy.optimize import least_squares

from experiments.real.robot_gap import KINDS, RESULTS, asked
from experiments.real.xl330 import EARLIER, Pendulum, swing
from experiments.saving import save
from simgap.robots.windows import LENGTH, smoothed
from simgap.simulators.recording import Recording, read_recording

STEPS = 6
ALONG = [n for n, p in Pendulum.parameters.items() if p.get("fitted")]
MORE = {"delay": (0.0, 0.01, 0.1), "lag": (0.0, 0.005, 0.05)}  # nominal, size, highest [s]
# Where a fit begins [sizes from nominal]: friction's slope at nothing says nothing of a friction.
BEGIN = 0.5
KNOWN = 30.0  # mrad of residual that count as much as one sd of the owners' figures


def effects() -> dict[str, list[str]]:
    """Effect -> its parameters: the example's candidates, a late command and a late encoder."""
    out: dict[str, list[str]] = {}
    for name, known in Pendulum.parameters.items():
        if name not in ALONG:
            out.setdefault(str(known.get("effect", name)), []).append(name)
    return out | {name: [name] for name in MORE}


def windows(logs: list[Recording]) -> list[tuple]:
    """Log, first row, end, and the start's angle [rad] and rate [rad/s] of every window."""
    noise, out = Pendulum.channels["position"]["noise"], []
    for log in logs:
        for begin in np.arange(log.t[0] + 0.03, log.t[-1] - 0.5 * LENGTH, LENGTH):
            first, end = np.searchsorted(log.t, [begin, begin + LENGTH])
            (q, _), (w, _) = smoothed(log.t, log["position"], int(first), noise)
            out.append((log, int(first), int(end), q, w))
    return out


def residual(values: dict[str, float], every: list[tuple]) -> np.ndarray:
    """Recorded less simulated [mrad], all windows."""
    p = np.array([values.get(n, known["nominal"]) for n, known in Pendulum.parameters.items()])
    lag, out = values.get("lag", 0.0) + EARLIER, []
    for log, first, end, q, w in every:
        t = log.t[first:end]
        pwm = np.interp(t - values.get("delay", 0.0), log.t, log["pwm"])
        on = np.ascontiguousarray(log["torque_enable"][first:end])
        angle = swing(p, t, pwm, on, q + lag * w, w)
        out.append(log["position"][first:end] - angle + lag * np.gradient(angle, t))
    return 1e3 * np.concatenate(out)


def fit(free: list[str], every: list[tuple], begin: dict[str, float]) -> tuple[float, dict[str, float]]:
    """Least squares by some parameters: rms [mrad], and where."""
    known = [Pendulum.parameters.get(n) for n in free]
    rows = [
        (p["nominal"], p["sd"], p.get("low", -np.inf), p.get("high", np.inf))
        if p is not None
        else (MORE[n][0], MORE[n][1], 0.0, MORE[n][2])
        for n, p in zip(free, known, strict=True)
    ]
    nominal, size, low, high = np.array(rows).T
    measured = np.array([n in ("mass", "length") for n in free])
    at = np.array([begin.get(n, m + BEGIN * s) for n, m, s in zip(free, nominal, size, strict=True)])
    bounds = (low - nominal) / size, (high - nominal) / size

    def cost(x: np.ndarray) -> np.ndarray:
        found = residual(dict(zip(free, nominal + size * x, strict=True)), every)
        return np.concatenate([found, KNOWN * x[measured]])

    inside = np.clip((at - nominal) / size, bounds[0] + 1e-3, bounds[1] - 1e-3)
    done = least_squares(cost, inside, bounds=bounds, diff_step=1e-4, max_nfev=25)
    found = dict(zip(free, (nominal + size * done.x).tolist(), strict=True))
    return float(np.sqrt(np.mean(residual(found, every) ** 2))), found


def main() -> None:
    """Add effects one by one and write what each step leaves."""
    given = asked(__doc__ or "")
    paths = sorted(given.folder.glob(KINDS["xl330"][1]))
    every = windows([read_recording(p, Pendulum.channels) for p in paths])
    rms, at = fit(ALONG, every, {})
    steps: list[dict] = [{"added": None, "rms": rms, "parameters": at}]
    have: list[str] = []
    while len(have) < STEPS:
        free = ALONG + [n for e in have for n in effects()[e]]
        tried = {e: fit(free + names, every, at) for e, names in effects().items() if e not in have}
        order = sorted(tried, key=lambda e: tried[e][0])
        have.append(order[0])
        rms, at = tried[order[0]]
        others = {e: tried[e][0] for e in order}
        steps.append({"added": order[0], "rms": rms, "parameters": at, "others": others})
        print(have, f"{rms:.1f} mrad", flush=True)
    save(given.output or RESULTS / "xl330_by_hand.json", {"steps": steps})


if __name__ == "__main__":
    main()
