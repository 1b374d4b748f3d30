"""Worlds in which boundary intervals are judged: rates, paces, noise, ringing, pads, effects, untidy hands.

Trials are the virtual model's own; each number gives the same blocks and the same draw of the
operator in every world.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache

import numpy as np

from experiments.sweeps.cells import Cell
from experiments.sweeps.trials import GRASP_SPREAD, disturbed, recording_rig, scene
from experiments.untidy import UNTIDY
from hmmseg.hand.signals import task_space
from hmmseg.io.rig import Fingertip, Rig
from hmmseg.io.trial import Trial
from simgap.gap.synthetic import recorded
from simgap.world.operator import OperatorSettings
from simgap.world.properties import random_properties
from simgap.world.simulate import SimulatedTrial, simulate_trials

SHEAR_SHARE = 0.625  # shear over normal stiffness of the usual pads
HOLDING = 0.2  # N
TURN, TURNED = 1.5e-4, 0.05  # m that a turned block spreads the fingers, N of shear that holds it


@dataclass(frozen=True)
class World:
    """One row of the table; `cell` as in the sweeps, `pads` [N/m] told to the estimator as they are.

    `effects` act on the recording without a word in the rig. `untidy` names an alteration.
    """

    name: str
    cell: Cell = field(default_factory=Cell)
    pads: float | None = None
    effects: dict[str, dict[str, float]] = field(default_factory=dict)
    untidy: str | None = None


@dataclass(frozen=True)
class Judged:
    """A trial as the estimator gets it, with its true boundaries [s]."""

    trial: Trial
    rig: Rig
    boundaries: np.ndarray


def _worlds() -> list[World]:
    rates = [World(f"{r:g} Hz", Cell(rate=r)) for r in (10.0, 20.0, 50.0, 100.0, 1000.0)]
    paces = [World(f"pace {p:g}", Cell(pace=p)) for p in (0.5, 3.0)]
    noises = [World(f"noise x{n:g}", Cell(noise=n)) for n in (0.25, 4.0, 16.0)]
    rings = [World(f"ringing {v:g} N", Cell(vibration=v)) for v in (0.2, 1.0)]
    pads = [World(f"pads {k:g} N/m", pads=k) for k in (1500.0, 12000.0)]
    effects = {
        "lag 60 ms": {"force_lag": {"delay": 0.06}},
        "low-pass 30 ms": {"force_lowpass": {"time_constant": 0.03}},
        "bias": {"force_bias": {"fx1": 0.08, "fy1": 0.0, "fx2": 0.0, "fy2": -0.06}},
        "pads x0.6": {"fingertip_compliance": {"normal_stiffness": 2400.0, "shear_stiffness": 1500.0}},
        "creep": {"fingertip_creep": {"ratio": 0.4, "time_constant": 0.5}},
    }  # fmt: skip
    told = [World(f"untold: {name}", effects=e) for name, e in effects.items()]
    untidy = [World(name, untidy=name) for name in (*UNTIDY, "turned")]
    fast = [World(f"{name}, 100 Hz", Cell(rate=100.0), untidy=name) for name in ("late finger", "tapping")]
    missing = [World("missing 40 %", Cell(missing=0.4))]
    return [*rates, *paces, *noises, *rings, *pads, *missing, *told, *untidy, *fast]


WORLDS = {world.name: world for world in _worlds()}


def trials_of(world: World, numbers: Sequence[int]) -> list[Judged]:
    """Trials of a world by their numbers."""
    rig = _rig(world)
    stated = recording_rig(world.cell, rig)
    _, task = scene()
    out = []
    for simulated in _performed(world.cell.pace, world.pads, _scene_key(world), world.untidy, tuple(numbers)):
        t = np.arange(int(simulated.t[-1] * world.cell.rate)) / world.cell.rate
        resampled = replace(simulated, trial=replace(simulated.trial, t=t))
        trial = recorded(resampled, task, stated, world.effects)
        trial = disturbed(trial, simulated.boundaries, world.cell, simulated.seed)
        if world.untidy == "turned":
            trial = _turned(trial, simulated.boundaries, stated)
        judged = Judged(trial, stated, simulated.boundaries)
        if world.untidy != "slipping" or _still_held(judged):
            out.append(judged)
    return out


def _still_held(judged: Judged) -> bool:
    """Whether every block is in the grip as it lands: what slips out of it is a drop, and a misfit."""
    lands = judged.boundaries[2::4]
    if not np.isfinite(judged.boundaries).all():
        return False
    signals = task_space(judged.trial, judged.rig)
    return bool((np.interp(lands, signals.t, signals.grip) > HOLDING).all())


def _rig(world: World) -> Rig:
    rig, _ = scene()
    if world.pads is None:
        return rig
    pads = Fingertip(normal_stiffness=world.pads, shear_stiffness=SHEAR_SHARE * world.pads)
    return rig.model_copy(update={"fingertip": pads})


def _scene_key(world: World) -> tuple[float, float] | None:
    values = world.effects.get("fingertip_compliance")
    return None if values is None else (values["normal_stiffness"], values["shear_stiffness"])


@lru_cache(maxsize=4)
def _performed(pace: float, pads: float | None, true_pads: tuple[float, float] | None, untidy: str | None,
               numbers: tuple[int, ...]) -> list[SimulatedTrial]:  # fmt: skip
    """What truly happened; worlds that differ by their sensors alone share it."""
    rig, task = _rig(World("", pads=pads)), scene()[1]
    if true_pads is not None:
        hand = Fingertip(normal_stiffness=true_pads[0], shear_stiffness=true_pads[1])
        rig = rig.model_copy(update={"fingertip": hand})
    operator = OperatorSettings(pace=(pace, pace), grasp=(-GRASP_SPREAD, GRASP_SPREAD))
    blocks = [random_properties(task, number) for number in numbers]
    return simulate_trials(task, rig, blocks, list(numbers), operator, alter=UNTIDY.get(untidy or ""))


def _turned(trial: Trial, boundaries: np.ndarray, rig: Rig) -> Trial:
    """Blocks that turn a little once they leave the ground: faces spread the fingers, shear holds them."""
    channels, rng = dict(trial.channels), np.random.default_rng(len(trial.t))
    for leave, meet in boundaries.reshape(-1, 4)[:, 1:3]:
        up = np.clip((trial.t - leave) / 0.15, 0, 1) * np.clip((meet - trial.t) / 0.05, 0, 1)
        sign = rng.choice([-1.0, 1.0])
        channels["fy1"] = channels["fy1"] + sign * TURNED * up
        channels["fy2"] = channels["fy2"] - sign * TURNED * up
        signals = task_space(replace(trial, channels=channels), rig)
        push = np.clip(signals.grip, 0, None) > 0
        spread = TURN * up * push
        for i, way in ((1, -spread / 2), (2, spread / 2)):
            q, links = (channels[f"q{i}1"], channels[f"q{i}2"]), rig.finger(i).links
            jacobian = np.array([[-links[0] * np.sin(q[0]), -links[1] * np.sin(q[1])],
                                 [links[0] * np.cos(q[0]), links[1] * np.cos(q[1])]])  # fmt: skip
            step = np.linalg.solve(jacobian.transpose(2, 0, 1), np.stack([way, 0 * way], 1)[..., None])[
                ..., 0
            ]
            channels[f"q{i}1"], channels[f"q{i}2"] = q[0] + step[:, 0], q[1] + step[:, 1]
    return replace(trial, channels=channels)
