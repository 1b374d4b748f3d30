"""Between a log's samples and a simulator's steps: commands held, sensors read, turns."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from simgap.simulators.recording import Recording


class Held:
    """Commands held from sample to sample, as each step of the simulator has them on average; of one window
    (n,) or of many with as many samples each (B, n)."""

    def __init__(self, since: np.ndarray, times: np.ndarray) -> None:
        self.since, self.times = since, times
        self.edges = np.append(times, 2 * times[-1] - times[-2])
        self.width = np.diff(self.edges)
        self.at = self._at(since)

    def __call__(self, values: np.ndarray, line: float = 0.0) -> np.ndarray:
        """Means (..., steps) of a column (..., n); missing samples hold the one before. `line`: the share of
        the line to the next sample, in the place of a step."""
        seen = np.isfinite(values)
        if seen.all():
            t, u, k = self.since, values, self.at
        elif values.ndim > 1:
            each = zip(self.since, values, strict=True)
            return np.stack([Held(t, self.times)(v, line) for t, v in each])
        else:
            t, u = self.since[seen], values[seen]
            k = self._at(t)
        rise, wide = np.diff(u), np.diff(t)
        done = np.cumsum((u[..., :-1] + 0.5 * line * rise) * wide, -1)
        area = np.concatenate([np.zeros((*done.shape[:-1], 1)), done], -1)
        steep = line * rise / np.where(wide > 0, wide, np.inf)
        slope = np.concatenate([steep, np.zeros((*done.shape[:-1], 1))], -1)
        here, held, begun, steep = (np.take_along_axis(v, k, -1) for v in (area, u, t, slope))
        late = self.edges - begun
        return np.diff(here + (held + 0.5 * steep * late) * late) / self.width

    def _at(self, t: np.ndarray) -> np.ndarray:
        """The sample that is held at each edge."""
        if t.ndim > 1:
            return np.stack([self._at(one) for one in t])
        return np.clip(np.searchsorted(t, self.edges, side="right") - 1, 0, t.size - 1)


class Between:
    """Between points of an even grid of `times` (T,), `at` (B, n) in B windows, by cubics through neighbours
    (Catmull & Rom 1974)."""

    def __init__(self, at: np.ndarray, times: np.ndarray) -> None:
        place = np.clip(at / (times[1] - times[0]), 0, times.size - 1)
        i = np.minimum(place.astype(int), times.size - 2)
        self.s = (place - i)[..., None]
        self.inner = ((i > 0) & (i < times.size - 2))[..., None]
        first = times.size * np.arange(len(at))[:, None]
        self.rows = [np.clip(i + k, 0, times.size - 1) + first for k in (-1, 0, 1, 2)]

    def __call__(self, values: np.ndarray) -> np.ndarray:
        """Values (B, n, k) of those on the grid (B, T, k)."""
        flat, s = values.reshape(-1, values.shape[-1]), self.s
        p0, p1, p2, p3 = (flat[rows] for rows in self.rows)
        bend = s * (p2 - p0) + s**2 * (2 * p0 - 5 * p1 + 4 * p2 - p3) + s**3 * (3 * (p1 - p2) + p3 - p0)
        return np.where(self.inner, p1 + 0.5 * bend, p1 + s * (p2 - p1))


@dataclass(frozen=True)
class Side:
    """Windows of as many samples, side by side: how their commands are held and their sensors read."""

    held: Held
    between: Between

    @classmethod
    def of(cls, since: np.ndarray, times: np.ndarray) -> Side:
        """Of windows whose samples are at `since` (B, n) [s] of their begin."""
        return cls(Held(since, times), Between(since, times))


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
