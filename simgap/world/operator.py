"""A simulated operator who performs any block task, with the motions, grip, dwell and tremor of a person.

A plan is a sequence of commanded fingertip positions; the compliant hand (`simgap.world.dynamics`) turns
commands beyond a contact into grip and pressing. Motions are minimum-jerk (Flash & Hogan, J. Neurosci. 5,
1985) and are superposed where one begins before another ends (Flash & Henis, J. Cogn. Neurosci. 3, 1991);
physiological tremor lies at 6-12 Hz.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import AfterValidator, BeforeValidator

from hmmseg.io.rig import Rig
from hmmseg.io.schema import Finite, FinitePositive, StrictTable, read_json, read_toml
from hmmseg.io.task import BlockTask, Move
from simgap.world.dynamics import CONTROL_PERIOD
from simgap.world.properties import Blocks, Tabletop, lay_out
from simgap.world.virtual_model import finite_stiffness

TREMOR_BAND = (6.0, 12.0)  # cited: Hz
WANDER_BAND = (0.1, 0.6)  # prior: Hz
HOVER = 0.008  # look: m; clearance of the open fingers above the highest block
NEAR = 0.0025  # look: m above touchdown, where a quick descent becomes a slow approach
PACE = 5.0  # cited: s; shortest time per move, the paper's (two moves in 10 s)


def _pair(given: Any) -> Any:
    return [given, given] if isinstance(given, int | float) else given


def _rising(given: tuple[float, float]) -> tuple[float, float]:
    if not given[0] <= given[1]:
        raise ValueError(f"is {given}; expected (low, high), low <= high")
    return given


Range = Annotated[tuple[Finite, Finite], BeforeValidator(_pair), AfterValidator(_rising)]
Above = Annotated[tuple[FinitePositive, Finite], BeforeValidator(_pair), AfterValidator(_rising)]


class OperatorSettings(StrictTable):
    """Ranges from which the operator's quantities are drawn uniformly, once per motion.

    Times [s], lengths [m], forces [N]; `pace` divides all durations. Drawn once per trial: the hand's
    `hand_stiffness` [N/m], `hand_mass` [kg] and `hand_damping` (ratio), the `offset` between the fingers'
    heights, and the rms `tremor` and `wander` of each tip."""

    grip: Above = (2.0, 3.2)
    press: Range = (0.9, 1.9)
    slide_press: Range = (0.0, 0.2)
    rest: Range = (0.2, 0.5)
    travel: Range = (0.45, 0.6)
    descend: Range = (0.38, 0.5)
    dwell: Range = (0.02, 0.1)
    close: Range = (0.18, 0.26)
    hold: Range = (0.3, 0.5)
    lift: Range = (0.36, 0.48)
    air: Range = (0.05, 0.25)  # pause between the parts of a carry; if negative, they overlap
    approach: Range = (0.14, 0.2)
    place: Range = (0.3, 0.5)
    slide: Range = (0.6, 0.9)
    open: Range = (0.14, 0.2)
    finish: Range = (0.3, 0.4)
    clearance: Range = (0.010, 0.013)  # opening in excess of a block's width
    rise: Range = (0.012, 0.018)
    grasp: Range = (-0.001, 0.001)  # height of the grasp above the block's centre
    misplacement: Range = (-0.0008, 0.0008)
    offset: Range = (-0.0005, 0.0005)
    tremor: Range = (2.5e-5, 5.5e-5)
    wander: Range = (3e-5, 1.8e-4)
    hand_stiffness: Above = (350.0, 550.0)
    hand_mass: Above = (0.10, 0.18)
    hand_damping: Above = (0.7, 1.0)
    pace: Above = (1.0, 1.0)


def read_operator(path: str | Path) -> OperatorSettings:
    """Settings from a TOML or JSON file: [low, high] or one number per name; InputError if invalid."""
    json = Path(path).suffix.lower() == ".json"
    table = read_json(path, "operator settings") if json else read_toml(path)
    return OperatorSettings.validated(table, str(path))


@dataclass(frozen=True)
class Window:
    """Command times of a move [s]: closing, lifting (or pushing), midway, opening, let go."""

    object: str
    slide: bool
    close: float
    lift: float
    middle: float
    open: float
    end: float


@dataclass(frozen=True)
class Plan:
    """One performance as it is commanded."""

    command: np.ndarray  # (num_periods, 4) tips x1, y1, x2, y2 [m], one row per control period
    impedance: tuple[float, float, float]  # of the hand: mass [kg], stiffness [N/m], damping [N s/m]
    start: dict[str, tuple[float, float]]  # initial centre of every block [m]
    windows: tuple[Window, ...]
    duration: float  # [s] of the trial


def minimum_jerk(phase: np.ndarray) -> np.ndarray:
    """Completed share of a minimum-jerk motion at a phase of 0 to 1 (Flash & Hogan 1985)."""
    s = np.clip(phase, 0.0, 1.0)
    return s**3 * (10.0 - 15.0 * s + 6.0 * s**2)


class _Coordinate:
    """One commanded coordinate: a start and superposed minimum-jerk motions."""

    def __init__(self, start: float) -> None:
        self.start = self.target = start
        self.motions: list[tuple[float, float, float]] = []

    def go(self, target: float, at: float, duration: float) -> None:
        self.motions.append((at, duration, target - self.target))
        self.target = target

    def sample(self, t: np.ndarray) -> np.ndarray:
        out = np.full_like(t, self.start)
        for at, duration, way in self.motions:
            out += way * minimum_jerk((t - at) / duration)
        return out


class _Performer:
    """State of a performance while it is planned: commanded coordinates, tabletop and clock [s]."""

    def __init__(self, rig: Rig, blocks: Blocks, table: Tabletop, settings: OperatorSettings,
                 rng: np.random.Generator) -> None:  # fmt: skip
        self.blocks, self.table, self.settings, self.rng = blocks, table, settings, rng
        self.pace = self.draw("pace")
        self.stiffness, self.mass = self.draw("hand_stiffness"), self.draw("hand_mass")
        self.pad_normal = finite_stiffness(rig.fingertip.normal_stiffness)
        self.pad_shear = finite_stiffness(rig.fingertip.shear_stiffness)
        self.clock = self.time("rest")

    def draw(self, name: str) -> float:
        """Draw a value of a setting."""
        return float(self.rng.uniform(*getattr(self.settings, name)))

    def time(self, name: str, way: float = 0.0, usual: float = 1.0) -> float:
        """Draw a duration [s] at the operator's pace, longer if the way [m] exceeds the usual one."""
        return self.draw(name) / self.pace * max(1.0, way / usual)

    def begin(self, name: str) -> None:
        """Wait with open fingers above and next to the first block."""
        self.x = _Coordinate(self.table.x[name] + self.rng.uniform(-0.02, 0.02))
        self.y = _Coordinate(self.table.top() + self.rng.uniform(0.012, 0.022))
        self.gap = _Coordinate(self.blocks[name].width + self.draw("clearance"))

    def perform(self, move: Move) -> Window:
        """Plan pregrasp, pickup, carry or slide, place and release of a move."""
        block, centre = self.blocks[move.object], self.table.centre(move.object)
        grasp = centre + self.draw("grasp")
        self._reach(self.table.x[move.object], grasp, block.width + self.draw("clearance"))
        close, squeeze = self.clock, self.draw("grip") * (1 / self.pad_normal + 1 / self.stiffness)
        closing = self.time("close")
        self.gap.go(block.width - 2 * squeeze, close, closing)
        lift = close + closing + self.time("hold")
        middle, placed = self._slide(move, lift) if move.slide else self._carry(move, lift, grasp - centre)
        release, opening = placed + self.time("place"), self.time("open")
        self.gap.go(block.width + self.draw("clearance"), release, opening)
        end = release + opening + self.time("dwell")
        above = max(self.y.target + self.draw("rise"), self.table.top() + HOVER)
        rising = self.time("lift", above - self.y.target, 0.03)
        self.y.go(above, end, rising)
        self.clock = end + rising
        return Window(move.object, move.slide, close, lift, middle, release, end)

    def _reach(self, x: float, y: float, opening: float) -> None:
        """Move over a block and descend around it."""
        travel = self.time("travel", abs(x - self.x.target), 0.05)
        self.x.go(x + self.draw("misplacement"), self.clock, travel)
        self.gap.go(max(opening, self.gap.target), self.clock, travel)
        down = self.clock + travel + self.time("dwell")
        descend = self.time("descend", self.y.target - y, 0.04)
        self.y.go(y, down, descend)
        self.clock = down + descend + self.time("dwell")

    def _slide(self, move: Move, start: float) -> tuple[float, float]:
        """Push a block along its support; the times [s] midway and at the end."""
        target = self.table.slide(move, self.draw("misplacement"))
        way = abs(target - self.x.target)
        duration = self.time("slide", way, 0.05) * min(1.0, max(0.4, way / 0.03))
        self.y.go(self.y.target - self.draw("slide_press") / (2 * self.stiffness), start - 0.1, 0.1)
        self.x.go(target, start, duration)
        return start + duration / 2, start + duration

    def _carry(self, move: Move, start: float, grasp: float) -> tuple[float, float]:
        """Lift a block, carry it over its destination and press it down; the times [s] midway and then."""
        block, before = self.blocks[move.object], self.table.centre(move.object)
        target = self.table.carry(move, self.draw("misplacement"))
        rest, rise = self.table.centre(move.object), self.draw("rise")
        clear = self.table.top(without=move.object) + block.height / 2
        high = max(before, clear) + grasp + rise
        up, fall = self.time("lift", high - before, 0.035), self.time("descend", high - rest, 0.04)
        travel = self.time("travel", abs(target - self.x.target), 0.05)
        self.y.go(high, start, up)
        across = start + up + self.time("air")
        self.x.go(target, across, travel)
        down = across + travel + self.time("air")
        # At touchdown the block hangs from the pads' shear; pressing commands the tips beyond it.
        touch = rest + grasp + block.weight / (2 * self.pad_shear)
        self.y.go(touch + NEAR, down, fall)
        press, ramp = self.draw("press") / (2 * self.stiffness), self.time("hold")
        landing, approach = down + 0.9 * fall, self.time("approach")
        self.y.go(touch - press / 2, landing, approach)
        self.y.go(touch - press, landing + approach, ramp)
        return across + travel / 2, landing + approach


def plan(task: BlockTask, rig: Rig, blocks: Blocks, settings: OperatorSettings,
         rng: np.random.Generator) -> Plan:  # fmt: skip
    """Plan one performance of a task, with all variation drawn from `rng`."""
    table = lay_out(task, blocks, settings.clearance[1], settings.misplacement, rng)
    start = {name: (table.x[name], table.centre(name)) for name in task.objects}
    performer = _Performer(rig, blocks, table, settings, rng)
    performer.begin(task.performed[0].object)
    windows = tuple(performer.perform(move) for move in task.performed)
    duration = max(PACE * len(windows) / performer.pace, performer.clock + performer.time("finish"))
    t = np.arange(round(duration / CONTROL_PERIOD) + 1) * CONTROL_PERIOD
    x, y, gap = (c.sample(t) for c in (performer.x, performer.y, performer.gap))
    offset, tremor, wander = (performer.draw(name) for name in ("offset", "tremor", "wander"))
    tips = np.stack([x - gap / 2, y - offset / 2, x + gap / 2, y + offset / 2], 1)
    for k in range(4):
        tips[:, k] += _sway(t, TREMOR_BAND, tremor, rng) + _sway(t, WANDER_BAND, wander, rng)
    damping = 2 * performer.draw("hand_damping") * np.sqrt(performer.stiffness * performer.mass)
    return Plan(tips, (performer.mass, performer.stiffness, damping), start, windows, duration)


def _sway(t: np.ndarray, band: tuple[float, float], rms: float, rng: np.random.Generator) -> np.ndarray:
    """Narrow-band motion [m] (T,) of a given rms: sinusoids of random frequency and phase."""
    count = 6
    frequency, phase = rng.uniform(*band, (count, 1)), rng.uniform(0, 2 * np.pi, (count, 1))
    return rms * np.sqrt(2 / count) * np.sin(2 * np.pi * frequency * t + phase).sum(axis=0)
