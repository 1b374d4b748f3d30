"""Windows of logs, each simulated from a start that is smoothed from the log.

Rollouts drift away from a log, so a simulator is judged over short windows. The error of a start is no part
of the gap but of the noise (`simgap.robots.whiten`).
"""

from __future__ import annotations

import itertools
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.ndimage import maximum_filter1d, minimum_filter1d

from hmmseg.levels import GAP
from simgap.simulators.protocol import RATE, Simulator
from simgap.simulators.recording import Recording
from simgap.simulators.user import restarts

LENGTH = 0.4  # numerics: s
FEWEST = 6  # numerics: samples of a window
# chosen: s on either side from which a start is smoothed, over NEIGHBOURS samples or more
REACH = 0.03
NEIGHBOURS = 5  # numerics: samples
DEGREES = (2, 3, 4)  # numerics: of polynomials through them
# chosen: a start's sd over what noise alone gives: the window's own samples settle the rest
DOUBT = 3.0
STILL = 0.01  # chosen: share of a channel's range; a stretch in which no channel travels further is still
AT_REST, CALM = 0.002, 0.05  # chosen: likewise, and s: what touches and travels no further in this time rests
JUMPS = "command jumps"  # a further state of a start: when in its interval a command jumped
ABRUPT = 4.0  # chosen: a change over this many times those before and after is a jump
# A model may lack different things in flight, at rest, and where bodies strike, slide or roll.
FLIES, RESTS, STRIKES = REGIMES = ("nothing touches", "bodies rest on each other", "bodies move in contact")


@dataclass(frozen=True)
class Window:
    """Rows [begin, end) of a log.

    `log`, `begin`, `end`: number of the log and its rows; `lead`: how many rows earlier it is run from, so
    that what is read late or smoothed shows what went before; `forward`: whether the start is smoothed from
    later samples alone; `start`, `doubt`: its states and their standard deviations; None where the simulator
    does not restart; `regime`: one of REGIMES, where the simulator reports contacts; `aside`: how far from
    the start the window is run and linearised, by state.
    """

    log: int
    begin: int
    end: int
    forward: bool  # the start is smoothed from later samples alone
    start: dict[str, float] | None
    doubt: dict[str, float]
    regime: str = FLIES
    aside: Mapping[str, float] = field(default_factory=dict)
    lead: int = 0

    @property
    def first(self) -> int:
        """The row from which it is run."""
        return self.begin - self.lead

    def begun(self, read: Mapping[str, tuple[float, float]] | None = None) -> dict[str, float] | None:
        """Where the window is run from; `read`: states that were read anew."""
        if self.start is None:
            return None
        new = {n: v for n, (v, _) in (read or {}).items()}
        return {n: new.get(n, v) + self.aside.get(n, 0.0) for n, v in self.start.items()}


def cut(
    simulator: Simulator, recordings: Sequence[Recording], noise: Mapping[str, float], length: float = LENGTH
) -> list[Window]:
    """Cut every log into windows; new ones begin after gaps, at changes of contact and where touching bodies
    come to rest.

    Args:
        simulator: The robot's model; one that does not restart gets one window a log.
        recordings: The logs.
        noise: Standard deviation of one sample by channel [its unit].
        length: About how long windows are [s].
    """
    out = []
    reach = reaches(simulator, recordings)
    for number, log in enumerate(recordings):
        if not restarts(simulator):
            out.append(Window(number, 0, len(log), True, None, {}))
            continue
        jumped = jumps(simulator, log)
        touching = _touching(simulator, log)
        rests = touching & resting(log, reach)
        turns = np.flatnonzero(np.diff(rests.astype(int))) + 1
        contacts = getattr(simulator, "contacts", None)
        step = np.diff(log.t)  # in a gap nothing is known of the commands
        gaps = np.flatnonzero(step > GAP * np.median(step)) + 1
        marks = [*([] if contacts is None else map(float, contacts(log))), *log.t[turns], *log.t[gaps]]
        edges = _edges(log, marks, length)
        edges[0] = _readable(simulator, log, edges[1])
        early = max(1, round(REACH / max(float(np.median(step)), 1e-9)))
        for begin, end in itertools.pairwise(edges):
            near = any(abs(float(log.t[begin]) - m) < REACH for m in marks)
            regime = FLIES
            if touching[begin:end].any():
                regime = RESTS if rests[begin:end].all() else STRIKES
            # What rests is run from rest, and what strikes did not a moment earlier.
            lead = 0 if near or regime == RESTS or begin == edges[0] else min(early, begin - edges[0])
            window = Window(number, begin, end, near, None, {}, regime, lead=lead)
            out.append(_begun(simulator, log, window, noise, jumped))
    return out


def _begun(
    simulator: Simulator, log: Recording, window: Window, noise: Mapping[str, float], jumped: np.ndarray
) -> Window:
    state = start_of(simulator, log, window.first, noise, window.forward)
    values, doubt = {n: v for n, (v, _) in state.items()}, {n: s for n, (_, s) in state.items()}
    if jumped[window.first : window.end].any():
        doubt[JUMPS] = DOUBT * 12**-0.5  # uniform over the interval
    return replace(window, start=values, doubt=doubt)


def jumps(simulator: Simulator, log: Recording) -> np.ndarray:
    """For each row the interval [s] (num_timesteps,) in which its commands jumped, 0 where they did not.

    Commands are logged at samples; a jump between two samples happened some time after the earlier one.
    """
    acts = getattr(simulator, "acts", None)
    if acts is None:
        return np.zeros(len(log))
    given = log.columns.get(acts, log.t)
    first = np.flatnonzero(np.diff(given, prepend=-np.inf) > 0)
    wide = np.zeros(first.size)
    for name, channel in simulator.channels.items():
        if channel.kind == "command":
            change = np.abs(np.diff(log[name][first]))
            beside = np.maximum(np.append(change[1:], 0.0), np.append(0.0, change[:-1]))
            wide[1:] = np.where(change > ABRUPT * beside, np.diff(given[first]), wide[1:])
    return wide[np.searchsorted(first, np.arange(len(log)), side="right") - 1]


def earlier(simulator: Simulator, log: Recording, share: float) -> Recording:
    """The log with jumping commands carried out this share of their interval earlier."""
    acts = simulator.acts  # type: ignore[attr-defined]
    return log.with_columns({acts: log.columns.get(acts, log.t) - share * jumps(simulator, log)})


def reaches(simulator: Simulator, recordings: Sequence[Recording]) -> dict[str, float]:
    """The range of every position channel over all logs [its unit]."""
    names = [n for n, c in simulator.channels.items() if c.kind == "position"]
    return {n: max(max(travel(r[n]) for r in recordings), 1e-12) for n in names}


def moves(log: Recording, begin: int, end: int, reach: Mapping[str, float]) -> bool:
    """Whether any position travels over STILL of its `reach` in the rows [begin, end)."""
    return any(travel(log[n][begin:end]) > STILL * most for n, most in reach.items())


def resting(log: Recording, reach: Mapping[str, float]) -> np.ndarray:
    """Samples (num_timesteps,) about which no position travels over AT_REST of its `reach` within CALM."""
    size = max(2, round(CALM / max(float(np.median(np.diff(log.t))), 1e-9))) if len(log) > 1 else 1
    calm = np.full(len(log), bool(reach))
    for name, most in reach.items():
        known = np.where(np.isfinite(log[name]), log[name], np.nanmean(log[name]))
        calm &= maximum_filter1d(known, size) - minimum_filter1d(known, size) <= AT_REST * most
    return calm


def travel(values: np.ndarray) -> float:
    """The range of values (n,), NaN left out."""
    seen = values[np.isfinite(values)]
    return float(np.ptp(seen)) if seen.size else 0.0


def _touching(simulator: Simulator, log: Recording) -> np.ndarray:
    """Whether bodies touch at each sample (num_timesteps,) of the log."""
    states = getattr(simulator, "contact_states", None)
    if states is None:
        return np.zeros(len(log), bool)
    times, what = states(log)
    latest = np.searchsorted(times, log.t, side="right") - 1
    return np.array([bool(pairs) for pairs in what])[np.maximum(latest, 0)]


def meets(simulator: Simulator, run: Recording) -> bool:
    """Whether bodies touch along a run of a window; a touch next to its ends is its neighbour's."""
    inside = (run.t > run.t[0] + REACH) & (run.t < run.t[-1] - REACH)
    return bool(_touching(simulator, run)[inside].any())


def _readable(simulator: Simulator, log: Recording, end: int) -> int:
    """The first row from which a first window up to `end` can begin: with samples on either side.

    A log often begins with a jerk, which a parabola through later samples alone would turn into a wrong rate.
    """
    if getattr(simulator, "state_at", None) is not None:
        return 0
    row = max(int(np.searchsorted(log.t - log.t[0], REACH - 1e-9)), NEIGHBOURS // 2)
    return row if end - row >= FEWEST else 0


def _edges(log: Recording, contacts: Sequence[float], length: float) -> list[int]:
    """First rows of the windows, and the end of the last."""
    span = float(log.t[-1] - log.t[0])
    inside = sorted(m - float(log.t[0]) for m in contacts)
    marks = [0.0, *(m for m in inside if 0 <= m < span), span]
    times: list[float] = []
    for a, b in itertools.pairwise(marks):
        pieces = max(1, round((b - a) / length))
        times += list(a + (b - a) * np.arange(pieces) / pieces)
    rows = [int(np.searchsorted(log.t - log.t[0], t - 1e-9)) for t in times]
    edges = [0]
    for row in rows[1:]:
        if row - edges[-1] >= FEWEST and len(log) - row >= FEWEST:
            edges.append(row)
    return [*edges, len(log)]


def start_of(
    simulator: Simulator, log: Recording, row: int, noise: Mapping[str, float], forward: bool,
    only: Collection[str] | None = None,
) -> dict[str, tuple[float, float]]:  # fmt: skip
    """The state at a row of a log.

    Args:
        simulator: The robot's model.
        log: The log.
        row: The row.
        noise: Standard deviation of one sample by channel.
        forward: Whether later samples alone are used (see `smoothed`).
        only: Columns whose states are wanted; all by default. Each state is read from its own column.

    Returns:
        State name -> (value, standard deviation).
    """
    own = getattr(simulator, "state_at", None)
    if own is not None:
        return {n: (float(v), float(s)) for n, (v, s) in own(log, float(log.t[row])).items()}
    out: dict[str, tuple[float, float]] = {}
    states = getattr(simulator, "states", None)
    for name, channel in simulator.channels.items():
        asked = (states is None or name in states) and (only is None or name in only)
        if channel.kind == "position" and asked:
            (value, sd), (rate, rate_sd) = smoothed(log.t, log[name], row, noise[name], forward)
            out[name], out[name + RATE] = (value, sd), (rate, rate_sd)
    return out


def smoothed(
    t: np.ndarray, values: np.ndarray, row: int, noise: float, forward: bool = False
) -> tuple[tuple[float, float], tuple[float, float]]:
    """Value and rate at a row, each with its standard deviation, from a polynomial through its neighbours.

    A parabola, or a higher degree where samples show a jerk, which a parabola would turn into a wrong rate
    (AIC: Akaike, IEEE Transactions on Automatic Control 19, 1974). What the polynomial misses counts as
    noise.

    Args:
        t: Times (num_timesteps,) [s].
        values: Samples (num_timesteps,); NaN where missing.
        row: The row.
        noise: Standard deviation of one sample.
        forward: Use later samples alone, as a contact at the row changes rates.
    """
    first, end = np.searchsorted(t, (t[row] - 2 * REACH, t[row] + 2 * REACH))  # a slice of a long log
    there = np.isfinite(values[first:end]) & (np.abs(t[first:end] - t[row]) <= REACH)
    near = first + np.flatnonzero(there)
    if near.size < NEIGHBOURS or forward:
        seen = np.flatnonzero(np.isfinite(values))
        seen = seen[seen >= row] if forward and (seen >= row).sum() >= NEIGHBOURS else seen
        near = np.sort(seen[np.argsort(np.abs(t[seen] - t[row]))[: max(NEIGHBOURS, near.size // 2)]])
    since = t[near] - t[row]
    scale = float(np.abs(since).max())
    fits = [_fit(since / scale, values[near], k, noise) for k in DEGREES if near.size > k + 1]
    found, sd, _ = min(fits, key=lambda fit: fit[2])
    return (float(found[0]), float(sd[0])), (float(found[1] / scale), float(sd[1] / scale))


def _fit(x: np.ndarray, y: np.ndarray, degree: int, noise: float) -> tuple[np.ndarray, np.ndarray, float]:
    """Coefficients of a polynomial, their standard deviations, and its AIC at this noise."""
    design = np.vander(x, degree + 1, increasing=True)
    inverse = np.linalg.inv(design.T @ design)
    found = inverse @ design.T @ y
    left = float(np.sum((y - design @ found) ** 2))
    variance = max(noise**2, left / max(x.size - degree - 1, 1))
    return found, DOUBT * np.sqrt(variance * np.diag(inverse)), left / noise**2 + 2 * (degree + 1)
