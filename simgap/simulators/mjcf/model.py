"""A MuJoCo model with a map as a simulator; windows are rolled out together, in threads."""

from __future__ import annotations

import itertools
import os
from collections import defaultdict
from collections.abc import Mapping, Sequence, Set
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np
from numpy.polynomial import Polynomial

from hmmseg.robust import bridged
from simgap.effect import Parameter
from simgap.latest import latest
from simgap.simulators.mjcf.engine import FULL, HINGE, SLIDE, mujoco
from simgap.simulators.mjcf.map import POSE, Map
from simgap.simulators.mjcf.play import Played
from simgap.simulators.mjcf.runs import ACTS, Runs, body_rate, free_run
from simgap.simulators.mjcf.setting import HOLD, LATE, SMOOTH, Setting, changed_model, nothing, object_id
from simgap.simulators.protocol import RATE, Channel, Channels, Job, Values
from simgap.simulators.recording import Recording

CLOSING, CLOSED = 20, 1e-9  # numerics: most steps that close a loop, and the last of them
RESTS, STILL = 1.0, 0.02  # numerics: s in which a model comes to rest, and the rates at which it does
GIVEN = 1000  # numerics: windows for which it is kept how ties have them start, and how far they give


@dataclass
class MjcfSimulator:
    """A compiled model with a sensor for each compared column. What no column determines starts as the
    model's own run of the whole log has it."""

    model: Any
    map: Map
    channels: Mapping[str, Channel]
    parameters: Mapping[str, Parameter]
    settings: Mapping[str, Setting]
    sensor: Mapping[str, int]  # address in the sensor data by compared column
    joints: Mapping[str, int]  # joint by position column
    driven: Mapping[str, int]  # actuator by command column
    free: Mapping[int, Mapping[str, str]]  # columns of the pose by free joint
    touching: bool
    # columns of every body whose whole pose is read
    poses: Mapping[str, Mapping[str, str]] = field(default_factory=dict)
    says: Mapping[str, str] = field(default_factory=dict)
    played: Mapping[str, Played] = field(default_factory=dict)  # by setting
    spec: Any = None  # what the model was compiled from
    restarts: bool = True
    acts: str = ACTS
    threads: int = field(default_factory=lambda: max(1, min(4, os.cpu_count() or 1)))
    _logs: dict[str, Recording] = field(default_factory=dict, repr=False)
    _ran: dict[Any, Any] = field(default_factory=dict, repr=False)
    _gave: dict[Any, Any] = field(default_factory=dict, repr=False)
    _touched: dict[Any, Any] = field(default_factory=dict, repr=False)

    def __post_init__(self) -> None:
        self._data = [mujoco.MjData(self.model) for _ in range(self.threads)]
        self._runs_of = Runs(self.model, self._data, self.channels, self.sensor, self.driven, self.free)
        places = (self.model.jnt_qposadr, self.model.jnt_dofadr)
        self._places = {c: tuple(int(p[j]) for p in places) for c, j in self.joints.items()}
        self._ties = [(*tie, tie[-1].deriv()) for tie in ties(self.model, [*self.joints.values()])]
        self._inner = inner(self.model, {*self.joints.values(), *(tie[0] for tie in self._ties)})
        self._nominal = {n: s.nominal for n, s in self.settings.items()}
        # A law that acts needs all its numbers, those too that are as it came.
        of_laws = (n for n, s in self.settings.items() if s.put is nothing and s.nominal)
        self._shapes = {n: self.parameters[n].effect for n in of_laws}
        self.uncertain, self.sd = self.map.uncertain, self.map.sd  # as the diagnosis asks for them

    def simulate(self, parameters: Values, recording: Recording, start: Values | None = None) -> Channels:
        """One run; its channels are NaN where it diverged."""
        (found,) = self.simulate_many([Job(parameters, recording, start)])
        return {n: np.full(len(recording), np.nan) for n in self.sensor} if found is None else found

    def simulate_many(self, jobs: Sequence[Job]) -> list[Channels | None]:
        """All jobs' channels, None of one that diverged; jobs with equal parameters run together."""
        out: list[Channels | None] = [None] * len(jobs)
        groups: dict[tuple[Any, ...], list[int]] = defaultdict(list)
        for i, job in enumerate(jobs):
            values, own = job.parameters.items(), self._nominal
            acting = {self.parameters[n].effect for n, v in values if v != own[n]}
            changed = tuple((n, v) for n, v in values if v != own[n] or self._shapes.get(n, "") in acting)
            groups[changed].append(i)
        for key, mine in groups.items():
            mixed = [(n, v) for n, v in key if self.settings[n].mixed is not None]
            changed = tuple((n, v) for n, v in key if self.settings[n].mixed is None)
            for i, channels in zip(mine, self._mixed([jobs[i] for i in mine], changed, mixed), strict=True):
                out[i] = channels
        return out

    def _mixed(
        self, jobs: Sequence[Job], changed: tuple[tuple[str, float], ...], mixed: Sequence[tuple[str, float]]
    ) -> list[Channels | None]:
        """All jobs' channels, linear in each of the `mixed` settings between their two runs."""
        if not mixed:
            return self._all(jobs, changed)
        (name, value), *rest = mixed
        far = self.settings[name].mixed
        assert far is not None
        near, away = (self._mixed(jobs, (*changed, *c), rest) for c in ((), ((name, far),)))
        return [_mixed(a, b, value / far) for a, b in zip(near, away, strict=True)]

    def _all(self, jobs: Sequence[Job], changed: tuple[tuple[str, float], ...]) -> list[Channels | None]:
        """All jobs' channels with some settings changed."""
        if plays := [n for n, _ in changed if n in self.played]:
            return self.played[plays[0]](jobs, self._states(jobs), changed, self.model)
        states = self._states(jobs, tuple(c for c in changed if c[0].endswith(TIE)))
        with changed_model(self.model, self.settings, changed):
            return self._runs_of([j.recording for j in jobs], states, changed)

    def _states(self, jobs: Sequence[Job], softness: tuple[tuple[str, float], ...] = ()) -> np.ndarray:
        """Full physics states (jobs, size) at the windows' starts, with ties as soft as `softness` says."""
        bare, ran = None if self._partial else self._reset(), dict[str, np.ndarray]()
        for log in {job.recording.name for job in jobs if job.start is not None} & self._logs.keys():
            key, most = (log, softness), 2 * len(self._logs)  # as the model came, and one other
            ran[log] = latest(self._ran, key, partial(self._run, log, softness), most)
        return np.array([self._state(job, bare, ran.get(job.recording.name)) for job in jobs])

    def _run(self, log: str, softness: tuple[tuple[str, float], ...]) -> np.ndarray:
        """Full physics states (num_timesteps, size) along a log, as the model runs it freely."""
        recording = self._logs[log]
        first = self._rested(self._state(Job({}, recording, None)), recording)
        with changed_model(self.model, self.settings, softness):
            found = free_run(self.model, self._data[0], recording, first, self.driven)
        found[0] = first
        found[:, 0] = 0.0
        return self._followed(recording, np.where(np.isfinite(found), found, first))

    def _state(self, job: Job, bare: np.ndarray | None = None, ran: np.ndarray | None = None) -> np.ndarray:
        """Full physics state (size,) at a window's start; `bare`: what no column tells, `ran`: the log's."""
        there = None if ran is None else ran[job.recording.first]
        if job.start is None or bare is None:
            state = self._own_state(job.recording) if there is None or not self._partial else there.copy()
        else:
            state = bare.copy()
        if job.start is None:
            return state
        nq = self.model.nq
        for column, (q, v) in self._places.items():
            state[1 + q] = job.start[column]
            state[1 + nq + v] = job.start[column + RATE]
        state = latest(self._gave, (state.tobytes(),), lambda: self._tied(state), GIVEN).copy()
        if there is not None:  # under load a tie gives, as in the model's own run
            state += latest(self._gave, there.tobytes(), lambda: there - self._tied(there), GIVEN)
        for joint, columns in self.free.items():
            q, v = 1 + int(self.model.jnt_qposadr[joint]), 1 + nq + int(self.model.jnt_dofadr[joint])
            place, turn = [columns[a] for a in POSE[:3]], [columns[a] for a in POSE[3:]]
            state[q : q + 3] = [job.start[n] for n in place]
            state[v : v + 3] = [job.start[n + RATE] for n in place]
            quat = np.array([job.start[n] for n in turn])
            rate = np.array([job.start[n + RATE] for n in turn])
            norm = np.linalg.norm(quat)
            quat, rate = quat / norm, rate / norm
            state[q + 3 : q + 7] = quat
            state[v + 3 : v + 6] = body_rate(quat, rate - quat * (quat @ rate))
        return state

    def _rested(self, first: np.ndarray, log: Recording) -> np.ndarray:
        """The full physics state in which the model comes to rest under a log's first commands, with joints
        held where columns have them; `first` where it comes to none, or the map says where it starts."""
        m, data, nq = self.model, self._data[0], self.model.nq
        if self.map.keyframe is not None:
            return first
        mujoco.mj_setState(m, data, first, FULL)
        for column, actuator in self.driven.items():
            data.ctrl[actuator] = log[column][0]
        dofs = [v for _, v in self._places.values()]
        at = [q for q, _ in self._places.values()]
        for _ in range(round(RESTS / float(m.opt.timestep))):
            mujoco.mj_step(m, data)
            data.qpos[at], data.qvel[dofs] = first[[1 + q for q in at]], 0.0
        rested = np.empty_like(first)
        mujoco.mj_getState(m, data, rested, FULL)
        rested[0] = 0.0
        still = np.isfinite(rested).all() and np.abs(rested[1 + nq : 1 + nq + m.nv]).max() < STILL
        return rested if still else first

    def along(self, log: Recording) -> np.ndarray:
        """Full physics states (num_timesteps, size) along a log: columns where they tell, else a free run."""
        if not (self._partial or self._ties):
            ran = np.tile(self._own_state(log), (len(log), 1))
        else:
            self._logs = {**self._logs, log.name: log}
            ran = self._run(log.name, ())
        for column, (q, _) in self._places.items():
            ran[:, 1 + q] = bridged(log[column])
        return np.array([self._tied(state) for state in ran]) if self._ties and not self._inner.size else ran

    def _tied(self, state: np.ndarray) -> np.ndarray:
        """A full physics state with joints that follow others where these have them."""
        state = state.copy()
        m, q, v = self.model, state[1:], state[1 + self.model.nq :]
        for joint, other, by, slope in self._ties:
            at, away = m.jnt_qposadr[joint], q[m.jnt_qposadr[other]] - m.qpos0[m.jnt_qposadr[other]]
            q[at] = m.qpos0[at] + by(away)
            v[m.jnt_dofadr[joint]] = slope(away) * v[m.jnt_dofadr[other]]
        return self._closed(state) if self._inner.size else state

    def _closed(self, state: np.ndarray) -> np.ndarray:
        """A full physics state whose inner joints close the model's loops, by Newton's method."""
        m, data, dofs = self.model, self._data[0], self.model.jnt_dofadr[self._inner]
        place, rate = 1 + m.jnt_qposadr[self._inner], 1 + m.nq + dofs
        for _ in range(CLOSING):
            loops, slopes = self._loops(state)
            step = np.linalg.lstsq(slopes, data.efc_pos[loops], rcond=None)[0]
            state[place] -= step
            if np.abs(step).max() < CLOSED:
                break
        state[rate] = 0.0
        drawn = _carried(m, data, state[1 + m.nq : 1 + m.nq + m.nv])[loops]
        state[rate] = -np.linalg.lstsq(slopes, drawn, rcond=None)[0]
        return state

    def _loops(self, state: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The constraints (k,) that close loops in a state, and their slopes (k, n) by the inner joints."""
        m, data = self.model, self._data[0]
        mujoco.mj_setState(m, data, state, FULL)
        mujoco.mj_fwdPosition(m, data)
        loops = np.flatnonzero(data.efc_type == mujoco.mjtConstraint.mjCNSTR_EQUALITY)
        turns = np.eye(m.nv)[m.jnt_dofadr[self._inner]]
        return loops, np.stack([_carried(m, data, one)[loops] for one in turns], 1)

    def _followed(self, log: Recording, ran: np.ndarray) -> np.ndarray:
        """Full physics states (num_timesteps, size) along a log, `ran` freely, where columns determine the
        inner joints: these close the loops from one sample to the next, which a run that strays does in
        another way."""
        if not self._inner.size or np.linalg.matrix_rank(self._loops(ran[0])[1]) < self._inner.size:
            return ran
        place = 1 + self.model.jnt_qposadr[self._inner]
        for column, (q, _) in self._places.items():
            ran[:, 1 + q] = bridged(log[column])
        for k in range(len(ran)):
            ran[k, place] = ran[max(k - 1, 0), place]
            ran[k] = self._tied(ran[k])
        return ran

    def _own_state(self, log: Recording) -> np.ndarray:
        """The model's own start of a log."""
        state = self._reset()
        for column, (q, _) in self._places.items():
            seen = log[column][np.isfinite(log[column])]
            state[1 + q] = seen[0] if seen.size else 0.0
        return self._tied(state)

    def _reset(self) -> np.ndarray:
        """The model's own state, or its keyframe's."""
        data, state = self._data[0], np.empty(mujoco.mj_stateSize(self.model, FULL))
        if self.map.keyframe is None:
            mujoco.mj_resetData(self.model, data)
        else:
            mujoco.mj_resetDataKeyframe(self.model, data, object_id(self.model, "key", self.map.keyframe))
        mujoco.mj_getState(self.model, data, state, FULL)
        state[0] = 0.0
        return state

    @property
    def numerics(self) -> frozenset[str]:
        """Parameters of the simulation rather than the robot."""
        return self.dear | ({HOLD, LATE, SMOOTH} & self.settings.keys())

    @property
    def dear(self) -> frozenset[str]:
        """Those of them that cost a second run."""
        return frozenset(n for n, s in self.settings.items() if s.mixed is not None)

    @property
    def states(self) -> tuple[str, ...]:
        """Columns from which a window's start is read."""
        return (*self.joints, *(n for m in self.free.values() for n in m.values()))

    @property
    def _partial(self) -> bool:
        """Whether no column determines some of the state."""
        states = len(self.joints) + len(self._ties) + 6 * len(self.free)
        return states < self.model.nv or self.model.na > 0

    def prepare(self, recordings: Sequence[Recording]) -> None:
        """Keep logs whose run by the model starts windows where columns do not suffice."""
        if self._partial or self._ties:
            self._logs, self._ran = {log.name: log for log in recordings}, {}

    def contacts(self, recording: Recording) -> list[float]:
        """Times [s] at which the set of touching bodies changes along the recorded motion."""
        times, what = self.contact_states(recording)
        return [float(t) for t, a, b in zip(times[1:], what, what[1:], strict=False) if a != b]

    def contact_states(self, recording: Recording) -> tuple[np.ndarray, list[Pairs]]:
        """Times (n,) [s] along the recorded motion, and the pairs of bodies that touch then or next to it; a
        joint on a stop that it leaves or reaches counts as a pair, numbered below zero."""
        rows, none, m = self._shown(recording), frozenset[tuple[int, int]](), self.model
        touched, body = self.touched(recording) if self.touching else [none] * rows.size, m.geom_bodyid
        sets = [frozenset((int(body[a]), int(body[b])) for a, b in one) for one in touched]
        for column, j in self.joints.items():
            away = np.abs(bridged(recording[column])[rows] - m.jnt_range[j].mean())
            stopped = (away > 0.5 * np.ptp(m.jnt_range[j])) & bool(m.jnt_limited[j])
            if not stopped.all():  # what lies on its stop throughout magnifies no error
                sets = [s | {(~j, ~j)} if on else s for s, on in zip(sets, stopped, strict=True)]
        wide = [a | b | c for a, b, c in zip([none, *sets], sets, [*sets[1:], none], strict=False)]
        return recording.t[rows], closed(recording.t[rows], wide)

    def _shown(self, recording: Recording) -> np.ndarray:
        """The samples at which contacts are checked, at most 200 a second."""
        span = float(recording.t[-1] - recording.t[0])
        return np.arange(0, len(recording), max(1, round(len(recording) / max(span * 200, 1.0))))

    def touched(self, recording: Recording) -> list[Pairs]:
        """Pairs of geoms that touch at these samples of the recorded motion."""
        states = (*self.joints, *(m[a] for m in self.free.values() for a in POSE))
        at = [q for q, _ in self._places.values()]
        for joint in self.free:
            at += range(int(self.model.jnt_qposadr[joint]), int(self.model.jnt_qposadr[joint]) + len(POSE))
        rows = self._shown(recording)
        poses = np.array([bridged(recording[c])[rows] for c in states]).reshape(-1, rows.size).T

        def made() -> list[Pairs]:
            data = self._data[0]
            mujoco.mj_setState(self.model, data, self._reset(), FULL)
            return touching_pairs(self.model, data, poses, at)

        return latest(self._touched, (poses.shape, poses.tobytes()), made)


def tied(model: Any) -> np.ndarray:
    """The active equalities (k,) by which one joint follows another."""
    joints = (model.eq_type == mujoco.mjtEq.mjEQ_JOINT) & model.eq_active0.astype(bool)
    return np.flatnonzero(joints & (model.eq_obj2id >= 0))


def inner(model: Any, known: Set[int]) -> np.ndarray:
    """Hinges and slides (k,) that neither a column nor another joint tells, in loops of bodies."""
    kinds = mujoco.mjtEq.mjEQ_CONNECT, mujoco.mjtEq.mjEQ_WELD
    if not (np.isin(model.eq_type, kinds) & model.eq_active0.astype(bool)).any():
        return np.zeros(0, int)
    turns = np.flatnonzero(np.isin(model.jnt_type, (HINGE, SLIDE)))
    return np.array([j for j in turns if int(j) not in known], int)


def _carried(model: Any, data: Any, rates: np.ndarray) -> np.ndarray:
    """Rates (n,) of all constraints at rates (nv,) of the joints."""
    out = np.zeros(data.nefc)
    mujoco.mj_mulJacVec(model, data, out, np.ascontiguousarray(rates))
    return out


def ties(model: Any, seen: Sequence[int]) -> list[tuple[int, int, Polynomial]]:
    """Joints that no column shows but an equality has follow another, directly or not, that is `seen`.

    Returns:
        The joint, the other, and the polynomial of how far the other is from its reference that gives how far
            the joint is from its own.
    """
    out, known = list[tuple[int, int, Polynomial]](), {*seen}
    pairs = [
        (int(model.eq_obj1id[k]), int(model.eq_obj2id[k]), Polynomial(model.eq_data[k, :5]))
        for k in tied(model)
    ]
    for _ in pairs:
        for joint, other, by in pairs:
            first, slope, *more = by.coef
            if joint not in known and other in known:
                out.append((joint, other, by))
            elif other not in known and joint in known and slope and not any(more):
                out.append((other, joint, Polynomial([-float(first) / float(slope), 1 / float(slope)])))
            known |= {one for one, _, _ in out}
    return out


def _mixed(a: Channels | None, b: Channels | None, share: float) -> Channels | None:
    return None if a is None or b is None else {n: a[n] + share * (b[n] - a[n]) for n in a}


TIE = ".tie"  # suffix of a setting: how softly a joint follows another
# chosen: s: a contact that returns sooner was never lost: noise of the sensors breaks it
BROKEN = 0.04

Pairs = frozenset[tuple[int, int]]


def closed(t: np.ndarray, sets: Sequence[Pairs]) -> list[Pairs]:
    """The pairs that touch at times t (n,), with gaps up to BROKEN filled; a touch counts however brief."""
    out = list(sets)
    for pair in frozenset().union(*sets):
        rows = [i for i, s in enumerate(sets) if pair in s]
        for a, b in itertools.pairwise(rows):
            if t[b] - t[a] <= BROKEN:
                out[a:b] = [s | {pair} for s in out[a:b]]
    return out


def touching_pairs(model: Any, data: Any, poses: np.ndarray, at: Sequence[int]) -> list[Pairs]:
    """Pairs of geoms that touch in each pose (n, k) of the coordinates `at` (k,)."""
    out, none = [], frozenset[tuple[int, int]]()
    for pose in poses:
        data.qpos[at] = pose
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_collision(model, data)
        found = data.contact[: data.ncon] if data.ncon else ()
        out.append(frozenset((int(c.geom1), int(c.geom2)) for c in found) or none)
    return out
