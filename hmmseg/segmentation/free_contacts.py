"""Contact states in any order, fitted to one trial alone: the alternative to a task.

States are free motion and, for every distinct block of the trial (grips of similar width and weight are one
block), hold on ground, hold above ground and, if the task slides, sliding; any state may follow any other.
Emissions are those of `hmmseg.segmentation.emissions` without resting levels (each hold would need its own)
and with lifted blocks that may be held still, which must not pass for resting on something. Fitted by Viterbi
training from robust starts, so that an order which the trial does not follow cannot bias weights or widths.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import log_ndtr

from hmmseg.contact.decompose import ABOVE_GROUND, FREE, ON_GROUND, SLIDING, Subtask
from hmmseg.contact.equations import block_width
from hmmseg.densities import log_student
from hmmseg.hmm import dense
from hmmseg.levels import FIRM, MOVED, SURE
from hmmseg.robust import NORMAL, filled, median_of_known, runs
from hmmseg.segmentation.emissions import STILL, Features, Parameters, log_likelihoods, noise_sd
from hmmseg.segmentation.fit import maximisation, otsu

SAME_WIDTH = 1e-3  # chosen: m; grips this alike in width ...
SAME_WEIGHT = 0.25  # chosen: ... and, relatively, in weight are grips of one block
ENDS = 3  # numerics: samples of whose heights the median is a grip's height at either end


@dataclass(frozen=True)
class Block:
    """A block as seen in one trial: `width` [m] and `weight` [N] (NaN: never lifted)."""

    width: float
    weight: float

    def like(self, other: Block, slack: float = 1.0) -> bool:
        """Whether both may be the same block: similar widths, and weights where both are known.

        `slack` multiplies the tolerances.
        """
        narrow = abs(self.width - other.width) <= slack * SAME_WIDTH
        apart = abs(self.weight - other.weight)  # NaN where either is unknown, which excludes nothing
        return bool(narrow and not apart > slack * SAME_WEIGHT * max(self.weight, other.weight))


def ungripped(f: Features) -> tuple[np.ndarray, float, np.ndarray]:
    """Initial force biases (4,) [N], force noise [N] and gripped samples, from the grip force.

    Otsu's split always returns two groups. They count as free and gripped only if they are far apart compared
    with the noise; if the lower group carries force too, all samples are gripped.
    """
    noise = max(median_of_known(np.array([noise_sd(c) for c in f.force.T]), 0.0), 1e-3 * f.span["force"])
    grip = f.grip
    there = np.isfinite(grip)
    every = np.ones(grip.size, bool)
    if there.sum() < 2:
        return np.zeros(4), noise, ~every
    split = otsu(grip)
    low, high = grip[there & (grip <= split)], grip[there & (grip > split)]
    apart = high.size > 0 and np.median(high) - np.median(low) > SURE * noise
    # A single group of opposed forces far above the noise is a grip, anything else a bias.
    opposed = abs(median_of_known(f.force[:, 0] + f.force[:, 2], np.inf)) < 0.3 * np.median(grip[there])
    if np.median(low) > (0.3 * np.median(high) if apart else SURE * noise) and opposed:
        return np.zeros(4), noise, every
    threshold = np.median(low) + 0.25 * (np.median(high) - np.median(low)) if apart else np.inf
    held = filled(grip) > threshold
    free = f.force[~held]
    bias = np.array([median_of_known(c, 0.0) for c in free.T])
    spread = np.array([NORMAL * median_of_known(np.abs(c), np.nan) for c in (free - bias).T])
    return bias, max(median_of_known(spread, 0.0), noise), held


def blocks_of(f: Features, bias: np.ndarray, held: np.ndarray, guessing: bool = False) -> tuple[Block, ...]:
    """Distinct blocks among the grips, each grip's width and weight by robust means.

    Weights come from samples that surely move. A load lost in noise gives no weight or, if `guessing`, its
    apparent value, at least two standard errors.
    """
    fy = f.force[:, 1] + f.force[:, 3] - bias[1] - bias[3]
    fx1, fx2 = (filled(f.force[:, c] - bias[c]) for c in (0, 2))
    widths = block_width(f.d, fx1, fx2, f.pads)
    noise = noise_sd(f.force[:, 1])
    found: list[Block] = []
    for start, stop in runs(held):
        span = slice(start, stop)
        width = median_of_known(widths[span], np.nan)
        if stop - start < 2 or not np.isfinite(width):
            continue
        lifted = (fy / f.carrying)[span][_lifted(f, span, guessing)]
        lifted = lifted[np.isfinite(lifted)]
        weight = float(np.median(lifted)) if lifted.size > 2 else np.nan
        # Standard error of the median of n sums of two forces: sqrt(pi / 2) sqrt(2 / n) sds of one force.
        error = noise * np.sqrt(np.pi / max(lifted.size, 1))
        least = weight if guessing else 3 * error
        block = Block(width, max(weight, 2 * error) if weight >= least else np.nan)
        match = next((i for i, other in enumerate(found) if block.like(other)), None)
        if match is None:
            found.append(block)
        elif not np.isfinite(found[match].weight):
            found[match] = block
    return tuple(found)


def _lifted(f: Features, span: slice, guessing: bool) -> np.ndarray:
    """Samples of one grip, (stop - start,), at which the block is surely lifted; if `guessing`, probably.

    Lifted blocks move vertically; blocks that are pushed or only gripped do not. Velocities show it where
    they are known precisely; heights, which persist longer, show it in noisy recordings: samples far from the
    heights at which the grip begins and ends. A block that falls is at its final height when the grip ends,
    so a guess only asks for samples far from the initial height.
    """
    moving = np.abs(f.vy[span]) > SURE * f.sd_vy[span]
    height = filled(f.y)[span]
    least = np.maximum(4 * f.sd_y[span], MOVED)
    ends = np.median(height[:ENDS]), np.median(height[-ENDS:])
    return moving | np.all([np.abs(height - end) > least for end in ends[: 1 if guessing else 2]], axis=0)


STRAY = 1e-3  # prior: share of resting samples that move: settling contacts have states of their own here
CLOSED = 1e-3  # prior: share of blocks released in place by fingers that slide off without opening
HIGH = 0.9  # numerics: quantile of the heights of a carried block that stands for the highest
RINGING = 0.1  # prior: share of samples that ring while a contact settles
ROUNDS = 8  # numerics: most iterations; it converges sooner
# cited: s; a shorter touch cannot have been meant as a lift: grip and load forces rise in turn before a lift,
# taking 0.2 s together at the fastest (Johansson and Westling, Exp. Brain Res. 56, 1984)
TAP = 0.2

States = tuple[tuple[str, int | None], ...]
Trained = tuple[States, tuple[Block, ...], Parameters, np.ndarray, np.ndarray]


@dataclass(frozen=True)
class FreeContacts:
    """Fitted free contact states: log-likelihoods `table` (num_timesteps, num_states) of `states`.

    A state is (contact state, index into `blocks`; None in free motion); `path` (num_timesteps,) is the most
    probable sequence of states, at samples `interval` s apart. `ringing` (num_timesteps,): log-likelihoods of
    free motion just after a contact, in which a block may still slide out. `opened` (num_timesteps,):
    log-likelihoods of the fingers' distance if they have just released a block that stays in place;
    `lowered` (num_timesteps,): those of its height if it has just been set down. `taps` [s]: touches of a
    block before its grip, which are free motion in `path` and uninformative in `table`.
    """

    parameters: Parameters
    blocks: tuple[Block, ...]
    states: States
    table: np.ndarray
    path: np.ndarray
    opened: np.ndarray
    lowered: np.ndarray
    ringing: np.ndarray
    interval: float
    taps: tuple[tuple[float, float], ...] = ()

    @property
    def gripped(self) -> list[int]:
        """Block of each separate grip of the path, in order."""
        block = np.array([-1 if number is None else number for _, number in self.states])[self.path]
        begins = (block >= 0) & (np.r_[-1, block[:-1]] < 0)
        return [int(number) for number in block[begins]]


def fit_free_contacts(f: Features, sliding: bool) -> FreeContacts:
    """Fit free contact states to one trial; `sliding`: whether the task has slides."""
    bias, scale, held = ungripped(f)
    states, blocks, parameters, table, path = _likeliest(f, sliding, bias, scale, held)
    interval = float(np.median(np.diff(f.t)))
    tapped = _tapped(states, path, interval, f)
    taps = tuple((float(f.t[span][0] - interval / 2), float(f.t[span][-1] + interval / 2)) for span in tapped)
    ringing = log_likelihoods(f, _subtasks(states[:1]), replace(parameters, levels=()), 0, rung=RINGING)[:, 0]
    opened, lowered, slides = _ends(f, states, path, parameters)
    ringing[slides] = np.logaddexp(ringing[slides], np.log(RINGING) + table[slides].max(axis=1))
    for span in tapped:
        table[span], ringing[span], path[span] = 0.0, 0.0, 0
    return FreeContacts(parameters, blocks, states, table, path, opened, lowered, ringing, interval, taps)


def _likeliest(f: Features, sliding: bool, bias: np.ndarray, scale: float, held: np.ndarray) -> Trained:
    """The likelier of two fits: with certain block weights only, and with guessed ones.

    The whole recording decides whether a block that could not be weighed reliably was carried: with no weight
    for it, every trial of a task with a carry would be a misfit.
    """
    starts = [blocks_of(f, bias, held)]
    if any(np.isnan(b.weight) for b in starts[0]):
        starts.append(blocks_of(f, bias, held, guessing=True))

    def evidence(fit: Trained) -> float:  # penalised for each block's width and weight (Schwarz 1978)
        states, blocks, _, table, _ = fit
        num = len(blocks) + sum(np.isfinite(b.weight) for b in blocks)
        return dense.log_evidence(table, *_any_order(states, len(table))) - 0.5 * num * np.log(len(table))

    return max((_trained(f, sliding, bias, scale, blocks) for blocks in starts), key=evidence)


def _trained(
    f: Features, sliding: bool, bias: np.ndarray, scale: float, blocks: tuple[Block, ...]
) -> Trained:
    """Viterbi training started from these blocks: states, blocks, parameters, table and path."""
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
        # No levels. Free motion rings only just after a contact, or holding an unnamed object would pass
        # for ringing.
        table = log_likelihoods(f, _subtasks(states), replace(parameters, levels=()), 0, STRAY, rung=0.0)
        before, path = path, dense.viterbi(table, *_any_order(states, len(table))).path
        used = [i for i in range(len(blocks)) if any(states[k][1] == i for k in np.unique(path))]
        if not blocks or np.array_equal(path, before):
            unweighed = _unweighed(states, path, blocks)
            if unweighed is blocks:
                break
            blocks, path = unweighed, before[:0]
            continue
        if len(used) < len(blocks):  # drop blocks that the path does not use
            blocks, path = tuple(blocks[i] for i in used), before[:0]
            continue
        onehot, learned = np.eye(len(states))[path], replace(parameters, levels=())
        parameters = replace(maximisation([f], _subtasks(states), learned, [onehot]), levels=())
        widths, weights = parameters.width, parameters.weight
        blocks = tuple(
            Block(widths.get(str(i), b.width), weights[str(i)] if np.isfinite(b.weight) else np.nan)
            for i, b in enumerate(blocks)
        )
    return states, blocks, parameters, table, path


def _unweighed(states: States, path: np.ndarray, blocks: tuple[Block, ...]) -> tuple[Block, ...]:
    """Blocks without the weights of those never carried, merged with carried ones of like width."""
    carried = {states[k][1] for k in np.unique(path) if states[k][0] == ABOVE_GROUND}
    if all(i in carried or np.isnan(b.weight) for i, b in enumerate(blocks)):
        return blocks
    kept = [b for i, b in enumerate(blocks) if i in carried]
    for i, block in enumerate(blocks):
        unweighed = replace(block, weight=np.nan)
        if i not in carried and not any(unweighed.like(b) for b in kept):
            kept.append(unweighed)
    return tuple(kept)


def _ends(f: Features, states: States, path: np.ndarray, p: Parameters) -> tuple[np.ndarray, ...]:
    """What tells a block that is set down and released from one that falls, three arrays (num_timesteps,).

    Log-likelihoods of the fingers' distance if they release a block that stays in place: pads relax before
    they leave it; if the fingers are no farther apart than while holding, it has gone. (Half the nominal give
    of the pads suffices, as they may be stiffer.) Those of the height of a carried block that meets a
    support: it has come down, unless it stays where it was carried (STILL). Both are relative to any distance
    or height. And samples at which it may slide out of opening fingers, which it loads more, for their grip,
    than while carried; a support takes the load before the grip goes.
    """
    load = np.abs(filled(f.force[:, 1] + f.force[:, 3] - p.bias[1] - p.bias[3]))
    grip, height = filled(f.grip - (p.bias[0] - p.bias[2]) / 2), f.block_y(p.bias)
    given, noise = f.block_width(p.bias) - f.d, SURE * np.sqrt(2) * p.scale["force"]
    state, slides = np.array([state for state, _ in states])[path], np.zeros(load.size, bool)
    least, level = np.full(load.size, -np.inf), np.full(load.size, np.nan)
    for start, stop in runs(state != FREE):
        held, slides[start:] = slice(start, stop), False
        least[start:] = median_of_known(f.d[held], -np.inf) + median_of_known(given[held], 0.0) / 2
        carried = start + np.flatnonzero(state[held] == ABOVE_GROUND)
        if carried.size:
            weight, firm = np.median(load[carried]), np.median(grip[carried])
            slides[start:] = firm * (load[start:] - noise) > weight * grip[start:]
            level[held] = np.quantile(height[carried], HIGH)
    chance = log_ndtr(np.where(np.isfinite(f.d), (f.d - least) / f.sd_d, np.inf))
    aloft = np.log(STILL * f.span["y"]) + log_student(level - height, np.sqrt(2) * f.sd_y)
    lowered = np.where(np.isfinite(level - height), -np.logaddexp(np.log1p(-STILL), aloft), 0.0)
    return np.logaddexp(np.log1p(-CLOSED) + chance, np.log(CLOSED)), lowered, slides


def _tapped(states: States, path: np.ndarray, interval: float, f: Features) -> list[slice]:
    """Samples of touches too brief for a grip, of a resting block that is gripped next.

    A touch lasts as long as it presses about as firmly as that grip.
    """
    held = np.array([state != FREE for state, _ in states])[path]
    force = filled(f.grip)
    grips = [slice(*run) for run in runs(held)]
    out = []
    for grip, following in itertools.pairwise(grips):
        touched = {states[k] for k in path[grip]}
        same = {block for _, block in touched} == {states[path[following.start]][1]}
        firm = int((force[grip] > FIRM * np.median(force[following])).sum())
        brief = firm * interval <= TAP and grip.start > 0
        if brief and same and {state for state, _ in touched} == {ON_GROUND}:
            out.append(grip)
    return out


def switching(states: States, leave: float) -> np.ndarray:
    """Log transition probabilities that leave any state with probability `leave`.

    Any state may follow, except those of another block, which is reached only through free motion.
    """
    block = np.array([-1 if b is None else b for _, b in states])
    allowed = (block[:, None] == block) | (block[:, None] < 0) | (block < 0)
    np.fill_diagonal(allowed, False)
    count = np.maximum(allowed.sum(axis=1, keepdims=True), 1)
    out = np.where(allowed, np.log(leave / count), -np.inf)
    np.fill_diagonal(out, np.log1p(-leave))
    return out


def _any_order(states: States, n: int) -> tuple[np.ndarray, np.ndarray]:
    return np.full(len(states), -np.log(len(states))), switching(states, min(0.5, 10.0 / n))


def _states(blocks: tuple[Block, ...], sliding: bool) -> States:
    out: list[tuple[str, int | None]] = [(FREE, None)]
    for i, b in enumerate(blocks):
        carried = [ABOVE_GROUND] * bool(np.isfinite(b.weight))
        out += [(state, i) for state in (ON_GROUND, *carried, *[SLIDING] * sliding)]
    return tuple(out)


def _subtasks(states: States) -> tuple[Subtask, ...]:
    named = ((state, None if block is None else str(block)) for state, block in states)
    return tuple(Subtask(i, state, block, state, None) for i, (state, block) in enumerate(named))
