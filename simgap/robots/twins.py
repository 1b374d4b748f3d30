"""Healthy twins: the simulator itself, with noise, along the same commands, through the same windows.

What their residuals have beyond noise (starts smoothed from samples, commands between samples, resolution)
is the comparison's own doing, and counts as noise in the recording.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from simgap.progress import say
from simgap.robots.linear import Linear, linearise
from simgap.robots.model import Composed, Point
from simgap.robots.noise import resolution
from simgap.robots.whiten import covariances
from simgap.robots.windows import NEIGHBOURS, REACH, STRIKES, start_of
from simgap.simulators.protocol import Channels, Job, run_all
from simgap.simulators.recording import Recording
from simgap.simulators.user import restarts

TWINS = 6  # numerics: drawn; they bound a chance from below by their ranks


@dataclass(frozen=True)
class Twins:
    """`factor` (N,) by which the recording's noise grows, each twin's residuals whitened with it, and those
    residuals as they are, in their units (0 where there are none)."""

    factor: np.ndarray
    residuals: tuple[np.ndarray, ...]
    plain: tuple[np.ndarray, ...] = ()


def healthy_twins(composed: Composed, plain: Linear, seed: int) -> Twins:
    """Twins at the plain point; where the simulator cannot be run along the logs, noise is as stated.

    The noise grows by window and channel: where a log begins in the midst of a motion its first start is read
    badly, and that is no reason to doubt the others.
    """
    rng = np.random.default_rng(seed)
    make = along_windows if _begins_anew(composed, plain.point) else along_logs
    steps = {n: max(resolution(r[n]) for r in composed.recordings) for n in composed.noise}
    # Twins start alike but for noise, and where nothing strikes that moves no sensitivity to a start.
    smooth = all(w.regime != STRIKES for w in composed.windows)
    found, left, starts = [], [], None
    for number in range(TWINS):
        say(f"{number + 1} of {TWINS}")
        twin = make(composed, plain.point, steps, rng)
        if twin is None:
            return Twins(np.ones(plain.residual.size), ())
        linear = linearise(twin, plain.point, [], starts)
        starts = linear.starts if smooth else None
        white = covariances(twin, linear).whitener()
        left.append(np.where(np.isfinite(linear.residual), linear.residual, 0.0))
        found.append(white(left[-1]))
    rows = composed.rows
    group = rows.window * len(rows.channels) + rows.channel
    ratio = np.bincount(group, np.mean(np.square(found), 0)) / np.maximum(np.bincount(group), 1)
    factor = np.sqrt(np.maximum(ratio, 1.0))[group]
    return Twins(factor, tuple(white / factor for white in found), tuple(left))


def _begins_anew(composed: Composed, point: Point) -> bool:
    """Whether windows are begun from states that are read from the logs as they are."""
    return restarts(composed.simulator) and composed.unread(point) is None


def along_windows(
    composed: Composed, point: Point, steps: Mapping[str, float], rng: np.random.Generator
) -> Composed | None:
    """The same windows, as the simulator gives them from the recorded states a little before them.

    A simulator that is driven by torques and run along a whole log would soon be elsewhere, and what noise it
    shows there is not what the recording has.
    """
    early, leads = [], []
    for window in composed.windows:
        log = composed.recordings[window.log]
        lead = 0 if window.forward else min(window.begin, _lead(log))
        begun = start_of(composed.simulator, log, window.begin - lead, composed.noise, window.forward)
        start = {n: v for n, (v, _) in begun.items()}
        early.append(replace(window, begin=window.begin - lead, start=start))
        leads.append(lead)
    wide = replace(composed, windows=tuple(early), wobble=None)
    given = wide.read(wide.rolled(point, [w.start for w in early]), point)
    windows, read = [], []
    for window, before, lead, channels in zip(composed.windows, early, leads, given, strict=True):
        windows.append(window)
        read.append(None)
        if channels is None:
            continue
        stretch = composed.recordings[window.log].window(before.begin, window.end)
        noisy = stretch.with_columns(_noisy(composed, stretch, channels, steps, rng))
        begun = start_of(composed.simulator, noisy, lead, composed.noise, window.forward)
        start, doubt = {n: v for n, (v, _) in begun.items()}, {n: s for n, (_, s) in begun.items()}
        windows[-1] = replace(window, start=start, doubt=doubt)
        read[-1] = {n: noisy[n][lead:] for n in composed.noise}
    rows = replace(composed.rows, observed=composed.rows.averaged(read))
    return None if all(r is None for r in read) else replace(composed, windows=tuple(windows), rows=rows)


def _lead(log: Recording) -> int:
    """Samples before a window's start from which that is smoothed."""
    return max(NEIGHBOURS, int(np.ceil(REACH / float(np.median(np.diff(log.t))))))


def along_logs(
    composed: Composed, point: Point, steps: Mapping[str, float], rng: np.random.Generator
) -> Composed | None:
    """The logs as the simulator itself would have given them; None where it does not follow them."""
    out = []
    commanded = composed.commanded(point)
    parameters = composed.parameters(point)
    for log, driven in zip(composed.recordings, commanded, strict=True):
        start = None
        if restarts(composed.simulator):
            found = start_of(composed.simulator, log, 0, composed.noise, True)
            start = {n: v for n, (v, _) in found.items()}
        (channels,) = run_all(composed.simulator, [Job(parameters, driven, start)])
        if channels is None:
            return None
        channels = composed.read_whole(log, channels, point)
        out.append(log.with_columns(_noisy(composed, log, channels, steps, rng)))
    return composed.like(out)


def _noisy(
    composed: Composed,
    log: Recording,
    channels: Channels,
    steps: Mapping[str, float],
    rng: np.random.Generator,
) -> dict[str, np.ndarray]:
    """Compared channels with the sensors' noise and resolution, where the log has samples."""
    columns = {}
    for name, noise in composed.noise.items():
        step = steps[name]
        stated = composed.simulator.channels[name].noise
        sd = noise if step == 0 else (stated if np.isfinite(stated) and stated > step else step / 10)
        values = channels[name] + sd * rng.standard_normal(len(log))
        values = np.round(values / step) * step if step > 0 else values
        columns[name] = np.where(np.isfinite(log[name]), values, np.nan)
    return columns
