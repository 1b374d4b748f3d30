"""One trial run in MuJoCo: noise-free motion and forces of the tips at 1 kHz."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import mujoco
import numpy as np

from experiments.blind_check.operator import Plan
from experiments.blind_check.scene import DAMPING, STEP, TIP_MASS, Block, World, mjcf

EVERY = round(0.001 / STEP)  # steps a millisecond
SETTLE = 0.15  # s that the servos stand still before the trial
FELT = 2e-3  # N, contact
if mujoco.get_mju_user_warning() is None:  # it reports failed line searches on standard output
    mujoco.set_mju_user_warning(lambda text: None)
GAP = 30  # ms: a shock may lift a pad for less
LIFT = 0.003  # m
BOUNCE = 300  # ms after a release in which a finger may bounce


@dataclass(frozen=True)
class Motion:
    """A trial's truth, n rows [s, m, m/s, N]: `t`, and x1, y1, x2, y2 of tip position, velocity, force.

    `boundaries`: both touch, leaves, meets, one lets go, for every move; `centres` (n, blocks, 2) [m]
    and `turns` (n, blocks) [rad], counterclockwise.
    """

    t: np.ndarray
    position: np.ndarray
    velocity: np.ndarray
    force: np.ndarray
    boundaries: tuple[float, ...]
    centres: np.ndarray
    turns: np.ndarray


def perform(plan: Plan, blocks: Mapping[str, Block], world: World) -> Motion:
    """Run a plan; ValueError if a grip fails, a block is lost or a finger meets a block at rest."""
    text = mjcf(blocks, plan.centres, tuple(plan.command[0]), world, plan.servos)
    model = mujoco.MjModel.from_xml_string(text)
    data = mujoco.MjData(model)
    names = list(blocks)
    at = {model.joint(j).name: model.joint(j).qposadr[0] for j in range(model.njnt)}
    fingers = [at[n] for n in ("x1", "z1", "x2", "z2")]
    pads = [at[n] for n in ("n1", "s1", "n2", "s2")]
    cubes = [[at[f"x_{n}"], at[f"z_{n}"]] for n in names]
    turns = [at[f"turn_{n}"] for n in names]
    turning = [at["r1"], at["r2"]]
    data.qpos[fingers] = plan.command[0]
    data.qpos[turns] = world.tilt  # blocks on a slope are inclined
    command, roll = plan.command[::EVERY], plan.roll[::EVERY]
    rows, law = len(command), _PadLaw(world)
    bears, grips = _bearings(model, names), _grips(model, names)
    q_log, v_log = np.empty((rows, model.nq)), np.empty((rows, model.nv))
    pad_log, a_log = np.empty((rows, 4)), np.empty((rows, 4))
    stands, touched = np.zeros((rows, len(names)), bool), np.zeros((rows, len(names)), bool)
    for _ in range(round(SETTLE / STEP)):
        data.ctrl[:] = command[0]
        law.push(data, pads)
        mujoco.mj_step(model, data)
    for r in range(rows):
        data.ctrl[:] = command[r]
        model.qpos_spring[turning] = roll[r]  # pads turn with the hand, and the block with them
        law.push(data, pads)
        q_log[r], v_log[r], pad_log[r] = data.qpos, data.qvel, law.extra
        mujoco.mj_step(model, data)
        # Accelerations and contacts belong to the state before the step.
        a_log[r] = data.qacc[fingers] + data.qacc[pads]
        for a, b in data.contact.geom[: data.ncon].tolist():
            k = bears[a, b]
            if k >= 0:
                stands[r, k] = True
            if grips[a, b] >= 0:
                touched[r, grips[a, b]] = True
        if law.needed:
            for _ in range(EVERY - 1):
                law.push(data, pads)
                mujoco.mj_step(model, data)
        else:
            mujoco.mj_step(model, data, EVERY - 1)
    stiffness = np.array(world.pads()) * (world.exponent == 1.0)
    force = -q_log[:, pads] * stiffness - v_log[:, pads] * DAMPING + pad_log - TIP_MASS * a_log
    t = np.arange(rows) * STEP * EVERY
    start = np.array([plan.centres[b] for b in names])
    centres = np.stack([q_log[:, c] for c in cubes], 1) + start
    moved = [names.index(b) for b in plan.moved]
    boundaries = _boundaries(t, force, stands, centres, moved)
    _check_touches(t, touched, boundaries[3::4], moved)
    return Motion(t, q_log[:, fingers], v_log[:, fingers], force, boundaries, centres, q_log[:, turns])


def _by_pair(model: mujoco.MjModel, pairs: list[tuple[str, str, int]]) -> np.ndarray:
    """Number of a block (geoms, geoms) for pairs of geoms, -1 for others."""
    out = np.full((model.ngeom, model.ngeom), -1)
    for one, other, block in pairs:
        a, b = model.geom(one).id, model.geom(other).id
        out[a, b] = out[b, a] = block
    return out


def _bearings(model: mujoco.MjModel, names: list[str]) -> np.ndarray:
    """For each pair of geoms, the block that stands on the other there, or -1."""
    pairs = []
    for k, name in enumerate(names):
        others = [n for n in names if n != name]
        for end in (1, 2):
            pairs += [(f"foot{end}_{name}", what, k) for what in ("table", *(f"box_{n}" for n in others))]
            pairs += [(f"top{end}_{n}", f"box_{name}", k) for n in others]
    return _by_pair(model, pairs)


def _grips(model: mujoco.MjModel, names: list[str]) -> np.ndarray:
    """For each pair of geoms, the block that a pad touches there, or -1."""
    ends = [f"tip{i}{e}" for i in (1, 2) for e in "ab"]
    return _by_pair(model, [(end, f"box_{name}", k) for k, name in enumerate(names) for end in ends])


def _check_touches(t: np.ndarray, touched: np.ndarray, parts: tuple[float, ...], moved: list[int]) -> None:
    """ValueError if a pad touches a block that is neither the one to be moved nor the one just let go."""
    move = np.searchsorted(parts, t)
    before, after = [moved[0], *moved], [*moved, moved[-1]]
    for k in range(touched.shape[1]):
        strange = (np.take(before, move) != k) & (np.take(after, move) != k)
        if (touched[:, k] & strange).any():
            raise ValueError("a finger met another block")


class _PadLaw:
    """A pad's force beyond its linear spring: a Maxwell arm, or a power law in place of the spring.

    The law with exponent p has the nominal stiffness as secant at the reference force.
    """

    def __init__(self, world: World) -> None:
        self.world = world
        self.needed = world.creep_ratio > 0 or world.exponent != 1.0
        self.stiffness = np.array(world.pads())
        self.arm, self.before = np.zeros(4), np.zeros(4)
        self.extra = np.zeros(4)
        self.fade = np.exp(-STEP / world.creep_time)

    def push(self, data: mujoco.MjData, pads: list[int]) -> None:
        """Apply the forces on the tips [N] for their positions."""
        if not self.needed:
            return
        place, out = data.qpos[pads], np.zeros(4)
        if self.world.exponent != 1.0:
            scale = self.world.reference / self.stiffness
            out -= self.world.reference * np.sign(place) * (np.abs(place) / scale) ** self.world.exponent
        if self.world.creep_ratio > 0:
            gain = self.world.creep_ratio * self.stiffness
            self.arm = self.fade * self.arm - gain * (place - self.before)
            self.before = place.copy()
            out += self.arm
        self.extra = out
        data.qfrc_applied[pads] = out


def _boundaries(
    t: np.ndarray, force: np.ndarray, stands: np.ndarray, centres: np.ndarray, moved: list[int]
) -> tuple[float, ...]:
    """Times [s] at which the contacts change, four a move.

    A touch that is given up before the block is lifted is no grip: the last one before it counts.
    """
    touching = _filled((force[:, 0] > FELT) & (-force[:, 2] > FELT))
    out: list[float] = []
    k = 0
    for b in moved:
        middle = _lifted(stands[:, b], touching, centres[:, b, 1], k)
        leave = _last(stands[:, b], k, middle)
        touch = _last(~touching, k, leave)
        meet = _first(stands[:, b], middle)
        part = _first(~touching, meet)
        if not touching[touch:part].all():
            raise ValueError("a grip was lost on the way")
        out += [float(t[i]) for i in (touch, leave, meet, part)]
        k = part + BOUNCE
    return tuple(out)


def _filled(what: np.ndarray) -> np.ndarray:
    """Fill interruptions shorter than GAP."""
    out = what.copy()
    ends = np.flatnonzero(np.diff(np.concatenate([[1], what.astype(int), [1]])))
    for begin, end in ends.reshape(-1, 2):
        if end - begin < GAP:
            out[begin:end] = True
    return out


def _first(what: np.ndarray, start: int) -> int:
    found = np.flatnonzero(what[start:])
    if not found.size:
        raise ValueError("a contact never came about")
    return start + int(found[0])


def _last(what: np.ndarray, start: int, end: int) -> int:
    """The sample after the last true one before `end`."""
    found = np.flatnonzero(what[start:end])
    if not found.size:
        raise ValueError("a contact never came about")
    return start + int(found[-1]) + 1


def _lifted(stands: np.ndarray, touching: np.ndarray, height: np.ndarray, start: int) -> int:
    """A sample of the flight: held, off the support, and above it by more than tremor.

    A hand that wanders may lift a gripped block by a hair and set it down again before it carries it.
    """
    high = touching & ~stands & (height > height[start] + LIFT)
    high[:start] = False
    if not high.any():
        raise ValueError("a block never left its support")
    return int(high.argmax())
