"""Table 1, equation 1 and Table 2: from the decomposition and from the rules themselves.

python -m experiments.paper.tables
"""

from __future__ import annotations

import itertools

import numpy as np

from experiments.paper.sources import recorded, save, simulated
from experiments.recordings import Case
from hmmseg.contact.decompose import ABOVE_GROUND, FREE, ON_GROUND, decompose, subtasks
from hmmseg.hand.signals import Signals
from hmmseg.segmentation.thresholds import (
    FORCE_THRESHOLD,
    NUMBERS,
    VELOCITY_THRESHOLD,
    label_states,
    threshold,
)

COLUMNS = ("weight", "width", "height", "friction")
SENSED = {"vx": VELOCITY_THRESHOLD, "vy": VELOCITY_THRESHOLD, "fx": FORCE_THRESHOLD,
          "fy": FORCE_THRESHOLD, "grip": FORCE_THRESHOLD, "shear": FORCE_THRESHOLD}  # fmt: skip
SIGNS = {(-1,): "-", (0,): "0", (1,): "+", (-1, 0): "- or 0", (-1, 1): "+ or -", (0, 1): "+ or 0"}


def table_1() -> dict:
    """Rows of Table 1 (all nine subtasks), what goes beyond the paper in parentheses; equation 1."""
    found = decompose(recorded().task)
    rows = []
    for step in found.subtasks:
        row = {"subtask": f"{step.name} {step.object}", "state": step.state}
        cells = {entry.name: found.cell(step.index, entry, evidence)
                 for entry, evidence in found.reveals(step.index)}  # fmt: skip
        rows.append(row | {column: cells.get(column, "") for column in COLUMNS})
    return {"rows": rows, "equation": found.equation()}


def probe() -> Signals:
    """Combinations of finger forces and velocities in which every sensed parameter takes every sign."""
    forces, signs = (-2.0, -1.0, 0.0, 1.0, 2.0), (-1.0, 0.0, 1.0)
    fx1, fx2, fy1, fy2, vx, vy = np.array(list(itertools.product(forces, forces, *[signs] * 4))).T
    zero = np.zeros(fx1.size)
    return Signals(t=np.arange(fx1.size), x1=zero, y1=zero, vx1=vx, vy1=vy, fx1=fx1, fy1=fy1, x2=zero,
                   y2=zero, vx2=vx, vy2=vy, fx2=fx2, fy2=fy2, sd_x=zero, sd_y=zero, sd_vx=zero,
                   sd_vy=zero, sd_force=0.0)  # fmt: skip


def table_2() -> list[dict]:
    """Rows of Table 2, read off the rules: the signs with which each state is ever identified."""
    signals = probe()
    labels = label_states(signals)
    chosen = {
        "free-motion": labels.state == 1,
        "hold-on-ground": (labels.state == 3) & ~labels.sliding,
        "hold-on-ground, sliding": (labels.state == 3) & labels.sliding,
        "hold-above-ground": labels.state == 2,
    }
    rows = []
    for state, there in chosen.items():
        row = {"state": state}
        for name, level in SENSED.items():
            seen = tuple(sorted({int(v) for v in threshold(getattr(signals, name), level)[there]}))
            row[name] = SIGNS.get(seen, "")  # all three: the rule does not ask
        rows.append(row)
    return rows


def agreement(case: Case) -> dict:
    """Share of the samples of each true state that the rules identify as each state, 0 as none."""
    true, found = [], []
    states = np.array([NUMBERS[step.state] for step in subtasks(case.task)])
    for signals, boundaries in zip(case.signals, case.truth, strict=True):
        true.append(states[np.searchsorted(boundaries, signals.t, side="right")])
        found.append(label_states(signals).state)
    true, found = np.concatenate(true), np.concatenate(found)
    table = {
        state: [float(np.mean(found[true == NUMBERS[state]] == k)) for k in (1, 2, 3, 0)]
        for state in (FREE, ABOVE_GROUND, ON_GROUND)
    }
    return {"right": float(np.mean(true == found)), "by_state": table}


def main() -> None:
    """Save all of it."""
    rules = {"rows": table_2(), "recordings": agreement(recorded()), "simulated": agreement(simulated())}
    save("tables", {"table_1": table_1(), "table_2": rules})


if __name__ == "__main__":
    main()
