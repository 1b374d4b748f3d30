"""Synthetic trials: an operator performs a task, sensors record it, and contacts give the truth."""

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import tomlkit
from jax import Array

from hmmseg.contact.decompose import UNITS, subtasks
from hmmseg.errors import InputError
from hmmseg.hand.kinematics import inverse, joint_velocity, require_reach
from hmmseg.hand.signals import task_space
from hmmseg.io.rig import Rig
from hmmseg.io.task import BlockTask
from hmmseg.io.trial import CARTESIAN_CHANNELS, JOINT_CHANNELS, Trial
from hmmseg.jaxconfig import double_precision
from hmmseg.segmentation.spans import Segmentation, known, spans_table
from hmmseg.tables import Tabled
from simgap.world import dynamics
from simgap.world.dynamics import CONTROL_PERIOD, Physics, Record, State
from simgap.world.operator import OperatorSettings, Plan, Window, plan
from simgap.world.properties import Blocks, blocks_table
from simgap.world.virtual_model import Surroundings, physics, substeps_for

# What the hand's sensors record of a true motion: samples with the rig's noise.

DEFAULT_RATE = 20.0  # cited: Hz, the paper's
# prior: sd of one sample if the rig leaves it to be learned: rad, m, rad/s, N
DEFAULT_NOISE = {"angle": 2e-4, "position": 3e-5, "velocity": 0.03, "force": 0.012}
DEFAULT_CARTESIAN_VELOCITY = 0.004  # prior: m/s


def record(t: np.ndarray, position: np.ndarray, velocity: np.ndarray, force: np.ndarray, rig: Rig,
           rng: np.random.Generator | None, file: str) -> Trial:  # fmt: skip
    """Record tips (num_timesteps, 2 fingers, 2 axes) at times t (num_timesteps,) [s]. Positions [m],
    velocities [m/s], forces [N] on the environment. Noise as in the rig is drawn from `rng` (none if None).
    InputError if a tip is beyond the hand's reach."""
    channels: dict[str, np.ndarray] = {}

    def take(name: str, values: np.ndarray, quantity: str) -> None:
        noise = 0.0 if rng is None else noise_sd(rig, quantity) * rng.standard_normal(values.shape)
        channels[name] = values + noise

    for i in (1, 2):
        place, speed = position[:, i - 1], velocity[:, i - 1]
        names, quantity = [(f"{axis}{i}", f"v{axis}{i}") for axis in "xy"], "position"
        if rig.jointed:
            finger, quantity = rig.finger(i), "angle"
            require_reach(finger, i, place)
            angles = inverse(finger, i, place)
            place, speed = angles, joint_velocity(finger, angles, speed)
            names = [(f"q{i}{k}", f"dq{i}{k}") for k in (1, 2)]
        for k, (name, rate) in enumerate(names):
            take(name, place[:, k], quantity)
            take(rate, speed[:, k], "velocity")
        for k, axis in enumerate("xy"):
            take(f"f{axis}{i}", force[:, i - 1, k], "force")
    order = JOINT_CHANNELS if rig.jointed else CARTESIAN_CHANNELS
    return Trial(file, t, {name: channels[name] for name in order})


def noise_sd(rig: Rig, quantity: str) -> float:
    """Standard deviation of one sample of `angle`, `position`, `velocity` or `force`."""
    value = getattr(rig.noise, quantity)
    if value is not None:
        return value
    if quantity == "velocity" and not rig.jointed:
        return DEFAULT_CARTESIAN_VELOCITY
    return DEFAULT_NOISE[quantity]


BATCH, SMALL = 16, 4  # numerics: trials integrated together, if there are many or few
MOVING = 2e-3  # physics: a definition: m/s; a slide begins and ends where the block passes this speed


@dataclass(frozen=True, repr=False)
class SimulatedTrial(Tabled):
    """A synthetic recording with its truth.

    `trial` is the recording, as read from a file. `boundaries` (num_subtasks - 1,) [s] are the times between
    the subtasks, from the contacts (NaN if one never happened, as with a dropped block). `motion` is the true
    motion, one row per millisecond at times `t` [s], with blocks in the order of `blocks`. `rig` recorded it.
    """

    trial: Trial
    boundaries: np.ndarray
    t: np.ndarray
    motion: Record
    blocks: Blocks
    seed: int
    task: BlockTask
    rig: Rig

    @property
    def segmentation(self) -> Segmentation:
        """The true subtasks, without uncertainty."""
        edges = [float(self.trial.t[0]), *self.boundaries, float(self.trial.t[-1])]
        recorded = task_space(self.trial, self.rig)
        return known(self.trial.file, self.trial.rate, subtasks(self.task), edges, recorded=recorded)

    def to_json(self) -> dict[str, Any]:
        """The entry of one trial in the JSON of `simulate`, except for its file name."""
        return {"seed": self.seed, "rate": self.trial.rate, "boundaries": self.boundaries}

    def tables(self) -> list[Any]:
        """The true subtasks, and the blocks."""
        return [spans_table(self.segmentation), blocks_table(self.blocks)]

    def plot(self, path: str | Path | None = None) -> list[Any]:
        """Plot recorded signals over the true subtasks, to `path` if given; the axes."""
        return self.segmentation.plot(path)


@double_precision
def simulate_trials(task: BlockTask, rig: Rig, properties: Sequence[Blocks], seeds: Sequence[int],
                    operator: OperatorSettings | None = None, surroundings: Surroundings | None = None,
                    alter: Callable[[Plan, np.random.Generator], Plan] | None = None,
                    ) -> list[SimulatedTrial]:  # fmt: skip
    """Several performances of a task, one for each seed with its blocks, integrated together, which costs
    less and changes nothing. `alter` changes the operator's commands, given a random generator of its own.
    InputError if a block is missing or out of reach."""
    settings = operator or OperatorSettings()
    if not seeds:
        return []
    for blocks in properties:
        for name in task.objects:
            if name not in blocks:
                raise InputError("properties", f"object {name!r} is missing", "a block for every object")
    plans = [plan(task, rig, blocks, settings, np.random.default_rng([seed, 0]))
             for blocks, seed in zip(properties, seeds, strict=True)]  # fmt: skip
    if alter is not None:
        plans = [alter(p, np.random.default_rng([seed, 4])) for p, seed in zip(plans, seeds, strict=True)]
    scenes = [physics(rig, [blocks[name] for name in task.objects], surroundings) for blocks in properties]
    substeps = max(substeps_for(scene, CONTROL_PERIOD) for scene in scenes)
    length = -(-max(len(p.command) for p in plans) // dynamics.BUCKET) * dynamics.BUCKET
    trials = []
    for k in range(0, len(plans), BATCH):
        batch = range(k, min(k + BATCH, len(plans)))
        records = _perform_all(task, [plans[j] for j in batch], [scenes[j] for j in batch], length, substeps)
        trials += [_trial(task, rig, plans[j], motion, properties[j], seeds[j])
                   for j, motion in zip(batch, records, strict=True)]  # fmt: skip
    return trials


def _perform_all(task: BlockTask, plans: Sequence[Plan], scenes: Sequence[Physics], length: int,
                 substeps: int) -> list[Record]:  # fmt: skip
    """Records of one batch, padded to 1, SMALL or BATCH trials so that three programs serve all sizes."""
    hands = [dynamics.Impedance(*map(jnp.asarray, p.impedance)) for p in plans]
    commands = [np.pad(p.command, ((0, length - len(p.command)), (0, 0)), "edge") for p in plans]
    starts = [_start(scene, task, p) for scene, p in zip(scenes, plans, strict=True)]
    rows = list(zip(scenes, hands, commands, starts, strict=True))
    whole = 1 if len(rows) == 1 else SMALL if len(rows) <= SMALL else BATCH
    rows += [rows[-1]] * (whole - len(rows))
    stacked = jax.tree.map(lambda *leaves: np.stack(leaves), *rows)
    batch = jax.tree.map(np.asarray, _perform_batch(*stacked, substeps=substeps))
    return [jax.tree.map(lambda a, j=j: a[j], batch) for j in range(len(plans))]


@partial(jax.jit, static_argnames=("substeps",))
def _perform_batch(
    scenes: Physics, hands: dynamics.Impedance, commands: Array, starts: State, substeps: int
) -> Record:
    return jax.vmap(partial(dynamics.perform, substeps=substeps))(scenes, hands, commands, starts)


def _start(scene: Physics, task: BlockTask, performance: Plan) -> State:
    x, y = zip(*(performance.start[name] for name in task.objects), strict=True)
    return dynamics.resting_state(scene, [jnp.asarray(v) for v in x], [jnp.asarray(v) for v in y])


def _trial(task: BlockTask, rig: Rig, performance: Plan, motion: Record, blocks: Blocks,
           seed: int) -> SimulatedTrial:  # fmt: skip
    """The recording and the truth of a performance, from its rollout `motion`."""
    n = len(performance.command)
    motion = jax.tree.map(lambda a: a[:n], motion)
    fine = np.arange(n) * CONTROL_PERIOD
    rate = rig.rate or DEFAULT_RATE
    t = np.arange(int(round(performance.duration * rate, 6))) / rate
    moved = motion.position, motion.velocity, motion.force
    place, speed, force = (dynamics.interpolated(t, fine, z) for z in moved)
    trial = record(t, place, speed, force, rig, np.random.default_rng([seed, 2]), f"simulated, seed {seed}")
    order = {name: k for k, name in enumerate(task.objects)}
    truth = [time for w in performance.windows for time in _boundaries(w, order[w.object], fine, motion)]
    return SimulatedTrial(trial, np.array(truth), fine, motion, blocks, seed, task, rig)


def _boundaries(window: Window, block: int, t: np.ndarray, motion: Record) -> list[float]:
    """The four times [s] of a move: both fingers touch, it leaves (slides), meets (stops), one lets go."""
    gripped = (motion.pads[:, :, block] > 0).all(axis=1)
    early, late = (t >= window.lift) & (t < window.middle), (t >= window.middle) & (t < window.end)
    if window.slide:
        still = np.hypot(motion.block_velocity[:, block, 0], motion.block_velocity[:, block, 1]) < MOVING
        start = t[early & still].max(initial=window.lift)
        stop = _first(t, late & still)
    else:
        standing = motion.support[:, block] > 0
        start = t[early & standing].max(initial=window.lift)
        stop = _first(t, late & standing)
        if standing[np.searchsorted(t, window.middle)]:  # never lifted
            start = stop = np.nan
    closing = (t >= window.close) & (t < window.lift)
    return [_first(t, closing & gripped), start, stop, _first(t, (t >= window.open) & ~gripped)]


def _first(t: np.ndarray, there: np.ndarray) -> float:
    """Time of the first true entry; NaN if none is true."""
    return float(t[np.argmax(there)]) if there.any() else np.nan


# Synthetic trials as file contents: rig, task, actual properties, trials and their truth.

DIGITS = {"q": 6, "d": 5, "x": 7, "y": 7, "v": 6, "f": 5}  # numerics: decimals by a channel's first letter


def scene_files(task: BlockTask, rig: Rig, blocks: Blocks) -> dict[str, str]:
    """Contents of rig.toml, without the columns of its recordings, task.toml and actual.toml by file name."""
    actual = {
        name: {key: {"unit": unit, "value": float(getattr(blocks[name], key))} for key, unit in UNITS.items()}
        for name in task.objects
    }
    hand = rig.model_dump(exclude={"columns", "topics", "gripper"}, exclude_none=True, exclude_defaults=True)
    return {"rig.toml": tomlkit.dumps(hand),
            "task.toml": tomlkit.dumps(task_table(task)), "actual.toml": tomlkit.dumps(actual)}  # fmt: skip


def trial_files(number: int, trial: Trial, boundaries: np.ndarray, seed: int) -> dict[str, str]:
    """Contents of one trial and its truth (boundaries [s], null if one never happened) by file name."""
    times = [round(float(b), 6) if np.isfinite(b) else None for b in boundaries]
    truth = json.dumps({"boundaries": times, "seed": int(seed)})
    return {f"trial_{number:02d}.csv": trial_csv(trial), f"truth/trial_{number:02d}.json": truth + "\n"}


def trial_csv(trial: Trial) -> str:
    """A trial as CSV: t and the hand's channels, rounded below their noise; missing samples are empty."""
    rows = [f"{t:.6f}" for t in trial.t]
    for name, values in trial.channels.items():
        digits = DIGITS[name[0]]
        cells = (f"{value:.{digits}f}" if np.isfinite(value) else "" for value in values)
        rows = [f"{row},{cell}" for row, cell in zip(rows, cells, strict=True)]
    return "\n".join([",".join(["t", *trial.channels]), *rows]) + "\n"


def task_table(task: BlockTask) -> dict[str, Any]:
    """The content of `task.toml` that describes a task."""
    moves = [{"object": m.object, "to": m.to} | ({"slide": True} if m.slide else {}) for m in task.moves]
    table: dict[str, Any] = {} if task.repeat == 1 else {"repeat": task.repeat}
    return table | {"objects": {name: {"on": on} for name, on in task.initial.items()}, "moves": moves}
