"""A simulator with effects around it: the channels of all windows at any values of their parameters."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from simgap.robot_effects.base import RobotEffect
from simgap.robots.rows import Rows, rows_of
from simgap.robots.windows import DOUBT, FLIES, LENGTH, RESTS, STRIKES, Window, cut, meets, smoothed, start_of
from simgap.simulators.protocol import RATE, Channels, Job, Simulator, run_all
from simgap.simulators.recording import Recording
from simgap.simulators.user import restarts

# numerics: windows of a regime; of more a search uses every second, third, ..
FIRST = 48
MOST_ROWS = 15000  # numerics: rows of a regime that a search uses at most
SETTLE = 0.2  # numerics: s for a model to come to rest before a window of rest

Point = Mapping[str, Mapping[str, float]]  # effect -> parameter -> value; neutral where absent


@dataclass(frozen=True)
class Composed:
    """A simulator with effects around it, along the windows of recordings.

    Derivatives by the simulator's own numbers (its step, how it holds commands) hardly depend on the other
    parameters: they are taken once, at the point `about`, and what would cost a second run (a finer step) is
    linear in its parameter.

    `simulator`: the robot's model; `recordings`: its logs; `windows`: stretches of the logs, each simulated
    from its own start; `effects`: candidates and what is fitted along, by name; `noise`: standard deviation
    of one sample by channel [its unit]; `rows`: the rows that the windows give; `wobble`: change (N, K) of
    the rows by a usual size of every effect, in windows in which bodies move in contact; None without such
    windows; `motion`: A number for every log's motion, equal in repeats (see `motions`); empty where windows
    restart from states of their own; `about`: the point of those derivatives.
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
    _slopes: dict[Any, Any] = field(default_factory=dict, repr=False)

    @classmethod
    def of(
        cls,
        simulator: Simulator,
        recordings: Sequence[Recording],
        effects: Mapping[str, RobotEffect],
        noise: Mapping[str, float],
        length: float = LENGTH,
    ) -> Composed:
        """Cut windows of about `length` [s] and lay out their rows."""
        windows = tuple(cut(simulator, recordings, noise, length))
        rows = rows_of(recordings, windows, noise)
        motion = () if restarts(simulator) else tuple(motions(simulator, recordings))
        made = cls(simulator, tuple(recordings), windows, effects, noise, rows, motion=motion)
        if not restarts(simulator) or getattr(simulator, "state_at", None) is not None:
            return made
        windows = tuple(made._doubted())
        return replace(made, windows=windows, rows=rows_of(recordings, windows, noise))

    def _doubted(self) -> Iterator[Window]:
        """The windows as the model's own run has them, with rates of starts in doubt by what curves through
        samples miss of its own.

        Where commands jump at every sample a stiff drive's rate swings between samples, always alike: at them
        it is another than that of any curve through them. Where the model's own run touches what the log
        misses by a hair, neither is in flight; a touch next to a window's ends is its neighbour's.
        """
        runs = self._rolled({}, self.windows, [w.start for w in self.windows])
        for w, run in zip(self.windows, runs, strict=True):
            t, doubt, start = self.recordings[w.log].t[w.first : w.end], dict(w.doubt), w.start or {}
            for name, values in (run or {}).items():
                if (state := name + RATE) in doubt:
                    _, (rate, _) = smoothed(t, values, 0, self.noise[name], forward=True)
                    doubt[state] = float(np.hypot(doubt[state], DOUBT * (rate - start[state])))
            regime = w.regime
            if run is not None and regime == FLIES:
                along = self.recordings[w.log].window(w.first, w.end).with_columns(run)
                regime = STRIKES if meets(self.simulator, along) else FLIES
            yield replace(w, doubt=doubt, regime=regime)

    def calm(self) -> Composed:
        """The same without windows of bodies that move in contact, unless some log has no others."""
        kept = [k for k, w in enumerate(self.windows) if w.regime != STRIKES]
        logs = {self.windows[k].log for k in kept}
        if logs < {w.log for w in self.windows} or len(kept) == len(self.windows):
            return self
        return replace(self.among(kept), wobble=None)

    def among(self, numbers: Sequence[int]) -> Composed:
        """The same in some of the windows, by number, ascending."""
        windows = tuple(self.windows[k] for k in numbers)
        wobble = None if self.wobble is None else self.wobble[np.isin(self.rows.window, numbers)]
        return replace(
            self, windows=windows, rows=rows_of(self.recordings, windows, self.noise), wobble=wobble
        )

    def repeats(self) -> list[int]:
        """The number of these logs that repeat each window's motion."""
        if not self.motion:
            return [1] * len(self.windows)
        made = [self.motion[log] for log in {w.log for w in self.windows}]
        return [made.count(self.motion[w.log]) for w in self.windows]

    def thinned(self) -> list[int]:
        """Numbers of the windows that a search uses: evenly chosen ones of every regime, FIRST or more where
        that is no more than MOST_ROWS rows."""
        if any(w.start is None for w in self.windows):
            return [*range(len(self.windows))]
        kept: list[int] = []
        for regime in sorted({w.regime for w in self.windows}):
            mine = [k for k, w in enumerate(self.windows) if w.regime == regime]
            every = max(1, len(mine) // FIRST)
            rows = sum(self.rows.of[k].stop - self.rows.of[k].start for k in mine) / every
            kept += mine[:: every * max(1, int(np.ceil(rows / MOST_ROWS)))]
        return sorted(kept)

    def commanded(self, point: Point) -> list[Recording]:
        """The recordings with commands as the drives carried them out."""
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
        """The same with the derivatives by the simulator's own numbers taken at this point."""
        return replace(self, about=dict(point), _slopes={})

    def run_aside(self, asides: Mapping[int, Mapping[str, float]]) -> Composed:
        """The same with windows, by number, run that far aside of their starts."""
        windows = [replace(w, aside=asides[k]) if k in asides else w for k, w in enumerate(self.windows)]
        return replace(self, windows=tuple(windows))

    def rolled(self, point: Point, starts: Sequence[Mapping[str, float] | None]) -> list[Channels | None]:
        """Roll out every window.

        Args:
            point: Parameters of the effects.
            starts: Start of each window, by state.

        Returns:
            True channels of every window from where it is run, before read-out effects; None where a rollout
                diverged.
        """
        out = self._rolled(self._without_dear(point), self.windows, starts)
        for name, theta in point.items():
            if self.effects[name].dear:
                neutral = self.effects[name].neutral()
                for short, value in theta.items():
                    out = self.stepped(out, name, short, value - neutral[short])
        return out

    def _without_dear(self, point: Point) -> dict[str, Mapping[str, float]]:
        return {n: v for n, v in point.items() if not self.effects[n].dear}

    def stepped(
        self, true: Sequence[Channels | None], name: str, short: str, by: float
    ) -> list[Channels | None]:
        """True channels with one of the simulator's own numbers changed by `by`."""
        return (
            [_sum(a, b, by) for a, b in zip(true, self._slope(name, short), strict=True)] if by else [*true]
        )

    def _slope(self, name: str, short: str) -> list[Channels]:
        """Derivatives of every window's true channels by one of the simulator's own numbers; empty where it
        diverged."""
        keys = [(w.log, w.begin, w.end, name, short) for w in self.windows]
        new = [w for w, key in zip(self.windows, keys, strict=True) if key not in self._slopes]
        if new:
            known = self.effects[name].parameters[short]
            about = self._without_dear(self.about)
            first = [n for n in self.about if self.effects[n].dear][:1]  # the solver's step
            if name not in first and any(w.regime != FLIES for w in self.windows):
                # In contact what an integrator changes at one step is not what it changes at another.
                about |= {n: self.about[n] for n in first}
            now = {**self.effects[name].neutral(), **about.get(name, {})}
            step = known.sd if now[short] + known.sd <= known.high else -known.sd
            there = {**about, name: {**now, short: now[short] + step}}
            both = [self._rolled(p, new, [w.begun() for w in new]) for p in (about, there)]
            for w, here, moved in zip(new, *both, strict=True):
                change = {} if here is None or moved is None else _sum(moved, here, -1.0)
                found = {n: v / step for n, v in (change or {}).items()}
                self._slopes[w.log, w.begin, w.end, name, short] = found
        return [self._slopes[key] for key in keys]

    def _rolled(
        self, point: Point, windows: Sequence[Window], starts: Sequence[Mapping[str, float] | None]
    ) -> list[Channels | None]:
        """True channels of windows, all from the simulator itself."""
        recordings, parameters = self.commanded(point), self.parameters(point)
        jobs, leads = [], []
        for window, start in zip(windows, starts, strict=True):
            along, lead = recordings[window.log].window(window.first, window.end), 0
            if window.regime == RESTS:
                along, lead = preceded_by_rest(along)
            jobs.append(Job(parameters, along, start))
            leads.append(lead)
        return [
            None if channels is None else {n: v[lead:] for n, v in channels.items()}
            for channels, lead in zip(run_all(self.simulator, jobs), leads, strict=True)
        ]

    def read(self, true: Sequence[Channels | None], point: Point) -> list[Channels | None]:
        """Channels of every window as the sensors report them."""
        acting = [(e.alter, v) for e, v in self._acting(point) if e.alter is not None]
        out: list[Channels | None] = []
        for window, channels in zip(self.windows, true, strict=True):
            if channels is None or not (acting or window.lead):
                out.append(channels)
                continue
            here, along = dict(channels), self.recordings[window.log].window(window.first, window.end)
            for alter, theta in acting:
                here |= alter(along, here, theta)
            out.append({n: v[window.lead :] for n, v in here.items()})
        return out

    def starts(self, point: Point) -> list[Mapping[str, float] | None]:
        """Where every window is run from: aside of its start, smoothed from the recordings with read-out
        effects undone."""
        undone = self.unread(point)
        if undone is None:
            return [w.begun() for w in self.windows]
        # A start is read column by column; only changed columns are read again.
        changed = [
            {n for n, v in new.columns.items() if v is not old.columns.get(n)}
            for old, new in zip(self.recordings, undone, strict=True)
        ]
        out: list[Mapping[str, float] | None] = []
        for w in self.windows:
            mine = undone[w.log], w.first, self.noise, w.forward, changed[w.log]
            out.append(None if w.start is None else w.begun(start_of(self.simulator, *mine)))
        return out

    def unread(self, point: Point) -> list[Recording] | None:
        """The recordings with read-out effects undone; None where none acts."""
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
    """One plus `by` times the other, channel by channel."""
    return one if one is None or not other else {n: v + by * other[n] for n, v in one.items()}


def preceded_by_rest(window: Recording) -> tuple[Recording, int]:
    """Prepend SETTLE to a window, constant as at its first sample, so that the model comes to rest where it
    would rest itself.

    Returns:
        The longer window, and the number of samples prepended.
    """
    step = float(np.median(np.diff(window.t)))
    lead = max(1, round(SETTLE / step))
    t = np.concatenate([window.t[0] - step * np.arange(lead, 0, -1), window.t])
    columns = {n: np.concatenate([np.full(lead, v[0]), v]) for n, v in window.columns.items()}
    return Recording(window.name, t, columns, window.first), lead


# A model's error is the same in every repeat of a motion: twelve repeats say as much of it as one, and twelve
# times as much of the sensors' noise alone.

ALIKE = 0.1  # chosen: share of a command's usual size; logs with commands closer than this repeat a motion


def motions(simulator: Simulator, recordings: Sequence[Recording]) -> list[int]:
    """A number for every log's motion, equal where the commands are alike; without commands every log is its
    own."""
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
