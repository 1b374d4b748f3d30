"""Effects around a simulator: the channels of all windows for any values of all effects' parameters."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from simgap.robot_effects.base import RobotEffect
from simgap.robots.rows import Rows, rows_of
from simgap.robots.windows import LENGTH, RESTS, STRIKES, Window, cut, start_of
from simgap.simulators.protocol import Channels, Job, Simulator, run_all
from simgap.simulators.recording import Recording
from simgap.simulators.user import restarts

# numerics: windows of a regime from which on a search takes some of them alone
FIRST = 48
SETTLE = 0.2  # numerics: s that a model has to come to rest where a window is of rest

Point = Mapping[str, Mapping[str, float]]  # effect -> parameter -> value; what is not named is neutral


@dataclass(frozen=True)
class Composed:
    """A simulator with effects around it, along the windows of recordings.

    `wobble` (N, K): by how much every effect of its usual size moves the rows of windows in which bodies
    move in contact; None where there is none. `motion`: a number for every log's motion, the same in repeats
    (see `motions`); none where windows begin anew from states of their own. How rows move with the
    simulator's own numbers (its step, how it holds commands) hardly depends on where: that is taken as it is
    at the point `about`, and what would cost another run (a finer step) is in proportion to it.
    """

    simulator: Simulator
    recordings: tuple[Recording, ...]
    windows: tuple[Window, ...]
    effects: Mapping[str, RobotEffect]
    noise: Mapping[str, float]
    rows: Rows
    wobble: np.ndarray | None = None
    motion: tuple[int, ...] = ()
    about: Point = field(default_factory=dict)
    _slopes: dict = field(default_factory=dict, repr=False)

    @classmethod
    def of(
        cls,
        simulator: Simulator,
        recordings: Sequence[Recording],
        effects: Mapping[str, RobotEffect],
        noise: Mapping[str, float],
        length: float = LENGTH,
    ) -> Composed:
        """With windows of about `length` [s] cut, and their rows laid out."""
        windows = tuple(cut(simulator, recordings, noise, length))
        rows = rows_of(recordings, windows, noise)
        motion = () if restarts(simulator) else tuple(motions(simulator, recordings))
        return cls(simulator, tuple(recordings), windows, effects, noise, rows, motion=motion)

    def calm(self) -> Composed:
        """The same in flight and at rest alone, where there are such windows; else this."""
        kept = [k for k, w in enumerate(self.windows) if w.regime != STRIKES]
        if not kept or len(kept) == len(self.windows):
            return self
        return replace(self.among(kept), wobble=None)

    def among(self, numbers: Sequence[int]) -> Composed:
        """The same in some of the windows alone, by number, ascending."""
        windows = tuple(self.windows[k] for k in numbers)
        wobble = None if self.wobble is None else self.wobble[np.isin(self.rows.window, numbers)]
        return replace(
            self, windows=windows, rows=rows_of(self.recordings, windows, self.noise), wobble=wobble
        )

    def repeats(self) -> list[int]:
        """In how many of these logs each window's motion is made."""
        if not self.motion:
            return [1] * len(self.windows)
        made = [self.motion[log] for log in {w.log for w in self.windows}]
        return [made.count(self.motion[w.log]) for w in self.windows]

    def thinned(self) -> list[int]:
        """Numbers of windows that a search takes: of every regime evenly chosen ones, FIRST at least."""
        if any(w.start is None for w in self.windows):
            return [*range(len(self.windows))]
        kept: list[int] = []
        for regime in sorted({w.regime for w in self.windows}):
            mine = [k for k, w in enumerate(self.windows) if w.regime == regime]
            kept += mine[:: max(1, len(mine) // FIRST)]
        return sorted(kept)

    def commanded(self, point: Point) -> list[Recording]:
        """The recordings with commands as the drives took them."""
        out = list(self.recordings)
        for name, theta in point.items():
            act = self.effects[name].command
            if act is not None:
                out = [act(r, {**self.effects[name].neutral(), **theta}) for r in out]
        return out

    def parameters(self, point: Point) -> dict[str, float]:
        """The simulator's parameters."""
        out = {name: p.nominal for name, p in self.simulator.parameters.items()}
        for name, theta in point.items():
            for short, value in theta.items():
                if short in self.effects[name].model:
                    out[self.effects[name].model[short]] = value
        return out

    def moved(self, point: Point) -> Composed:
        """The same, with what the simulator's own numbers do as it is at this point."""
        return replace(self, about=dict(point), _slopes={})

    def rolled(self, point: Point, starts: Sequence[Mapping[str, float] | None]) -> list[Channels | None]:
        """True channels of every window from these starts; None where a rollout diverged."""
        out = self._rolled(self._without_dear(point), self.windows, starts)
        for name, theta in point.items():
            if self.effects[name].dear:
                neutral = self.effects[name].neutral()
                for short, value in theta.items():
                    out = self.stepped(out, name, short, value - neutral[short])
        return out

    def _without_dear(self, point: Point) -> Point:
        return {n: v for n, v in point.items() if not self.effects[n].dear}

    def stepped(
        self, true: Sequence[Channels | None], name: str, short: str, by: float
    ) -> list[Channels | None]:
        """True channels with one of the simulator's own numbers changed by so much."""
        return (
            [_sum(a, b, by) for a, b in zip(true, self._slope(name, short), strict=True)] if by else [*true]
        )

    def _slope(self, name: str, short: str) -> list[Channels]:
        """Derivatives of every window's channels by a number of the simulator's, none where one diverges."""
        keys = [(w.log, w.begin, w.end, name, short) for w in self.windows]
        new = [w for w, key in zip(self.windows, keys, strict=True) if key not in self._slopes]
        if new:
            known = self.effects[name].parameters[short]
            about = self._without_dear(self.about)
            now = {**self.effects[name].neutral(), **about.get(name, {})}
            step = known.sd if now[short] + known.sd <= known.high else -known.sd
            there = {**about, name: {**now, short: now[short] + step}}
            both = [self._rolled(p, new, [w.start for w in new]) for p in (about, there)]
            for w, here, moved in zip(new, *both, strict=True):
                change = {} if here is None or moved is None else _sum(moved, here, -1.0)
                found = {n: v / step for n, v in (change or {}).items()}
                self._slopes[w.log, w.begin, w.end, name, short] = found
        return [self._slopes[key] for key in keys]

    def _rolled(
        self, point: Point, windows: Sequence[Window], starts: Sequence[Mapping[str, float] | None]
    ) -> list[Channels | None]:
        """True channels of windows, all as the simulator gives them."""
        recordings, parameters = self.commanded(point), self.parameters(point)
        jobs, leads = [], []
        for window, start in zip(windows, starts, strict=True):
            along, lead = recordings[window.log].window(window.begin, window.end), 0
            if window.regime == RESTS:
                along, lead = settled(along)
            jobs.append(Job(parameters, along, start))
            leads.append(lead)
        return [
            None if channels is None else {n: v[lead:] for n, v in channels.items()}
            for channels, lead in zip(run_all(self.simulator, jobs), leads, strict=True)
        ]

    def read(self, true: Sequence[Channels | None], point: Point) -> list[Channels | None]:
        """Channels of every window as they are read."""
        acting = [(e.alter, v) for e, v in self._acting(point) if e.alter is not None]
        out: list[Channels | None] = []
        for window, channels in zip(self.windows, true, strict=True):
            if channels is None or not acting:
                out.append(channels)
                continue
            here, along = dict(channels), self.recordings[window.log].window(window.begin, window.end)
            for alter, theta in acting:
                here |= alter(along, here, theta)
            out.append(here)
        return out

    def starts(self, point: Point) -> list[Mapping[str, float] | None]:
        """Every window's start, smoothed from the recordings with read-outs' effects undone."""
        undone = self.unread(point)
        if undone is None:
            return [w.start for w in self.windows]
        # A start is read column by column, and what is not undone is read as it was.
        changed = [
            {n for n, v in new.columns.items() if v is not old.columns.get(n)}
            for old, new in zip(self.recordings, undone, strict=True)
        ]
        out: list[Mapping[str, float] | None] = []
        for w in self.windows:
            if w.start is None:
                out.append(None)
                continue
            mine = undone[w.log], w.begin, self.noise, w.forward, changed[w.log]
            read = start_of(self.simulator, *mine)
            out.append({n: read[n][0] if n in read else v for n, v in w.start.items()})
        return out

    def unread(self, point: Point) -> list[Recording] | None:
        """The recordings with read-outs' effects undone, None where none acts."""
        acting = [(e.restore, v) for e, v in self._acting(point) if e.restore is not None]
        if not acting:
            return None
        out = list(self.recordings)
        for restore, theta in reversed(acting):
            out = [restore(log, theta) for log in out]
        return out

    def _acting(self, point: Point) -> list[tuple[RobotEffect, dict[str, float]]]:
        return [(self.effects[n], {**self.effects[n].neutral(), **v}) for n, v in point.items()]


def _sum(one: Channels | None, other: Channels, by: float) -> Channels | None:
    """One and so much of another, channel by channel."""
    return one if one is None or not other else {n: v + by * other[n] for n, v in one.items()}


def settled(window: Recording) -> tuple[Recording, int]:
    """A window with SETTLE before it in which all is as at its first sample, and how many samples that is:
    the model is to lie where it would lie itself, and not on its way there."""
    step = float(np.median(np.diff(window.t)))
    lead = max(1, round(SETTLE / step))
    t = np.concatenate([window.t[0] - step * np.arange(lead, 0, -1), window.t])
    columns = {n: np.concatenate([np.full(lead, v[0]), v]) for n, v in window.columns.items()}
    return Recording(window.name, t, columns, window.first), lead


# A model's error is the same each time the same motion is made: twelve repeats tell of it what one does, and
# only of the sensors' noise twelve times as much.

ALIKE = 0.1  # chosen: of a command's usual size; logs whose commands are closer than this are of one motion


def motions(simulator: Simulator, recordings: Sequence[Recording]) -> list[int]:
    """A number for every log's motion: the same where its commands are the same. Without commands each log is
    a motion of its own."""
    names = [n for n, c in simulator.channels.items() if c.kind == "command"]
    every = {n: np.concatenate([log[n] for log in recordings]) for n in names}
    size = {n: max(float(np.std(v) + abs(np.mean(v))), 1e-300) for n, v in every.items()}

    def alike(one: Recording, other: Recording) -> bool:
        t, u = one.t - one.t[0], other.t - other.t[0]
        both = t <= min(t[-1], u[-1])
        apart = {n: one[n][both] - np.interp(t[both], u, other[n]) for n in names}
        return bool(names) and all(np.sqrt(np.mean(d**2)) < ALIKE * size[n] for n, d in apart.items())

    first: list[Recording] = []
    out = []
    for log in recordings:
        out.append(next((k for k, one in enumerate(first) if alike(log, one)), len(first)))
        first += [log] if out[-1] == len(first) else []
    return out
