"""Conformity of a trial to its task: the task's order against contact states in any order.

A single hidden Markov model contains both: the chain of the task's subtasks, and the states of
`free_contacts`, for which a path may leave the chain for good. The probability of departure is small
(DEPARTURE), so a trial is a misfit only if departing gains more evidence than that (posterior odds above 1);
the failing subtask is then the one that the path does not reach. Ending before the last subtask, or starting
outside the first, is a departure as well. Contacts ring and bounce for a while after each change, so every
state is entered through settling stages (docs/segmentation.md).

For a misfit, the subtasks before the failing one are reported together with the final subtasks, counted from
the end, that the last runs of the recording still match (same contact state, same block). Whatever lies in
between belongs to no subtask.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from hmmseg.contact.decompose import (
    ABOVE_GROUND,
    FREE,
    ON_GROUND,
    SLIDING,
    Subtask,
    height_equations,
    subtasks,
)
from hmmseg.hmm import Chain, dense, viterbi
from hmmseg.io.task import BlockTask
from hmmseg.levels import MOVED, SETTLING
from hmmseg.segmentation.boundaries import BoundaryPosterior
from hmmseg.segmentation.emissions import Features, Parameters
from hmmseg.segmentation.free_contacts import RINGING, Block, FreeContacts, fit_free_contacts, switching

DEPARTURE = 1e-4  # prior: probability that a trial leaves its task at any one boundary
STAGES = 3  # prior: most stages of the Erlang distribution of settling times
IMPOSSIBLE = -1e3  # numerics: log-likelihood of a state that the trial never shows
BRIEF = 1e-8  # prior: factor for leaving unsettled: a bounce is no grip, a halt in the air no place


def column(free: FreeContacts, step: Subtask, assignment: dict[str, int | None]) -> int | None:
    """Index in `free.states` of the contact state of a subtask in one trial; None if its block is absent."""
    state = (step.state, None if step.state == FREE else assignment.get(str(step.object)))
    return free.states.index(state) if state in free.states else None


def scored(free: FreeContacts, columns: Sequence[int | None]) -> np.ndarray:
    """Log-likelihoods (num_timesteps, num_subtasks + num_states) of the chain, then of the free states."""
    n = len(free.table)
    chain = [np.full(n, IMPOSSIBLE) if c is None else free.table[:, c] for c in columns]
    return np.column_stack([*chain, free.table])


def settled(
    free: FreeContacts, columns: Sequence[int | None], log_initial: np.ndarray, log_transition: np.ndarray
) -> tuple[np.ndarray, int, tuple[np.ndarray, np.ndarray]]:
    """Add settling stages: log-likelihoods, number of stages, and (log_initial, log_transition)."""
    stages = int(np.clip(round(SETTLING / free.interval / 2), 1, STAGES))
    settle = min(0.5, stages * free.interval / SETTLING)
    index = np.r_[[-1 if c is None else c for c in columns], np.arange(len(free.states))]
    table = scored(free, columns)
    staged = np.empty((len(table), stages + 1, table.shape[1]))  # the largest table of a long recording
    staged[:, -1] = table
    staged[:, :-1] = _settling_table(table, index, free)[:, None]
    # Within the task, a block is lowered and fingers open to release it; a path that departs may lose it.
    for i, (before, c) in enumerate(itertools.pairwise(columns), 1):
        if c is not None and free.states[c][0] == FREE:
            staged[:, 0, i] += free.opened[: len(table)]
        elif c is not None and before is not None and free.states[before][0] == ABOVE_GROUND:
            staged[:, 0, i] += free.lowered[: len(table)]
    model = _settling(log_initial, log_transition, stages, settle)
    return staged.reshape(len(table), -1), stages, model


def departing(
    states: tuple[tuple[str, int | None], ...], columns: Sequence[int | None], leave: float
) -> tuple[np.ndarray, np.ndarray]:
    """Log initial and transition probabilities of the chain followed by the free states.

    `leave`: probability per sample of leaving a contact state.
    """
    k, num_states = len(columns), len(states)
    out = np.full((k + num_states, k + num_states), -np.inf)
    out[k:, k:] = switching(states, leave)
    index = np.arange(k)
    out[index, index] = np.log1p(-leave)
    out[index[:-1], index[1:]] = np.log(leave) + np.log1p(-DEPARTURE)
    for i, same in enumerate(columns):
        if same is not None:
            follows = np.isfinite(out[k + same, k:])
            follows[same] = False  # staying in the same contact state is no departure
            out[i, k:][follows] = np.log(leave * DEPARTURE / max(follows.sum(), 1))
    initial = np.full(k + num_states, np.log(DEPARTURE / num_states))
    initial[: k + 1] = -np.inf  # initial free motion always belongs to the task
    initial[0] = np.log1p(-DEPARTURE)
    return initial, out


def _settling(
    log_initial: np.ndarray, log_transition: np.ndarray, stages: int, settle: float
) -> tuple[np.ndarray, np.ndarray]:
    """Replicate every state stages + 1 times: entered in the first stage, settled in the last.

    A stage passes to the next with probability `settle` per sample, so durations are Erlang rather than
    geometric; before the last stage, leaving the state is BRIEF times as likely. Recordings start settled.
    Returns log initial and log transition probabilities over (stages, states).
    """
    same = np.eye(log_initial.size, dtype=bool)
    stay, move = np.where(same, log_transition, -np.inf), np.where(same, -np.inf, log_transition)
    blocks = [[np.full_like(stay, -np.inf)] * (stages + 1) for _ in range(stages + 1)]
    for i in range(stages):
        blocks[i][i], blocks[i][i + 1] = stay + np.log1p(-settle), stay + np.log(settle)
        blocks[i][0] = np.logaddexp(blocks[i][0], move + np.log(BRIEF))
    blocks[-1][-1], blocks[-1][0] = stay, move
    return np.r_[np.full(stages * log_initial.size, -np.inf), log_initial], np.block(blocks)


def _settling_table(table: np.ndarray, columns: np.ndarray, free: FreeContacts) -> np.ndarray:
    """Log-likelihoods (num_timesteps, num_states) while a contact settles.

    Fingers and block ring for a while after any contact change. The forces of a ringing sample identify the
    held block but not how it is held, so every hold of that block scores as the likeliest of them. Fingers
    that have just released a block ring in the air.
    """
    out = table.copy()
    blocks = np.array([-1 if block is None else block for _, block in free.states])
    block = np.where(columns < 0, -1, blocks[columns])
    out[:, (columns >= 0) & (block < 0)] = free.ringing[: len(table), None]
    for number in np.unique(block[block >= 0]):
        same = block == number
        ringing = np.log(RINGING) + table[:, same].max(axis=1, keepdims=True)
        out[:, same] = np.logaddexp(np.log1p(-RINGING) + table[:, same], ringing)
    return out


ENDING = 1e-3  # prior: probability that the recording stops before the task ends
# cited: s; no new grip begins before a slip is felt (Johansson and Westling, Exp. Brain Res. 66, 1987)
LAPSE = 0.074
MAX_ASSIGNMENTS = 24  # numerics: most assignments tried
MANY = 20  # learned: trials; with more than this no single trial sways the consensus
BETWEEN_TRIALS = 2.0  # prior: slack of like blocks: poses, pads and cables shift widths and weights as well


@dataclass(frozen=True)
class Run:
    """Samples [start, stop) of a path in one contact state, with the trial's own block.

    `subtask` is its index in the task, None once the path has departed.
    """

    state: str
    block: int | None
    start: int
    stop: int
    subtask: int | None


@dataclass(frozen=True)
class Conformity:
    """Whether and how far a trial follows its task.

    `failing` is the index of the first missing subtask, None if all are present. `log_odds`: log posterior
    odds of departing from the task against completing it (nats; the prior's are about log(K DEPARTURE));
    `log_evidence` covers both hypotheses. `assignment` maps each object to its block in `free.blocks`, None
    if the trial does not show it. `wrong_rise` [m]: rise of the failing subtask's object from pickup to
    place, where that rise is the failure.
    """

    free: FreeContacts
    assignment: dict[str, int | None]
    runs: tuple[Run, ...]
    failing: int | None
    log_odds: float
    log_evidence: float
    wrong_rise: float | None = None

    def block(self, name: str) -> Block | None:
        """The block of this trial that represents an object of the task."""
        index = self.assignment.get(name)
        return None if index is None else self.free.blocks[index]


def examine(features: Sequence[Features], tasks: Sequence[BlockTask]) -> list[Conformity]:
    """Conformity of every trial; `tasks` have the same moves, each starting from its trial's initial state.

    `features` need no more than emissions' MAX_RATE, since contact states outlast its samples.

    Each trial is judged with its own parameters; the consensus of the other trials about the blocks then
    tells whether it moved the same ones.
    """
    steps = subtasks(tasks[0])
    sliding = any(move.slide for move in tasks[0].moves)
    alone = [conformity(fit_free_contacts(f, sliding), steps) for f in features]
    fitting = [c for c in alone if c.failing is None]
    among_many = _consensus(fitting) if len(fitting) > MANY else None
    out = []
    for f, c, task in zip(features, alone, tasks, strict=True):
        usual = among_many or _consensus([other for other in fitting if other is not c])
        if usual and (c.failing is not None or any(_differ(c.block(n), b) for n, b in usual.items())):
            c = conformity(c.free, steps, usual)
        out.append(_check_rises(f, c, steps, task))
    return out


def _consensus(others: Sequence[Conformity]) -> dict[str, Block]:
    """Median width and weight per object on which most of at least two other trials agree."""
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


def _differ(block: Block | None, usual: Block) -> bool:
    return block is None or not block.like(usual, BETWEEN_TRIALS)


def _check_rises(f: Features, c: Conformity, steps: tuple[Subtask, ...], task: BlockTask) -> Conformity:
    """Fail blocks that were placed on the wrong side, up or down, of where they were picked up.

    One such move is a wrong place; several are wrong blocks from the start.
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
    """Compare the task's order with free contact states.

    Tries the assignments of blocks to objects and takes the first that fits, otherwise the one of highest
    evidence. `known` blocks fix the assignment of their objects.
    """
    fixed: dict[str, int | None] = {}
    for name, block in (known or {}).items():  # the most similar block that may be it, if any
        alike = [i for i, own in enumerate(free.blocks) if own.like(block, BETWEEN_TRIALS)]
        fixed[name] = min(alike, key=lambda i: abs(free.blocks[i].width - block.width), default=None)
    tried = []
    for assignment in (each | fixed for each in assignments(free, steps)):
        c = _compare(free, steps, assignment)
        while c.failing is not None and (lost := _lapses(c)):
            table, ringing, opened = c.free.table.copy(), c.free.ringing.copy(), c.free.opened.copy()
            for span in lost:  # treated as uninformative
                table[span], ringing[span], opened[span] = 0.0, 0.0, 0.0
            unread = replace(c.free, table=table, ringing=ringing, opened=opened)
            c = _compare(unread, steps, assignment)
        tried.append(c)
        if c.failing is None:
            return c
    return max(tried, key=lambda c: c.log_evidence)


def _lapses(c: Conformity) -> list[slice]:
    """Samples at which a departing path loses a gripped block too briefly for a new grip.

    Samples that were discarded before count as no loss.
    """
    out = []
    for before, lost, after in zip(c.runs, c.runs[1:], c.runs[2:], strict=False):
        brief = (lost.stop - lost.start - 1) * c.free.interval <= LAPSE
        span = slice(lost.start, lost.stop)
        if brief and lost.state == FREE and before.block == after.block and c.free.table[span].any():
            out.append(span)
    return out


def assignments(free: FreeContacts, steps: Sequence[Subtask]) -> list[dict[str, int | None]]:
    """Assignments of the task's objects to the trial's blocks, likeliest first, at most MAX_ASSIGNMENTS.

    Injective if there are enough blocks, otherwise every block is assigned to some object. First in the order
    of the trial's grips, one by one, allowing for one extra or one missing grip; then any.
    """
    names = list(dict.fromkeys(str(s.object) for s in steps if s.object is not None))
    numbers, count = range(len(free.blocks)), len(names)
    if not numbers:
        return [dict.fromkeys(names)]
    least = min(len(numbers), count)  # with fewer blocks some objects look alike, or are never touched
    few = len(numbers) < count
    others = itertools.product(numbers, repeat=count) if few else itertools.permutations(numbers, count)
    out: list[dict[str, int | None]] = []
    for order in itertools.chain(_as_gripped(free, steps, names), others):
        each: dict[str, int | None] = dict(zip(names, order, strict=True))
        if len(set(order)) == least and each not in out:
            out.append(each)
        if len(out) == MAX_ASSIGNMENTS:
            break
    return out


def _as_gripped(
    free: FreeContacts, steps: Sequence[Subtask], names: Sequence[str]
) -> Iterator[tuple[int, ...]]:
    """Blocks of the objects (num_objects,), matching grips to moves in order.

    Objects that are never gripped get the remaining blocks, if any.
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
    leave = min(0.5, num_subtasks / n)  # as many changes as the task has subtasks
    table, stages, model = settled(free, columns, *departing(free.states, columns, leave))
    num_states = num_subtasks + len(free.states)
    last = np.arange(num_states) == num_subtasks - 1
    table[-1, np.tile(np.arange(num_states) < num_subtasks - 1, stages + 1)] += np.log(ENDING)
    table[-1, : stages * num_states] += np.log(ENDING)  # recordings rarely end amid a contact change

    def ending_in(states: np.ndarray) -> np.ndarray:
        conditioned = table.copy()
        conditioned[-1, ~np.tile(states, stages + 1)] = -np.inf
        return conditioned

    log_left, log_complete = (dense.log_evidence(ending_in(ends), *model) for ends in (~last, last))
    failing = None
    if log_left > log_complete:
        runs = _runs(dense.viterbi(ending_in(~last), *model).path % num_states, steps, free, columns)
        failing = min(sum(r.subtask is not None for r in runs), num_subtasks - 1)
    else:
        chain = scored(free, columns)[:, :num_subtasks]
        chain[-1, :-1] += np.log(ENDING)
        leaves = np.full(num_subtasks, leave)
        path = viterbi(chain, Chain(np.log1p(-leaves), np.log(leaves[:-1]))).path
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


PHRASES = {
    ON_GROUND: "held on the ground", ABOVE_GROUND: "held above the ground", SLIDING: "pushed along",
}  # fmt: skip


@dataclass(frozen=True)
class Plan:
    """The order that a misfit actually shows, as steps for its alignment.

    The first `num_before` steps are the task's first, the last `num_after` its last. `start`: parameters of
    the free contact states, under the object names used by the steps.
    """

    steps: tuple[Subtask, ...]
    num_before: int
    num_after: int
    start: Parameters


def plan(c: Conformity, steps: tuple[Subtask, ...]) -> Plan:
    """Order shown by a misfit, a trial that fails at some subtask."""
    failing = c.failing
    assert failing is not None
    unseen = next((i for i, r in enumerate(c.runs) if r.state != FREE and r.block is None), len(c.runs))
    runs = list(c.runs[: max(unseen, 1)])  # of a block that no grip shows nothing is known
    if c.wrong_rise is not None:  # wrong block or place: nothing from there on belongs to the task
        runs = [replace(r, subtask=None) if r.subtask is None or r.subtask >= failing else r for r in runs]
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
    """Number of final runs that match the final subtasks of the task."""
    count = 0
    for run, step in zip(reversed(runs), reversed(tail), strict=False):
        expected = None if step.state == FREE else c.assignment.get(str(step.object))
        if run.state != step.state or run.block != expected:
            break
        count += 1
    return count if count > 1 else 0  # free motion alone does not tell which release it is


def task_boundaries(
    shown: Plan, boundaries: Sequence[BoundaryPosterior], num_subtasks: int, first: float, last: float
) -> tuple[BoundaryPosterior, ...]:
    """Boundaries of the task, given those of the order shown.

    The failing subtask spans everything that belongs to no subtask; missing ones after it have zero length.
    """
    starts, length = [point_mass(first), *boundaries, point_mass(last)], len(shown.steps)
    back = (min(num_subtasks - k, shown.num_after) for k in range(1, num_subtasks))
    return tuple(starts[k if k <= shown.num_before else length - b] for k, b in enumerate(back, 1))


def point_mass(t: float) -> BoundaryPosterior:
    """A boundary known to be at t [s]."""
    return BoundaryPosterior(np.array([t]), np.array([1.0]))


def explain(c: Conformity, steps: tuple[Subtask, ...], starts: Sequence[float]) -> str:
    """Why the failing subtask is missing, as a sentence for people.

    `starts` [s]: start of each step of the order shown.
    """
    assert c.failing is not None
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
        return _let_go(c, steps[left - 1], left, starts)
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
