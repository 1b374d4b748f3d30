"""A person's paths for any task of blocks: knots joined by motions of a given profile.

Every length, duration and force is drawn for each trial; profile and servo are the lab's.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from experiments.blind_check.scene import GROUND, PAD, PIVOT, STEP, TIP, Block, Servo, Task, World

# Profiles: share of the way (0 to 1) over share of the time.

Profile = Callable[[np.ndarray], np.ndarray]


def minimum_jerk(rng: np.random.Generator) -> Profile:
    """Flash & Hogan, J. Neurosci. 5, 1985."""
    return _quintic


def _quintic(s: np.ndarray) -> np.ndarray:
    s = np.clip(s, 0, 1)
    return ((6 * s - 15) * s + 10) * s**3


def trapezoid(rng: np.random.Generator) -> Profile:
    """A machine's profile: constant acceleration, plateau and constant deceleration, of unequal shares."""
    rise, fall = rng.uniform(0.15, 0.4, 2)
    top = 1 / (1 - (rise + fall) / 2)

    def way(s: np.ndarray) -> np.ndarray:
        s = np.clip(s, 0, 1)
        up = top * s**2 / (2 * rise)
        along = top * (s - rise / 2)
        down = 1 - top * (1 - s) ** 2 / (2 * fall)
        return np.where(s < rise, up, np.where(s < 1 - fall, along, down))

    return way


def person(rng: np.random.Generator) -> Profile:
    """A person's profile, skewed towards the start, with a later correction of the first motion's error.

    A lognormal speed (Plamondon, Biol. Cybern. 72, 1995) drawn to its end by a minimum-jerk correction
    (Flash & Henis, J. Cogn. Neurosci. 3, 1991).
    """
    skew, reach = rng.uniform(0.15, 0.45), rng.uniform(0.9, 1.03)
    late, lasting = rng.uniform(0.4, 0.55), rng.uniform(0.4, 0.45)

    def way(s: np.ndarray) -> np.ndarray:
        s = np.clip(s, 0, 1)
        first = _quintic(s ** (1 - skew / 2) / 0.9)
        return reach * first + (1 - reach) * _quintic((s - late) / lasting)

    return way


PROFILES: dict[str, Callable[[np.random.Generator], Profile]] = {
    "minimum_jerk": minimum_jerk,
    "trapezoid": trapezoid,
    "person": person,
}


# Plans.

CLEAR = 0.016  # m; between a carried block and what it passes over
CLEARANCE = 0.001  # m; between pads and the support of the block they hold
OPEN = (0.010, 0.013)  # m; opening of the fingers in excess of a block


@dataclass(frozen=True)
class Style:
    """How a case is worked, as ranges: `pace` (1: two moves in 10 s), `grip` and `press` [N], waits [s]
    at the start (`rest`), open around a block (`dwell`), held (`hold`), placed (`place`) and at the end
    (`finish`); `rise` [m] after letting go; `height` [m] of the grasp over a block's centre; `stagger`
    [s] by which one finger closes and opens before the other; the fingers' heights differ by `uneven` [m].

    Of the lab: `profile` of motions, servo `stiffness` [N/m], whether the task is worked to the left
    (`mirrored`). `roll` [rad], rms, turns both fingers about the grip while they carry. The first names
    and meanings are those of the operator settings that a next experiment carries.
    """

    pace: tuple[float, float] = (0.9, 1.15)
    grip: tuple[float, float] = (2.0, 3.4)
    press: tuple[float, float] = (0.7, 1.7)
    rest: tuple[float, float] = (0.2, 0.5)
    hold: tuple[float, float] = (0.3, 0.5)
    dwell: tuple[float, float] = (0.04, 0.12)
    place: tuple[float, float] = (0.1, 0.25)
    finish: tuple[float, float] = (0.25, 0.4)
    rise: tuple[float, float] = (0.010, 0.016)
    height: tuple[float, float] = (-0.0012, 0.0012)
    stagger: tuple[float, float] = (0.0, 0.0)
    uneven: tuple[float, float] = (-0.0005, 0.0005)
    stiffness: tuple[float, float] = (600.0, 1000.0)
    profile: str = "minimum_jerk"
    mirrored: bool = False
    roll: float = 0.0


@dataclass(frozen=True)
class Plan:
    """Commands x1, y1, x2, y2 (n, 4) [m] at every STEP, the hand's roll (n,) [rad] about the grip, servos,
    block centres and moved blocks in order."""

    command: np.ndarray
    roll: np.ndarray
    servos: tuple[Servo, Servo]
    centres: dict[str, tuple[float, float]]
    moved: tuple[str, ...]


class Knots:
    """Targets in time of middle x, height y, each finger's opening (half) and roll."""

    def __init__(self, profile: Profile, rng: np.random.Generator, **start: float) -> None:
        self.now, self.profile, self.rng = 0.0, profile, rng
        self.first, self.value = dict(start), dict(start)
        self.parts: list[tuple[str, float, float, float, float]] = []
        self.held: list[tuple[float, float]] = []  # times from grip to release

    def to(self, duration: float, early: float = 0.0, **targets: float) -> None:
        """Move to `targets` in `duration` [s], begun `early` [s] before the last motion ends."""
        start = self.now - early
        for name, target in targets.items():
            self.add(name, start, duration, target)
        self.now = start + duration

    def add(self, name: str, start: float, duration: float, target: float) -> None:
        """Add a motion of one coordinate at a given time."""
        self.parts.append((name, start, duration, self.value[name], target))
        self.value[name] = target

    def fingers(self, duration: float, opening: float, apart: float = 0.0) -> None:
        """Open or close; one finger begins `apart` [s] after the other (negative: the left one)."""
        left, right = max(-apart, 0.0), max(apart, 0.0)
        self.add("left", self.now + left, duration, opening / 2)
        self.add("right", self.now + right, duration, opening / 2)
        self.now += duration + abs(apart)

    def wait(self, duration: float) -> None:
        self.now += duration

    def path(self, name: str, t: np.ndarray) -> np.ndarray:
        out = np.full_like(t, self.first[name])
        for part, start, duration, before, after in self.parts:
            if part == name:
                out += (after - before) * self.profile((t - start) / duration)
        return out


def plan(
    task: Task, blocks: Mapping[str, Block], world: World, style: Style, rng: np.random.Generator
) -> Plan:
    """Commands that carry out the task's moves in order."""
    u = rng.uniform
    pace, stiffness = u(*style.pace), u(*style.stiffness)
    servos = tuple(_servo(stiffness * u(0.95, 1.05), u(0.10, 0.16), u(0.8, 1.1)) for _ in (0, 1))
    yard = _Yard(task, blocks, np.tan(world.tilt), style.mirrored, rng)
    centres = dict(yard.centres)
    first = task.moves[0][0]
    x, top = centres[first][0], centres[first][1] + blocks[first].height / 2
    half = (blocks[first].width + u(*OPEN)) / 2
    profile = PROFILES[style.profile](rng)
    k = Knots(profile, rng, x=x + u(-0.015, 0.02), y=top + u(0.012, 0.02), left=half, right=half)
    k.wait(u(*style.rest) / pace)
    for block, to in task.moves:
        start = yard.centres[block]
        end, height = yard.put(block, to)
        _move(k, blocks[block], start, end, height, world, stiffness, style, pace)
    k.wait(u(*style.finish))
    t = np.arange(int(k.now / STEP) + 1) * STEP
    x, y, left, right = (k.path(name, t) for name in ("x", "y", "left", "right"))
    # Uneven heights are settled by the hand that holds: half a roll up on one side, down on the other.
    uneven, roll = u(*style.uneven), _rolled(k, t, style.roll, rng)
    lean = uneven + roll * (left + right)
    command = np.stack([x - left, y - lean / 2, x + right, y + lean / 2], 1)
    tremor, wander = u(2.5e-5, 6e-5, 4), u(3e-5, 1.5e-4, 4)
    for c in range(4):
        command[:, c] += _shake(t, 7.0, 11.0, tremor[c], rng) + _shake(t, 0.1, 0.5, wander[c], rng)
    return Plan(command, roll, servos, centres, tuple(b for b, _ in task.moves))  # type: ignore[arg-type]


class _Yard:
    """Current places of the blocks: spots on the ground, and heights."""

    def __init__(self, task: Task, blocks: Mapping[str, Block], slope: float, mirrored: bool, rng) -> None:
        u, widest = rng.uniform, sorted(b.width for b in blocks.values())
        self.blocks, self.slope, self.rng = blocks, slope, rng
        self.on = dict(task.on)
        # Far enough off that a finger opened around one block passes its neighbour.
        apart = sum(widest[-2:]) / min(len(widest), 2) + OPEN[1] / 2 + 2 * TIP + u(0.005, 0.014)
        grounded = [b for b, on in task.on.items() if on == GROUND]
        here = u(0.106, 0.118)
        spots = [here + i * apart for i in range(3)]
        if mirrored:
            spots = [2 * PIVOT + 0.01 - x for x in spots]
        self.spots = dict(zip(grounded, spots, strict=False))
        self.free = spots[len(grounded)]
        self.x = dict(self.spots)
        self.centres: dict[str, tuple[float, float]] = {}
        for block in sorted(task.on, key=self._level):
            below = self.on[block]
            if below != GROUND:
                self.x[block] = self.x[below] + u(-0.0008, 0.0008)
            self.centres[block] = self._centre(block)

    def _level(self, block: str) -> int:
        return 0 if self.on[block] == GROUND else 1 + self._level(self.on[block])

    def _face(self, block: str, x: float) -> float:
        """Height of the support of `block` at x."""
        below = self.on[block]
        if below == GROUND:
            return self.slope * (x - PIVOT)
        return self._face(below, x) + self.blocks[below].height

    def _centre(self, block: str) -> tuple[float, float]:
        return self.x[block], self._face(block, self.x[block]) + self.blocks[block].height / 2

    def put(self, block: str, to: str) -> tuple[tuple[float, float], float]:
        """Put a block on `to`; its new centre, and the height of everything it passes."""
        others = [self._face(b, self.x[b]) + self.blocks[b].height for b in self.on if b != block]
        self.on[block] = to
        if to == GROUND:
            self.x[block] = self.free
        else:
            self.x[block] = self.x[to] + self.rng.uniform(-0.0008, 0.0008)
        self.centres[block] = self._centre(block)
        return self.centres[block], max([0.0, *others])


def _servo(stiffness: float, mass: float, ratio: float) -> Servo:
    return Servo(mass, stiffness, 2 * ratio * (stiffness * mass) ** 0.5)


def _move(k: Knots, block: Block, start, end, top: float, world: World, stiffness: float, style: Style,
          pace: float) -> None:  # fmt: skip
    """Move a block from centre `start` to centre `end` [m], over anything up to `top` [m]."""
    u = k.rng.uniform
    # Pads clear the block's support even when sheared by pressing it down.
    lowest = PAD + TIP + CLEARANCE + style.press[1] / 2 / world.shear_stiffness - block.height / 2
    grasp = max(u(*style.height), lowest)
    over = max(top + block.height / 2 + CLEAR, k.value["y"])
    wide = block.width + u(*OPEN)
    opening = max(wide, k.value["left"] * 2)
    k.add("left", k.now, 0.3 / pace, opening / 2)
    k.add("right", k.now, 0.3 / pace, opening / 2)
    k.to(u(0.25, 0.35) / pace, y=over)
    k.to(u(0.5, 0.65) / pace, early=0.1 / pace, x=start[0] + u(-0.0006, 0.0006))
    k.add("left", k.now, 0.4 / pace, wide / 2)
    k.add("right", k.now, 0.4 / pace, wide / 2)
    k.to(u(0.45, 0.6) / pace, early=0.02 / pace, y=start[1] + grasp)
    k.wait(u(*style.dwell))
    grip = u(*style.grip)
    inwards = grip * (1 / stiffness + 1 / world.normal_stiffness)
    closed = k.now
    way = float(k.rng.choice([-1.0, 1.0]))
    k.fingers(u(0.2, 0.28) / pace, block.width - 2 * inwards, way * u(*style.stagger))
    k.wait(u(*style.hold) / pace)
    clear = max(start[1], top + block.height / 2) + CLEAR - 0.004 + grasp
    k.to(u(0.42, 0.55) / pace, y=clear)
    k.to(u(0.5, 0.65) / pace, early=u(0.0, 0.08) / pace, x=end[0])
    sag = block.weight / 2 * (1 / stiffness + 1 / world.shear_stiffness)
    touch = end[1] + grasp + sag
    k.to(u(0.4, 0.5) / pace, early=u(0.0, 0.05) / pace, y=touch + 0.0025)
    pressing = (u(*style.press) + block.weight) / 2 * (1 / stiffness + 1 / world.shear_stiffness)
    # No stop at the surface: a hand moves on until it feels the expected resistance.
    k.to(u(0.36, 0.48) / pace, y=touch - pressing)
    k.wait(u(*style.place) / pace)
    k.held.append((closed, k.now))
    k.fingers(u(0.18, 0.25) / pace, wide, -way * u(*style.stagger) / 2)
    k.wait(u(*style.dwell))
    k.to(u(0.3, 0.4) / pace, y=max(top, end[1] + block.height / 2) + u(*style.rise))


def _rolled(k: Knots, t: np.ndarray, size: float, rng: np.random.Generator) -> np.ndarray:
    """Roll (n,) [rad] of the hand while it carries, of rms `size`; none during grip and release."""
    if not size:
        return np.zeros_like(t)
    out, weight = _shake(t, 0.3, 1.2, 1.0, rng), np.zeros_like(t)
    for begin, end in k.held:
        rise = np.clip((t - begin - 0.5) / 0.3, 0, 1) * np.clip((end - 0.5 - t) / 0.3, 0, 1)
        weight = np.maximum(weight, rise)
    out *= weight
    there = weight > 0  # about from lift to landing: rms over the carries, as the contract has it
    return size * out / np.sqrt(np.mean(out[there] ** 2)) if there.any() else 0 * out


def _shake(t: np.ndarray, low: float, high: float, rms: float, rng: np.random.Generator) -> np.ndarray:
    """Involuntary motion [m]: eight sinusoids between two frequencies [Hz]."""
    out = np.zeros_like(t)
    for _ in range(8):
        out += np.sin(2 * np.pi * rng.uniform(low, high) * t + rng.uniform(0, 2 * np.pi))
    return rms / 2 * out
