"""Aligned trials as padded arrays: what an effect acts on and what the contact equations need."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from hmmseg.contact.decompose import ABOVE_GROUND, FREE, Subtask, height_equations
from hmmseg.hand.signals import task_space
from hmmseg.io.rig import Rig
from hmmseg.io.task import BlockTask
from hmmseg.io.trial import Trial
from hmmseg.segmentation.align import AlignedTrials, TrialAlignment
from simgap.effects.base import FORCES, World
from simgap.gap.sensor_noise import channel_noise, misfit, residual_noise, sample_noise

CHANNELS = ("x", "y", "distance", "offset", "vx", "vy", "fx", "fy", "grip", "shear")
BORNE = ("x", "y", "fx", "fy")  # channels whose equations tell a block on its support from one in the air
PHASES = ("free", "pickup", "carry", "place", "slide")
MAX_RATE = 30.0  # chosen: Hz; finer samples are averaged first
TOUCHING = 5.0  # chosen: sds of a force by which a touch shows
# chosen: chance of a boundary to lie beyond a sample from which that sample is of neither side
EITHER_SIDE = 0.02
FIRST_TOUCH = 0.2  # chosen: s; one finger touches no earlier before the other, nor lets go later
TRIALS = 4  # numerics: arrays are padded to multiples of it, so that few programs are compiled


class Arrays(NamedTuple):
    """Constants of the contact equations: T trials, N samples, C channels, M moves, O objects.

    `there` (T, N, C): 1 where a residual is defined and recorded; `sd` (T, N, C): its sensor noise
    in units of the channel; `kind` (T, N): 2 * phase, + 1 beside a contact change; `subtask` (T, N);
    `onehot` (T, N, M): nearest move; `objects`, `rises` (M, O); `phase` (T, N, 5) one-hot;
    `sample` (T, N, C): noise of one sample of a channel itself.
    """

    there: np.ndarray
    sd: np.ndarray
    kind: np.ndarray
    subtask: np.ndarray
    onehot: np.ndarray
    objects: np.ndarray
    rises: np.ndarray
    phase: np.ndarray
    sample: np.ndarray


@dataclass(frozen=True)
class Frame:
    """Everything the diagnosis needs of aligned trials; the first `num_trials` rows are real."""

    files: tuple[str, ...]
    steps: tuple[Subtask, ...]
    task: BlockTask
    rig: Rig
    world: World
    arrays: Arrays
    lengths: tuple[int, ...]

    @property
    def num_trials(self) -> int:
        """Number of real trials."""
        return len(self.files)


def thinned(trial: Trial) -> tuple[Trial, int]:
    """The trial averaged down to MAX_RATE at most, and how many samples went into one."""
    group = int(np.ceil(trial.rate / MAX_RATE - 1e-6))
    if group <= 1:
        return trial, 1
    count = trial.t.size // group

    def mean(values: np.ndarray) -> np.ndarray:
        block = values[: count * group].reshape(count, group)
        there = np.isfinite(block)
        total = np.where(there, block, 0.0).sum(1)
        return np.where(there.any(1), total / np.maximum(there.sum(1), 1), np.nan)

    return Trial(trial.file, mean(trial.t), {k: mean(v) for k, v in trial.channels.items()}), group


def build(trials: Sequence[Trial], aligned: AlignedTrials, rig: Rig) -> Frame:
    """Frame of the trials that fit their task; ValueError where none does."""
    steps, task = aligned.subtasks, aligned.task
    chosen = [(trial, a) for trial, a in zip(trials, aligned.trials, strict=True) if a.segmentation.complete]
    if not chosen:
        raise ValueError("no trial fits its task")
    rows = [_row(trial, _boundaries(a), steps, rig) for trial, a in chosen]
    length = padded_length(max(r["t"].size for r in rows))
    count = -(-len(rows) // TRIALS) * TRIALS
    stack = {key: _stacked([r[key] for r in rows], length, count) for key in rows[0] if key != "events"}
    events = np.stack([r["events"] for r in rows])
    events = np.concatenate([events, np.repeat(events[-1:], count - len(rows), 0)])
    for r in range(count):
        end = rows[r]["t"].size if r < len(rows) else 0
        stack["there"][r, end:] = 0.0  # padding says nothing
        t = stack["t"][r]  # time goes on evenly, for the sampling interval is read off it
        last, step = (end, np.median(np.diff(t[:end]))) if end else (1, np.median(np.diff(rows[-1]["t"])))
        t[last:] = t[last - 1] + step * np.arange(1, t.size - last + 1)
    moves = len(task.performed)
    objects, rises = np.zeros((moves, len(task.objects))), np.zeros((moves, len(task.objects)))
    for m, move in enumerate(task.performed):
        objects[m, task.objects.index(move.object)] = 1.0
    for m, rise in height_equations(task):
        for name, value in rise.items():
            rises[m, task.objects.index(name)] = value
    onehot = np.eye(moves)[stack["move"].astype(int)]
    arrays = Arrays(
        stack["there"],
        stack["sd"],
        stack["kind"].astype(int),
        stack["subtask"].astype(int),
        onehot,
        objects,
        rises,
        stack["phase"],
        stack["sample"],
    )
    lengths = tuple(r["t"].size for r in rows)
    return Frame(
        tuple(t.name for t, _ in chosen),
        steps,
        task,
        rig,
        _world(stack, events, onehot, rig),
        arrays,
        lengths,
    )


def padded_length(samples: int) -> int:
    """Samples to pad to: 240, 480, 960, .. (ten seconds at 20 Hz fit the first)."""
    return 240 * 2 ** max(0, int(np.ceil(np.log2(samples / 240))))


def _stacked(rows: list[np.ndarray], length: int, count: int) -> np.ndarray:
    """Rows of different length as one array (count, length, ...), padded with their last entries."""
    padded = [np.pad(r, [(0, length - len(r)), *[(0, 0)] * (r.ndim - 1)], "edge") for r in rows]
    return np.stack(padded + [padded[-1]] * (count - len(rows)))


def _boundaries(aligned: TrialAlignment) -> np.ndarray:
    """Quantiles (3, B) [s] of every boundary: nearly the first, the median and nearly the last it may be."""
    levels = (EITHER_SIDE, 0.5, 1 - EITHER_SIDE)
    return np.array([[b.quantile(p) for b in aligned.boundaries] for p in levels])


def _row(trial: Trial, quantiles: np.ndarray, steps: tuple[Subtask, ...], rig: Rig) -> dict[str, np.ndarray]:
    """One trial's signals, states and noise, arrays over its samples."""
    trial, group = thinned(trial)
    first, boundaries, last = quantiles
    signals = task_space(trial, rig)
    t, step = trial.t, np.median(np.diff(trial.t))
    subtask = np.searchsorted(boundaries, t, side="right")
    phase = np.array([_phase(s) for s in steps])[subtask]
    edge = np.abs(t[:, None] - boundaries).min(axis=1) < step
    force = np.stack([signals.__dict__[c] for c in FORCES], 1)
    names = ("q11", "q12", "q21", "q22") if rig.jointed else ("x1", "y1", "x2", "y2")
    joints = np.stack([trial.channels[n] for n in names], 1)
    if rig.jointed:
        rates = np.stack([trial.channels[f"d{n}"] for n in names], 1)
    else:
        rates = np.stack([signals.vx1, signals.vy1, signals.vx2, signals.vy2], 1)
    there = _there(t, phase, *(np.asarray(np.isfinite(z).all(1)) for z in (force, joints, rates)))
    force, joints, rates = (_filled(t, z) for z in (force, joints, rates))
    sample = sample_noise(signals, rig, group)
    sd = residual_noise(signals, sample, rig, step)
    sd[:, 6:] = np.hypot(sd[:, 6:], misfit(t, force, phase == 0, edge & (phase == 2), boundaries))
    lone = _one_finger(t, force, subtask, phase == 0, boundaries, sample["force"])
    there[lone, CHANNELS.index("fx") :] = 0.0
    carried = np.array([_phase(s) == 2 for s in steps])
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
        "sample": channel_noise(sample),
        "kind": (2 * phase + edge).astype(float),
        "subtask": subtask.astype(float),
        "move": _moves(t, boundaries, steps, subtask).astype(float),
        "phase": np.eye(len(PHASES))[phase],
    }


def _one_finger(
    t: np.ndarray,
    force: np.ndarray,
    subtask: np.ndarray,
    free: np.ndarray,
    boundaries: np.ndarray,
    sd: np.ndarray,
) -> np.ndarray:
    """Samples (N,) of free motion beside a grip at which one finger touches already or still.

    Such a touch is a contact that the task does not list and no gap. One finger presses inwards, compared
    with its own median in that free motion, and the other does not; `sd` (N,) is a force's noise [N].
    """
    out = np.zeros(t.size, bool)
    for s in np.unique(subtask[free]):
        mine = np.flatnonzero(subtask == s)
        change = force[mine] - np.median(force[mine], axis=0)
        inwards = np.stack([change[:, 0], -change[:, 2]], 1) > TOUCHING * sd[mine, None]
        quiet = np.abs(change.reshape(-1, 2, 2)).max(axis=2) < TOUCHING * sd[mine, None]
        near = (np.abs(t[mine, None] - boundaries) < FIRST_TOUCH).any(axis=1)
        out[mine] = near & ((inwards[:, 0] & quiet[:, 1]) | (inwards[:, 1] & quiet[:, 0]))
    return out


def _phase(step: Subtask) -> int:
    if step.state == FREE:
        return 0
    if step.state == ABOVE_GROUND:
        return 2
    return PHASES.index(step.name)


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
    out = values.copy()
    for column in out.T:
        good = np.isfinite(column)
        column[~good] = np.interp(t[~good], t[good], column[good])
    return out


def _there(
    t: np.ndarray, phase: np.ndarray, force: np.ndarray, place: np.ndarray, speed: np.ndarray
) -> np.ndarray:
    """Where each channel's equation is defined and every signal in it was recorded (N, C)."""
    free, carry, held = phase == 0, phase == 2, phase > 0
    still = held & ~carry & (phase != 4)
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
        "y": (still | (phase == 4)) & force & place,
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


def _world(stack: dict[str, np.ndarray], events: np.ndarray, onehot: np.ndarray, rig: Rig) -> World:
    pad, zero = rig.fingertip, np.zeros(())
    base, length = np.zeros(4), np.zeros(4)
    if rig.jointed:
        base = np.array([*rig.finger(1).base, *rig.finger(2).base])
        length = np.array([*rig.finger(1).links, *rig.finger(2).links])
    phase = stack["phase"]
    carry = phase[..., 2]
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
        doubt_joints=np.zeros_like(stack["joints"]),
        slip=np.zeros_like(carry),
        modes=np.zeros(6),
        free=phase[..., 0],
        ground=phase[..., 1] + phase[..., 3] + phase[..., 4],
        carry=carry,
        move=onehot,
        events=events,
    )


def subtask_name(step: Subtask) -> str:
    """A subtask as the interface names it, as `carry block1`."""
    return step.name if step.object is None else f"{step.name} {step.object}"
