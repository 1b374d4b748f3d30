"""One trial run in MuJoCo: what the tips do and feel, at 1 kHz and free of noise."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np

from experiments.blind_check.operator import Plan
from experiments.blind_check.scene import DAMPING, STEP, TIP_MASS, UPRIGHT, Block, World, mjcf

EVERY = 5  # steps a millisecond
SETTLE = 0.15  # s that the servos stand still before the trial
FELT = 2e-3  # N, contact


@dataclass(frozen=True)
class Motion:
    """A trial's truth, n rows [s, m, m/s, N]: `t`, and x1, y1, x2, y2 of tip position, velocity, force.

    `boundaries`: both touch, leaves, meets, one lets go, for every move; `centres` (n, 2 blocks, 2).
    """

    t: np.ndarray
    position: np.ndarray
    velocity: np.ndarray
    force: np.ndarray
    boundaries: tuple[float, ...]
    centres: np.ndarray


def perform(plan: Plan, blocks: dict[str, Block], world: World) -> Motion:
    """Run a plan. ValueError where a grip never comes about or a block is lost."""
    text = mjcf(blocks, plan.centres, tuple(plan.command[0]), world, plan.servos)
    model = mujoco.MjModel.from_xml_string(text)
    data = mujoco.MjData(model)
    at = {model.joint(j).name: model.joint(j).qposadr[0] for j in range(model.njnt)}
    fingers = [at[n] for n in ("x1", "z1", "x2", "z2")]
    pads = np.array([at[n] for n in ("n1", "s1", "n2", "s2")])
    pads_list = list(pads)
    cubes = [[at[f"x_{n}"], at[f"z_{n}"]] for n in blocks]
    data.qpos[fingers] = plan.command[0]
    settle = round(SETTLE / STEP)
    n = len(plan.command)
    law = _PadLaw(world)
    rows = n // EVERY
    names = list(blocks)
    supports = {model.geom(f"foot_{b}").id: k for k, b in enumerate(names)}
    q_log, v_log = np.empty((rows, model.nq)), np.empty((rows, model.nv))
    pad_log, a_log, stands = np.empty((rows, 4)), np.empty((rows, 4)), np.zeros((rows, len(names)), bool)
    turning = _Turning(model, data, blocks, world) if world.mass_offset else None
    for k in range(-settle, rows * EVERY):
        data.ctrl[:4] = plan.command[max(k, 0)]
        if law.needed:
            law.push(data.qpos[pads_list])
            data.qfrc_applied[pads_list] = law.extra
        if turning is not None:
            turning.aim()
        if k >= 0 and k % EVERY == 0:
            r = k // EVERY
            q_log[r], v_log[r], pad_log[r] = data.qpos, data.qvel, law.extra
            for pair in data.contact.geom[: data.ncon]:
                for geom in pair:
                    if geom in supports:
                        stands[r, supports[geom]] = True
        mujoco.mj_step(model, data)
        if k >= 0 and k % EVERY == 0:  # the accelerations belong to the state before the step
            a_log[k // EVERY] = data.qacc[fingers] + data.qacc[pads_list]
    stiffness = np.array([world.normal_stiffness, world.shear_stiffness] * 2) * (world.exponent == 1.0)
    force = -q_log[:, pads] * stiffness - v_log[:, pads] * DAMPING + pad_log - TIP_MASS * a_log
    t = np.arange(rows) * STEP * EVERY
    start = np.array([plan.centres[b] for b in names])
    centres = np.stack([q_log[:, c] for c in cubes], 1) + start
    boundaries = _boundaries(t, force, stands, [names.index(b) for b in plan.moved])
    return Motion(t, q_log[:, fingers], v_log[:, fingers], force, boundaries, centres)


class _PadLaw:
    """What a pad adds to its linear spring: a Maxwell arm, or a whole power law instead of the spring.

    The law with exponent p has the nominal stiffness as secant at the reference force.
    """

    def __init__(self, world: World) -> None:
        self.world = world
        self.needed = world.creep_ratio > 0 or world.exponent != 1.0
        self.stiffness = np.array([world.normal_stiffness, world.shear_stiffness] * 2)
        self.arm, self.before = np.zeros(4), np.zeros(4)
        self.extra = np.zeros(4)
        self.fade = np.exp(-STEP / world.creep_time)

    def push(self, place: np.ndarray) -> None:
        """Forces on the tips [N] for their displacements `place` (4,) [m]."""
        out = np.zeros(4)
        if self.world.exponent != 1.0:
            scale = self.world.reference / self.stiffness
            out -= self.world.reference * np.sign(place) * (np.abs(place) / scale) ** self.world.exponent
        if self.world.creep_ratio > 0:
            gain = self.world.creep_ratio * self.stiffness
            self.arm = self.fade * self.arm - gain * (place - self.before)
            self.before = place.copy()
            out += self.arm
        self.extra = out


class _Turning:
    """Blocks whose mass lies beside the middle: carried, they turn until the pads' shear balances it.

    Flat pads keep a block upright against everything else, as in the healthy world, and the hand holds up
    the heavier side: its fingers stay where they are.
    """

    def __init__(self, model, data, blocks: dict[str, Block], world: World) -> None:
        self.data, self.smooth = data, np.zeros(len(blocks))
        self.feet = [model.geom(f"foot_{b}").id for b in blocks]
        width = np.array([b.width for b in blocks.values()])
        # The couple +-c of both fingers' shear times half the width on each side is the mass's moment.
        self.couple = np.array([b.weight for b in blocks.values()]) * world.mass_offset / width
        yielding = world.shear_stiffness * width**2 / 2
        self.aims = -self.couple / (world.shear_stiffness * width / 2) * (1 + yielding / UPRIGHT)
        self.heights = [model.joint(f"z{i}").dofadr[0] for i in (1, 2)]

    def aim(self) -> None:
        """Set the turn aimed at and the hand's support for what is in the air now."""
        standing = np.zeros(len(self.feet))
        for pair in self.data.contact.geom[: self.data.ncon]:
            for k, foot in enumerate(self.feet):
                if foot in pair:
                    standing[k] = 1.0
        self.smooth += (1 - standing - self.smooth) * STEP / 0.01
        self.data.ctrl[4:] = self.aims * self.smooth
        carried = float(self.couple @ self.smooth)
        self.data.qfrc_applied[self.heights] = -carried, carried


def _boundaries(t: np.ndarray, force: np.ndarray, stands: np.ndarray, moved: list[int]) -> tuple[float, ...]:
    """Times [s] at which the contacts change, four a move."""
    touching = (force[:, 0] > FELT) & (-force[:, 2] > FELT)
    out: list[float] = []
    k = 0
    for b in moved:
        touch = _first(touching, k)
        leave = _last(stands[:, b], touch, _middle(stands[:, b], touch))
        meet = _first(stands[:, b], _middle(stands[:, b], touch))
        part = _first(~touching, meet)
        if not touching[leave:meet].all():
            raise ValueError("a grip was lost on the way")
        out += [float(t[i]) for i in (touch, leave, meet, part)]
        k = part + 300  # a finger may bounce as it lets go
    return tuple(out)


def _first(what: np.ndarray, start: int) -> int:
    found = np.flatnonzero(what[start:])
    if not found.size:
        raise ValueError("a contact never came about")
    return start + int(found[0])


def _last(what: np.ndarray, start: int, end: int) -> int:
    """The sample after the last true one before `end`."""
    return start + int(np.flatnonzero(what[start:end])[-1]) + 1


def _middle(stands: np.ndarray, start: int) -> int:
    """A sample within the longest time off the support after `start`."""
    off = np.flatnonzero(np.diff(np.concatenate([[1], stands[start:].astype(int), [1]])))
    spans = off.reshape(-1, 2)
    if not len(spans):
        raise ValueError("a block never left its support")
    begin, end = spans[np.argmax(spans[:, 1] - spans[:, 0])]
    return start + (int(begin) + int(end)) // 2
