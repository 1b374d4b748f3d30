"""The unconstrained alternative to a task: contact states in any order, fitted to one trial alone.

States are free motion and, for every distinct block the trial shows (grips of like width and
weight are one block), hold on ground, hold above ground and, where the task slides, sliding;
any state may follow any other. Emissions are those of contact_emissions, but for two things: no
resting levels (each hold would need its own), and a lifted block may also be held still, which
must not pass for a rest on something. Fitted by Viterbi training from robust starts, so that an
order forced on a trial that does not have it cannot spoil weights or widths.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace

import numpy as np

from hmmseg.contact.decompose import ABOVE_GROUND, FREE, ON_GROUND, SLIDING, Subtask
from hmmseg.contact.equations import block_width
from hmmseg.hmm import dense as ergodic
from hmmseg.segmentation.emissions import Features, Parameters, log_likelihoods
from hmmseg.segmentation.features import noise_sd
from hmmseg.segmentation.fit import maximisation, otsu
from hmmseg.segmentation.standing import standing

STRAY = 1e-3  # prior: share of resting samples that move: contacts settle in states of their own here
SAME_WIDTH = 1e-3  # chosen: m; grips this alike in width ...
SAME_WEIGHT = 0.25  # chosen: ... and, relatively, in weight are grips of one block
APART = 10  # chosen: noise sds of the grip force between free and gripped
# chosen: m from the heights at a grip's ends (medians of so many samples) to be lifted
RAISED, ENDS = 3e-3, 3
ROUNDS = 8  # numerics: of an iteration that settles sooner
# cited: s; no touch that ends sooner can have been meant to lift: grip forces rise for about as long before a
# lift as loads do in it, 0.2 s together at the fastest (Johansson and Westling, Exp. Brain Res. 56, 1984)
TAP = 0.2
FIRM = 0.5  # chosen: of the force with which a block is gripped next: who presses less has not gripped it yet
IMPOSSIBLE = -1e3  # numerics: log-likelihood of a state that the trial never shows


@dataclass(frozen=True)
class Block:
    """A block as one trial shows it: `width` [m] and `weight` [N] (NaN: never lifted)."""

    width: float
    weight: float

    def like(self, other: Block, slack: float = 1.0) -> bool:
        """Whether both can be the same block: like widths, and weights where both are known.

        `slack` multiplies the tolerances.
        """
        narrow = abs(self.width - other.width) <= slack * SAME_WIDTH
        apart = abs(self.weight - other.weight)  # NaN where either is unknown, which excludes nothing
        return bool(narrow and not apart > slack * SAME_WEIGHT * max(self.weight, other.weight))


@dataclass(frozen=True)
class FreeContacts:
    """The fitted alternative: `table` (num_timesteps, num_states) of log-likelihoods of `states`.

    Samples are `interval` s apart. A state is (contact state, number of its block in `blocks`; None in
    free motion); `path` (num_timesteps,) is the most probable sequence of states. `taps` [s] are touches of a
    block before its grip: to the path they are free motion, in the table they say nothing.
    """

    parameters: Parameters
    blocks: tuple[Block, ...]
    states: tuple[tuple[str, int | None], ...]
    table: np.ndarray
    path: np.ndarray
    interval: float
    taps: tuple[tuple[float, float], ...] = ()

    @property
    def num_grips(self) -> int:
        """How many separate grips the path has."""
        held = np.array([state != FREE for state, _ in self.states])[self.path]
        return int((np.diff(held.astype(int), prepend=0) == 1).sum())


def fit_free_contacts(f: Features, sliding: bool) -> FreeContacts:
    """Fit the alternative to one trial; `sliding`: whether the task has slides."""
    bias, scale, held = _ungripped(f)
    blocks = _blocks(f, bias, held)
    span = f.span["force"]
    weights = [b.weight for b in blocks if np.isfinite(b.weight)]
    parameters = Parameters(bias, {}, {
        "force": scale, "carry": 0.1 * float(np.median(weights)) if weights else 10 * scale,
        "net_x": 0.1 * span, "shear": 0.1 * span, "velocity": 0.01, "level": 1e-3, "width": 1e-3,
    })  # fmt: skip
    path = np.zeros(0, int)
    for _ in range(ROUNDS):
        parameters = replace(
            parameters,
            weight={str(i): b.weight if np.isfinite(b.weight) else span for i, b in enumerate(blocks)},
            width={str(i): b.width for i, b in enumerate(blocks)},
        )
        states = _states(blocks, sliding)
        table = free_table(f, states, parameters)
        before, path = path, most_probable(table, *_any_order(states, len(table)))
        used = [i for i in range(len(blocks)) if any(states[k][1] == i for k in np.unique(path))]
        if not blocks or np.array_equal(path, before):
            break
        if len(used) < len(blocks):  # a start that the model does not need
            blocks, path = tuple(blocks[i] for i in used), before[:0]
            continue
        learned = maximisation([f], _subtasks(states), replace(parameters, levels=()),
                               [np.eye(len(states))[path]])  # fmt: skip
        parameters = replace(learned, levels=())
        blocks = tuple(
            Block(
                learned.width.get(str(i), b.width),
                learned.weight[str(i)] if np.isfinite(b.weight) else np.nan,
            )
            for i, b in enumerate(blocks)
        )
    interval = float(np.median(np.diff(f.t)))
    tapped = _tapped(states, path, interval, f)
    taps = tuple((float(f.t[span][0] - interval / 2), float(f.t[span][-1] + interval / 2)) for span in tapped)
    for span in tapped:
        table[span], path[span] = 0.0, 0
    return FreeContacts(parameters, blocks, states, table, path, interval, taps)


def _tapped(
    states: tuple[tuple[str, int | None], ...], path: np.ndarray, interval: float, f: Features
) -> list[slice]:
    """Samples of touches too brief for a grip, of a block at rest that is gripped next.

    A touch lasts as long as it presses about as firmly as that grip. Fingers that stand on something touch
    what is no block.
    """
    held = np.array([state != FREE for state, _ in states])[path]
    force, stands = _filled(f.grip), standing(f.t, f.force, np.nan, ~held)
    edges = np.flatnonzero(np.diff(np.r_[False, held, False].astype(int)))
    grips = [slice(int(a), int(b)) for a, b in zip(edges[::2], edges[1::2], strict=True)]
    out = []
    for grip, following in itertools.pairwise(grips):
        touched = {states[k] for k in path[grip]}
        same = {block for _, block in touched} == {states[path[following.start]][1]}
        firm = int((force[grip] > FIRM * np.median(force[following])).sum())
        brief = firm * interval <= TAP and grip.start > 0
        longer = (grip.stop - grip.start) * interval > TAP
        if longer and stands[grip].any():
            continue
        if brief and same and {state for state, _ in touched} == {ON_GROUND}:
            out.append(grip)
    return out


def free_table(f: Features, states: tuple[tuple[str, int | None], ...], p: Parameters) -> np.ndarray:
    """Log-likelihoods (num_timesteps, num_states) without levels.

    No free sample may ring: whoever holds what the task does not name would pass for that.
    """
    return log_likelihoods(f, _subtasks(states), replace(p, levels=()), 0, STRAY, rung=0.0)


def most_probable(table: np.ndarray, log_initial: np.ndarray, log_transition: np.ndarray) -> np.ndarray:
    """Most probable path (num_timesteps,) of a dense model."""
    return ergodic.viterbi(table, log_initial, log_transition).path


def log_evidence(table: np.ndarray, log_initial: np.ndarray, log_transition: np.ndarray) -> float:
    """Log evidence of a dense model."""
    return ergodic.log_evidence(table, log_initial, log_transition)


def switching(states: tuple[tuple[str, int | None], ...], leave: float) -> np.ndarray:
    """Log transition probabilities that leave any state with probability `leave`.

    Any state may follow but another block's: a block changes only through free motion.
    """
    block = np.array([-1 if b is None else b for _, b in states])
    allowed = (block[:, None] == block) | (block[:, None] < 0) | (block < 0)
    np.fill_diagonal(allowed, False)
    count = np.maximum(allowed.sum(axis=1, keepdims=True), 1)
    out = np.where(allowed, np.log(leave / count), -np.inf)
    np.fill_diagonal(out, np.log1p(-leave))
    return out


def _any_order(states: tuple[tuple[str, int | None], ...], n: int) -> tuple[np.ndarray, np.ndarray]:
    return np.full(len(states), -np.log(len(states))), switching(states, min(0.5, 10.0 / n))


def _states(blocks: tuple[Block, ...], sliding: bool) -> tuple[tuple[str, int | None], ...]:
    held = [
        (state, i)
        for i, b in enumerate(blocks)
        for state in (ON_GROUND, ABOVE_GROUND, SLIDING)
        if (state != SLIDING or sliding) and (state != ABOVE_GROUND or np.isfinite(b.weight))
    ]
    return ((FREE, None), *held)


def _subtasks(states: tuple[tuple[str, int | None], ...]) -> tuple[Subtask, ...]:
    return tuple(
        Subtask(i, state, None if block is None else str(block), state, None)
        for i, (state, block) in enumerate(states)
    )


def _ungripped(f: Features) -> tuple[np.ndarray, float, np.ndarray]:
    """Force biases (4,), force scale and which samples are gripped: a start from the grip force.

    Otsu's split always finds two groups. They are free and gripped only where they lie far
    apart in terms of noise; where the lower one carries force as well, all is gripped.
    """
    found = np.array([noise_sd(f.force[:, c]) for c in range(4)])
    noise = max(_median(found, 0.0), 1e-3 * f.span["force"])
    grip = f.grip
    there = np.isfinite(grip)
    every = np.ones(grip.size, bool)
    if there.sum() < 2:
        return np.zeros(4), noise, ~every
    split = otsu(grip)
    low, high = grip[there & (grip <= split)], grip[there & (grip > split)]
    apart = high.size > 0 and np.median(high) - np.median(low) > APART * noise
    # Where one group alone is there, opposed forces far above the noise are a grip, others a bias.
    opposed = abs(_median(f.force[:, 0] + f.force[:, 2], np.inf)) < 0.3 * np.median(grip[there])
    if np.median(low) > (0.3 * np.median(high) if apart else 3 * APART * noise) and opposed:
        return np.zeros(4), noise, every
    threshold = np.median(low) + 0.25 * (np.median(high) - np.median(low)) if apart else np.inf
    held = _filled(grip) > threshold
    free = f.force[~held]
    bias = np.array([_median(free[:, c], 0.0) for c in range(4)])
    spread = np.array([1.4826 * _median(np.abs(free[:, c] - bias[c]), np.nan) for c in range(4)])
    return bias, max(_median(spread, 0.0), noise), held


def _median(values: np.ndarray, otherwise: float) -> float:
    """Median of what is there."""
    there = values[np.isfinite(values)]
    return float(np.median(there)) if there.size else otherwise


def _filled(values: np.ndarray) -> np.ndarray:
    """Values with what is missing interpolated; zeros where all are."""
    there = np.flatnonzero(np.isfinite(values))
    return np.interp(np.arange(values.size), there, values[there]) if there.size else np.zeros(values.size)


def _blocks(f: Features, bias: np.ndarray, held: np.ndarray) -> tuple[Block, ...]:
    """Distinct blocks among the grips, each grip's width and weight by robust means."""
    edges = np.flatnonzero(np.diff(np.r_[False, held, False].astype(int)))
    fy = f.force[:, 1] + f.force[:, 3] - bias[1] - bias[3]
    fx1, fx2 = (_filled(f.force[:, c] - bias[c]) for c in (0, 2))
    widths = block_width(f.d, fx1, fx2, f.pads)
    noise = noise_sd(f.force[:, 1])
    found: list[Block] = []
    for start, stop in zip(edges[::2], edges[1::2], strict=True):
        span = slice(start, stop)
        width = _median(widths[span], np.nan)
        if stop - start < 2 or not np.isfinite(width):
            continue
        lifted = (fy / f.carrying)[span][_lifted(f, span)]
        lifted = lifted[np.isfinite(lifted)]
        weight = float(np.median(lifted)) if lifted.size > 2 else np.nan
        # Of the median of n sums of two forces, whose standard error is sqrt(pi / 2) sqrt(2 / n) sds of one.
        significant = weight > 3 * noise * np.sqrt(np.pi / max(lifted.size, 1))
        block = Block(width, weight if significant else np.nan)
        match = next((i for i, other in enumerate(found) if block.like(other)), None)
        if match is None:
            found.append(block)
        elif not np.isfinite(found[match].weight):
            found[match] = block
    return tuple(found)


def _lifted(f: Features, span: slice) -> np.ndarray:
    """Which samples of one grip, (stop - start,), are surely of a lifted block.

    Whatever is lifted moves vertically; a block that is pushed or only gripped does not. Velocities
    tell it where they are known and exact; heights, which last longer, tell it of poor recordings: far
    from where the grip begins and from where it ends.
    """
    moving = np.abs(f.vy[span]) > 6 * f.sd_vy[span]
    height = _filled(f.y)[span]
    least = np.maximum(4 * f.sd_y[span], RAISED)
    ends = np.median(height[:ENDS]), np.median(height[-ENDS:])
    return moving | np.all([np.abs(height - end) > least for end in ends], axis=0)
