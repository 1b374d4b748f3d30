"""Contact that is not tidy: an operator's commands altered so that hands do what hands do.

Each alteration is of the commanded motion, so that the simulator's own mechanics makes the forces;
`turned` alone edits the recording, as the simulator's blocks keep their orientation.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from simgap.world.operator import Plan, Window, minimum_jerk
from simgap.world.performance import CONTROL_PERIOD

Alter = Callable[[Plan, np.random.Generator], Plan]
LATE = (0.02, 0.1)  # s by which one finger closes after the other
PUSH = 1.5e-3  # m that a push on the ground commands
STILL = 10.0  # s of holding a block still in the air
SLOWEST = 0.05  # of the usual pace, amid a hesitation
LOOSENED = 0.06  # s for which a grip opens amid a carry, by ...
SLACK = 0.42  # ... this share of its way: it is lost for 40 ms; from about 0.46 on blocks are dropped


def _row(t: float) -> int:
    return round(t / CONTROL_PERIOD)


def _pulse(n: int) -> np.ndarray:
    """There and back (n,) by minimum-jerk motions."""
    phase = np.linspace(0.0, 1.0, n)
    return minimum_jerk(2 * phase) - minimum_jerk(2 * phase - 1)


def _inserted(plan: Plan, at: float, change: np.ndarray) -> Plan:
    """The plan with a pause at `at` [s]; `change` (n, 4) [m] is added to what is commanded in it."""
    k, longer = _row(at), len(change) * CONTROL_PERIOD
    command = np.concatenate([plan.command[:k], plan.command[k] + change, plan.command[k:]])

    def later(w: Window) -> Window:
        times = {f: getattr(w, f) for f in ("close", "lift", "middle", "open", "end")}
        return replace(w, **{f: v + longer * (v >= at) for f, v in times.items()})

    windows = tuple(later(w) for w in plan.windows)
    return replace(plan, command=command, windows=windows, duration=plan.duration + longer)


def late_finger(plan: Plan, rng: np.random.Generator) -> Plan:
    """One finger closes up to 0.1 s after the other, at every grip."""
    command = plan.command.copy()
    for w in plan.windows:
        late, column = _row(rng.uniform(*LATE)), rng.choice([0, 2])
        start, stop = _row(w.close), _row(w.lift)
        command[start + late : stop, column] = plan.command[start : stop - late, column]
        command[start : start + late, column] = plan.command[start, column]
    return replace(plan, command=command)


def tapping(plan: Plan, rng: np.random.Generator) -> Plan:
    """The fingers touch a block for a moment before they grip it, every time."""
    for k in range(len(plan.windows)):
        w = plan.windows[k]
        row, after = plan.command[_row(w.close)], plan.command[_row(w.lift) - 1]
        grip = (after[2] - after[0]) - (row[2] - row[0])  # to the commanded squeeze, negative
        n = _row(rng.uniform(0.35, 0.5))
        way = -grip / 2 * rng.uniform(0.62, 0.75)
        change = np.zeros((n, 4))
        change[:, 0], change[:, 2] = way * _pulse(n), -way * _pulse(n)
        plan = _inserted(plan, w.close, np.concatenate([change, np.zeros((150, 4))]))
    return plan


def pushed(plan: Plan, rng: np.random.Generator) -> Plan:
    """A gripped block is pushed sideways on the ground before it is lifted."""
    for k in range(len(plan.windows)):
        n, change = _row(0.4), np.zeros((_row(0.4), 4))
        change[:, 0] = change[:, 2] = rng.choice([-PUSH, PUSH]) * _pulse(n)
        plan = _inserted(plan, plan.windows[k].lift - 0.02, change)
    return plan


def still(plan: Plan, rng: np.random.Generator) -> Plan:
    """The first block is held still in the air for ten seconds, but for a tremor."""
    t = np.arange(_row(STILL)) * CONTROL_PERIOD
    change = 4e-5 * np.sin(2 * np.pi * rng.uniform(6, 12, 4) * t[:, None])
    return _inserted(plan, plan.windows[0].middle, change)


def hesitating(plan: Plan, rng: np.random.Generator) -> Plan:
    """The hand nearly stops on its way to a lift, in mid-lift and on its way down, in every move."""
    moments = [m + rng.uniform(-0.05, 0.05) for w in plan.windows
               for m in (w.close - 0.25, w.lift + 0.2, (w.middle + w.open) / 2)]  # fmt: skip
    t = np.arange(len(plan.command)) * CONTROL_PERIOD
    slow = 1 - (1 - SLOWEST) * np.max([np.exp(-(((t - m) / 0.06) ** 2)) for m in moments], axis=0)
    warped = np.concatenate([[0.0], np.cumsum(CONTROL_PERIOD / slow)[:-1]])  # the time now at each row
    fine = np.arange(_row(warped[-1]) + 1) * CONTROL_PERIOD
    command = np.stack([np.interp(fine, warped, c) for c in plan.command.T], axis=1)

    def moved(time: float) -> float:
        return float(np.interp(time, t, warped))

    windows = tuple(
        replace(w, close=moved(w.close), lift=moved(w.lift), middle=moved(w.middle), open=moved(w.open),
                end=moved(w.end)) for w in plan.windows
    )  # fmt: skip
    return replace(plan, command=command, windows=windows, duration=len(fine) * CONTROL_PERIOD)


def slipping(plan: Plan, rng: np.random.Generator) -> Plan:
    """The grip loosens in mid-carry for a moment, the block slips a little and is held again."""
    for k in range(len(plan.windows)):
        w = plan.windows[k]
        open_, held = plan.command[_row(w.close)], plan.command[_row(w.lift) - 1]
        way = ((open_[2] - open_[0]) - (held[2] - held[0])) / 2
        n = _row(LOOSENED)
        change = np.zeros((2 * n, 4))
        loosen = SLACK * way * np.pad(_pulse(n), (0, n))
        change[:, 0], change[:, 2] = -loosen, loosen
        plan = _inserted(plan, w.middle, change)
    return plan


UNTIDY: dict[str, Alter] = {
    "late finger": late_finger, "tapping": tapping, "pushed": pushed, "still": still,
    "hesitating": hesitating, "slipping": slipping,
}  # fmt: skip
