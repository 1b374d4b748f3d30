"""Aligned trials as padded arrays: the world that effects change, and what the contact equations need."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from hmmseg.contact.decompose import FREE, Subtask, height_equations
from hmmseg.errors import InputError
from hmmseg.hand.kinematics import forward, joint_velocity, tip_velocity
from hmmseg.hand.signals import Signals, group_size, grouped, task_space
from hmmseg.io.rig import FORCE_CHANNELS, JOINTS, Finger, Rig
from hmmseg.io.task import BlockTask
from hmmseg.io.trial import Trial
from hmmseg.levels import SURE
from hmmseg.robust import bridged
from hmmseg.segmentation.align import AlignedTrials
from simgap.effects import catalogue, forms_of, free_parameters
from simgap.effects.base import World
from simgap.gap.rounding import rounding_error, rounding_step
from simgap.gap.sensor_noise import (
    between_samples,
    changes,
    channel_noise,
    kinks,
    mean_of,
    motion_doubt,
    of_a_kink,
    residual_noise,
    sample_noise,
    sensor_sd,
)
from simgap.phases import Phase, phase_of

# What a sensor in the wrist can show of the gap: net forces and where the hand is.
#
# The channels of two fingers are derived from the wrist's (`hmmseg.hand.wrist`): each has half of the force,
# both are at one height, and velocities are differences of positions. Derived channels agree by construction
# and are not compared; effects on one finger or between the two are not considered.

DERIVED = ("offset", "shear", "vx", "vy")
GRIP = ("distance", "grip")  # without a grip force, pads' compression is part of the opening
NOT_COMPARED = (
    "a wrist sensor feels the sum of both fingers: net forces and positions are compared, {absent} are not, "
    "and effects on one finger or inside the grip are not thought of"
)


def of_wrist(trials: Sequence[Trial]) -> bool:
    """Whether these recordings are from a sensor in the wrist."""
    return any(trial.inertia is not None for trial in trials)


def absent(trial: Trial) -> tuple[str, ...]:
    """Channels that a trial lacks although its two derived fingers have them."""
    if trial.inertia is None:
        return ()
    return (*DERIVED, *GRIP) if "friction" in trial.hidden else DERIVED


def shown(names: Sequence[str]) -> list[str]:
    """Effects on net forces or on where things are.

    Offsets, drift, drag and the tool's own mass are not among them: they are estimated in free motion and
    removed (`hmmseg.hand.tool`).
    """
    return [n for n in names if catalogue()[n].wrist]


def shown_forms(names: Sequence[str]) -> list[str]:
    """Keys of the forms of effects that act on both fingers alike."""
    return [key for n in shown(names) for key in forms_of(n)[:1] if free_parameters(key)]


def check_forced(forced: Sequence[str]) -> None:
    """Check that a wrist sensor shows the forced effects.

    Raises:
        InputError: One of them it does not show.
    """
    known = shown(list(catalogue()))
    for name in forced:
        if name not in known:
            problem = "acts in the grip, on one finger or on what free motion takes out, unseen by a wrist"
            raise InputError(f"effect {name!r}", problem, ", ".join(known))


# One aligned trial as arrays over its samples: signals, states, noise, and where each equation holds.

CHANNELS = ("x", "y", "distance", "offset", "vx", "vy", "fx", "fy", "grip", "shear")
OFFSET, NET, FORCES, GRIP_FORCE = 3, slice(6, 8), slice(6, 10), 8  # physics: places among CHANNELS
BORNE = ("x", "y", "fx", "fy")  # channels whose equations distinguish a supported block from a lifted one
LOST = 0.05  # chosen: share of the neighbouring grip forces below which a sample's forces are lost
MAX_RATE = 30.0  # chosen: Hz; finer samples are averaged first
# chosen: probability that a boundary lies beyond a sample above which the sample belongs to neither side
EITHER_SIDE = 0.02
FIRST_TOUCH = 0.2  # chosen: s; longest time between the two fingers' touches, or releases


def without_dropouts(trial: Trial) -> Trial:
    """Mark forces as missing where a finger reads nothing for a single sample within a grip.

    No finger can let go and grip again within one sample: the reading was lost. If a simulator lost the
    contact, the other finger's reading is wrong too.
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


def thinned(trial: Trial, rig: Rig) -> tuple[Trial, int]:
    """Average a trial down to MAX_RATE at most.

    Lost readings are left out. Angles and rates are those of the tips' mean positions and velocities, as a
    fast finger is not where its mean angles are.

    Returns:
        The trial, and the number of samples averaged into one.
    """
    trial = without_dropouts(trial)
    group = group_size(trial.rate, MAX_RATE)
    if group <= 1:
        return trial, 1
    inertia = None if trial.inertia is None else grouped(trial.inertia, group)[0]
    channels = {k: grouped(v, group)[0] for k, v in trial.channels.items()}
    for number in (1, 2) if rig.jointed else ():
        channels |= _of_mean_tip(trial, channels, rig.finger(number), number, group)
    t = grouped(trial.t, group)[0]
    return Trial(trial.file, t, channels, hidden=trial.hidden, inertia=inertia), group


def _of_mean_tip(
    trial: Trial, means: dict[str, np.ndarray], finger: Finger, number: int, group: int
) -> dict[str, np.ndarray]:
    """Angles and rates of one finger at its tip's mean position and velocity, linearised at their `means`."""
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


def trial_arrays(
    trial: Trial, quantiles: np.ndarray, steps: tuple[Subtask, ...], rig: Rig
) -> dict[str, np.ndarray]:
    """One trial's signals, states and noise as arrays over its samples.

    `quantiles` (3, B) [s] of every boundary: EITHER_SIDE, the median, and 1 - EITHER_SIDE.
    """
    trial, group = thinned(trial, rig)
    first, boundaries, last = quantiles
    signals = task_space(trial, rig)
    t, step = trial.t, np.median(np.diff(trial.t))
    subtask = np.searchsorted(boundaries, t, side="right")
    phase = np.array([phase_of(s) for s in steps])[subtask]
    free, carry = phase == Phase.FREE, phase == Phase.CARRY
    edge = np.abs(t[:, None] - boundaries).min(axis=1) < step
    force = np.stack([signals.__dict__[c] for c in FORCE_CHANNELS], 1)
    names = JOINTS if rig.jointed else ("x1", "y1", "x2", "y2")
    joints = np.stack([trial.channels[n] for n in names], 1)
    speeds = trial.channels if rig.jointed else signals.__dict__
    rates = np.stack([speeds[f"d{n}" if rig.jointed else f"v{n}"] for n in names], 1)
    there = _there(t, phase, *(np.asarray(np.isfinite(z).all(1)) for z in (force, joints, rates)))
    # Missing samples are interpolated; they are masked where they count.
    force, joints, rates = (np.stack([bridged(c, t) for c in z.T], 1) for z in (force, joints, rates))
    sample = sample_noise(signals, group)
    plain = residual_noise(sample, rig, step)
    # The finger that touches first pushes the block for a while, and so does a closing hand; a carried block
    # swings in the grip as the hand speeds up.
    push = changes(mean_of(signals, "x"), sample["x"] / np.sqrt(2))
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
    lifts = carried[1:] != carried[:-1]  # a block leaves or meets a support
    either = ((first[lifts] <= t[:, None]) & (t[:, None] <= last[lifts])).any(axis=1)
    there[np.ix_(either, np.isin(CHANNELS, BORNE))] = 0.0
    if group > 1:  # a mean over a contact change belongs to neither contact
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
        "sample": channel_noise(sample) * np.sqrt(group),  # of one recorded sample
        "subtask": subtask,
        "move": _moves(t, boundaries, steps, subtask),
        "phase": np.eye(len(Phase))[phase],
    }


def _struck(force: np.ndarray, sd: np.ndarray) -> np.ndarray:
    """Samples (N,) next to a finger's touch or release, where its speed jumps unseen by any difference."""
    touches = np.hypot(force[:, ::2], force[:, 1::2]) > SURE * sd[:, None]
    change = np.pad((touches[1:] != touches[:-1]).any(axis=1), (2, 2))
    return change[:-3] | change[1:-2] | change[2:-1] | change[3:]


def _shaken(
    signals: Signals, sample: dict[str, np.ndarray], force: np.ndarray, carried: np.ndarray,
    subtask: np.ndarray, step: float, group: int,
) -> np.ndarray:  # fmt: skip
    """Jump (N,) of a carried block's load near each sample, times gravity."""
    weight, root2 = np.zeros(carried.size), np.sqrt(2.0)
    for s in np.unique(subtask[carried]):
        mine = subtask == s
        weight[mine] = max(float(np.median(force[mine, 1] + force[mine, 3])), 0.0)
    jumps = np.hypot(*(kinks(mean_of(signals, v), sample[v] / root2) for v in ("vx", "vy")))
    # Differences of velocities see one side or the other of a jump, and what pads hold rings as much again in
    # both directions, as it turns in the grip as well.
    return weight * root2 * of_a_kink(group)[1] / step * jumps


def _one_finger(
    t: np.ndarray,
    force: np.ndarray,
    subtask: np.ndarray,
    free: np.ndarray,
    boundaries: np.ndarray,
    sd: np.ndarray,
) -> np.ndarray:
    """Samples (N,) of free motion next to a grip at which only one finger touches, or one presses harder.

    Such a touch, of the block or of its support, is a contact that the task does not list, and no gap: what
    the support's friction holds need not balance. One finger's force departs from its median in that free
    motion and the other's does not, or not against it; `sd` (N,) is the noise of a force [N].
    """
    out = np.zeros(t.size, bool)
    for s in np.unique(subtask[free]):
        mine = np.flatnonzero(subtask == s)
        change = force[mine] - np.median(force[mine], axis=0)
        touches = np.abs(change.reshape(-1, 2, 2)).max(axis=2) > SURE * sd[mine, None]
        unequal = np.abs(change[:, 0] + change[:, 2]) > SURE * np.sqrt(2.0) * sd[mine]
        near = (np.abs(t[mine, None] - boundaries) < FIRST_TOUCH).any(axis=1)
        out[mine] = near & ((touches[:, 0] != touches[:, 1]) | unequal)
    return out


def _opening(signals: Signals, force: np.ndarray, free: np.ndarray) -> np.ndarray:
    """Samples (N,) right after a grip at which the fingers are closer than unloaded pads would be.

    Pads recover late: opening fingers lose the block while they are still closer than it is wide. The
    distance of unloaded pads is what the grip's own distances extrapolate to at zero force, whatever the
    pads' stiffness.
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
    """Move of each sample; free motion belongs to the nearer grip."""
    own = [-1 if s.state == FREE or s.move is None else s.move for s in steps]
    starts, ends = dict[int, int](), dict[int, int]()
    for k, move in enumerate(own):
        if move >= 0:
            starts.setdefault(move, boundaries[k - 1])
            ends[move] = boundaries[k] if k < len(boundaries) else t[-1]
    distance = np.stack([np.maximum(starts[m] - t, 0) + np.maximum(t - ends[m], 0) for m in sorted(starts)])
    found = np.array(own)[subtask]
    return np.where(found >= 0, found, distance.argmin(axis=0))


def _there(
    t: np.ndarray, phase: np.ndarray, force: np.ndarray, place: np.ndarray, speed: np.ndarray
) -> np.ndarray:
    """Where each channel's equation holds and all of its signals were recorded (N, C)."""
    free, carry = phase == Phase.FREE, phase == Phase.CARRY
    held, still = ~free, (phase == Phase.PICKUP) | (phase == Phase.PLACE)
    step = np.diff(t)
    even = np.zeros(t.size, bool)
    even[1:-1] = np.abs(step[1:] / step[:-1] - 1) < 0.2
    both = even & place & speed
    both[1:-1] &= (place & speed)[2:] & (place & speed)[:-2]
    near = speed.copy()
    near[1:-1] &= speed[2:] & speed[:-2]
    slid, seen, net = still | (phase == Phase.SLIDE), force & place, force & (free | (carry & near))
    x, y, apart, open_ = still & seen, slid & seen, held & seen, free & force
    return np.stack([x, y, apart, apart, both, both, net, net, open_, open_], 1).astype(float)


class Arrays(NamedTuple):
    """Constants of the contact equations: T trials, N samples, C channels, M moves, O objects.

    Attributes:
        there: 1 (T, N, C) where a residual is defined and recorded.
        sd: Standard deviation (T, N, C) of residuals from sensors and doubts, in units of the channel.
        plain: That from sensors alone (T, N, C).
        pushed: Motion of the fingers (T, N) from sample to sample beyond noise [m].
        subtask: Index of the subtask (T, N).
        onehot: Nearest move (T, N, M), one-hot.
        new: First samples (T, N, 3) with a new constant of x, y, offset.
        objects, rises: Block (M, O) of each move, and the heights that raise its destination.
        phase: Phase (T, N, 5), one-hot.
        sample: Noise (T, N, C) of a single sample of each channel itself.
        sensor: Noise (T, N, 3) of angles, rates and forces as in `World`.
    """

    there: np.ndarray
    sd: np.ndarray
    plain: np.ndarray
    pushed: np.ndarray
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
    """Aligned trials as the diagnosis needs them.

    Attributes:
        files: Names of the trials.
        steps: Subtasks of the task.
        task, rig: The task and the nominal hand.
        world: Signals, states and constants that effects change.
        arrays: Constants of the contact equations.
        lengths: Number of samples of each trial, padding left out.
        forces: Each trial's forces (N, 4) as recorded [N].
        groups: Number of recorded samples averaged into one.
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
        """Number of trials."""
        return len(self.files)

    @cached_property
    def step(self) -> float:
        """The step [N] to which forces were rounded; 0 if they were not."""
        return rounding_step(self.forces)

    @property
    def rounding_errors(self) -> np.ndarray:
        """The errors (T, N, 4) [N] from rounding that the forces themselves show."""
        out = np.zeros_like(self.world.force)
        for r, (force, group) in enumerate(zip(self.forces, self.groups, strict=True)):
            error = grouped(rounding_error(force, self.step), group)[0]
            out[r, : len(error)] = error
        return out


def build(aligned: AlignedTrials) -> Frame:
    """Assemble the frame of the trials that fit their task.

    Raises:
        ValueError: No trial fits its task.
    """
    steps, task, rig = aligned.subtasks, aligned.task, aligned.rig
    chosen = [a for a in aligned.trials if a.segmentation.complete]
    if not chosen:
        raise ValueError("no trial fits its task")
    trials = [a.trial for a in chosen]
    levels = (EITHER_SIDE, 0.5, 1 - EITHER_SIDE)
    ends = [np.array([[b.quantile(p) for b in a.boundaries] for p in levels]) for a in chosen]
    rows = [trial_arrays(t, q, steps, rig) for t, q in zip(trials, ends, strict=True)]
    length = max(r["t"].size for r in rows)
    stack = {key: _stacked([r[key] for r in rows], length) for key in rows[0] if key != "events"}
    events = np.stack([r["events"] for r in rows])
    for r, row in enumerate(rows):
        end, t = row["t"].size, stack["t"][r]
        stack["there"][r, end:] = 0.0  # padding
        # Time continues evenly, as the sampling interval is computed from it.
        t[end:] = t[end - 1] + np.median(np.diff(t[:end])) * np.arange(1, length - end + 1)
    moves = len(task.performed)
    objects, rises = np.zeros((moves, len(task.objects))), np.zeros((moves, len(task.objects)))
    for m, move in enumerate(task.performed):
        objects[m, task.objects.index(move.object)] = 1.0
    for m, rise in height_equations(task):
        for name, value in rise.items():
            rises[m, task.objects.index(name)] = value
    move, place = stack["move"], stack["phase"][..., Phase.PLACE].astype(int)
    grip, part = _others(move), _others(2 * move + place)
    new = np.stack([part, grip, grip], -1)
    own = {name: values for name, values in stack.items() if name in Arrays._fields}
    arrays = Arrays(onehot=np.eye(moves)[move], new=new, objects=objects, rises=rises, **own)
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
    """Samples (T, N) whose number differs from that of the sample before."""
    return np.diff(number, axis=1, prepend=-1) != 0


def _stacked(rows: list[np.ndarray], length: int) -> np.ndarray:
    """Stack rows of different length as one array (T, length, ...), padded with their last entries."""
    return np.stack([np.pad(r, [(0, length - len(r)), *[(0, 0)] * (r.ndim - 1)], "edge") for r in rows])


def _world(stack: dict[str, np.ndarray], events: np.ndarray, rig: Rig) -> World:
    pad, phase = rig.fingertip, stack["phase"]
    base, length = np.zeros(4), np.zeros(4)
    if rig.jointed:
        base = np.array([*rig.finger(1).base, *rig.finger(2).base])
        length = np.array([*rig.finger(1).links, *rig.finger(2).links])
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
        give_normal=np.full(2, 1 / pad.normal_stiffness),
        give_shear=np.full(2, 1 / pad.shear_stiffness),
        slip=np.zeros_like(stack["t"]),
        free=phase[..., Phase.FREE],
        ground=phase[..., Phase.PICKUP] + phase[..., Phase.PLACE] + phase[..., Phase.SLIDE],
        carry=phase[..., Phase.CARRY],
        events=events,
    )
