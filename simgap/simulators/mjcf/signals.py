"""Between a log's samples and a simulator's steps: commands held, sensors read, turns."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from simgap.simulators.recording import Recording


class Held:
    """Commands held from sample to sample, as each step of the simulator has them on average."""

    def __init__(self, since: np.ndarray, times: np.ndarray) -> None:
        self.since = since
        self.edges = np.append(times, 2 * times[-1] - times[-2])
        self.width = np.diff(self.edges)
        self.at = self._at(since)

    def __call__(self, values: np.ndarray) -> np.ndarray:
        """Means (steps,) of a column (num_timesteps,); missing samples hold the one before."""
        seen = np.isfinite(values)
        if seen.all():
            t, u, k = self.since, values, self.at
        else:
            t, u = self.since[seen], values[seen]
            k = self._at(t)
        area = np.concatenate([[0.0], np.cumsum(u[:-1] * np.diff(t))])
        return np.diff(area[k] + u[k] * (self.edges - t[k])) / self.width

    def _at(self, t: np.ndarray) -> np.ndarray:
        """The sample that is held at each edge."""
        return np.clip(np.searchsorted(t, self.edges, side="right") - 1, 0, t.size - 1)


def cubic(at: np.ndarray, times: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Values (n, ...) between points of an even grid, (T, ...), by cubics through neighbours (Catmull & Rom
    1974)."""
    h = times[1] - times[0]
    place = np.clip(at / h, 0, times.size - 1)
    i = np.minimum(place.astype(int), times.size - 2)
    s = (place - i).reshape(-1, *([1] * (values.ndim - 1)))
    p0, p1, p2, p3 = (values[np.clip(i + k, 0, times.size - 1)] for k in (-1, 0, 1, 2))
    inner = ((i > 0) & (i < times.size - 2)).reshape(s.shape)
    bend = 0.5 * (s * (p2 - p0) + s**2 * (2 * p0 - 5 * p1 + 4 * p2 - p3) + s**3 * (3 * (p1 - p2) + p3 - p0))
    return np.where(inner, p1 + bend, p1 + s * (p2 - p1))


def body_rate(quat: np.ndarray, rate: np.ndarray) -> np.ndarray:
    """Angular velocity (3,) in the body's frame, 2 conj(q) dq/dt, of a unit quaternion, scalar first."""
    w, x, y, z = quat
    a, b, c, d = rate
    return 2 * np.array(
        [w * b - x * a - y * d + z * c, w * c - y * a - z * b + x * d, w * d - z * a - x * c + y * b]
    )


def aligned(log: Recording, out: dict[str, np.ndarray], columns: Mapping[str, str]) -> None:
    """Turn the sign of simulated quaternions to the recorded ones': both are the same turn."""
    turn = [columns[a] for a in ("qw", "qx", "qy", "qz") if columns[a] in out]
    if len(turn) == 4:
        dot = sum(np.nan_to_num(log[n]) * out[n] for n in turn)
        sign = np.where(dot < 0, -1.0, 1.0)
        for n in turn:
            out[n] = out[n] * sign
