"""Consistency of a recording's scales: forces with pads, the two fingers and positions with each other.

Mechanics ties channels to each other whatever the blocks are. Each tie estimates the error of a scale of the
hand (0 if rig.toml is right), with an uncertainty:

- *squeeze*: both fingers press a carried block equally: if finger 1 is read g times too large, fx1 = -g fx2.
- *balance*: a carried block weighs W (1 + a / g) however the fingers share it: if finger 1 is read g times
  too large, their sum follows their difference, d(fy1 + fy2) / d(fy1 - fy2) = (g - 1) / (g + 1).
- *rigidity*: a held block keeps its width, so the fingers' distance, corrected for the pads' squeeze, has no
  slope over the position of the hand. Wrong angles, links or bases give it one.
- *motion*: displacements equal integrated velocities.
- *room*: no fingertip enters the space of a standing block.
- *support*: a block on another stands above part of it.
- *level*: a fingertip that holds a block is neither below its bottom nor above its top.

For each tie two hypotheses are compared: the hand is as accurate as its rig says, or a scale is misstated by
a size of which little is known. Normal densities about 0 with sds (error, WELL_MADE) and (error, WELL_MADE,
SIZE) give the odds; a scale is contradicted, and dependent properties get no number, if it is misstated with
a probability of CERTAIN. With prior odds of WRONG this takes about 4.5 sds of a healthy hand.

A common scale of all forces is a matter of pads and noise. Forces read g times too large squeeze pads that
seem 1 / g times as soft, with g times the stated noise; pads that truly differ leave the noise unchanged. If
[fingertip] states the pads, four explanations of the grips are compared: the rig is right, its pads are
wrong, both force axes are scaled by g, or the vertical axis alone. Weights are then drawn from all of them,
so that their intervals cover the truth whichever holds.

Nothing checks what all of these leave invariant: the distance of the fingers' bases as long as there is room,
and the common length of all links.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise, product

import numpy as np

from estimation.design import RISE, Design, PadDoubt
from estimation.observations import MIN_FREE, WeighedTrial, channel_values, free_forces, gravity_factor
from estimation.pads import MISSTATED, SLOPE_SD
from hmmseg.contact.decompose import ON_GROUND
from hmmseg.errors import InputError
from hmmseg.hand.plausibility import scale_to_velocity
from hmmseg.hand.sensing import WHITE
from hmmseg.io.rig import Rig
from hmmseg.io.trial import position_pairs
from hmmseg.levels import AROUND, CERTAIN, MOVED
from hmmseg.robust import robust_sd
from hmmseg.segmentation.align import AlignedTrials

WRONG = 0.01  # prior: share of recordings in which one such scale is misstated
# learned: above the sds of 45 healthy hands by consistency.py of commit f82105c, whose slopes were 3e-4: of
# logarithms of gains and rates, of slopes [m/m], of places [m]; in addition to [systematic] of rig.toml
WELL_MADE = {
    "squeeze": 0.015, "balance": 0.03, "rigidity": 1e-3, "motion": 0.04, "room": 5e-4, "support": 5e-4,
    "level": 1.5e-3,
}  # fmt: skip
# prior: sds of what is misstated, in the same units
SIZE = {
    "squeeze": 0.7, "balance": 0.7, "rigidity": 0.1, "motion": 0.3, "room": 0.02, "support": 0.02,
    "level": 0.02,
}  # fmt: skip
COARSE = 5e-4  # limit: m; of steps of positions: pads of usual stiffness give as much in a grip
BRIEF = 5  # numerics: fewer samples may be a glitch
FEWEST = 8  # numerics: least samples of a carry to determine a slope


@dataclass(frozen=True)
class Grip:
    """Where the fingertips hold a standing block [m], before (`pickup`) or after (`place`) a move."""

    move: int
    key: str
    object: str
    beneath: tuple[str, ...]  # objects from its support down to the ground
    subtask: int
    x1: float
    x2: float
    y: float


@dataclass(frozen=True)
class Tie:
    """One tie: its violation, and the properties that depend on it."""

    kind: str
    value: float  # error of the scale
    error: float  # its uncertainty
    properties: tuple[str, ...]
    text: str  # describes the violation
    made: float = 0.0  # sd of healthy hands that the rig itself admits, in addition to WELL_MADE

    @property
    def probability(self) -> float:
        """Probability that a scale is misstated."""
        healthy = float(np.hypot(self.error, np.hypot(WELL_MADE[self.kind], self.made)))
        wrong = float(np.hypot(healthy, SIZE[self.kind]))
        gain = np.log(healthy / wrong) + 0.5 * self.value**2 * (1 / healthy**2 - 1 / wrong**2)
        return float(1 / (1 + (1 / WRONG - 1) * np.exp(-min(gain, 500.0))))


def contradictions(aligned: AlignedTrials, weighed: Sequence[WeighedTrial], design: Design) -> dict[str, str]:
    """Why properties get no number, by `object.property`: contradictory scales."""
    out: dict[str, str] = {}
    coarsest = np.max([one.trial.step for one in aligned.trials], axis=0)  # across and up
    for prop, step in zip(("width", "height"), coarsest.tolist(), strict=True):
        if step > COARSE:
            text = f"positions go in steps of {1e3 * step:.2g} mm, as much as pads give in a grip"
            out |= {f"{obj}.{prop}": text for obj in aligned.task.objects}
    for tie in ties(aligned, weighed, design):
        if tie.probability > CERTAIN:
            for prop in tie.properties:
                for obj in aligned.task.objects:
                    out.setdefault(f"{obj}.{prop}", tie.text)
    return out


def check_motion(aligned: AlignedTrials) -> None:
    """InputError if positions and velocities contradict each other: no model reproduces both."""
    for tie in _motion(aligned):
        if tie.probability > CERTAIN:
            time = f't = {{from = "t", unit = {np.exp(-tie.value):.2g}}}'
            raise InputError(aligned.trials[0].trial.file, tie.text,
                             f"{time} under [columns] in rig.toml if times are off, or other units of "
                             "positions or velocities")  # fmt: skip


def ties(aligned: AlignedTrials, weighed: Sequence[WeighedTrial], design: Design) -> Iterator[Tie]:
    """All ties that a recording determines."""
    if any(one.trial.inertia is not None for one in aligned.trials):  # the fingers of a wrist are virtual
        return
    yield from _squeeze(aligned.rig, weighed)
    if not aligned.late:
        yield from _balance(aligned, weighed)
        yield from _rigidity(aligned, weighed)
    yield from _motion(aligned)
    yield from _room(aligned, weighed)
    yield from _support(aligned, weighed)
    yield from _level(aligned, weighed, design)


def _carries(
    weighed: Sequence[WeighedTrial], name: str, *needed: str
) -> Iterator[tuple[WeighedTrial, int, np.ndarray]]:
    """Trial, move and weights (num_timesteps,) of each grip's mean `name` where all `needed` are recorded."""
    for a in weighed:
        known = np.all([np.isfinite(getattr(a.signals, each)) for each in needed], axis=0)
        for move, grip in a.grips.items():
            weight = grip[name].mean(axis=0) * known
            if (weight > 0).sum() >= FEWEST:
                yield a, move, weight / weight.sum()


def _squeeze(rig: Rig, weighed: Sequence[WeighedTrial]) -> Iterator[Tie]:
    """Both fingers press a carried block equally, apart from its inertia."""
    pressed = []
    for a, _, weight in _carries(weighed, "force", "fx1", "fx2"):
        free = free_forces(a.signals, a) if a.free.any() else np.zeros(4)
        left, right = (weight @ np.nan_to_num(fx) for fx in (a.signals.fx1, -a.signals.fx2))
        if left > free[0] and right > -free[2]:
            pressed.append((left - free[0], right + free[2]))
    if pressed:
        left, right = np.median(pressed, axis=0)
        ratios = np.log(np.divide(*np.transpose(pressed)))
        text = (
            f"fx1 and -fx2 press what is carried with {left:.3g} and {right:.3g} N, which should be alike: "
            "one of the fingers is read on another scale"
        )
        made = float(np.hypot(rig.systematic.force_gain[0], rig.systematic.force_gain[2]))
        yield Tie("squeeze", float(np.median(ratios)), float(np.std(ratios) / np.sqrt(ratios.size)),
                  ("weight", "width", "friction"), text, made)  # fmt: skip


def _balance(aligned: AlignedTrials, weighed: Sequence[WeighedTrial]) -> Iterator[Tie]:
    """Both fingers carry the same weight however they share it."""
    rig, performed = aligned.rig, aligned.task.performed
    of, sums, apart, factors, weights, noises = [], [], [], [], [], []
    for a, move, weight in _carries(weighed, "force", "fy1", "fy2"):
        s, inside = a.signals, weight > 0
        factor, free = gravity_factor(s, rig), a.free > 0
        if free.sum() < MIN_FREE:
            continue
        noises.append([np.nanmean(np.diff(np.where(free, f, np.nan), 2) ** 2) / 6 for f in (s.fy1, s.fy2)])
        of += [performed[move].object] * int(inside.sum())
        sums.append((s.fy1 + s.fy2)[inside])
        apart.append((s.fy1 - s.fy2)[inside])
        factors.append(factor[inside])
        weights.append(weight[inside] / weight[inside].max())
    if not sums:
        return
    y, x, root = (np.concatenate(each) for each in (sums, apart, weights))
    root = np.sqrt(root)
    columns = np.stack(
        [np.where(np.array(of) == obj, np.concatenate(factors), 0.0) * root for obj in dict.fromkeys(of)], 1
    )
    first, second = np.nanmean(noises, axis=0)
    left = [v - columns @ np.linalg.lstsq(columns, v, rcond=None)[0] for v in (y * root, x * root)]
    total = float(root @ root)
    syy, sxx, sxy = (float(a @ b) / total for a, b in (left[:1] * 2, left[1:] * 2, left))
    moved = sxx - first - second
    if moved <= 3 * (first + second) * np.sqrt(2 / total):
        return
    slope = (sxy - (first - second)) / moved
    rest = max(syy - slope**2 * moved, first + second)
    error = float(np.sqrt(rest * sxx / total) / moved)
    if abs(slope) < 1:
        ratio = 2 * float(np.arctanh(slope))
        text = (
            f"what fy1 takes of a carried weight fy2 gives up {np.exp(-ratio):.2g}-fold: one of the fingers "
            "is read on another scale"
        )
        made = float(np.hypot(rig.systematic.force_gain[1], rig.systematic.force_gain[3]))
        yield Tie("balance", ratio, 2 * error / (1 - slope**2), ("weight", "height", "friction"), text, made)


def _rigidity(aligned: AlignedTrials, weighed: Sequence[WeighedTrial]) -> Iterator[Tie]:
    """A held block keeps its width wherever the hand takes it."""
    rig, fits = aligned.rig, []
    for a, _, weight in _carries(weighed, "distance", "x", "y", "distance", "fx1", "fx2"):
        s, root = a.signals, np.sqrt(weight)
        width = np.nan_to_num(channel_values(s, rig)["distance"])
        place = [np.nan_to_num(v - weight @ np.nan_to_num(v)) for v in (s.x, s.y)]
        rows = np.stack([np.ones(width.size), *place], axis=1) * root[:, None]
        slope = np.linalg.lstsq(rows, width * root, rcond=None)[0]
        rest = width * root - rows @ slope
        covariance = np.linalg.pinv(rows.T @ rows) * (rest @ rest) / max((weight > 0).sum() - 3, 1)
        fits.append(np.stack([slope[1:], np.diag(covariance)[1:]]))
    if not fits:
        return
    slopes, variances = np.moveaxis(np.array(fits), 1, 0)
    admitted = [*rig.systematic.joint_offset, *rig.systematic.link_length] if rig.jointed else [0.0]
    made = float(np.linalg.norm(admitted))  # sd of the slope due to the rig's own [systematic]
    for k, axis in enumerate(("horizontally", "vertically")):
        steep = float(np.median(slopes[:, k]))
        spread = robust_sd(slopes[:, k] - steep)
        error = max(spread, float(np.sqrt(np.median(variances[:, k])))) / np.sqrt(len(slopes))
        text = (f"the fingers' distance changes by {1e2 * abs(steep):.2g} cm a metre that the hand carries a "
                f"block {axis}, which no block does: joint angles, links or bases are farther off than "
                "[systematic] in rig.toml admits")  # fmt: skip
        yield Tie("rigidity", steep, error, ("width", "height"), text, made)


def _motion(aligned: AlignedTrials) -> Iterator[Tie]:
    """Displacements equal integrated velocities."""
    slopes = [[scale_to_velocity(a.trial, *pair) for pair in position_pairs(a.trial)] for a in aligned.trials]
    ratios = np.array(slopes).ravel()
    usable = ratios[np.isfinite(ratios) & (ratios > 0)]
    if usable.size < 2 or usable.size <= ratios.size / 2:
        return
    logs = np.log(usable)
    text = (
        f"positions go {1 / np.exp(np.median(logs)):.3g} times as far as their velocities carry them: one of "
        "the two scales is wrong"
    )
    error = float(robust_sd(logs - np.median(logs)) / np.sqrt(usable.size))
    yield Tie("motion", float(np.median(logs)), error, ("width", "height"), text)


def _grips(a: WeighedTrial, aligned: AlignedTrials, present: np.ndarray) -> Iterator[Grip]:
    """Where the fingertips hold each standing block."""
    s = a.signals
    for move, grip in a.grips.items():
        steps = [each for each in aligned.subtasks if each.move == move and each.state == ON_GROUND]
        ground = [each for each in steps if present[each.index]]
        for key, of in (("pickup", ground[:1]), ("place", ground[1:])):
            weight = grip[key].mean(axis=0) * np.isfinite(s.x1 + s.x2 + s.y)
            if of and weight.any():
                x1, x2, y = (float(weight @ np.nan_to_num(v) / weight.sum()) for v in (s.x1, s.x2, s.y))
                yield Grip(move, key, of[0].object or "", of[0].beneath, of[0].index, x1, x2, y)


def _room(aligned: AlignedTrials, weighed: Sequence[WeighedTrial]) -> Iterator[Tie]:
    """No fingertip enters the space of a standing block: by how far one does in the median trial."""
    every = []
    for a, one in zip(weighed, aligned.trials, strict=True):
        s, deepest = a.signals, 0.0
        edges = [one.signals.t[0], *(b.quantile(0.5) for b in one.boundaries), one.signals.t[-1]]
        spans = list(pairwise(np.maximum.accumulate(edges)))
        grips = list(_grips(a, aligned, one.present))
        for grip in grips:
            start, end = spans[grip.subtask]
            of_it = [g.subtask for g in grips if g.object == grip.object]
            if grip.key == "pickup":  # it has stood there since it was last put down, or from the start
                before = [k for k in of_it if k < grip.subtask]
                since, until = spans[max(before)][1] if before else s.t[0], start
            else:
                after = [k for k in of_it if k > grip.subtask]
                since, until = end, spans[min(after)][0] if after else s.t[-1] + 1
            at = (s.t > since + AROUND) & (s.t < until - AROUND)
            floor = grip.y - MOVED if grip.beneath else -np.inf
            for x, y in ((s.x1, s.y1), (s.x2, s.y2)):
                within = at & (y < grip.y) & (y > floor)
                depth = np.minimum(x - grip.x1, grip.x2 - x)[within]
                depth = np.sort(depth[np.isfinite(depth)])
                if depth.size >= BRIEF:
                    deepest = max(deepest, float(depth[-BRIEF]))
        every.append(deepest)
    depth = float(np.median(every))
    text = (
        f"a fingertip comes {1e3 * depth:.2g} mm within a block that stands: the fingers' bases, links or "
        "positions are not as rig.toml has them"
    )
    yield Tie("room", depth, 0.0, ("width",), text)


def _support(aligned: AlignedTrials, weighed: Sequence[WeighedTrial]) -> Iterator[Tie]:
    """What stands on a block stands above part of it: by how far it would miss in the median trial."""
    task, off = aligned.task, dict[tuple[str, str], list[float]]()
    for a, one in zip(weighed, aligned.trials, strict=True):
        grips = {(grip.move, grip.key): grip for grip in _grips(a, aligned, one.present)}
        for (move, _), grip in grips.items():
            for below in grip.beneath[:1]:
                moves = [k for k, each in enumerate(task.performed) if each.object == below]
                before = [k for k in moves if k < move]
                there = (before[-1], "place") if before else (min(moves, default=-1), "pickup")
                if (other := grips.get(there)) is not None:  # where it stands meanwhile
                    miss = max(other.x1 - grip.x2, grip.x1 - other.x2)
                    off.setdefault((grip.object, below), []).append(miss)
    pair, miss = max(((p, float(np.median(v))) for p, v in off.items()), key=lambda e: e[1], default=("", 0))
    if miss > 0:
        text = f"{pair[0]} stands {1e3 * miss:.2g} mm beside {pair[1]}, on which the task has it"
        yield Tie("support", miss, 0.0, ("height",), text)


def _level(aligned: AlignedTrials, weighed: Sequence[WeighedTrial], design: Design) -> Iterator[Tie]:
    """Blocks are held between bottom and top; for hands with joints, whose heights depend on their links."""
    if not aligned.rig.jointed:
        return  # y = 0 need not be the ground
    heights = _heights(design)
    off: dict[tuple[int, str], list[float]] = {}
    for a, one in zip(weighed, aligned.trials, strict=True):
        for grip in _grips(a, aligned, one.present):
            if all(name in heights for name in grip.beneath):
                bottom = sum(heights[name] for name in grip.beneath)
                above, below = grip.y - bottom - heights.get(grip.object, np.inf), bottom - grip.y
                far = max(above, 0.0) if above > below else min(-below, 0.0)
                off.setdefault((grip.move, grip.key), []).append(far)
    if off:
        usual = [(m, float(np.median(v))) for (m, _), v in off.items()]
        move, far = max(usual, key=lambda each: abs(each[1]))
        where = "above its top" if far > 0 else "beneath its bottom"
        text = (
            f"{aligned.task.performed[move].object} is held {1e3 * abs(far):.2g} mm {where}: the fingers' "
            "bases or links are not as rig.toml has them, or y = 0 is not the ground"
        )
        yield Tie("level", abs(far), 0.0, ("width", "height"), text)


def _heights(design: Design) -> dict[str, float]:
    """Heights [m] of the objects whose height is determined on its own, by least squares."""
    rows = (design.channel == RISE) & ~design.slope
    mine = [i for i, u in enumerate(design.unknowns) if u.prop == "height"]
    if not rows.any() or not mine:
        return {}
    heights = np.linalg.lstsq(design.coefficients[rows][:, mine], design.mean[rows], rcond=None)[0]
    unknowns = [design.unknowns[i] for i in mine]
    return {u.name[0]: float(v) for u, v in zip(unknowns, heights, strict=True) if u.single}


MISREAD = 0.5  # prior: probability that forces are to blame if pads and forces contradict each other
GAIN_LOG_SD = 1.0  # prior: of log g: another range or unit of the amplifier
PADS_LOG_SD = 0.8  # prior: of a wrong stiffness: foams of another kind are a third or three times as stiff
NOISE_LOG_SD, AXIS_LOG_SD = 0.35, 0.3  # prior: stated noise is off by a factor of two once in twenty
GRID = np.linspace(np.log(1e-3), np.log(1e3), 2001)  # numerics: log g, in steps of 0.7 %
TELLING = 1.0  # limit: sd of the pads' share along the grip beyond which grips are uninformative


@dataclass(frozen=True)
class ForceScale:
    """Posterior of the factor g by which vertical forces are read too large."""

    probability: float  # that forces are misread
    density: np.ndarray  # (len(GRID),) of log g if they are

    def corrected(self, chain: np.ndarray, weights: list[int], rng: np.random.Generator) -> np.ndarray:
        """Draws (walkers, steps, Q) with those of `weights` [N] divided by draws of g."""
        out, size = chain.copy(), chain.shape[:2]
        misread = rng.uniform(size=size) < self.probability
        out[..., weights] *= np.exp(-(misread * rng.choice(GRID, size, p=self.density)))[..., None]
        return out

    def remark(self) -> str:
        """The contradiction, for people."""
        g = float(np.exp(self.density @ GRID))
        size = f"{g:.2g} times too large" if g > 1 else f"{1 / g:.2g} times too small"
        return (
            f"forces and [fingertip] contradict each other: forces are read {size} with a probability of "
            f"{self.probability:.0%}, or the pads are not as stated; weights allow for both, and a weighed "
            "block would tell"
        )


def force_scale(
    doubts: Mapping[str, PadDoubt], weighed: Sequence[WeighedTrial], rig: Rig
) -> ForceScale | None:
    """Scale of the forces if pads and noise give evidence against 1; not for late forces."""
    tip = rig.fingertip
    if not np.isfinite([tip.normal_stiffness, tip.shear_stiffness]).all():
        return None
    (normal, normal_sd), (shear, shear_sd) = (doubt.seen for doubt in doubts.values())
    if normal_sd > TELLING:
        return None
    share = np.expm1(-GRID)  # apparent excess compliance if forces are g times too large

    def pads(of_normal: np.ndarray | float, of_shear: np.ndarray | float) -> np.ndarray:
        """Log likelihood (len(GRID),) of both shares given their true values."""
        out = np.zeros(GRID.size)
        for seen, sd, true in ((normal, normal_sd, of_normal), (shear, shear_sd, of_shear)):
            if np.isfinite(sd):
                error = np.hypot(sd, SLOPE_SD * (1 + np.asarray(true)))
                out = out - 0.5 * ((seen - true) / error) ** 2 - np.log(error)
        return out

    excess = _noise_excess(weighed, rig)

    def noise(of_x: np.ndarray | float, of_y: np.ndarray | float) -> np.ndarray:
        """Log likelihood of the noise of both axes, read too large by these log factors."""
        if excess is None:
            return np.zeros(GRID.size)
        covariance = np.full((2, 2), NOISE_LOG_SD**2) + AXIS_LOG_SD**2 * np.eye(2)
        off = np.stack(np.broadcast_arrays(excess[0] - of_x, excess[1] - of_y, GRID)[:2])
        return -0.5 * (off * np.linalg.solve(covariance, off)).sum(axis=0)

    def normal_prior(sd: float) -> np.ndarray:
        density = np.exp(-0.5 * (GRID / sd) ** 2)
        return np.log(density / density.sum())

    def evidence(log_likelihood: np.ndarray, sd: float) -> float:
        return float(np.logaddexp.reduce(normal_prior(sd) + log_likelihood))

    wrong_pads = (pads(share, share), pads(share, 0.0), pads(0.0, share))
    foam = max(evidence(each, PADS_LOG_SD) for each in wrong_pads)
    both, vertical = pads(share, share) + noise(GRID, GRID), pads(0.0, share) + noise(0.0, GRID)
    right = float((pads(0.0, 0.0) + noise(0.0, 0.0))[0])
    log_odds = np.array([
        np.log(1 - MISSTATED) + right,
        np.log(MISSTATED * (1 - MISREAD)) + foam + float(noise(0.0, 0.0)[0]),
        np.log(MISSTATED * MISREAD / 2) + evidence(both, GAIN_LOG_SD),
        np.log(MISSTATED * MISREAD / 2) + evidence(vertical, GAIN_LOG_SD),
    ])  # fmt: skip
    odds = np.exp(log_odds - np.logaddexp.reduce(log_odds))
    wrong = float(odds[2] + odds[3])
    if wrong < MISSTATED:  # below the prior probability that anything is wrong
        return None
    prior = normal_prior(GAIN_LOG_SD)
    of_g = [np.exp(prior + each - np.logaddexp.reduce(prior + each)) for each in (both, vertical)]
    density = (odds[2] * of_g[0] + odds[3] * of_g[1]) / wrong
    return ForceScale(wrong, density / density.sum())


def _noise_excess(weighed: Sequence[WeighedTrial], rig: Rig) -> tuple[float, float] | None:
    """Log ratio of the noise of fx and of fy to the stated one; None if filtered or unstated."""
    if rig.noise.force is None:
        return None
    out = []
    for axis in "xy":
        bends, followed = [], []
        for a, finger in product(weighed, (1, 2)):
            force = np.where(a.free > 0, getattr(a.signals, f"f{axis}{finger}"), np.nan)
            bend = np.diff(force, 2) / a.signals.sd_force
            bends.append(bend)
            followed.append(bend[1:] * bend[:-1])
        every, neighbours = (v[np.isfinite(v)] for v in map(np.concatenate, (bends, followed)))
        if neighbours.size < MIN_FREE or not every.any() or neighbours.mean() / np.mean(every**2) > WHITE:
            return None
        shown = robust_sd(every) / np.sqrt(6)
        if shown == 0:  # resolution coarser than the noise
            return None
        out.append(float(np.log(shown)))
    return out[0], out[1]
