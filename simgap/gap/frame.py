"""Aligned trials as padded arrays: what an effect acts on and what the contact equations need."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from hmmseg.contact.decompose import FREE, Subtask, height_equations
from hmmseg.errors import InputError
from hmmseg.hand.kinematics import forward, joint_velocity, tip_velocity
from hmmseg.hand.signals import Signals, group_size, grouped, task_space
from hmmseg.io.rig import FORCE_CHANNELS, Finger, Rig
from hmmseg.io.task import BlockTask
from hmmseg.io.trial import Trial
from hmmseg.levels import SURE
from hmmseg.robust import bridged
from hmmseg.segmentation.align import AlignedTrials, TrialAlignment
from simgap.effects import catalogue, forms_of, free_parameters
from simgap.effects.base import World
from simgap.gap.sensor_noise import (
    between_samples,
    channel_noise,
    kinks,
    mean_of,
    motion_doubt,
    of_a_kink,
    pushed,
    residual_noise,
    sample_noise,
    sensor_sd,
)
from simgap.phases import Phase, phase_of

# What of the gap a sensor in the wrist can show: net forces and where the hand is.
#
# The channels of two fingers are made up from the wrist's (`hmmseg.hand.wrist`): each has half of the force,
# both have one height, and velocities are derived from positions. What was made up agrees with itself and is
# compared with nothing; effects that act on one finger or between both are not thought of.

MADE_UP = ("offset", "shear", "vx", "vy")
GRIP = ("distance", "grip")  # without a grip force what the pads give is read off the opening itself
NOT_COMPARED = (
    "a wrist sensor feels the sum of both fingers: net forces and positions are compared, {absent} are not, "
    "and effects on one finger or inside the grip are not thought of"
)


def of_wrist(trials: Sequence[Trial]) -> bool:
    """Whether these recordings are from a sensor in the wrist."""
    return any(trial.inertia is not None for trial in trials)


def absent(trial: Trial) -> tuple[str, ...]:
    """Channels that a trial has not, though its two made-up fingers do."""
    if trial.inertia is None:
        return ()
    return (*MADE_UP, *GRIP) if "friction" in trial.hidden else MADE_UP


def not_compared(trials: Sequence[Trial]) -> str:
    """One line of what a diagnosis leaves out."""
    missing = dict.fromkeys(name for trial in trials for name in absent(trial))
    return NOT_COMPARED.format(absent=", ".join(missing))


def shown(names: Sequence[str]) -> list[str]:
    """Effects that act on net forces or on where things are.

    Offsets, drift, drag and the tool's own mass are not among them: free motion takes them out
    (`hmmseg.hand.tool`).
    """
    return [n for n in names if catalogue()[n].wrist]


def shown_forms(names: Sequence[str]) -> list[str]:
    """Keys of those forms of effects that act on both fingers alike."""
    return [key for n in shown(names) for key in forms_of(n)[:1] if free_parameters(key)]


def check_forced(forced: Sequence[str]) -> None:
    """InputError for an effect that a wrist does not show."""
    known = shown(list(catalogue()))
    for name in forced:
        if name not in known:
            problem = "acts in the grip, on one finger or on what free motion takes out, unseen by a wrist"
            raise InputError(f"effect {name!r}", problem, ", ".join(known))


def as_from_wrist(trial: Trial, like: Trial) -> Trial:
    """A simulated trial of two fingers as a wrist would give it: halves, and what is made up marked."""
    c = dict(trial.channels)
    for axis in "xy":
        half = (c[f"f{axis}1"] + c[f"f{axis}2"]) / 2
        grip = (c["fx1"] - c["fx2"]) / 2 if axis == "x" else 0.0
        c[f"f{axis}1"], c[f"f{axis}2"] = half + grip, half - grip
    middle = (c["y1"] + c["y2"]) / 2
    c["y1"], c["y2"] = middle, middle
    assert like.inertia is not None
    return replace(trial, channels=c, inertia=np.zeros((trial.t.size, 2)), hidden=like.hidden)


# One aligned trial as arrays over its samples: signals, states, noise, and which equations hold where.

CHANNELS = ("x", "y", "distance", "offset", "vx", "vy", "fx", "fy", "grip", "shear")
OFFSET, NET, FORCES, GRIP_FORCE = 3, slice(6, 8), slice(6, 10), 8  # physics: places among CHANNELS
BORNE = ("x", "y", "fx", "fy")  # channels whose equations tell a block on its support from one in the air
LOST = 0.05  # chosen: share of the grip on either side below which all forces of a sample are nothing
MAX_RATE = 30.0  # chosen: Hz; finer samples are averaged first
# chosen: chance of a boundary to lie beyond a sample from which that sample is of neither side
EITHER_SIDE = 0.02
FIRST_TOUCH = 0.2  # chosen: s; one finger touches no earlier before the other, nor lets go later


def without_dropouts(trial: Trial) -> Trial:
    """The trial with forces missing where a finger's are nothing for one sample in the midst of a grip.

    No finger can let go and grip again from one sample to the next: the reading was lost. What the other
    finger reads at that sample is as wrong where a simulator lost the contact.
    """
    force = np.stack([trial.channels[c] for c in FORCE_CHANNELS], 1).reshape(-1, 2, 2)
    size, pressed = np.abs(force).max(axis=2), np.stack([force[:, 0, 0], -force[:, 1, 0]], 1)
    least, most = np.minimum(pressed[:-2], pressed[2:]), np.maximum(pressed[:-2], pressed[2:])
    held = ((least > LOST * np.nanmax(pressed, initial=0.0)) & (most < 2 * least)).all(axis=1)
    lost = held & (size[1:-1] < LOST * least).any(axis=1)
    if not lost.any():
        return trial
    gone = np.pad(lost, 1)
    channels = {k: np.where(gone, np.nan, v) if k in FORCE_CHANNELS else v for k, v in trial.channels.items()}
    return replace(trial, channels=channels)


def thinned(trial: Trial, rig: Rig, rate: float = MAX_RATE) -> tuple[Trial, int]:
    """The trial averaged down to a `rate` [Hz] at most, and how many samples went into one.

    Lost readings are left out. Angles and their rates are those of the tips' mean positions and velocities:
    a finger that moves quickly is not where its mean angles are.
    """
    trial = without_dropouts(trial)
    group = group_size(trial.rate, rate)
    if group <= 1:
        return trial, 1
    inertia = None if trial.inertia is None else grouped(trial.inertia, group)[0]
    channels = {k: grouped(v, group)[0] for k, v in trial.channels.items()}
    for number in (1, 2) if rig.jointed else ():
        channels |= _of_mean_tip(trial, channels, rig.finger(number), number, group)
    return Trial(
        trial.file, grouped(trial.t, group)[0], channels, hidden=trial.hidden, inertia=inertia
    ), group


def _of_mean_tip(
    trial: Trial, means: dict[str, np.ndarray], finger: Finger, number: int, group: int
) -> dict[str, np.ndarray]:
    """Angles and rates of one finger at its tip's mean position and velocity, from their own `means`."""
    names = [f"q{number}{k}" for k in (1, 2)]
    rates = [f"d{name}" for name in names]

    def of(channels: dict[str, np.ndarray], which: list[str]) -> np.ndarray:
        return np.stack([channels[name] for name in which], 1)

    every, angles = of(trial.channels, names), of(means, names)
    place = grouped(forward(finger, every), group)[0]
    angles = angles + joint_velocity(finger, angles, place - forward(finger, angles))
    velocity = grouped(tip_velocity(finger, every, of(trial.channels, rates)), group)[0]
    rate = joint_velocity(finger, angles, velocity)
    return dict(zip(names + rates, np.concatenate([angles, rate], 1).T, strict=True))


def boundary_quantiles(aligned: TrialAlignment) -> np.ndarray:
    """Quantiles (3, B) [s] of every boundary: nearly the first, the median and nearly the last it may be."""
    levels = (EITHER_SIDE, 0.5, 1 - EITHER_SIDE)
    return np.array([[b.quantile(p) for b in aligned.boundaries] for p in levels])


def trial_arrays(
    trial: Trial, quantiles: np.ndarray, steps: tuple[Subtask, ...], rig: Rig
) -> dict[str, np.ndarray]:
    """One trial's signals, states and noise, arrays over its samples."""
    trial, group = thinned(trial, rig)
    first, boundaries, last = quantiles
    signals = task_space(trial, rig)
    t, step = trial.t, np.median(np.diff(trial.t))
    subtask = np.searchsorted(boundaries, t, side="right")
    phase = np.array([phase_of(s) for s in steps])[subtask]
    free, carry = phase == Phase.FREE, phase == Phase.CARRY
    edge = np.abs(t[:, None] - boundaries).min(axis=1) < step
    force = np.stack([signals.__dict__[c] for c in FORCE_CHANNELS], 1)
    names = ("q11", "q12", "q21", "q22") if rig.jointed else ("x1", "y1", "x2", "y2")
    joints = np.stack([trial.channels[n] for n in names], 1)
    if rig.jointed:
        rates = np.stack([trial.channels[f"d{n}"] for n in names], 1)
    else:
        rates = np.stack([signals.vx1, signals.vy1, signals.vx2, signals.vy2], 1)
    there = _there(t, phase, *(np.asarray(np.isfinite(z).all(1)) for z in (force, joints, rates)))
    force, joints, rates = (_filled(t, z) for z in (force, joints, rates))
    sample = sample_noise(signals, group)
    plain = residual_noise(sample, rig, step)
    push = pushed(mean_of(signals, "x"), sample["x"] / np.sqrt(2))
    sd = np.hypot(plain, motion_doubt(signals, sample, push, step, group, rig.fingertip))
    sd[:, FORCES] = np.hypot(sd[:, FORCES], between_samples(t, force, free, edge & carry, boundaries))
    shaken = _shaken(signals, sample, force, carry, subtask, step, group) / rig.gravity
    sd[:, NET] = np.hypot(sd[:, NET], shaken[:, None])
    sd[:, OFFSET] = np.hypot(sd[:, OFFSET], shaken / rig.fingertip.shear_stiffness)
    if trial.inertia is not None:
        sd[:, NET] = np.hypot(sd[:, NET], trial.inertia)
    there[:, np.isin(CHANNELS, absent(trial))] = 0.0
    there[np.ix_(_struck(force, sample["force"]), np.isin(CHANNELS, ("vx", "vy")))] = 0.0
    lone = _one_finger(t, force, subtask, free, boundaries, sample["force"])
    there[lone, FORCES] = 0.0
    there[_opening(signals, force, free), GRIP_FORCE] = 0.0
    carried = np.array([phase_of(s) == Phase.CARRY for s in steps])
    lifts = carried[1:] != carried[:-1]  # a block leaves its support or meets one
    either = ((first[lifts] <= t[:, None]) & (t[:, None] <= last[lifts])).any(axis=1)
    there[np.ix_(either, np.isin(CHANNELS, BORNE))] = 0.0
    if group > 1:  # a mean over a contact change is of neither contact
        there[np.abs(t[:, None] - boundaries).min(axis=1) <= step / 2] = 0.0
    return {
        "t": t,
        "joints": joints,
        "rates": rates,
        "force": force,
        "events": boundaries,
        "there": there,
        "sd": sd,
        "plain": plain,
        "pushed": push,
        "sensor": sensor_sd(joints, rates, sample, rig, group),
        "sample": channel_noise(sample) * np.sqrt(group),  # of one as it was recorded
        "kind": (2 * phase + edge).astype(float),
        "subtask": subtask.astype(float),
        "move": _moves(t, boundaries, steps, subtask).astype(float),
        "phase": np.eye(len(Phase))[phase],
    }


def _struck(force: np.ndarray, sd: np.ndarray) -> np.ndarray:
    """Samples (N,) next to a finger's touch or release, where its speed jumps as no difference shows."""
    touches = np.hypot(force[:, ::2], force[:, 1::2]) > SURE * sd[:, None]
    change = np.pad((touches[1:] != touches[:-1]).any(axis=1), (2, 2))
    return change[:-3] | change[1:-2] | change[2:-1] | change[3:]


def _shaken(
    signals: Signals, sample: dict[str, np.ndarray], force: np.ndarray, carried: np.ndarray,
    subtask: np.ndarray, step: float, group: int,
) -> np.ndarray:  # fmt: skip
    """By how much (N,) a carried block's load jumps near each sample, times gravity."""
    weight, root2 = np.zeros(carried.size), np.sqrt(2.0)
    for s in np.unique(subtask[carried]):
        mine = subtask == s
        weight[mine] = max(float(np.median(force[mine, 1] + force[mine, 3])), 0.0)
    jumps = np.hypot(*(kinks(mean_of(signals, v), sample[v] / root2) for v in ("vx", "vy")))
    # Differences of speeds have one or the other next to a jump, and what pads hold rings as much again, both
    # ways, for it turns in the grip as well.
    return weight * root2 * of_a_kink(group)[1] / step * jumps


def _one_finger(
    t: np.ndarray,
    force: np.ndarray,
    subtask: np.ndarray,
    free: np.ndarray,
    boundaries: np.ndarray,
    sd: np.ndarray,
) -> np.ndarray:
    """Samples (N,) of free motion next to a grip at which one finger touches already or still.

    Such a touch, of the block or of what stands below it, is a contact that the task does not list and no
    gap. One finger's force is off its own median in that free motion, the other's is not; `sd` (N,) is a
    force's noise [N].
    """
    out = np.zeros(t.size, bool)
    for s in np.unique(subtask[free]):
        mine = np.flatnonzero(subtask == s)
        change = force[mine] - np.median(force[mine], axis=0)
        touches = np.abs(change.reshape(-1, 2, 2)).max(axis=2) > SURE * sd[mine, None]
        near = (np.abs(t[mine, None] - boundaries) < FIRST_TOUCH).any(axis=1)
        out[mine] = near & (touches[:, 0] != touches[:, 1])
    return out


def _opening(signals: Signals, force: np.ndarray, free: np.ndarray) -> np.ndarray:
    """Samples (N,) right after a grip at which fingers are not yet as far apart as pads without load are.

    Pads come back late: fingers that open lose the block while they are still nearer than it is wide. How far
    apart unloaded pads are is what the grip's own distances tend to as its force does to nothing, whatever
    the pads' stiffness.
    """
    out, distance, squeeze = np.zeros(free.size, bool), signals.x2 - signals.x1, force[:, 0] - force[:, 2]
    for end in np.flatnonzero(free[1:] & ~free[:-1]) + 1:
        start = 1 + int(np.flatnonzero(free[:end]).max(initial=-1))
        grip = np.arange(start, end)[np.isfinite(distance[start:end])]
        if np.unique(squeeze[grip]).size < 2:
            continue
        unloaded = np.polyfit(squeeze[grip], distance[grip], 1)[1]
        nearer = (distance[end:] < unloaded) & free[end:]
        out[end : end + int(np.argmin(np.append(nearer, False)))] = True
    return out


def _moves(
    t: np.ndarray, boundaries: np.ndarray, steps: tuple[Subtask, ...], subtask: np.ndarray
) -> np.ndarray:
    """The move of each sample; free motion belongs to the nearer grip."""
    own = [-1 if s.state == FREE or s.move is None else s.move for s in steps]
    starts, ends = {}, {}
    for k, move in enumerate(own):
        if move >= 0:
            starts.setdefault(move, boundaries[k - 1])
            ends[move] = boundaries[k] if k < len(boundaries) else t[-1]
    distance = np.stack([np.maximum(starts[m] - t, 0) + np.maximum(t - ends[m], 0) for m in sorted(starts)])
    found = np.array(own)[subtask]
    return np.where(found >= 0, found, distance.argmin(axis=0))


def _filled(t: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Columns with missing samples interpolated (they are masked where they count)."""
    return np.stack([bridged(column, t) for column in values.T], axis=1)


def _there(
    t: np.ndarray, phase: np.ndarray, force: np.ndarray, place: np.ndarray, speed: np.ndarray
) -> np.ndarray:
    """Where each channel's equation is defined and every signal in it was recorded (N, C)."""
    free, carry = phase == Phase.FREE, phase == Phase.CARRY
    held, still = ~free, (phase == Phase.PICKUP) | (phase == Phase.PLACE)
    step = np.diff(t)
    even = np.zeros(t.size, bool)
    even[1:-1] = np.abs(step[1:] / step[:-1] - 1) < 0.2
    both = even & place & speed
    both[1:-1] &= (place & speed)[2:] & (place & speed)[:-2]
    near = speed.copy()
    near[1:-1] &= speed[2:] & speed[:-2]
    inertial = force & near
    columns = {
        "x": still & force & place,
        "y": (still | (phase == Phase.SLIDE)) & force & place,
        "distance": held & force & place,
        "offset": held & force & place,
        "vx": both,
        "vy": both,
        "fx": (free & force) | (carry & inertial),
        "fy": (free & force) | (carry & inertial),
        "grip": free & force,
        "shear": free & force,
    }
    return np.stack([columns[c] for c in CHANNELS], 1).astype(float)


class Arrays(NamedTuple):
    """Constants of the contact equations: T trials, N samples, C channels, M moves, O objects.

    `there` (T, N, C): 1 where a residual is defined and recorded; `sd` (T, N, C): how far it
    is off by sensors and in doubt, in units of the channel, `plain` by sensors alone; `pushed` (T, N) [m]:
    how far the fingers are seen to go from sample to sample; `kind` (T, N):
    2 * phase, + 1 next to a contact change; `subtask` (T, N);
    `onehot` (T, N, M): nearest move; `new` (T, N, 3): first samples with another constant of x, y, offset;
    `objects`, `rises` (M, O); `phase` (T, N, 5) one-hot; `sample` (T, N, C): noise of one sample of a channel
    itself; `sensor` (T, N, 3): that of angles, rates and forces as they are in `World`.
    """

    there: np.ndarray
    sd: np.ndarray
    plain: np.ndarray
    pushed: np.ndarray
    kind: np.ndarray
    subtask: np.ndarray
    onehot: np.ndarray
    new: np.ndarray
    objects: np.ndarray
    rises: np.ndarray
    phase: np.ndarray
    sample: np.ndarray
    sensor: np.ndarray


@dataclass(frozen=True)
class Frame:
    """Everything the diagnosis needs of aligned trials.

    `forces`: each trial's forces (N, 4) [N] as they were read, of which `groups` became one sample here.
    """

    files: tuple[str, ...]
    steps: tuple[Subtask, ...]
    task: BlockTask
    rig: Rig
    world: World
    arrays: Arrays
    lengths: tuple[int, ...]
    forces: tuple[np.ndarray, ...]
    groups: tuple[int, ...]

    @property
    def num_trials(self) -> int:
        """Number of real trials."""
        return len(self.files)


def build(aligned: AlignedTrials) -> Frame:
    """Frame of the trials that fit their task; ValueError where none does."""
    steps, task, rig = aligned.subtasks, aligned.task, aligned.rig
    chosen = [a for a in aligned.trials if a.segmentation.complete]
    if not chosen:
        raise ValueError("no trial fits its task")
    trials = [a.trial for a in chosen]
    rows = [trial_arrays(a.trial, boundary_quantiles(a), steps, rig) for a in chosen]
    length = max(r["t"].size for r in rows)
    stack = {key: _stacked([r[key] for r in rows], length) for key in rows[0] if key != "events"}
    events = np.stack([r["events"] for r in rows])
    for r, row in enumerate(rows):
        end, t = row["t"].size, stack["t"][r]
        stack["there"][r, end:] = 0.0  # padding says nothing
        # Time continues evenly, as the sampling interval is read off it.
        t[end:] = t[end - 1] + np.median(np.diff(t[:end])) * np.arange(1, length - end + 1)
    moves = len(task.performed)
    objects, rises = np.zeros((moves, len(task.objects))), np.zeros((moves, len(task.objects)))
    for m, move in enumerate(task.performed):
        objects[m, task.objects.index(move.object)] = 1.0
    for m, rise in height_equations(task):
        for name, value in rise.items():
            rises[m, task.objects.index(name)] = value
    move, place = stack["move"].astype(int), stack["phase"][..., Phase.PLACE].astype(int)
    grip, part = _others(move), _others(2 * move + place)
    arrays = Arrays(
        stack["there"],
        stack["sd"],
        stack["plain"],
        stack["pushed"],
        stack["kind"].astype(int),
        stack["subtask"].astype(int),
        np.eye(moves)[move],
        np.stack([part, grip, grip], -1),
        objects,
        rises,
        stack["phase"],
        stack["sample"],
        stack["sensor"],
    )
    lengths = tuple(r["t"].size for r in rows)
    return Frame(
        tuple(t.name for t in trials),
        steps,
        task,
        rig,
        _world(stack, events, rig),
        arrays,
        lengths,
        tuple(np.stack([t.channels[c] for c in FORCE_CHANNELS], 1) for t in trials),
        tuple(group_size(t.rate, MAX_RATE) for t in trials),
    )


def _others(number: np.ndarray) -> np.ndarray:
    """Samples (T, N) with another number than the one before."""
    return np.diff(number, axis=1, prepend=-1) != 0


def _stacked(rows: list[np.ndarray], length: int) -> np.ndarray:
    """Rows of different length as one array (T, length, ...), padded with their last entries."""
    return np.stack([np.pad(r, [(0, length - len(r)), *[(0, 0)] * (r.ndim - 1)], "edge") for r in rows])


def _world(stack: dict[str, np.ndarray], events: np.ndarray, rig: Rig) -> World:
    pad, zero = rig.fingertip, np.zeros(())
    base, length = np.zeros(4), np.zeros(4)
    if rig.jointed:
        base = np.array([*rig.finger(1).base, *rig.finger(2).base])
        length = np.array([*rig.finger(1).links, *rig.finger(2).links])
    phase = stack["phase"]
    carry = phase[..., Phase.CARRY]
    return World(
        t=stack["t"],
        joints=stack["joints"],
        rates=stack["rates"],
        force=stack["force"],
        load=np.zeros_like(stack["force"]),
        base=base,
        length=length,
        jointed=np.asarray(float(rig.jointed)),
        gravity=np.asarray(rig.gravity),
        link=np.ones(4),
        give_normal=np.full(2, 1 / pad.normal_stiffness),
        give_shear=np.full(2, 1 / pad.shear_stiffness),
        delay=np.zeros(4),
        smoothing=np.zeros(4),
        creep=zero,
        creep_time=np.ones(()),
        tilt=zero,
        give_support=zero,
        support_time=zero,
        inertia=np.ones(()),
        couple=zero,
        loudness=np.ones_like(stack["force"]),
        ring=np.array([1.0, 0.05, 0.0]),
        slip=np.zeros_like(carry),
        modes=np.zeros(6),
        free=phase[..., Phase.FREE],
        ground=phase[..., Phase.PICKUP] + phase[..., Phase.PLACE] + phase[..., Phase.SLIDE],
        carry=carry,
        events=events,
    )
