"""Aligned trials as padded arrays: what an effect acts on and what the contact equations need."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from hmmseg.contact.decompose import Subtask, height_equations
from hmmseg.hand.signals import group_size
from hmmseg.io.rig import FORCE_CHANNELS, Rig
from hmmseg.io.task import BlockTask
from hmmseg.segmentation.align import AlignedTrials
from simgap.effects.base import World
from simgap.gap.trial_arrays import MAX_RATE, boundary_quantiles, trial_arrays
from simgap.phases import Phase

TRIALS = 4  # numerics: arrays are padded to multiples of it, so that few programs are compiled


class Arrays(NamedTuple):
    """Constants of the contact equations: T trials, N samples, C channels, M moves, O objects.

    `there` (T, N, C): 1 where a residual is defined and recorded; `sd` (T, N, C): how far it
    is off by sensors and in doubt, in units of the channel, `plain` by sensors alone; `kind` (T, N):
    2 * phase, + 1 beside a contact change; `subtask` (T, N);
    `onehot` (T, N, M): nearest move; `objects`, `rises` (M, O); `phase` (T, N, 5) one-hot;
    `sample` (T, N, C): noise of one sample of a channel itself; `sensor` (T, N, 3): that of angles, rates and
    forces as they stand in `World`.
    """

    there: np.ndarray
    sd: np.ndarray
    plain: np.ndarray
    kind: np.ndarray
    subtask: np.ndarray
    onehot: np.ndarray
    objects: np.ndarray
    rises: np.ndarray
    phase: np.ndarray
    sample: np.ndarray
    sensor: np.ndarray


@dataclass(frozen=True)
class Frame:
    """Everything the diagnosis needs of aligned trials; the first `num_trials` rows are real.

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
        stack["plain"],
        stack["kind"].astype(int),
        stack["subtask"].astype(int),
        onehot,
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


def padded_length(samples: int) -> int:
    """Samples to pad to: 240, 480, 960, .. (ten seconds at 20 Hz fit the first)."""
    return 240 * 2 ** max(0, int(np.ceil(np.log2(samples / 240))))


def _stacked(rows: list[np.ndarray], length: int, count: int) -> np.ndarray:
    """Rows of different length as one array (count, length, ...), padded with their last entries."""
    padded = [np.pad(r, [(0, length - len(r)), *[(0, 0)] * (r.ndim - 1)], "edge") for r in rows]
    return np.stack(padded + [padded[-1]] * (count - len(rows)))


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
        doubt_joints=np.zeros_like(stack["joints"]),
        slip=np.zeros_like(carry),
        modes=np.zeros(6),
        free=phase[..., Phase.FREE],
        ground=phase[..., Phase.PICKUP] + phase[..., Phase.PLACE] + phase[..., Phase.SLIDE],
        carry=carry,
        events=events,
    )
