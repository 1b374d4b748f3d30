"""Figures of a diagnosis: from its JSON where the gap is, which causes are suspected and how far it shrinks;
from the signals, the recorded, simulated and corrected course where they differ most."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import LogFormatter

from hmmseg.plot.style import BLUE, GREY, ORANGE, RED, canvas
from simgap.gap.diagnose import Diagnosis, channels
from simgap.generic.diagnose import GenericDiagnosis
from simgap.report.finding import CHANNELS, by_place, chances, plain_name, share_of
from simgap.report.robot import Course, Own, courses, residuals
from simgap.robots.changes import Changes
from simgap.robots.diagnose import RobotDiagnosis

Body = Mapping[str, Any]


def draw_all(
    found: Diagnosis | GenericDiagnosis, subtasks: Sequence[str], path: Callable[[str], Path]
) -> None:
    """Draw all figures of a diagnosis, at the paths that `path(name)` gives."""
    body = found.body
    draw_heat_map(body, subtasks, path("gap_where.png"))
    draw_suspects(body, path("gap_probabilities.png"))
    if isinstance(found, GenericDiagnosis):
        _draw_mean_course(found, path("gap_signal.png"))
    else:
        _draw_trial(found, path("gap_signal.png"))
    if body.get("shrinkage") and body["shrinkage"].get("before") is not None:
        draw_how_far(body, path("gap_before_after.png"))


def draw_heat_map(body: Body, subtasks: Sequence[str], path: Path | None = None) -> Axes:
    """Heat map of the gap's share by channel and subtask, over all trials."""
    cells = by_place(body)
    channels = [*CHANNELS, *sorted({k[0] for k in cells} - set(CHANNELS))]
    if not set(CHANNELS) & {k[0] for k in cells} and cells:
        channels = sorted({k[0] for k in cells})
    grid = np.full((len(channels), len(subtasks)), np.nan)
    for (channel, subtask), found in cells.items():
        if subtask in subtasks:
            grid[channels.index(channel), list(subtasks).index(subtask)] = 100 * share_of(found)
    with canvas(path, height=1.4 + 0.2 * len(channels)) as figure:
        axes = figure.add_subplot()
        top = float(np.nanmax(grid)) if np.isfinite(grid).any() else 1.0
        shown = axes.imshow(grid, aspect="auto", cmap="Oranges", vmin=0, vmax=max(top, 1.0))
        axes.set_yticks(range(len(channels)), channels)
        axes.set_xticks(range(len(subtasks)), [s.replace(" ", "\n") for s in subtasks])
        for (row, column), value in np.ndenumerate(grid):
            if np.isfinite(value):
                text = "<1" if value < 0.5 else f"{value:.0f}"
                colour = "white" if value > 0.6 * top else "black"
                axes.text(column, row, text, ha="center", va="center", color=colour)
        figure.colorbar(shown, label="share of the gap [%]")
        axes.set_title("Where recording and model differ (blank: within the noise)")
    return axes


def draw_suspects(body: Body, path: Path | None = None) -> Axes:
    """Probability that each suspect acts, and the share of the gap it explains; else the verdict's sets."""
    effects = body.get("attribution") or {}
    known = chances(body) if effects else body["probabilities"]
    names = sorted(effects or known, key=lambda name: -known[name])[:8][::-1]
    at = np.arange(len(names))
    with canvas(path, height=2.6) as figure:
        axes = figure.add_subplot()
        chance = [known[name] for name in names]
        axes.barh(at, chance, 0.6, color=BLUE, alpha=0.85, label="probability that it acts")
        for k, entry in enumerate(effects.get(name, {}) for name in names):
            share = entry.get("share")
            if share is not None and entry["probability"] >= 0.01:
                ends = entry.get("interval_90") or (share, share)
                axes.plot(ends, [k, k], color=RED, lw=1.4)
                label = "share of the gap" if k == len(names) - 1 else None
                axes.plot(share, k, "o", color=RED, ms=4, label=label)
        axes.set_yticks(at, [*map(plain_name, names)])
        axes.set(xlim=(0, 1.02))
        axes.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=2)
    return axes


def draw_how_far(body: Body, path: Path) -> None:
    """Mean squared residual of held-out trials before and after correction, and what healthy ones leave."""
    s = body["shrinkage"]
    with canvas(path, height=1.7) as figure:
        axes = figure.add_subplot()
        axes.barh([1, 0], [s["before"], s["after"]], 0.55, color=[RED, BLUE])
        axes.axvline(s["noise_floor"], color=GREY, lw=1, ls="--", label="left by healthy recordings")
        axes.set_yticks([1, 0], ["the model as it is", "with the cause in it"])
        if s["before"] > 20 * max(s["after"], 1e-9):
            axes.set_xscale("log")
        axes.set_xlabel(f"mean squared residual on {s['evaluated_on']} [noise variances]")
        axes.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0))  # above the bars, which may reach the edge


def _unit(channel: str) -> tuple[float, str]:
    """Factor and label with which a channel of task space is plotted."""
    if channel in ("fx", "fy", "grip", "shear"):
        return 1.0, f"{'net ' if channel.startswith('f') else ''}{channel} [N]"
    return 100.0, f"{channel} [cm{'/s' if channel.startswith('v') else ''}]"


def _draw_trial(found: Diagnosis, path: Path) -> None:
    """Draw channel and trial of the largest excess: recorded, simulated, corrected."""
    frame = found.problem.frame
    there = found.problem.there.astype(float)
    own = np.eye(len(frame.steps))[frame.arrays.subtask]
    square, count = (np.einsum("rns,rnc->rsc", own, there * z) for z in (found.before**2, 1.0))
    excess = np.where(count > 0, square - count, -np.inf)
    r, subtask, c = (int(k) for k in np.unravel_index(excess.argmax(), excess.shape))
    channel, n = list(CHANNELS)[c], frame.lengths[r]
    t, there = frame.world.t[r, :n], found.problem.there[r, :n, c]
    with canvas(path, height=3.4) as figure:
        above, below = figure.subplots(2, 1, sharex=True)
        factor, label = _unit(channel)
        lesser = np.minimum(frame.world.force[r, :n, 0], -frame.world.force[r, :n, 2])
        recorded = lesser if channel == "grip" else channels(frame.world)[r, :n, c]
        above.plot(t, factor * recorded, color="black", lw=1.2, label="recorded")
        off = found.problem.weight[r, :n, c]
        for residual, colour, name in ((found.before, RED, "simulated"), (found.after, BLUE, "corrected")):
            left = np.divide(residual[r, :n, c], off, out=np.full(n, np.nan), where=off > 0)
            above.plot(t, factor * (recorded - left), ".", color=colour, ms=2, label=name)
        above.set_ylabel(label)
        above.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=3)
        inside = t[frame.arrays.subtask[r, :n] == subtask]
        for axes in (above, below):
            for event in frame.world.events[r]:
                axes.axvline(event, color=GREY, lw=0.5)
            axes.axvspan(inside[0], inside[-1], color=ORANGE, alpha=0.2, lw=0)
        below.plot(t[there], found.before[r, :n, c][there], ".", color=RED, ms=3)
        below.plot(t[there], found.after[r, :n, c][there], ".", color=BLUE, ms=3)
        below.set_yscale("symlog", linthresh=3)
        below.set(xlabel="time [s]", ylabel="residual [sd]")
        above.set_title(f"{channel} in {frame.files[r]}, largest gap shaded", loc="left")


def _draw_mean_course(found: GenericDiagnosis, path: Path) -> None:
    """Draw the slow course with the largest excess in a subtask: real, simulated, corrected."""
    lay = found.scene.layout
    excess = (found.real.mean(0) - found.sim.mean(0)) ** 2 / found.variance
    t = (found.scene.bins[1:] + found.scene.bins[:-1]) / 2
    slow = [lay.of_channel(c)[: t.size] for c in range(len(lay.ensembles.channels))]
    starts = np.cumsum([0, *lay.bins[:-1]])
    mean = np.add.reduceat(excess[slow], starts, 1) / lay.bins  # (channels, subtasks)
    channel, worst = np.unravel_index(mean.argmax(), mean.shape)
    index = slow[channel]
    real, sim = found.real[:, index], found.sim[:, index]
    with canvas(path, height=3.8) as figure:
        above, below = figure.subplots(2, 1, sharex=True)
        for rows, colour, label in ((real, RED, "real"), (sim, BLUE, "simulated")):
            above.plot(t, rows.T, color=colour, lw=0.5, alpha=0.35)
            above.plot(t, rows.mean(0), color=colour, lw=1.4, label=label)
        moved = sim.mean(0) + found.shift[index]
        if found.leading:
            what = " + ".join(found.leading)
            above.plot(t, moved, color="black", lw=1, ls="--", label=f"corrected: {what}")
        above.legend(fontsize=6.5)
        above.set_ylabel(lay.ensembles.channels[channel])
        sd = np.sqrt(found.variance[index])
        below.plot(t, (real.mean(0) - sim.mean(0)) / sd, ".-", color=RED, ms=3, lw=0.6, label="before")
        below.plot(t, (real.mean(0) - moved) / sd, ".-", color=BLUE, ms=3, lw=0.6, label="after")
        below.set_yscale("symlog", linthresh=3)
        below.set(xlabel="time [s], subtasks at their mean real durations", ylabel="residual [sd]")
        below.legend()
        for axes in (above, below):
            for edge in found.scene.edges[1:-1]:
                axes.axvline(edge, color=GREY, lw=0.5)
            axes.axvspan(*found.scene.edges[worst : worst + 2], color="#E69F00", alpha=0.15, lw=0)
        above.set_title(f"Largest difference of a course: {lay.ensembles.channels[channel]} (shaded subtask)")


Robot = RobotDiagnosis | Changes


def draw_robot(
    found: Robot, body: dict[str, Any], own: Mapping[str, Own], path: Callable[[str], Path]
) -> None:
    """Draw all figures of a robot's diagnosis, at the paths that `path(name)` gives."""
    phases = sorted({cell["subtask"] for cell in body["where"]})
    if phases:
        draw_heat_map(body, phases, path("gap_where.png"))
    draw_course(max(courses(found, own), key=lambda c: c.over), found, path("gap_signal.png"))
    if isinstance(found, RobotDiagnosis):
        draw_suspects(body, path("gap_probabilities.png"))
        draw_before_after(found, path("gap_before_after.png"))


def _short(name: str) -> str:
    stem = Path(name).stem
    return stem if len(stem) <= 22 else "…" + stem[-21:]


def draw_course(one: Course, found: Robot, path: Path) -> None:
    """Draw a course recorded, simulated and corrected, with the residuals beneath."""
    if isinstance(found, Changes):
        names, how = ("as it was", "with what changed"), "run freely from its first sample"
    else:
        last = "with the causes, held out" if found.shrinkage is not None else "with what was fitted"
        names, how = ("model as it came", last), "windows restarted from the recording"
    with canvas(path, height=4.2) as figure:
        above, below = figure.subplots(2, 1, sharex=True)
        above.plot(one.t, one.recorded, color="black", lw=1.2, label="recorded")
        for run, colour, name in zip((one.simulated, one.corrected), (RED, BLUE), names, strict=True):
            above.plot(one.t, run, color=colour, lw=0.8, label=name)
            below.plot(one.t, one.recorded - run, color=colour, lw=0.8)
        above.set_ylabel(f"{one.channel} [{one.unit}]")
        below.set(xlabel="time [s]", ylabel=f"residual [{one.unit}]")
        below.axhline(0, color=GREY, lw=0.5)
        above.legend(fontsize=6.5)
        above.set_title(f"{_short(one.log)}: {how}")


def draw_before_after(found: RobotDiagnosis, path: Path) -> None:
    """Root mean square residual by log before and after correction, held out if it was cross-validated."""
    rows, both = found.composed.rows, residuals(found)
    logs = [r.name for r in found.composed.recordings]
    size = np.sqrt(rows.variance)
    at = np.arange(len(logs))
    with canvas(path, height=2.6) as figure:
        axes = figure.add_subplot()
        for place, left, colour, how in zip((-0.2, 0.2), both, (RED, BLUE), ("before", "after"), strict=True):
            each = [np.sqrt(np.nanmean(((left / size)[rows.log == k]) ** 2)) for k in at]
            axes.bar(at + place, each, 0.4, color=colour, label=how)
        axes.axhline(1, color=GREY, lw=0.8, ls="--")
        axes.set_yscale("log")
        axes.yaxis.set_major_formatter("{x:g}")
        axes.yaxis.set_minor_formatter(LogFormatter())  # within one decade only
        axes.set_xticks(at, [_short(n) for n in logs], rotation=30, ha="right", fontsize=6)
        axes.set_ylabel("rms residual [sd of noise]")
        axes.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=2)
        axes.set_title("Held-out logs" if found.shrinkage is not None else "All logs")
