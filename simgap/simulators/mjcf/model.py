"""A MuJoCo model with a map as a simulator: windows are rolled out together in threads."""

from __future__ import annotations

import os
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from simgap.simulators.mjcf.engine import mujoco, rollout
from simgap.simulators.mjcf.map import Map, Mapped
from simgap.simulators.mjcf.settable import Setting
from simgap.simulators.protocol import RATE, Channel, Channels, Job, Parameter, Values, finite
from simgap.simulators.recording import Recording

APPLIED = "applied:"  # a column of torques along a log that act on a joint besides its actuators
BATCH = 4e7  # numerics: numbers that one batch of rollouts holds at most


@dataclass
class MjcfSimulator:
    """The compiled model with a sensor for each compared column (`sensor` name -> address).

    `joints`: by position column its joint; `driven`: by command column its actuator; `free`: by body, the
    seven columns of its pose. What no column tells starts as the model's own run of the whole log has it.
    """

    model: Any
    map: Map
    channels: Mapping[str, Channel]
    parameters: Mapping[str, Parameter]
    settings: Mapping[str, Setting]
    sensor: Mapping[str, int]
    joints: Mapping[str, int]
    driven: Mapping[str, int]
    free: Mapping[int, Mapping[str, str]]
    touching: bool
    says: Mapping[str, str] = field(default_factory=dict)
    restarts: bool = True
    threads: int = field(default_factory=lambda: max(1, min(4, os.cpu_count() or 1)))
    _runs: dict[str, np.ndarray] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self._data = [mujoco.MjData(self.model) for _ in range(self.threads)]
        self._spec = mujoco.mjtState.mjSTATE_FULLPHYSICS
        self._size = mujoco.mj_stateSize(self.model, self._spec)
        self._nominal = {n: s.get(self.model) for n, s in self.settings.items()}

    def simulate(self, parameters: Values, recording: Recording, start: Values | None = None) -> Channels:
        """One run; channels that are not finite where it diverged."""
        (found,) = self.simulate_many([Job(parameters, recording, start)])
        return {n: np.full(len(recording), np.nan) for n in self.sensor} if found is None else found

    def simulate_many(self, jobs: Sequence[Job]) -> list[Channels | None]:
        """Every job's channels, None where it diverged; jobs of the same parameters go together."""
        out: list[Channels | None] = [None] * len(jobs)
        groups: dict[tuple, list[int]] = defaultdict(list)
        for i, job in enumerate(jobs):
            changed = tuple((n, v) for n, v in job.parameters.items() if v != self._nominal[n])
            groups[changed].append(i)
        for key, mine in groups.items():
            mixed = [(n, v) for n, v in key if self.settings[n].mixed is not None]
            changed = tuple((n, v) for n, v in key if self.settings[n].mixed is None)
            for i, channels in zip(mine, self._all([jobs[i] for i in mine], changed), strict=True):
                out[i] = channels
            for name, value in mixed:
                far = self.settings[name].mixed
                assert far is not None
                other = self._all([jobs[i] for i in mine], (*changed, (name, far)))
                for i, channels in zip(mine, other, strict=True):
                    out[i] = _mixed(out[i], channels, value / far)
        return out

    def _all(self, jobs: Sequence[Job], changed: tuple[tuple[str, float], ...]) -> list[Channels | None]:
        """Every job's channels with some settings changed."""
        out: list[Channels | None] = []
        with _Set(self.model, self.settings, changed):
            for part in self._batches(jobs, list(range(len(jobs)))):
                out += self._roll([jobs[i] for i in part])
        return out

    def _batches(self, jobs: Sequence[Job], mine: list[int]) -> list[list[int]]:
        longest = max(float(jobs[i].recording.t[-1] - jobs[i].recording.t[0]) for i in mine)
        each = (longest / self.model.opt.timestep + 2) * (self._size + self.model.nsensordata + self.model.nv)
        size = max(1, int(BATCH / each))
        return [mine[a : a + size] for a in range(0, len(mine), size)]

    def _roll(self, jobs: Sequence[Job]) -> list[Channels | None]:
        h = float(self.model.opt.timestep)
        spans = [float(j.recording.t[-1] - j.recording.t[0]) for j in jobs]
        steps = int(np.ceil(max(spans) / h - 1e-9)) + 2
        first = np.array([self._state(j) for j in jobs])
        width = self.model.nu + (self.model.nv if any(self._applied(j.recording) for j in jobs) else 0)
        control = np.zeros((len(jobs), steps, max(width, 1)))
        times = np.arange(steps) * h
        for i, job in enumerate(jobs):
            log = job.recording
            held = Held(log.t - log.t[0], times)
            for column, actuator in self.driven.items():
                control[i, :, actuator] = held(log[column])
            for column in self._applied(log):
                dof = int(self.model.jnt_dofadr[_joint(self.model, column.removeprefix(APPLIED))])
                control[i, :, self.model.nu + dof] = held(log[column])
        spec = int(mujoco.mjtState.mjSTATE_CTRL)
        if width > self.model.nu:
            spec |= int(mujoco.mjtState.mjSTATE_QFRC_APPLIED)
        if width == 0:
            control, spec = None, int(mujoco.mjtState.mjSTATE_CTRL)
        _, sensed = rollout.rollout(
            self.model, self._data, first, control, control_spec=spec, nstep=steps, persistent_pool=True
        )
        return [self._read(job.recording, sensed[i], times) for i, job in enumerate(jobs)]

    def _applied(self, log: Recording) -> list[str]:
        return [n for n in log.columns if n.startswith(APPLIED)]

    def _read(self, log: Recording, sensed: np.ndarray, times: np.ndarray) -> Channels | None:
        """Sensors at the log's times: on the grid as they are, between by cubics (positions, velocities)."""
        since = log.t - log.t[0]
        out = {}
        for name, address in self.sensor.items():
            values = sensed[:, address]
            smooth = self.channels[name].kind in ("position", "velocity")
            out[name] = cubic(since, times, values) if smooth else np.interp(since, times, values)
        for columns in self.free.values():
            aligned(log, out, columns)
        return finite(out) if all(np.abs(v).max() < 1e9 for v in out.values()) else None

    def _state(self, job: Job) -> np.ndarray:
        """Full physics state at the window's start."""
        state = np.array(self._own_state(job.recording, job.start is None))
        if job.start is None:
            return state
        nq = self.model.nq
        for column, joint in self.joints.items():
            state[1 + self.model.jnt_qposadr[joint]] = job.start[column]
            state[1 + nq + self.model.jnt_dofadr[joint]] = job.start[column + RATE]
        for joint, columns in self.free.items():
            q, v = 1 + int(self.model.jnt_qposadr[joint]), 1 + nq + int(self.model.jnt_dofadr[joint])
            place = [columns[a] for a in ("x", "y", "z")]
            turn = [columns[a] for a in ("qw", "qx", "qy", "qz")]
            state[q : q + 3] = [job.start[n] for n in place]
            state[v : v + 3] = [job.start[n + RATE] for n in place]
            quat = np.array([job.start[n] for n in turn])
            rate = np.array([job.start[n + RATE] for n in turn])
            norm = np.linalg.norm(quat)
            quat, rate = quat / norm, rate / norm
            state[q + 3 : q + 7] = quat
            state[v + 3 : v + 6] = body_rate(quat, rate - quat * (quat @ rate))
        return state

    def _own_state(self, log: Recording, whole: bool) -> np.ndarray:
        """What the model itself starts from; for a window, where its run of the whole log is by then."""
        if not whole and self._partial and log.name in self._runs:
            return self._runs[log.name][log.first]
        data = self._data[0]
        if self.map.keyframe is None:
            mujoco.mj_resetData(self.model, data)
        else:
            mujoco.mj_resetDataKeyframe(self.model, data, _key(self.model, self.map.keyframe))
        for column, actuator in self.driven.items():
            data.ctrl[actuator] = log[column][0]
        for column, joint in self.joints.items():
            seen = log[column][np.isfinite(log[column])]
            data.qpos[self.model.jnt_qposadr[joint]] = seen[0] if seen.size else 0.0
        state = np.empty(self._size)
        mujoco.mj_getState(self.model, data, state, int(self._spec))
        state[0] = 0.0
        return state

    @property
    def states(self) -> tuple[str, ...]:
        """Columns that a window's start is read from."""
        return (*self.joints, *(n for m in self.free.values() for n in m.values()))

    @property
    def _partial(self) -> bool:
        """Whether some of the state is told by no column."""
        told = len(self.joints) + 6 * len(self.free)
        return told < self.model.nv or self.model.na > 0

    def prepare(self, recordings: Sequence[Recording]) -> None:
        """Run whole logs once, where columns do not tell the whole state, to start windows from."""
        if not self._partial:
            return
        for log in recordings:
            first = self._state(Job({}, log, None))
            h = float(self.model.opt.timestep)
            times = np.arange(int(np.ceil((log.t[-1] - log.t[0]) / h)) + 2) * h
            held = Held(log.t - log.t[0], times)
            control = np.zeros((1, times.size, max(self.model.nu, 1)))
            for column, actuator in self.driven.items():
                control[0, :, actuator] = held(log[column])
            states, _ = rollout.rollout(
                self.model, self._data[0], first[None], control if self.model.nu else None, nstep=times.size
            )
            rows = np.clip(np.searchsorted(times, log.t - log.t[0]) - 1, 0, times.size - 1)
            found = states[0][rows]
            found[0] = first
            found[:, 0] = 0.0
            self._runs[log.name] = np.where(np.isfinite(found), found, first)

    def contacts(self, recording: Recording) -> list[float]:
        """Times at which the set of touching geoms changes along the recorded motion, for good."""
        if not self.touching:
            return []
        rows = self._shown(recording)
        return lasting_changes(recording.t[rows], self.touched(recording))

    def _shown(self, recording: Recording) -> np.ndarray:
        """Samples at which contacts are looked at: 200 a second at most."""
        span = float(recording.t[-1] - recording.t[0])
        return np.arange(0, len(recording), max(1, round(len(recording) / max(span * 200, 1.0))))

    def touched(self, recording: Recording) -> list[frozenset[tuple[int, int]]]:
        """Pairs of geoms that touch along the recorded motion, at the samples looked at."""
        data = self._data[0]
        told = (*self.joints, *(n for m in self.free.values() for n in m.values()))
        columns = {c: _filled(recording[c]) for c in told}
        mujoco.mj_setState(self.model, data, self._own_state(recording, True), int(self._spec))
        out = []
        for i in self._shown(recording):
            for column, joint in self.joints.items():
                data.qpos[self.model.jnt_qposadr[joint]] = columns[column][i]
            for joint, pose in self.free.items():
                at = int(self.model.jnt_qposadr[joint])
                data.qpos[at : at + 7] = [
                    columns[pose[a]][i] for a in ("x", "y", "z", "qw", "qx", "qy", "qz")
                ]
            mujoco.mj_kinematics(self.model, data)
            mujoco.mj_comPos(self.model, data)
            mujoco.mj_collision(self.model, data)
            out.append(frozenset((int(c.geom1), int(c.geom2)) for c in data.contact[: data.ncon]))
        return out


class Held:
    """Commands held from sample to sample, as each step of the simulator has them on average."""

    def __init__(self, since: np.ndarray, times: np.ndarray) -> None:
        self.since = since
        self.edges = np.append(times, 2 * times[-1] - times[-2])

    def __call__(self, values: np.ndarray) -> np.ndarray:
        """Means (steps,) of a column (num_timesteps,); missing samples hold the one before."""
        seen = np.isfinite(values)
        t, u = self.since[seen], values[seen]
        area = np.concatenate([[0.0], np.cumsum(u[:-1] * np.diff(t))])
        k = np.clip(np.searchsorted(t, self.edges, side="right") - 1, 0, t.size - 1)
        whole = area[k] + u[k] * (self.edges - t[k])
        return np.diff(whole) / np.diff(self.edges)


# chosen: s that a change of contact must last: sensors' noise makes and breaks contacts
LASTING = 0.04


def lasting_changes(t: np.ndarray, sets: Sequence[Any]) -> list[float]:
    """Times at which a sequence of sets changes to one that stays."""
    out: list[float] = []
    now = sets[0] if sets else None
    i = 0
    while i < len(sets):
        if sets[i] != now:
            end = i
            while end < len(sets) and sets[end] == sets[i]:
                end += 1
            if end == len(sets) or t[end] - t[i] >= LASTING:
                out.append(float(t[i]))
                now = sets[i]
                i = end
                continue
        i += 1
    return out


def _filled(values: np.ndarray) -> np.ndarray:
    seen = np.isfinite(values)
    return values if seen.all() else np.interp(np.arange(values.size), np.flatnonzero(seen), values[seen])


def _mixed(a: Channels | None, b: Channels | None, share: float) -> Channels | None:
    return None if a is None or b is None else {n: a[n] + share * (b[n] - a[n]) for n in a}


class _Set:
    """The model with some settings changed, for as long as it is entered."""

    def __init__(
        self, model: Any, settings: Mapping[str, Setting], changed: Sequence[tuple[str, float]]
    ) -> None:
        self.model, self.settings, self.changed = model, settings, changed

    def __enter__(self) -> None:
        if not self.changed:
            return
        self.kept = {n: np.array(getattr(self.model, n)) for n in FIELDS}
        opt = self.model.opt
        self.options = (np.array(opt.gravity), opt.timestep, opt.integrator, opt.iterations)
        for name, value in self.changed:
            self.settings[name].put(self.model, value)
        if any(self.settings[n].derived for n, _ in self.changed):
            mujoco.mj_setConst(self.model, mujoco.MjData(self.model))

    def __exit__(self, *exception: object) -> None:
        if not self.changed:
            return
        for name, values in self.kept.items():
            getattr(self.model, name)[:] = values
        opt = self.model.opt
        opt.gravity[:], opt.timestep, opt.integrator, opt.iterations = self.options
        if any(self.settings[n].derived for n, _ in self.changed):
            mujoco.mj_setConst(self.model, mujoco.MjData(self.model))


FIELDS = (
    "dof_damping",
    "dof_frictionloss",
    "dof_armature",
    "jnt_stiffness",
    "qpos_spring",
    "body_mass",
    "body_inertia",
    "body_ipos",
    "body_pos",
    "geom_friction",
    "geom_solref",
    "geom_solimp",
    "geom_size",
    "geom_rbound",
    "actuator_gainprm",
    "actuator_biasprm",
    "actuator_forcerange",
)


def _joint(model: Any, name: str) -> int:
    return mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_JOINT, name)


def _key(model: Any, name: str) -> int:
    return mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_KEY, name)


def cubic(at: np.ndarray, times: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Values between points of an even grid by cubics through neighbours (Catmull & Rom 1974)."""
    h = times[1] - times[0]
    place = np.clip(at / h, 0, times.size - 1)
    i = np.minimum(place.astype(int), times.size - 2)
    s = place - i
    p0, p1, p2, p3 = (values[np.clip(i + k, 0, times.size - 1)] for k in (-1, 0, 1, 2))
    inner = (i > 0) & (i < times.size - 2)
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


def sensed_columns(mapped: Mapping[str, Mapped]) -> list[Mapped]:
    """Columns that are compared."""
    return [m for m in mapped.values() if m.kind != "command"]
