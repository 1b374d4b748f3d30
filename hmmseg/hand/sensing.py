"""Remove readings that no working sensor can have taken, and name the faults.

Model of a working sensor: its readings scatter, so that neighbours are equal to the last digit as rarely as
elsewhere in the channel and its fellows (the other forces, the other joints); they stay within a few times
the range of all others; a position moves no farther between two samples than its velocity carries it; and
readings are missing as rarely as elsewhere in the recording. A run of repeated or missing readings is a
fault if its length is too improbable under that model, so that coarse sensors, forces held for some samples
and noiseless recordings pass. Faulty readings become missing, for segmentation and identification alike.

Forces in other units than N are invisible to mechanics, as load and inertia scale alike. Independent
knowledge reveals them: the sensor's noise if `rig.toml` states it, and the usual weight of grippers.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from hmmseg.hand.plausibility import Finding, changed, check_forces
from hmmseg.hand.tool import Tool
from hmmseg.io.rig import FORCE_CHANNELS, JOINTS, Rig
from hmmseg.io.trial import CARTESIAN_CHANNELS, Trial, position_pairs
from hmmseg.io.units import UNITS
from hmmseg.levels import CERTAIN, SURE
from hmmseg.robust import coarse_step, extent, robust_sd, runs, white_sd

NEAR = 0.3  # limit: relative error of a stated noise; units differ by factors of 4 and more
LIGHTEST, HEAVIEST = 0.08, 30.0  # limit: [kg] of a gripper with everything below its sensor
USUAL_TOOL = 1.0  # limit: [kg] of one
WHITE = -0.5  # limit: white noise has -0.56 or less; filters that reduce it to a tenth give -0.42 or more
STRETCH = 25  # numerics: samples
FORCES = ("mN", "gf", "kgf", "kN")


def check_noise(trial: Trial, rig: Rig) -> list[Finding]:
    """Fingertip forces whose noise is that of the rig times the size of another unit."""
    names = [name for name in FORCE_CHANNELS if name in trial.channels]
    if rig.noise.force is None or not names or check_forces(trial, rig):
        return []
    forces = [trial.channels[name] for name in names]
    shown = noise_of(forces)
    unit, off = _nearest_unit(rig.noise.force / shown) if shown > 0 else ("", np.inf)
    if off > NEAR or (UNITS[unit][1] > 1 and whiteness(forces) > WHITE):
        return []  # a filter reduces noise, too, but correlates neighbours
    stated = f"where [noise] force = {rig.noise.force:g} N in rig.toml"
    problem = f"has noise of {shown:.2g} {stated}: it looks like {unit}"
    return [Finding(names[0], problem, changed(names, rig, unit=unit), certain=False)]


def tool_warnings(trial: Trial, rig: Rig, tool: Tool) -> tuple[str, ...]:
    """A line if the tool's inertia is no gripper's, or differs from the stated one by a unit's factor."""
    gripper = rig.wrist
    names, inertia, stated = gripper.wrench[:3], abs(tool.inertia), gripper.tool_mass
    where = f"{trial.file}: columns {', '.join(names)}"
    likely = LIGHTEST < inertia < HEAVIEST
    if stated is not None:
        likely = _nearest_unit(stated / inertia)[1] > np.log(2)
    if likely and tool.weighed and abs(tool.mass / tool.inertia - 1) > NEAR:
        basis = "is stated to weigh" if stated is not None else "weighs, as it turns,"
        return (f"{where}: the tool {basis} {tool.mass:.3g} kg and moves like one of {tool.inertia:.3g} kg; "
                "expected one mass: gains, axes or tool_mass under [gripper] are wrong",)  # fmt: skip
    if likely:
        return ()
    unit, _ = _nearest_unit((USUAL_TOOL if stated is None else stated) / inertia)
    expected = f"{LIGHTEST:g} to {HEAVIEST:g} kg" if stated is None else f"{stated:g} kg in rig.toml"
    remedy = Finding(names[0], "", changed(names, rig, unit=unit)).remedy
    text = f"move a tool of {inertia:.3g} kg ({expected}): they look like {unit}; expected {remedy}"
    return (f"{where} {text}",)


def _nearest_unit(size: float) -> tuple[str, float]:
    """The unit of force nearest to a size [N], and the absolute logarithm of their ratio."""
    off = {unit: abs(float(np.log(size / UNITS[unit][1]))) for unit in FORCES}
    unit = min(off, key=lambda name: off[name])
    return unit, off[unit]


def _quiet_differences(channels: list[np.ndarray]) -> list[np.ndarray]:
    """Second differences in the quietest quarter of stretches, which has no contacts."""
    every = [v[np.isfinite(v)] for v in channels]
    parts = (p for v in every for p in np.array_split(v, max(1, v.size // STRETCH)))
    pieces = [np.diff(p, 2) for p in parts if p.size > 2]
    pieces.sort(key=lambda piece: float(piece @ piece) / piece.size)
    return pieces[: max(1, len(pieces) // 4)]


def whiteness(channels: list[np.ndarray]) -> float:
    """Correlation of neighbouring second differences of the noise, -2/3 if it is white."""
    pieces = _quiet_differences(channels)
    total = sum(float(piece @ piece) for piece in pieces)
    return sum(float(piece[1:] @ piece[:-1]) for piece in pieces) / total if total > 0 else 0.0


def noise_of(channels: list[np.ndarray]) -> float:
    """Noise standard deviation of one sample, from the noisiest stretch of the quietest quarter."""
    pieces = _quiet_differences(channels)
    return float(np.sqrt(np.mean(pieces[-1] ** 2) / 6)) if pieces else 0.0


# Probability below which a run of repeated or missing readings is a fault: rare in a healthy recording.
CHANCE = (1 - CERTAIN) / len(CARTESIAN_CHANNELS)
SCATTERS = -1 / 3  # numerics: correlation of second differences: -2/3 of white noise, positive if smooth
FAR = 5.0  # limit: ranges of all other readings that one may be off by; an impact is less
FEW = 0.01  # limit: share of readings that may be so far off; if more are, the others are no standard
LEAP = 20.0  # limit: noise sds that a step exceeds
FASTEST = 1.2  # limit: times the distance at the fastest velocity nearby; a sudden stop errs by half
SWEPT = 0.1  # limit: share of a position's range that its velocity covers while it stands still
MIN_ALIVE = 30  # numerics: readings that determine a channel's own noise
ROUNDING = 1e-6  # numerics: share of a channel's range; less noise is that of arithmetic
MOST = 200  # numerics: longest runs of a channel that are examined
LISTED = 3  # look: stretches in a line
STEPS = 3  # limit: of one encoder; more are motion of the hand (backlash)
SPARSE = 1 / 3  # limit: share of missing readings from which they are reported
WHOLE = 0.1  # limit: share of complete rows below which that is reported
PAUSE, USUAL = 0.6, 5.0  # limit: s, in which a subtask may hide, and usual intervals: a jump of the clock
CARTESIAN = ("x1", "y1", "x2", "y2")


@dataclass(frozen=True)
class Fault:
    """Something in a channel that no working sensor shows.

    `spans`: stretches [s] whose readings are removed; none if it is only reported.
    """

    channel: str
    problem: str
    spans: tuple[tuple[float, float], ...] = ()

    @property
    def line(self) -> str:
        """What is wrong, and when, in one line."""
        listed = [f"{a:.2f} to {b:.2f} s" for a, b in self.spans[:LISTED]]
        more = f" and {len(self.spans) - LISTED} more times" if len(self.spans) > LISTED else ""
        when = f" from {', '.join(listed)}{more}" if listed else ""
        return f"{self.channel} {self.problem}{when}"


def remove_faults(trial: Trial, rig: Rig) -> Trial:
    """The trial without faulty readings; faults are named in `faults` and `warnings`."""
    channels = {name: values.copy() for name, values in trial.channels.items()}
    found, kinds, steps = _find_gaps(trial), _group_channels(trial, rig), np.diff(trial.t)
    wide = np.flatnonzero(steps > max(PAUSE, USUAL * float(np.quantile(steps, 0.95))))
    usual = f"rows are {float(np.median(steps)):.2g} s apart: rows are missing, or the clock was set"
    found += [Fault("t", f"jumps by {steps[i]:.3g} s at {trial.t[i]:.2f} s, where {usual}")
              for i in wide[:LISTED]]  # fmt: skip
    for names, _ in kinds:
        for name in names:
            found += _remove_outliers(name, trial.t, channels[name])
    seen = {name: values.copy() for name, values in channels.items()}
    rates = dict(position_pairs(trial))
    for names, noise in kinds:
        for name in names:
            fault, stuck = _find_repeats(name, trial.t, seen, names, noise, rates.get(name))
            channels[name][stuck] = np.nan
            found += [] if fault is None else [fault]
    still = [rate for rate in rates.values() if extent(seen[rate]) == 0]
    if still and len(still) == len(rates) and not all(_rests(seen[name]) for name in rates):
        found.append(Fault(", ".join(still), "stand still though positions move, and are left out"))
        channels |= {rate: np.full(trial.t.size, np.nan) for rate in still}
    found += _remove_leaps(trial.t, channels, rates)
    trial = replace(trial, channels=channels)
    lines = tuple(f"{trial.file}: {fault.line}" for fault in found)
    return replace(trial, faults=tuple(found), warnings=(*trial.warnings, *lines))


def check_steps(trial: Trial, rig: Rig) -> Trial:
    """The trial with a warning of positions in steps coarser than their noise, and these in `step` [m].

    What stands still is then rounded alike in every sample, which no average removes: `touch_sd` has it.
    """
    across, up = ("x1", "x2"), ("y1", "y2")
    if rig.gripper is not None:
        vertical = rig.gripper.up.lstrip("-")
        up = tuple(name for axis, name in rig.gripper.position.items() if axis == vertical)
        across = rig.gripper.opening
    steps = {name: step for name in (*across, *up) if (step := coarse_step(trial.channels[name])) > 0}
    if not steps:
        return trial
    line = (f"{trial.file}: {', '.join(steps)} in steps of {1e3 * max(steps.values()):.3g} mm, more than the "
            "noise: widths and heights are known no better")  # fmt: skip
    sd = float(np.linalg.norm([steps.get(name, 0.0) for name in across]) / np.sqrt(12))
    step = tuple(max(steps.get(name, 0.0) for name in names) for names in (across, up))
    if rig.gripper is not None:  # how far its pads give is not read from the opening while they press
        step = 0.0, step[1]
    return replace(trial, touch_sd=sd, step=step, warnings=(*trial.warnings, line))


def _group_channels(trial: Trial, rig: Rig) -> list[tuple[list[str], float | None]]:
    """Channels grouped by quantity, as each is compared with its fellows, and the noise stated by the rig."""
    noise = rig.noise
    if rig.gripper is not None:
        g = rig.gripper
        kinds = [(names, None) for names in (g.wrench[:3], g.wrench[3:], g.position.values(), g.opening)]
    else:
        places = JOINTS if rig.jointed else CARTESIAN
        rates = tuple(("d" if rig.jointed else "v") + name for name in places)
        kinds = [(FORCE_CHANNELS, noise.force), (places, noise.angle if rig.jointed else noise.position),
                 (rates, noise.velocity)]  # fmt: skip
    there = [([name for name in names if name in trial.channels], sd) for names, sd in kinds]
    return [(names, sd) for names, sd in there if names]


def _remove_outliers(name: str, t: np.ndarray, values: np.ndarray) -> list[Fault]:
    """The few readings far beyond the range of all others, which are set to NaN in `values`."""
    there = np.flatnonzero(np.isfinite(values))
    few = max(1, int(FEW * there.size))
    if there.size < 4 * few:
        return []
    order = there[np.argsort(np.abs(values[there] - np.median(values[there])))]
    reach = np.ptp(values[order[:-few]])
    wild = order[-few:]
    wild = np.sort(wild[np.abs(values[wild] - np.median(values[there])) > FAR * reach])
    if not wild.size or reach == 0:
        return []
    worst = values[wild[np.argmax(np.abs(values[wild]))]]
    values[wild] = np.nan
    problem = f"reads {worst:.3g}, where its other readings span {reach:.3g}: left out"
    return [Fault(name, problem, tuple((float(t[i]), float(t[i])) for i in wild))]


def _find_repeats(name: str, t: np.ndarray, seen: dict[str, np.ndarray], fellows: list[str],
              stated: float | None, rate: str | None) -> tuple[Fault | None, np.ndarray]:  # fmt: skip
    """Runs of one value that a working sensor cannot have read, and their samples (num_timesteps,).

    `fellows`: channels of its kind, itself included; `stated`: noise of one reading; `rate`: the channel of
    its velocity.
    """
    values = seen[name]
    there = np.flatnonzero(np.isfinite(values))
    if there.size < MIN_ALIVE:
        return None, np.zeros(values.size, bool)
    shown = values[there]
    stuck = np.zeros(values.size, bool)
    standing: dict[float, list[tuple[float, float]]] = {}
    other = seen.get(name.translate(str.maketrans("12", "21")) if name[0] == "f" else "")
    repeats = sorted(runs(np.diff(shown) == 0), key=lambda run: run[0] - run[1])[:MOST]
    moving = np.delete(shown, slice(*repeats[0]) if repeats else [])  # a stuck sensor's one value is no step
    rounded = name not in FORCE_CHANNELS and coarse_step(moving) > 0  # and repeats itself at rest
    least = _share_of_repeats([seen[f] for f in fellows if f != name], shown.size)  # quick, for most runs
    for start, stop in repeats:
        value, at = float(shown[start]), there[start : stop + 1]
        # If the other finger's force is exactly zero as well, the sensors suppress small readings.
        if stop - start < 2 or (value == 0 and other is not None and np.mean(other[at] == 0) > 0.5):
            continue
        unlikely = (
            not rounded
            and _unlikely(stop - start, least, shown.size)
            and _unlikely(stop - start, _chance_of_repeat(name, value, at, seen, fellows, stated), shown.size)
        )
        if unlikely or (rate is not None and _is_swept(at, t, values, seen[rate])):
            stuck[at] = True
            standing.setdefault(value, []).append((float(t[at[0]]), float(t[at[-1]])))
    if not standing:
        return None, stuck
    value, spans = max(standing.items(), key=lambda entry: sum(b - a for a, b in entry[1]))
    every = tuple(sorted(span for some in standing.values() for span in some))
    if not (shown != value).any():
        problem = f"reads {value:.4g} in every row"
    elif len(spans) > 1 and abs(value) == np.abs(shown).max():
        problem = f"goes no farther than {value:.4g}: it saturates"
    else:
        problem = f"repeats {value:.4g} to the last digit"
    return Fault(name, f"{problem}, and is left out", every), stuck


def _is_swept(at: np.ndarray, t: np.ndarray, values: np.ndarray, rate: np.ndarray) -> bool:
    """Whether a live velocity carries a position far while the position repeats itself (samples `at`)."""
    known = rate[at][np.isfinite(rate[at])]
    if known.size < MIN_ALIVE // 3 or _rests(rate, at):
        return False
    v, steps = np.nan_to_num(rate[at]), np.diff(t[at])
    way = float(np.ptp(np.cumsum(steps * (v[1:] + v[:-1]) / 2)))
    by_noise = white_sd(known, 1) * float(np.median(steps)) * np.sqrt(steps.size)
    return bool(way > max(SWEPT * extent(values), SURE * by_noise))


def _chance_of_repeat(name: str, value: float, at: np.ndarray, seen: dict[str, np.ndarray],
                      fellows: list[str], stated: float | None) -> float:  # fmt: skip
    """Probability that a reading repeats the one before: how often others of the channel and its fellows do.

    1 if readings do not scatter, as far as they and the rig show, or the hand waits.
    """
    own = np.where(seen[name] == value, np.nan, seen[name])
    others = [seen[fellow] for fellow in fellows if fellow != name]
    alive = [own] if np.isfinite(own).sum() > MIN_ALIVE else [v for v in others if not _rests(v)]
    waits = all(_rests(v, at) for v in others)
    scatter = whiteness(alive) <= SCATTERS or (stated is not None and not waits)
    if not any(extent(v) > 0 for v in alive) or not scatter or (waits and name not in FORCE_CHANNELS):
        return 1.0
    return _share_of_repeats([own, *others])


def _share_of_repeats(channels: list[np.ndarray], more: int = 0) -> float:
    """Probability that a reading repeats the one before, if none of `more` readings elsewhere does."""
    differences = [np.diff(v[np.isfinite(v)]) for v in channels]
    pairs, repeats = (sum(d.size for d in differences), sum(int((d == 0).sum()) for d in differences))
    return (repeats + 1) / (pairs + more + 2)


def _unlikely(length: int, chance: float, count: int) -> bool:
    """Whether a run of `length` samples, each of this chance, is too improbable anywhere among `count`."""
    return bool(np.log(count) + length * np.log(chance) < np.log(CHANCE))


def _rests(values: np.ndarray, at: np.ndarray | slice = slice(None)) -> bool:
    """Whether (a stretch of) a channel mostly repeats itself, up to rounding."""
    stretch = values[at]
    steps = np.diff(stretch[np.isfinite(stretch)])
    return not steps.size or bool(np.mean(np.abs(steps) <= ROUNDING * extent(values)) > 0.5)


def _remove_leaps(t: np.ndarray, channels: dict[str, np.ndarray], rates: dict[str, str]) -> list[Fault]:
    """A single position that steps as its velocity does not; the samples in doubt are set to NaN.

    If several positions step, the hand does (backlash). A clock that errs moves all positions at once, each
    by its velocity, so that the others tell by how much.
    """
    periods, usual = np.diff(t), float(np.median(np.diff(t)))
    near = periods < 1.5 * usual  # velocities do not bridge a gap
    alive = {n: of for n, of in rates.items()
             if np.isfinite(np.diff(channels[n] + channels[of])[near]).sum() >= MIN_ALIVE}  # fmt: skip
    q, v = (np.array([channels[n] for n in names]).reshape(-1, t.size) for names in (alive, alive.values()))
    speeds = (v[:, 1:] + v[:, :-1]) / 2
    excess = np.where(near, np.diff(q) - periods * speeds, np.nan)
    noise = np.array([robust_sd(e[np.isfinite(e)]) for e in excess])[:, None]
    padded = np.pad(np.nan_to_num(np.abs(v)), ((0, 0), (2, 2)), mode="edge")
    fastest = np.lib.stride_tricks.sliding_window_view(padded, 6, axis=1).max(axis=2)
    least = np.maximum(LEAP * noise, FASTEST * fastest * periods)
    stepping = np.flatnonzero((np.abs(excess) > least).any(axis=1))
    if stepping.size != 1:
        return []
    k, name = stepping[0], list(alive)[stepping[0]]
    seen = np.nan_to_num(np.delete([speeds * excess, speeds**2], k, axis=1)).sum(axis=1)
    error = seen[0] / (seen[1] + (noise[k] / usual) ** 2)
    far = np.fmin(np.abs(excess[k]), np.abs(excess[k] - speeds[k] * error)) > least[k]
    steps = np.where(far, excess[k], 0.0)
    at, offset = np.flatnonzero(steps), np.r_[0.0, np.cumsum(steps)]
    if not 0 < at.size <= STEPS:
        return []
    away = np.flatnonzero(np.abs(offset) > np.abs(steps[at]).min() / 2)
    problem = f"jumps by {steps[at[0]]:.3g} at {t[at[0] + 1]:.2f} s, as its velocity does not"
    if away[-1] == t.size - 1:  # it never comes back: either side may be wrong
        first, last, why = 0, t.size - 1, ": which side is right nothing tells, so it is left out"
    else:
        first, last, why = away[0], away[-1], ", and is left out"
    channels[name][first : last + 1] = np.nan
    return [Fault(name, problem + why, ((float(t[first]), float(t[last])),))]


def _find_gaps(trial: Trial) -> list[Fault]:
    """Channels with few readings or long gaps, and rows that are hardly ever complete."""
    gone = {name: ~np.isfinite(values) for name, values in trial.channels.items()}
    out = []
    for name, lost in gone.items():
        share, long = float(lost.mean()), []
        for start, stop in runs(lost):
            chance = (lost.sum() - (stop - start) + 1) / (lost.size - (stop - start) + 2)
            if _unlikely(stop - start, chance, lost.size) and trial.t[stop - 1] - trial.t[start] > PAUSE:
                long.append((float(trial.t[start]), float(trial.t[stop - 1])))
        if long:
            out.append(Fault(name, "has no readings", tuple(long)))
        elif share > SPARSE:
            out.append(Fault(name, f"lacks {share:.0%} of its readings"))
    if len(out) == len(gone) and len({fault.problem + str(fault.spans) for fault in out}) == 1:
        return [replace(out[0], channel="every channel")]
    whole = float((~np.any(list(gone.values()), axis=0)).mean())
    if not out and whole < WHOLE:
        rows = "every row" if whole == 0 else f"all but {whole:.0%} of the rows"
        return [Fault(rows, "without some reading")]
    return out
