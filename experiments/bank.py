"""A bank of simulated healthy cases, as a folder of recordings would give them, with their truth.

Blocks, operator and noise differ between cases; seeds are fresh, so that what was tuned on other
seeds is judged on these. With a [systematic] table the hand of every case truly deviates from its
nominal rig, each deviation drawn from the table, alike in all trials of the case.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from experiments.recordings import Case
from hmmseg.hand.kinematics import inverse, joint_velocity
from hmmseg.hand.signals import Signals, task_space
from hmmseg.io.rig import FORCE_CHANNELS, JOINTS, Rig, Systematic, read_rig
from hmmseg.io.task import BlockTask, read_task
from hmmseg.io.trial import Trial
from simgap.world.properties import random_properties
from simgap.world.simulate import simulate_trials

SCENE = Path(__file__).parent / "sweeps"
SEED = 40_000  # cases are SEED, SEED + 1, ...; their trials 100 times that and on


@dataclass(frozen=True)
class Deviations:
    """How the true hand differs from the nominal one, units as in `hmmseg.io.rig.Systematic`."""

    force_bias: np.ndarray
    force_gain: np.ndarray
    joint_offset: np.ndarray
    link_length: np.ndarray
    pad_stiffness: np.ndarray


def draw_deviations(systematic: Systematic, rng: np.random.Generator) -> Deviations:
    """One hand: every deviation normal with its standard deviation from the table."""
    names = Deviations.__dataclass_fields__
    return Deviations(**{n: rng.normal(0.0, np.asarray(getattr(systematic, n))) for n in names})


def nominal(rate: float | None = None) -> tuple[Rig, BlockTask]:
    """The usual hand and task: two stacked blocks are reversed, as in the paper."""
    rig, task = read_rig(SCENE / "rig.toml"), read_task(SCENE / "task.toml")
    assert isinstance(task, BlockTask)
    return (rig if rate is None else rig.model_copy(update={"rate": rate})), task


def simulated_cases(num: int, trials: int = 4, seed: int = SEED, systematic: Systematic | None = None,
                    rate: float | None = None) -> list[Case]:  # fmt: skip
    """`num` cases of `trials` trials each; reproducible from their seeds, whatever their company."""
    rig, task = nominal(rate)
    blocks = [random_properties(task, seed + i) for i in range(num)]
    seeds = [100 * (seed + i) + k for i in range(num) for k in range(trials)]
    simulated = simulate_trials(task, rig, [b for b in blocks for _ in range(trials)], seeds)
    stated = rig if systematic is None else rig.model_copy(update={"systematic": systematic})
    cases = []
    for i in range(num):
        mine = simulated[i * trials : (i + 1) * trials]
        recorded = [replace(s.trial, file=f"trial_{k:02d}.csv") for k, s in enumerate(mine, 1)]
        if systematic is not None:
            hand = draw_deviations(systematic, np.random.default_rng([seed + i, 5]))
            recorded = [deviated(trial, rig, hand) for trial in recorded]
        true = {name: {p: (getattr(b, p), 0.0) for p in ("weight", "width", "height", "friction")}
                for name, b in blocks[i].items()}  # fmt: skip
        cases.append(Case(
            f"case_{seed + i}", stated, task, tuple(recorded),
            tuple(task_space(trial, stated) for trial in recorded),
            tuple(tuple(s.boundaries) for s in mine), true, ("none",),
        ))  # fmt: skip
    return cases


def deviated(trial: Trial, rig: Rig, hand: Deviations) -> Trial:
    """What a deviating hand records of the same motions and forces.

    Pads of another stiffness put the tips elsewhere for the same forces; other links and joint
    zeros give other angles for the same tips; forces are read with gain and bias.
    """
    signals, channels = task_space(trial, rig), dict(trial.channels)
    for i in (1, 2):
        give = 1 / (1 + hand.pad_stiffness[i - 1]) - 1
        tip = np.stack([
            _of(signals, f"x{i}") + _of(signals, f"fx{i}") / rig.fingertip.normal_stiffness * give,
            _of(signals, f"y{i}") + _of(signals, f"fy{i}") / rig.fingertip.shear_stiffness * give,
        ], axis=1)  # fmt: skip
        speed = np.stack([_of(signals, f"vx{i}"), _of(signals, f"vy{i}")], axis=1)
        nominal_finger = rig.finger(i)
        first, second = np.asarray(nominal_finger.links) * (1 + hand.link_length[2 * i - 2 : 2 * i])
        finger = nominal_finger.model_copy(update={"links": (float(first), float(second))})
        angles = inverse(finger, i, tip)
        rates = joint_velocity(finger, angles, speed)
        for k in (0, 1):
            channels[f"q{i}{k + 1}"] = angles[:, k] + hand.joint_offset[JOINTS.index(f"q{i}{k + 1}")]
            channels[f"dq{i}{k + 1}"] = rates[:, k]
    for k, name in enumerate(FORCE_CHANNELS):
        channels[name] = (1 + hand.force_gain[k]) * channels[name] + hand.force_bias[k]
    return replace(trial, channels=channels)


def _of(signals: Signals, name: str) -> np.ndarray:
    return getattr(signals, name)
