"""Does a trial show its task? The task's order against contact states in any order.

One hidden Markov model holds both: the chain of the task's subtasks, and the states of
free_contacts, into which a path may leave the chain for good. P(leaving) is small (DEPARTURE), so
that a trial counts as a misfit only where leaving gains more evidence than that (posterior odds
above 1); the subtask that the path then does not reach is the one that fails. Ending before the
last subtask, or starting outside of the first one, is leaving as well.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from hmmseg.contact.decompose import FREE, Subtask, height_equations, subtasks
from hmmseg.hmm.alignment import align
from hmmseg.io.task import BlockTask
from hmmseg.levels import MOVED
from hmmseg.segmentation.departure import column, departing, leaving, scored, settled
from hmmseg.segmentation.emissions import Features
from hmmseg.segmentation.first_look import Block
from hmmseg.segmentation.free_contacts import FreeContacts, fit_free_contacts, log_evidence, most_probable

ENDING = 1e-3  # prior: and that its recording stops before the task's end
# cited: s; nobody grips anew before a slip was felt (Johansson and Westling, Exp. Brain Res. 66, 1987)
LAPSE = 0.074
MAX_RATE = 50.0  # chosen: Hz; noise of finer samples is averaged before they are judged
MAX_ASSIGNMENTS = 24  # numerics: tried at most
MANY = 20  # learned: trials; of more than these one alone does not sway what most have learned
BETWEEN_TRIALS = 2.0  # prior: slack of like blocks: poses, pads and cables shift widths and weights as well


@dataclass(frozen=True)
class Run:
    """Samples [start, stop) of a path in one state: its contact state and the trial's own block.

    `subtask` is the index in the task, None once the trial has left its task.
    """

    state: str
    block: int | None
    start: int
    stop: int
    subtask: int | None


@dataclass(frozen=True)
class Conformity:
    """How far a trial follows its task.

    `failing` is the index of the first subtask that it does not show, None where it shows all.
    `log_odds`: log posterior odds of leaving the task against completing it (nats; the prior's are
    about log(K DEPARTURE)); `log_evidence` is that of both together. `assignment` gives each object
    its block in `free.blocks`, None for one that the trial does not show. `wrong_rise` [m]: how far
    the object of the failing subtask went up between pickup and place, where that is what fails.
    """

    free: FreeContacts
    assignment: dict[str, int | None]
    runs: tuple[Run, ...]
    failing: int | None
    log_odds: float
    log_evidence: float
    wrong_rise: float | None = None

    def block(self, name: str) -> Block | None:
        """The trial's own block that stands for an object of the task."""
        index = self.assignment.get(name)
        return None if index is None else self.free.blocks[index]


def examine(features: Sequence[Features], tasks: Sequence[BlockTask]) -> list[Conformity]:
    """Conformity of every trial; `tasks` have the same moves, each from where its trial starts.

    `features` need no more than MAX_RATE: contact states last longer than its samples.

    Each trial is judged by its own parameters; what most others have learned of the blocks then
    tells whether it moved the same ones.
    """
    steps = subtasks(tasks[0])
    sliding = any(move.slide for move in tasks[0].moves)
    alone = [conformity(fit_free_contacts(f, sliding), steps) for f in features]
    fitting = [c for c in alone if c.failing is None]
    among_many = _consensus(fitting) if len(fitting) > MANY else None
    found = []
    for f, c, task in zip(features, alone, tasks, strict=True):
        known = among_many or _consensus([other for other in fitting if other is not c])
        if known and (c.failing is not None or any(_differ(c.block(n), b) for n, b in known.items())):
            c = conformity(c.free, steps, known)
        found.append(_check_rises(f, c, steps, task))
    return found


def _consensus(others: Sequence[Conformity]) -> dict[str, Block]:
    """Median width and weight per object where most of at least two other trials agree."""
    out = {}
    for name in others[0].assignment if len(others) > 1 else ():
        blocks = [b for c in others if (b := c.block(name)) is not None]
        if len(blocks) < 2:
            continue
        weights = [b.weight for b in blocks if np.isfinite(b.weight)]
        weight = float(np.median(weights)) if weights else np.nan
        usual = Block(float(np.median([b.width for b in blocks])), weight)
        if 2 * sum(not _differ(b, usual) for b in blocks) > len(blocks):
            out[name] = usual
    return out


def _differ(own: Block | None, known: Block) -> bool:
    return own is None or not own.like(known, BETWEEN_TRIALS)


def _check_rises(f: Features, c: Conformity, steps: tuple[Subtask, ...], task: BlockTask) -> Conformity:
    """The verdict, with blocks put down on the wrong side of where they were picked up.

    One such move was put in another place; several are other blocks than the task's from the start.
    """
    wrong = []
    for move, rise in height_equations(task):
        held = [s.index for s in steps if s.move == move and s.state != FREE]
        spans = {r.subtask: slice(r.start, r.stop) for r in c.runs if r.subtask in (held[0], held[-1])}
        if len(spans) < 2 or not rise or len({np.sign(v) for v in rise.values()}) > 1:
            continue
        height = f.block_y(c.free.parameters.bias)
        if not all(np.isfinite(height[span]).any() for span in spans.values()):
            continue
        risen = float(np.nanmedian(height[spans[held[-1]]]) - np.nanmedian(height[spans[held[0]]]))
        if risen * np.sign(next(iter(rise.values()))) < -MOVED:
            wrong.append((held[0], held[-1], risen))
    if not wrong:
        return c
    failing = wrong[0][0] if len(wrong) > 1 else wrong[0][1]
    return replace(c, failing=failing, wrong_rise=wrong[0][2])


def conformity(
    free: FreeContacts, steps: tuple[Subtask, ...], known: dict[str, Block] | None = None
) -> Conformity:
    """Compare the task's order with the alternative.

    Which of the trial's blocks is which object is the assignment of highest evidence among all
    tried (the first with which the trial fits, if any), unless `known` blocks say it.
    """
    ways = assignments(free, steps)
    if known:
        fixed = _recognised(free, known)
        ways = [assignment | fixed for assignment in ways]
    found = []
    for assignment in ways:
        c = _compare(free, steps, assignment)
        while c.failing is not None and (lost := _lapses(c)):
            c = _compare(_unread(c.free, lost), steps, assignment)
        found.append(c)
        if c.failing is None:
            return c
    return max(found, key=lambda c: c.log_evidence)


def _lapses(c: Conformity) -> list[slice]:
    """Samples in which a departure has a grip lose its block for too brief a moment to grip anew.

    From the first of them to the last it was lost for sure. Those that were left out before say nothing.
    """
    out = []
    for before, lost, after in zip(c.runs, c.runs[1:], c.runs[2:], strict=False):
        brief = (lost.stop - lost.start - 1) * c.free.interval <= LAPSE
        span = slice(lost.start, lost.stop)
        if brief and lost.state == FREE and before.block == after.block and c.free.table[span].any():
            out.append(span)
    return out


def _unread(free: FreeContacts, spans: Sequence[slice]) -> FreeContacts:
    """The alternative without what some samples say."""
    table, ringing, opened = free.table.copy(), free.ringing.copy(), free.opened.copy()
    for span in spans:
        table[span], ringing[span], opened[span] = 0.0, 0.0, 0.0
    return replace(free, table=table, ringing=ringing, opened=opened)


def _recognised(free: FreeContacts, known: dict[str, Block]) -> dict[str, int | None]:
    """Nearest of the trial's blocks that may be the known one, None where there is none."""
    out: dict[str, int | None] = {}
    for name, block in known.items():
        alike = [i for i, own in enumerate(free.blocks) if own.like(block, BETWEEN_TRIALS)]
        out[name] = min(alike, key=lambda i: abs(free.blocks[i].width - block.width), default=None)
    return out


def assignments(free: FreeContacts, steps: Sequence[Subtask]) -> list[dict[str, int | None]]:
    """Assignments of the task's objects to the trial's blocks, likeliest first, MAX_ASSIGNMENTS at most.

    Distinct ones as long as there are enough blocks, else all blocks are some object's. First as the trial
    grips them, one after the other, and as if it had one grip more, or one less, than the task; then any.
    """
    names = list(dict.fromkeys(str(s.object) for s in steps if s.object is not None))
    numbers = range(len(free.blocks))
    if not numbers:
        return [dict.fromkeys(names)]
    few = len(numbers) < len(names)  # some objects look alike, or are never touched
    orders = (
        itertools.product(numbers, repeat=len(names)) if few else itertools.permutations(numbers, len(names))
    )
    least = len(numbers) if few else len(names)
    out: list[dict[str, int | None]] = []
    for order in itertools.chain(_as_gripped(free, steps, names), orders):
        each: dict[str, int | None] = dict(zip(names, order, strict=True))
        if len(set(order)) == least and each not in out:
            out.append(each)
        if len(out) == MAX_ASSIGNMENTS:
            break
    return out


def _as_gripped(
    free: FreeContacts, steps: Sequence[Subtask], names: Sequence[str]
) -> Iterator[tuple[int, ...]]:
    """Blocks of the objects (num_objects,) as they are held when it is their turn.

    Objects whose turn never comes are the blocks that are left, if any is.
    """
    moved = [str(then.object) for s, then in itertools.pairwise(steps) if s.state == FREE != then.state]
    gripped = free.gripped
    ways = [(moved, gripped)]
    ways += [(moved, gripped[:k] + gripped[k + 1 :]) for k in range(min(len(gripped), len(moved)))]
    ways += [(moved[:k] + moved[k + 1 :], gripped) for k in range(len(moved))]
    for objects, blocks in ways:
        first: dict[str, int] = {}
        for name, block in zip(objects, blocks, strict=False):
            first.setdefault(name, block)
        left = [block for block in range(len(free.blocks)) if block not in first.values()]
        for name in names:
            if name not in first:
                first[name] = left.pop(0) if left else 0
        yield tuple(first[name] for name in names)


def _compare(free: FreeContacts, steps: tuple[Subtask, ...], assignment: dict[str, int | None]) -> Conformity:
    n, num_subtasks = len(free.table), len(steps)
    columns = [column(free, s, assignment) for s in steps]
    leave = leaving(num_subtasks, n)
    table, stages, model = settled(free, columns, *departing(free.states, columns, leave))
    num_states = num_subtasks + len(free.states)
    last = np.arange(num_states) == num_subtasks - 1
    table[-1, np.tile(np.arange(num_states) < num_subtasks - 1, stages + 1)] += np.log(ENDING)
    table[-1, : stages * num_states] += np.log(ENDING)  # to end amid a change of contact is rare

    def ending(in_these: np.ndarray) -> np.ndarray:
        every = table.copy()
        every[-1, ~np.tile(in_these, stages + 1)] = -np.inf
        return every

    log_left, log_complete = (log_evidence(ending(ends), *model) for ends in (~last, last))
    failing = None
    if log_left > log_complete:
        runs = _runs(most_probable(ending(~last), *model) % num_states, steps, free, columns)
        failing = min(sum(r.subtask is not None for r in runs), num_subtasks - 1)
    else:
        chain = scored(free, columns)[:, :num_subtasks]
        chain[-1, :-1] += np.log(ENDING)
        leaves = np.full(num_subtasks, leave)
        path = align(chain, np.log1p(-leaves), np.log(leaves[:-1])).path
        runs = _runs(path, steps, free, columns)
    total = float(np.logaddexp(log_left, log_complete))
    return Conformity(free, assignment, runs, failing, log_left - log_complete, total)


def _runs(path: np.ndarray, steps: Sequence[Subtask], free: FreeContacts,
          columns: Sequence[int | None]) -> tuple[Run, ...]:  # fmt: skip
    edges = np.flatnonzero(np.diff(path, prepend=-1, append=-1))
    out = []
    for start, stop in itertools.pairwise(edges):
        k = int(path[start])
        chained = k < len(steps)
        column = columns[k] if chained else k - len(steps)
        state, block = (steps[k].state, None) if column is None else free.states[column]
        out.append(Run(state, block, int(start), int(stop), k if chained else None))
    return tuple(out)
