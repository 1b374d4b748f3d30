"""Many windows run by MuJoCo at once, from commands to channels."""

import hashlib
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from simgap.latest import latest
from simgap.simulators.mjcf.engine import rollout
from simgap.simulators.mjcf.laws import Laws
from simgap.simulators.mjcf.laws import run as run_with
from simgap.simulators.mjcf.setting import HOLD, LATE, SMOOTH
from simgap.simulators.protocol import Channel, Channels
from simgap.simulators.recording import Recording


class Held:
    """Commands held from sample to sample, averaged over the simulator's steps; of windows (n,) or (B, n)."""

    def __init__(self, since: np.ndarray, times: np.ndarray) -> None:
        self.since, self.times = since, times
        self.edges = np.append(times, 2 * times[-1] - times[-2])
        self.width = np.diff(self.edges)
        self.at = self._at(since)

    def __call__(self, values: np.ndarray, line: float = 0.0) -> np.ndarray:
        """Means (..., steps) of a column (..., n); missing samples repeat the one before. `line`: from 0,
        held in steps, to 1, on lines to the next sample."""
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
        slope = np.zeros(u.shape)
        slope[..., :-1] = steep
        slope[..., -1] = slope[..., -min(2, u.shape[-1])]  # the step in which the samples end
        here, held, begun, steep = (np.take_along_axis(v, k, -1) for v in (area, u, t, slope))
        late = self.edges - begun
        return np.diff(here + (held + 0.5 * steep * late) * late) / self.width

    def _at(self, t: np.ndarray) -> np.ndarray:
        """The sample held at each edge of a step."""
        if t.ndim > 1:
            return np.stack([self._at(one) for one in t])
        return np.clip(np.searchsorted(t, self.edges, side="right") - 1, 0, t.size - 1)


class Between:
    """Cubics through neighbours (Catmull & Rom 1974) on even `times` (T,), at `at` (B, n) in B windows."""

    def __init__(self, at: np.ndarray, times: np.ndarray) -> None:
        place = np.clip(at / (times[1] - times[0]), 0, times.size - 1)
        i = np.minimum(place.astype(int), times.size - 2)
        self.s = (place - i)[..., None]
        self.inner = ((i > 0) & (i < times.size - 2))[..., None]
        first = times.size * np.arange(len(at))[:, None]
        self.rows = [np.clip(i + k, 0, times.size - 1) + first for k in (-1, 0, 1, 2)]

    def __call__(self, values: np.ndarray) -> np.ndarray:
        """Values (B, n, k) from those on the grid (B, T, k)."""
        windows, steps, count = values.shape
        flat, s = values.reshape(windows * steps, count), self.s
        p0, p1, p2, p3 = (flat[rows] for rows in self.rows)
        bend = s * (p2 - p0) + s**2 * (2 * p0 - 5 * p1 + 4 * p2 - p3) + s**3 * (3 * (p1 - p2) + p3 - p0)
        return np.where(self.inner, p1 + 0.5 * bend, p1 + s * (p2 - p1))


def free_run(model: Any, data: Any, log: Recording, first: np.ndarray, driven: Mapping[str, int]
             ) -> np.ndarray:  # fmt: skip
    """Full states (num_timesteps, size) at a log's samples, run freely from `first` (size,)."""
    since, step = log.t - log.t[0], float(model.opt.timestep)
    times = np.arange(int(np.ceil(since[-1] / step)) + 2) * step
    control, held = np.zeros((1, times.size, model.nu)), Held(since, times)
    for column, actuator in driven.items():
        control[0, :, actuator] = held(log[column])
    states = rollout.rollout(model, data, first[None], control if model.nu else None, nstep=times.size)[0][0]
    return states[np.clip(np.searchsorted(times, since) - 1, 0, times.size - 1)]


def body_rate(quat: np.ndarray, rate: np.ndarray) -> np.ndarray:
    """Angular velocity (3,) [rad/s] in the body's frame, 2 conj(q) dq/dt, of a unit quaternion q."""
    w, x, y, z = quat
    a, b, c, d = rate
    about = w * b - x * a - y * d + z * c, w * c - y * a - z * b + x * d, w * d - z * a - x * c + y * b
    return 2 * np.array(about)


def aligned(log: Recording, out: dict[str, np.ndarray], columns: Mapping[str, str]) -> None:
    """Give simulated quaternions the sign of the recorded ones, in place: both are the same rotation."""
    turn = [columns[a] for a in ("qw", "qx", "qy", "qz") if columns[a] in out]
    if len(turn) == 4:
        dot = sum(np.nan_to_num(log[n]) * out[n] for n in turn)
        sign = np.where(dot < 0, -1.0, 1.0)
        for n in turn:
            out[n] = out[n] * sign


# A column of the times [s] from which each row's commands are carried out; suffixed "next", of the commands
# that follow, and suffixed with a command's name, what follows.
ACTS = "acts:"
BATCH = 4e7  # numerics: numbers that one batch of rollouts holds at most
KEPT = 1e8  # limit: bytes of the latest runs that are kept
FAR = 1e9  # numerics: a run that reads beyond it has diverged


@dataclass
class Runs:
    """Runs of the `model` in threads, one for each of `data`; other fields as in `MjcfSimulator`. The latest
    are kept, since a finite difference in one number of the solver includes those of all others."""

    model: Any
    data: Sequence[Any]
    channels: Mapping[str, Channel]
    sensor: Mapping[str, int]
    driven: Mapping[str, int]
    free: Mapping[int, Mapping[str, str]]
    _sides: dict[Any, Any] = field(default_factory=dict, repr=False)
    _held: dict[Any, Any] = field(default_factory=dict, repr=False)
    _ran: dict[Any, Any] = field(default_factory=dict, repr=False)

    def __call__(
        self, logs: Sequence[Recording], first: np.ndarray, changed: tuple[tuple[str, float], ...]
    ) -> list[Channels | None]:
        """Channels along logs from states (B, size) with some settings changed, None of one that diverged.

        Logs with equally many samples run together, so that none runs on to another's end.
        """
        alike: dict[int, list[int]] = defaultdict(list)
        for i, log in enumerate(logs):
            alike[len(log)].append(i)
        h, sensors = float(self.model.opt.timestep), max(self.model.nsensordata, 1)
        steps = np.array([(log.t[-1] - log.t[0]) / h + 2 for log in logs])
        kept = len(alike) * max(1, int(KEPT / (8 * sensors * steps.sum())))
        out: list[Channels | None] = [None] * len(logs)
        for every in alike.values():
            size = max(1, int(BATCH / (steps[every].max() * (first.shape[1] + sensors + self.model.nv))))
            for mine in (every[a : a + size] for a in range(0, len(every), size)):
                found = self._roll([logs[i] for i in mine], first[mine], changed, kept)
                for i, channels in zip(mine, found, strict=True):
                    out[i] = channels
        return out

    def _roll(
        self, logs: Sequence[Recording], first: np.ndarray, changed: tuple[Any, ...], kept: int
    ) -> list[Channels | None]:
        h = float(self.model.opt.timestep)
        span = max(float(log.t[-1] - log.t[0]) for log in logs)
        times = np.arange(int(np.ceil(span / h - 1e-9)) + 2) * h
        side = self._side(logs, times, kept)
        line, late, smooth = (dict(changed).get(name, 0.0) for name in (HOLD, LATE, SMOOTH))
        smooth = max(smooth, line * smooth)  # steps have no curve
        # A loop that sets a command and makes a step has the line where the step begins, not its mean.
        since = _carried_out(logs, side[0].since, (late + 0.5 * line) * h)
        every = [np.array([_commanded(log, column) for log in logs]) for column in self.driven]

        def steps() -> np.ndarray:
            held = side[0] if since is side[0].since else Held(since, times)
            control = np.zeros((len(logs), times.size, self.model.nu))
            for asked, place in zip(every, self.driven.values(), strict=True):
                asked[:, 1:-1] += 0.5 * smooth * np.diff(asked, 2)
                control[:, :, place] = held(asked, line)
            return control

        given = (since.tobytes(), times.size, h, line, smooth, *(asked.tobytes() for asked in every))
        control = latest(self._held, given, steps, kept)
        return self._read(logs, self._sensed(first, control, changed, kept), side, times)

    def _sensed(
        self, first: np.ndarray, control: np.ndarray, changed: tuple[Any, ...], kept: int
    ) -> np.ndarray:
        """Sensors (B, steps, sensors) of runs from these states."""
        laws = Laws.of(self.model, changed)

        def run() -> np.ndarray:
            if laws:
                return run_with(self.model, self.data[0], laws, first, control)
            return rollout.rollout(
                self.model, self.data, first, control if self.model.nu else None,
                nstep=control.shape[1], persistent_pool=True,
            )[1]  # fmt: skip

        given = hashlib.blake2b(first.tobytes() + control.tobytes()).digest()
        key = (changed, first.shape, control.shape, given)
        return latest(self._ran, key, run, kept)

    def _side(self, logs: Sequence[Recording], times: np.ndarray, kept: int) -> tuple[Held, Between]:
        """How windows with equally many samples lie on the steps: for their commands and their sensors."""
        since = np.array([log.t - log.t[0] for log in logs])
        key = (since.shape, since.tobytes(), times.size, float(times[1]))
        return latest(self._sides, key, lambda: (Held(since, times), Between(since, times)), kept)

    def _read(
        self, logs: Sequence[Recording], sensed: np.ndarray, side: tuple[Held, Between], times: np.ndarray
    ) -> list[Channels | None]:
        """Sensors (B, steps, sensors) at the logs' times, positions and velocities by cubics."""
        smooth = [n for n in self.sensor if self.channels[n].kind in ("position", "velocity")]
        held, between = side
        read = between(sensed[:, :, [self.sensor[n] for n in smooth]])
        whole: list[Channels | None] = []
        for b, log in enumerate(logs):
            out = {n: read[b, :, k] for k, n in enumerate(smooth)}
            for name, address in self.sensor.items():
                if name not in out:
                    out[name] = np.interp(held.since[b], times, sensed[b, :, address])
            for columns in self.free.values():
                aligned(log, out, columns)
            whole.append(out if all(np.abs(v).max() < FAR for v in out.values()) else None)
        return whole


def _carried_out(logs: Sequence[Recording], since: np.ndarray, late: float) -> np.ndarray:
    """Since when (B, n) commands are held that come `late` [s], and at times of their own where logs have
    these."""
    if ACTS in logs[0].columns:
        own = np.array([log[ACTS] - log.t[0] for log in logs])
        since = np.minimum.accumulate(np.minimum(own, since)[:, ::-1], 1)[:, ::-1]
        if f"{ACTS}next" in logs[0].columns:
            after = np.array([log[f"{ACTS}next"][-1] - log.t[0] for log in logs])
            since = np.column_stack([since, np.maximum(after, since[:, -1])])
    return since + late if late else since


def _commanded(log: Recording, column: str) -> np.ndarray:
    """A command's values, followed where a log has it by the one after the last."""
    following = log.columns.get(f"{ACTS}{column}")
    return log[column] if following is None else np.append(log[column], following[-1])
