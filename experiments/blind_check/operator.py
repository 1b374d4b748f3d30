"""A person's paths for reversing two stacked blocks, as knots that minimum-jerk motions join.

Flash & Hogan, J. Neurosci. 5, 1985. Every length, duration and force is drawn anew for each trial.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from experiments.blind_check.scene import PIVOT, STEP, TIP, Block, Servo, World

CLEAR = 0.012  # m between a carried block and what it passes over
OPEN = (0.010, 0.013)  # m that fingers are opened wider than a block


@dataclass(frozen=True)
class Style:
    """How a case is worked, as ranges: `pace` (1: two moves in 10 s), `grip` and `press` [N], waits [s]
    at the start (`rest`), open around a block (`dwell`), held (`hold`), placed (`place`) and at the end
    (`finish`); `rise` [m] after letting go; `height` [m] of the grasp over a block's centre.

    Names and meanings are those of the operator settings that a next experiment carries.
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


@dataclass(frozen=True)
class Plan:
    """Commands x1, y1, x2, y2 (n, 4) [m] at every STEP, servos, block centres and moved blocks in order."""

    command: np.ndarray
    servos: tuple[Servo, Servo]
    centres: dict[str, tuple[float, float]]
    moved: tuple[str, ...]


class _Knots:
    """Targets in time of middle x, height y and opening, each reached by minimum jerk."""

    def __init__(self, x: float, y: float, opening: float) -> None:
        self.now = 0.0
        self.value = {"x": x, "y": y, "opening": opening}
        self.parts: list[tuple[str, float, float, float, float]] = []

    def to(self, duration: float, early: float = 0.0, **targets: float) -> None:
        """Move to `targets` in `duration` [s], begun `early` [s] before the last motion ends."""
        start = self.now - early
        for name, target in targets.items():
            self.parts.append((name, start, duration, self.value[name], target))
            self.value[name] = target
        self.now = start + duration

    def wait(self, duration: float) -> None:
        self.now += duration

    def path(self, name: str, first: float, t: np.ndarray) -> np.ndarray:
        out = np.full_like(t, first)
        for part, start, duration, before, after in self.parts:
            if part == name:
                s = np.clip((t - start) / duration, 0, 1)
                out += (after - before) * (((6 * s - 15) * s + 10) * s**3)
        return out


def plan(blocks: dict[str, Block], world: World, style: Style, rng: np.random.Generator) -> Plan:
    """Commands that put block1 from block2 on the table, then block2 on it."""
    u = rng.uniform
    first, second = blocks["block1"], blocks["block2"]
    pace = u(*style.pace)
    stiffness = u(600.0, 1000.0)
    servos = tuple(_servo(stiffness * u(0.95, 1.05), u(0.10, 0.16), u(0.8, 1.1)) for _ in (0, 1))
    here = u(0.106, 0.118)
    # Far enough off that a finger opened around block2 passes block1 where it was put down.
    there = here + (first.width + second.width + OPEN[1]) / 2 + 2 * TIP + u(0.005, 0.014)
    lean = u(-0.0008, 0.0008)
    slope = np.tan(world.tilt)
    low = second.height / 2 + slope * (here - PIVOT)
    centres = {
        "block2": (here, low),
        "block1": (here + lean, slope * (here - PIVOT) + second.height + first.height / 2),
    }
    top = centres["block1"][1] + first.height / 2
    x0, y0, open0 = here + u(-0.015, 0.02), top + u(0.012, 0.02), first.width + u(*OPEN)
    k = _Knots(x0, y0, open0)
    k.wait(u(*style.rest) / pace)
    ground = slope * (there - PIVOT) + first.height / 2
    _move(k, first, centres["block1"], (there, ground), top, world, stiffness, style, pace, rng)
    placed = slope * (there - PIVOT) + first.height
    high = max(placed, second.height + slope * (here - PIVOT))
    target = (there + u(-0.0008, 0.0008), placed + second.height / 2)
    _move(k, second, centres["block2"], target, high, world, stiffness, style, pace, rng)
    k.wait(u(*style.finish))
    t = np.arange(int(k.now / STEP) + 1) * STEP
    x, y, opening = k.path("x", x0, t), k.path("y", y0, t), k.path("opening", open0, t)
    uneven = u(-0.0005, 0.0005)
    command = np.stack([x - opening / 2, y - uneven / 2, x + opening / 2, y + uneven / 2], 1)
    tremor, wander = u(2.5e-5, 6e-5, 4), u(3e-5, 1.5e-4, 4)
    for c in range(4):
        command[:, c] += _shake(t, 7.0, 11.0, tremor[c], rng) + _shake(t, 0.1, 0.5, wander[c], rng)
    return Plan(command, servos, centres, ("block1", "block2"))  # type: ignore[arg-type]


def _servo(stiffness: float, mass: float, ratio: float) -> Servo:
    return Servo(mass, stiffness, 2 * ratio * (stiffness * mass) ** 0.5)


def _move(k: _Knots, block: Block, start, end, top: float, world: World, stiffness: float, style: Style,
          pace: float, rng: np.random.Generator) -> None:  # fmt: skip
    """One block from centre `start` to centre `end` past anything up to `top` [m]."""
    u = rng.uniform
    grasp = u(*style.height)
    over = max(top + block.height / 2 + CLEAR + 0.004, k.value["y"])
    wide = block.width + u(*OPEN)
    k.to(u(0.25, 0.35) / pace, y=over, opening=max(wide, k.value["opening"]))
    k.to(u(0.5, 0.65) / pace, early=0.1 / pace, x=start[0] + u(-0.0006, 0.0006))
    k.to(u(0.45, 0.6) / pace, early=0.02 / pace, y=start[1] + grasp, opening=wide)
    k.wait(u(*style.dwell))
    grip = u(*style.grip)
    inwards = grip * (1 / stiffness + 1 / world.normal_stiffness)
    k.to(u(0.2, 0.28) / pace, opening=block.width - 2 * inwards)
    k.wait(u(*style.hold) / pace)
    clear = max(start[1], top + block.height / 2) + CLEAR + grasp
    k.to(u(0.42, 0.55) / pace, y=clear)
    k.to(u(0.5, 0.65) / pace, early=u(0.0, 0.08) / pace, x=end[0])
    sag = block.weight / 2 * (1 / stiffness + 1 / world.shear_stiffness)
    touch = end[1] + grasp + sag
    k.to(u(0.4, 0.5) / pace, early=u(0.0, 0.05) / pace, y=touch + 0.0025)
    pressing = (u(*style.press) + block.weight) / 2 * (1 / stiffness + 1 / world.shear_stiffness)
    # No stop at the surface: a hand goes on until it feels the resistance it expects.
    k.to(u(0.36, 0.48) / pace, y=touch - pressing)
    k.wait(u(*style.place) / pace)
    k.to(u(0.18, 0.25) / pace, opening=wide)
    k.wait(u(*style.dwell))
    k.to(u(0.3, 0.4) / pace, y=max(top, end[1] + block.height / 2) + u(*style.rise))


def _shake(t: np.ndarray, low: float, high: float, rms: float, rng: np.random.Generator) -> np.ndarray:
    """Involuntary motion [m]: eight sinusoids between two frequencies [Hz]."""
    out = np.zeros_like(t)
    for _ in range(8):
        out += np.sin(2 * np.pi * rng.uniform(low, high) * t + rng.uniform(0, 2 * np.pi))
    return rms / 2 * out
