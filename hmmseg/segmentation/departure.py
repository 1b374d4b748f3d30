"""The task's chain of subtasks, with departures into states of any order: transition matrices.

Contacts ring and bounce for a while after each change, so every state is entered through settling
stages; a path may leave the chain at any boundary for the states of free_contacts (docs/model.md).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from hmmseg.contact.decompose import FREE, Subtask
from hmmseg.segmentation.free_contacts import IMPOSSIBLE, RINGING, FreeContacts, switching

DEPARTURE = 1e-4  # prior: probability that a trial leaves its task at any one boundary
SETTLING, STAGES = 0.2, 3  # prior: s, and most stages (of an Erlang law) in which a contact state settles
BRIEF = 1e-8  # prior: to end before is less likely by this: a bounce is no grip, a halt in the air no place


def column(free: FreeContacts, step: Subtask, assignment: dict[str, int | None]) -> int | None:
    """Index in `free.states` of what a subtask looks like in one trial; None: it has no such block."""
    state = (step.state, None if step.state == FREE else assignment.get(str(step.object)))
    return free.states.index(state) if state in free.states else None


def scored(free: FreeContacts, columns: Sequence[int | None]) -> np.ndarray:
    """Log-likelihoods (num_timesteps, num_subtasks + num_states) of the chain and then the free states."""
    n = len(free.table)
    chain = [np.full(n, IMPOSSIBLE) if c is None else free.table[:, c] for c in columns]
    return np.column_stack([*chain, free.table])


def settled(
    free: FreeContacts, columns: Sequence[int | None], log_initial: np.ndarray, log_transition: np.ndarray
) -> tuple[np.ndarray, int, tuple[np.ndarray, np.ndarray]]:
    """Log-likelihoods with all settling stages, their number, and the model (initial, transitions)."""
    stages = int(np.clip(round(SETTLING / free.interval / 2), 1, STAGES))
    settle = min(0.5, stages * free.interval / SETTLING)
    index = np.r_[[-1 if c is None else c for c in columns], np.arange(len(free.states))]
    table = scored(free, columns)
    every = np.empty((len(table), stages + 1, table.shape[1]))  # the largest table of a long recording
    every[:, -1] = table
    every[:, :-1] = _settling_table(table, index, free)[:, None]
    for i, c in enumerate(columns):  # a block is let go by fingers that open; a path that leaves may lose it
        if c is not None and i > 0 and free.states[c][0] == FREE:
            every[:, 0, i] += free.opened[: len(table)]
    model = _settling(log_initial, log_transition, stages, settle)
    return every.reshape(len(table), -1), stages, model


def departing(
    states: tuple[tuple[str, int | None], ...], columns: Sequence[int | None], leave: float
) -> tuple[np.ndarray, np.ndarray]:
    """Log initial and transition probabilities of the chain followed by the free states.

    `leave`: probability per sample that a contact state ends.
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
            follows[same] = False  # to go on in the same state is not to leave
            out[i, k:][follows] = np.log(leave * DEPARTURE / max(follows.sum(), 1))
    initial = np.full(k + num_states, np.log(DEPARTURE / num_states))
    initial[: k + 1] = -np.inf  # whatever is free motion at the start is the task's own
    initial[0] = np.log1p(-DEPARTURE)
    return initial, out


def leaving(num_subtasks: int, n: int) -> float:
    """Probability per sample that a contact state ends: as many of them as the task has."""
    return min(0.5, num_subtasks / n)


def _settling(
    log_initial: np.ndarray, log_transition: np.ndarray, stages: int, settle: float
) -> tuple[np.ndarray, np.ndarray]:
    """Every state stages + 1 times: it is entered in the first and settled in the last.

    A stage passes to the next with `settle` per sample, so that durations are Erlang rather than
    geometric; before the last, leaving the state has BRIEF of its probability. A recording starts
    settled. Log initial and transition probabilities over (stages, states).
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

    Fingers and block ring for a while after any contact change. What the forces of a ringing sample
    do says which block is held, but not how: every hold of it scores as the likeliest of them. Fingers that
    have just let go ring in the air.
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
