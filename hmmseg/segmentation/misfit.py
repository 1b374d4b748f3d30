"""What is kept of a trial that leaves its task, and in words where it does.

Kept are the subtasks up to the failing one and, counted back from the end, those that the
recording's last runs still match (same contact state, same block). What lies between is the
recording's own: it belongs to no subtask.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from hmmseg.contact.decompose import ABOVE_GROUND, FREE, ON_GROUND, SLIDING, Subtask
from hmmseg.segmentation.boundaries import BoundaryPosterior
from hmmseg.segmentation.conformity import Conformity, Run
from hmmseg.segmentation.emissions import Parameters

PHRASES = {
    ON_GROUND: "held on the ground", ABOVE_GROUND: "held above the ground", SLIDING: "pushed along",
}  # fmt: skip


@dataclass(frozen=True)
class Plan:
    """The order that a misfit trial shows, as steps to align it with.

    The first `num_before` steps are the task's first; the last `num_after` its last. `start` are
    the alternative's parameters under the names that the steps give to blocks.
    """

    steps: tuple[Subtask, ...]
    num_before: int
    num_after: int
    start: Parameters


def plan(c: Conformity, steps: tuple[Subtask, ...]) -> Plan:
    """The order shown by a trial that fails."""
    failing = c.failing
    if failing is None:
        raise ValueError("the trial fits its task")
    if c.wrong_rise is not None:  # other blocks or places than the task's: nothing after is the task's
        runs = [
            r if r.subtask is not None and r.subtask < failing else replace(r, subtask=None) for r in c.runs
        ]
    else:
        runs = list(c.runs)
    before = sum(r.subtask is not None for r in runs)
    after = 0 if c.wrong_rise is not None else _matching(runs[before:], steps[failing + 1 :], c)
    own = {block: name for name, block in reversed(c.assignment.items()) if block is not None}
    shown, held = [], False
    for i, run in enumerate(runs):
        k = len(steps) - len(runs) + i if i >= len(runs) - after else run.subtask
        if k is None:
            names = {FREE: "release", ON_GROUND: "place" if held else "pickup", SLIDING: "slide",
                     ABOVE_GROUND: "carry"}  # fmt: skip
            block = None if run.block is None else own.get(run.block, f"block {run.block}")
            shown.append(Subtask(i, names[run.state], block, run.state, None))
        else:
            shown.append(replace(steps[k], index=i))
        held = run.state != FREE
    called = {str(s.object): str(run.block) for s, run in zip(shown, runs, strict=True) if s.state != FREE}
    learned = c.free.parameters
    start = replace(
        learned,
        weight={name: learned.weight[block] for name, block in called.items()},
        width={name: learned.width[block] for name, block in called.items()},
    )
    return Plan(tuple(shown), before, after, start)


def _matching(runs: Sequence[Run], tail: Sequence[Subtask], c: Conformity) -> int:
    """How many of the last runs match the task's last subtasks."""
    count = 0
    for run, step in zip(reversed(runs), reversed(tail), strict=False):
        expected = None if step.state == FREE else c.assignment.get(str(step.object))
        if run.state != step.state or run.block != expected:
            break
        count += 1
    return count if count > 1 else 0  # free motion alone says nothing of which release it is


def task_boundaries(
    shown: Plan, found: Sequence[BoundaryPosterior], num_subtasks: int, first: float, last: float
) -> tuple[BoundaryPosterior, ...]:
    """The task's boundaries from those of the order shown.

    The failing subtask takes all that belongs to none; missing ones after it have no length.
    """
    every = [at(first), *found, at(last)]  # every[i] is where step i starts
    resume = every[len(shown.steps) - shown.num_after]
    out = []
    for k in range(1, num_subtasks):
        back = num_subtasks - k
        if k <= shown.num_before:
            out.append(every[k])
        elif back < shown.num_after:
            out.append(every[len(shown.steps) - back])
        else:
            out.append(resume)
    return tuple(out)


def at(t: float) -> BoundaryPosterior:
    """A boundary that is known to be at t [s]."""
    return BoundaryPosterior(np.array([t]), np.array([1.0]))


def explain(
    c: Conformity, steps: tuple[Subtask, ...], starts: Sequence[float], stands: np.ndarray | None = None
) -> str:
    """Why the failing subtask is not there, in plain words.

    `starts` [s]: when each step of the order shown starts; `stands` [s]: when a finger stood on something.
    """
    if c.failing is None:
        raise ValueError("the trial fits its task")
    expected = steps[c.failing]
    if c.wrong_rise is not None:
        moved = "raised" if c.wrong_rise > 0 else "lowered"
        distance = f"{abs(c.wrong_rise) * 1e3:.0f} mm from pickup to place"
        return (
            f"{expected.object} was {moved} by {distance}, against the task: another block, or another place"
        )
    left = next((i for i, run in enumerate(c.runs) if run.subtask is None), None)
    if left is None:
        return _ended(steps[c.failing - 1], c.runs)
    if left == 0:
        return f"the recording starts while a block is {PHRASES[c.runs[0].state]}"
    if c.runs[left].state == FREE:
        return _stood(steps[left - 1], left, starts, stands) or _let_go(c, steps[left - 1], left, starts)
    if c.runs[left - 1].state == FREE:
        return _gripped(c, steps, left, starts[left])
    step, then = steps[left - 1], PHRASES[c.runs[left].state]
    return f"{step.object} is {then} at {starts[left]:.2f} s, where the task has {steps[c.failing].name}"


def _ended(last: Subtask, runs: Sequence[Run]) -> str:
    if last.state != FREE:
        return f"the recording ends while {last.object} is {PHRASES[last.state]}"
    grips = sum(a.state == FREE != b.state for a, b in itertools.pairwise(runs))
    number = {0: "", 1: "second ", 2: "third "}.get(grips, "further ")
    return f"no {number}grip: the recording ends in free motion"


def _stood(held: Subtask, left: int, starts: Sequence[float], stands: np.ndarray | None) -> str:
    """What is said of a grip that never lifted, where a finger stood on something meanwhile."""
    if stands is None or held.name != "pickup":
        return ""
    before = starts[left - 2] if left > 1 else -np.inf  # free motion before the grip
    then = stands[(stands >= before) & (stands < starts[left])]
    if not then.size:
        return ""
    return (
        f"a finger pushed down on something at {then[0]:.2f} s, harder than a grip could, before "
        f"{held.object} was held: on the ground, or on what the task does not name"
    )


def _let_go(c: Conformity, held: Subtask, left: int, starts: Sequence[float]) -> str:
    where = {"carry": " in mid-air", "pickup": " without being lifted"}.get(held.name, "")
    text = f"{held.object} was let go{where} at {starts[left]:.2f} s"
    again = next((i for i in range(left + 1, len(c.runs)) if c.runs[i].state != FREE), None)
    if again is not None and c.runs[again].block == c.runs[left - 1].block:
        text += f" and gripped again at {starts[again]:.2f} s"
    return text


def _gripped(c: Conformity, steps: tuple[Subtask, ...], left: int, t: float) -> str:
    if left == len(steps):
        return f"the recording goes on after the task's end with another grip at {t:.2f} s"
    expected, block = steps[left].object, c.runs[left].block
    before = [
        str(steps[r.subtask].object) for r in c.runs[:left] if r.subtask is not None and r.block == block
    ]
    if block is not None and before and before[-1] != expected:
        return f"{before[-1]} was gripped again at {t:.2f} s, not {expected}"
    if block != c.assignment.get(str(expected)):
        return f"another block than {expected} was gripped at {t:.2f} s"
    return f"{expected} is {PHRASES[c.runs[left].state]} from the moment it is gripped at {t:.2f} s"
