"""Friction of the fingers against each block: its lower bound, and its value if a grip slipped.

Coulomb's law: |shear| <= mu x normal force in every held sample (the paper's Table 3 takes the largest
recorded ratio). The bound here is the posterior of the largest true ratio (`largest_ratio`); a finger that
slips (`slip_evidence`) is at the limit, so the bound then equals mu. If a block is slid, the net force gives
its friction against the support (`ground_friction`).
"""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
from scipy.special import logsumexp

from estimation.observations import MIN_FREE, WeighedTrial
from estimation.report import summary
from hmmseg.contact.decompose import FREE, ON_GROUND, SLIDING, Subtask, subtasks
from hmmseg.io.rig import FORCE_CHANNELS, Rig
from hmmseg.io.task import BlockTask
from hmmseg.levels import CERTAIN, FIRM, SHOWN, SURE
from hmmseg.robust import robust_sd
from hmmseg.segmentation.emissions import acceleration

FEWEST = 4  # numerics: least samples of sliding


@dataclass(frozen=True)
class GroundFriction:
    """Posterior draws (num_draws,) of the friction coefficient against `support` ("ground" or a block)."""

    support: str
    mu_draws: np.ndarray


def ground_friction(
    weighed: Sequence[WeighedTrial], task: BlockTask, steps: tuple[Subtask, ...], obj: str, rig: Rig,
    weight: np.ndarray | None, rng: np.random.Generator,
) -> GroundFriction | None:  # fmt: skip
    """Friction of a block on the support it is slid on; None if it is not slid, or the data are insufficient.
    The law d fx = mu (W - fy) + W d a / g is linear in mu if `weight`, draws (num_draws,) of W [N], is given,
    and in mu W, mu and W otherwise. If a task slides the block on several supports, the last one counts."""
    slid = [s for s in steps if s.object == obj and s.state == SLIDING and s.move is not None]
    if not slid:
        return None
    support = task.performed[slid[-1].move or 0].to
    rows = [_rows(a, s, rig) for a in weighed for s in slid if task.performed[s.move or 0].to == support]
    push, lag, down = np.concatenate(rows).T
    if push.size < FEWEST:
        return None
    if weight is None:
        columns = np.stack([-down, np.ones(push.size), lag], axis=1)
        fitted, *_ = np.linalg.lstsq(columns, push, rcond=None)
        mean, square = fitted[:1], float(np.linalg.pinv(columns.T @ columns)[0, 0])
        left = push - columns @ fitted
    else:
        weight = rng.choice(weight, (DRAWS, 1))
        right, pushed = weight - down, push - weight * lag
        square = 1 / (right**2).sum(axis=1)
        mean = (right * pushed).sum(axis=1) * square
        left = (pushed - mean[:, None] * right).mean(axis=0)
    freedom = max(push.size - 3, 1)  # few where a slide is short
    draws = mean + np.sqrt(square * (left @ left) / freedom) * rng.standard_t(freedom, DRAWS)
    return GroundFriction(support, draws) if draws.mean() > SHOWN * draws.std() > 0 else None


def _rows(a: WeighedTrial, step: Subtask, rig: Rig) -> np.ndarray:
    """Rows (num_samples, 3) of d fx [N], d a / g and fy [N] while the block surely slides."""
    s, free = a.signals, a.free
    sliding = a.masks[:, step.index].all(axis=0) & np.isfinite(s.fx + s.fy + s.vx)
    if not sliding.any():
        return np.zeros((0, 3))
    direction = np.sign(np.median(s.vx[sliding]))
    sd = np.where(np.isfinite(s.sd_vx), s.sd_vx, 0.0) / np.sqrt(2.0)
    sliding &= direction * np.nan_to_num(s.vx) > SURE * sd
    bias_x, bias_y = (float(free @ np.nan_to_num(f)) for f in (s.fx, s.fy))
    lag = direction * np.nan_to_num(acceleration(s.t, s.vx)) / rig.gravity
    return np.stack([direction * (s.fx - bias_x), lag, s.fy - bias_y], axis=1)[sliding]


PRIOR = 0.05  # prior: probability of slip
STRAY = 0.1  # prior: share of stretches that move for other reasons: one alone proves nothing
STRAY_DRIFT = 2e-3  # prior: m per root second; drift of those
SPEEDS = (5e-4, 1.5e-3, 5e-3)  # prior: m/s; of a slipping pad
STUCK = 0.5  # prior: probability that a pad near its limit sticks nevertheless
PERSISTENCE = 0.01  # prior: s over which the speed of a slipping pad varies
DRIFTS = (0.0, 3e-5, 1e-4, 3e-4)  # prior: m per root second; of an anchor without slip
DRIFT_PRIOR = (0.5, 0.3, 0.15, 0.05)  # prior: probabilities of DRIFTS: most pads hold still
ANYWHERE = 0.01  # prior: m; sd of an anchor's height


@dataclass(frozen=True)
class Stretch:
    """One finger on one resting block, arrays (num_samples,)."""

    t: np.ndarray  # [s]
    anchor: np.ndarray  # [m] height less nominal shear deflection
    sd: np.ndarray  # [m] its noise
    shear: np.ndarray  # [N]
    ratio: np.ndarray  # of shear to normal force, signed
    ratio_sd: np.ndarray
    compliance: float  # [m/N] standard deviation of the pad's compliance error


@dataclass(frozen=True)
class SlipEvidence:
    """Posterior probability of slip, the log Bayes factor behind it, and whether it counts as seen."""

    probability: float
    log_bayes_factor: float
    seen: bool


def slip_evidence(
    stretches: Sequence[Stretch], others: Sequence[Stretch], bound_draws: np.ndarray
) -> SlipEvidence:
    """Evidence for slip in one block's grips, of this bound (num_draws,); `others` show usual drift."""
    stretches = [s for s in stretches if s.t.size > 2]
    if not stretches:
        return SlipEvidence(PRIOR, 0.0, False)
    every = [*stretches, *(s for s in others if s.t.size > 2)]
    if bends := [np.diff(s.anchor, 2) / s.sd[1:-1] for s in every if s.t.size > 3]:
        shown = robust_sd(np.concatenate(bends)) / np.sqrt(
            6.0
        )  # more than the stated noise of anchors, maybe
        every = [replace(s, sd=s.sd * max(shown, 1.0)) for s in every]
    own = every[: len(stretches)]
    stray = np.array([_log_density(s, STRAY_DRIFT) for s in every]) + np.log(STRAY)
    still = np.array([[_log_density(s, drift) for s in every] for drift in DRIFTS]) + np.log(1 - STRAY)
    still = np.logaddexp(still, stray)
    log_drift = np.log(np.asarray(DRIFT_PRIOR))
    moved = np.repeat(still[None], 3, axis=0)  # (num_coefficients, num_drifts, num_stretches)
    for k, coefficient in enumerate(np.quantile(bound_draws, (0.1, 0.5, 0.9))):
        for i, s in enumerate(own):
            near = _near(s, float(coefficient))
            if near.any():
                slips = [logsumexp([_log_density(s, drift, v, near) for v in SPEEDS]) for drift in DRIFTS]
                slips = np.array(slips) + np.log((1 - STUCK) / len(SPEEDS))
                moved[k, :, i] = np.logaddexp(slips, still[:, i] + np.log(STUCK))
    joint = log_drift + moved.sum(axis=2)
    factor = float(logsumexp(joint) - np.log(len(moved)) - logsumexp(log_drift + still.sum(axis=1)))
    odds = factor + np.log(PRIOR / (1 - PRIOR))
    probability = float(1 / (1 + np.exp(-np.clip(odds, -700, 700))))
    return SlipEvidence(probability, factor, probability > CERTAIN)


def _near(s: Stretch, coefficient: float) -> np.ndarray:
    """Whether the pad may slip between successive samples (num_samples - 1,), as their noise does not show
    that they are below the coefficient: sign of the shear, or 0."""
    near = np.sign(s.ratio) * (np.abs(s.ratio) >= coefficient - SHOWN * s.ratio_sd)
    return np.where(near[1:] != 0, near[1:], near[:-1])


def _log_density(s: Stretch, drift: float, speed: float = 0.0, near: np.ndarray | None = None) -> float:
    """Log density of the anchors given one drift and, while `near`, one speed of slip."""
    t, shift = s.t - s.t[0], s.compliance * (s.shear - s.shear.mean())
    covariance = ANYWHERE**2 + np.outer(shift, shift) + drift**2 * np.minimum.outer(t, t)
    residual = s.anchor - np.median(s.anchor)
    if near is not None:
        time, signed = (np.append(0.0, np.cumsum(np.diff(t) * each)) for each in (np.abs(near), near))
        covariance += speed**2 * PERSISTENCE * np.minimum.outer(time, time)
        residual = residual - speed * signed
    factor = np.linalg.cholesky(covariance + np.diag(s.sd**2))
    white = np.linalg.solve(factor, residual)
    return float(-0.5 * white @ white - np.log(np.diag(factor)).sum() - 0.5 * t.size * np.log(2 * np.pi))


CONCENTRATION = 1.0  # prior: weight of G's base measure, in samples
BINS_PER_SD = 3.0  # numerics: bins of G per smallest noise sd
MAX_BINS = 300  # numerics: most bins of G: the cost is linear in them
GLITCH = 0.01  # prior: share of glitches: a bound must rest on more than one sample
BURN_IN, SWEEPS = 20, 48  # numerics: of Gibbs sampling: discarded, and kept
CORROBORATING = int(np.ceil(np.log(np.finfo(float).eps) / np.log(GLITCH)))  # samples, not all glitches
REACH = 5.0  # numerics: standard deviations beyond which a sample cannot be the largest


def largest_ratio(
    ratio: np.ndarray, sd: np.ndarray, held: np.ndarray, rng: np.random.Generator, num_draws: int
) -> np.ndarray:
    """Posterior draws (num_draws,) of the largest true ratio.

    True ratios have an unknown distribution G, with a Dirichlet process prior on bins, and noise; a share
    GLITCH of samples is uninformative.

    `ratio`, `sd` (num_samples,): measured absolute ratios and their noise; `held` (num_alignments,
    num_samples): under which drawn alignments each sample counts. Alignments are marginalised in the maximum;
    G is learned from the samples of all of them."""
    end = float(np.max(ratio + REACH * sd))
    edges = np.linspace(0.0, end, int(np.clip(BINS_PER_SD * end / sd.min(), 20, MAX_BINS)) + 1)
    centres = (edges[1:] + edges[:-1]) / 2
    # The upper part of a Dirichlet is independent of how the lower part is split, so samples that cannot be
    # the largest enter by their number only.
    often = held.mean(axis=0)
    lower = np.sort(np.where(often == often.max(), ratio - REACH * sd, 0.0))
    cut = lower[-min(CORROBORATING, lower.size)]
    high = ratio + REACH * sd > cut
    top = centres > cut - REACH * sd[high].max()
    low_count = float((~high).sum()) + CONCENTRATION * float(np.mean(~top))
    prior = np.full(int(top.sum()), CONCENTRATION / centres.size)
    # Likelihood of the measured absolute ratios given true ones (num_samples, num_bins).
    z = np.stack([sign * ratio[high][:, None] - centres[top] for sign in (1, -1)]) / sd[high][:, None]
    likelihood = np.exp(-0.5 * z**2).sum(axis=0) / (sd[high][:, None] * np.sqrt(2 * np.pi))
    log_likelihood = np.log(likelihood + 1e-300)
    glitch = GLITCH / (1 - GLITCH) / edges[-1]
    held = held[:, high]
    weights = np.full(prior.size, 1.0 / centres.size)
    cdf = np.zeros(prior.size)
    for sweep in range(BURN_IN + SWEEPS):
        shares = np.cumsum(likelihood * weights, axis=1)
        total = shares[:, -1] + glitch
        if sweep >= BURN_IN:
            log_below = np.log((shares + glitch) / total[:, None])
            cdf += np.exp(held @ log_below).mean(axis=0) / SWEEPS
        bins = (shares < (rng.uniform(size=total.size) * total)[:, None]).sum(axis=1)
        true = bins < prior.size
        counts = _moved(bins[true], log_likelihood[true], rng)
        weights = rng.standard_gamma(counts + prior)
        weights /= weights.sum() + rng.standard_gamma(low_count + 1e-9)
    levels = np.concatenate([[0.0], np.maximum.accumulate(cdf)])
    upper = edges[np.flatnonzero(top)[0] :]
    quantiles = (rng.permutation(num_draws) + rng.uniform(size=num_draws)) / num_draws
    return np.interp(quantiles * levels[-1], levels, upper)


def _moved(bins: np.ndarray, log_likelihood: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Samples in each bin (num_bins,) after every atom was redrawn with its samples, lest it never leave."""
    atoms, member = np.unique(bins, return_inverse=True)
    joint = np.zeros((atoms.size, log_likelihood.shape[1]))
    np.add.at(joint, member, log_likelihood)
    places = np.argmax(joint + rng.gumbel(size=joint.shape), axis=1)
    sizes = np.bincount(member, minlength=atoms.size)
    return np.bincount(places, weights=sizes, minlength=log_likelihood.shape[1])


DRAWS = 2000  # numerics: of each coefficient


@dataclass(frozen=True)
class FrictionPosterior:
    """Friction coefficient of the fingers on one block."""

    lower_bound: float | None  # 5 % quantile of `bound_draws`; None if the block was not held
    bound_draws: np.ndarray | None = None  # (num_draws,) of the largest ratio
    mu_draws: np.ndarray | None = None  # (num_draws,) only if slip was seen
    slip: SlipEvidence | None = None
    reason: str | None = None  # why there is no value, or no bound
    ground: GroundFriction | None = None  # of the block on its support, if it was slid

    def to_json(self) -> dict[str, Any]:
        """The entry `friction` of one block in the JSON of `identify`."""
        out: dict[str, Any] = {"unit": "1", "lower_bound": self.lower_bound}
        if self.mu_draws is not None:
            out |= summary(self.mu_draws, "1")
        if self.slip is not None:
            out["slip"] = asdict(self.slip)
        if self.ground is not None:
            out["ground"] = summary(self.ground.mu_draws, "1") | {"support": self.ground.support}
        return out


@dataclass(frozen=True)
class _Forces:
    """Bias-free forces (num_timesteps,) of one finger and their noise sd [N]."""

    normal: np.ndarray
    shear: np.ndarray
    sd_normal: float
    sd_shear: float


def friction_posteriors(
    weighed: Sequence[WeighedTrial], task: BlockTask, rig: Rig, sd_force: float,
    rng: np.random.Generator, weights: Mapping[str, np.ndarray] | None = None,
) -> dict[str, FrictionPosterior]:  # fmt: skip
    """Friction of every object, alignments marginalised; `sd_force`: of a sample [N] if unstated."""
    steps = subtasks(task)
    fingers = [[_forces(a, rig, finger, sd_force) for finger in (1, 2)] for a in weighed]
    held = {obj: _held(weighed, fingers, steps, obj) for obj in task.objects}
    resting = {obj: _stretches(weighed, fingers, steps, obj, rig) for obj in task.objects}
    out = {}
    for obj in task.objects:
        ground = ground_friction(weighed, task, steps, obj, rig, (weights or {}).get(obj), rng)
        if held[obj][0].size == 0:
            reason = f"the recording never shows {obj} held firmly"
            out[obj] = FrictionPosterior(None, reason=reason, ground=ground)
            continue
        draws = largest_ratio(*held[obj], rng, DRAWS)
        others = [s for other in task.objects if other != obj for s in resting[other]]
        slip = slip_evidence(resting[obj], others, draws)
        gain = rig.systematic.force_gain  # its uncertainty scales every ratio
        worst = max(np.hypot(gain[0], gain[1]), np.hypot(gain[2], gain[3]))
        draws = draws * np.exp(worst * rng.standard_normal(DRAWS))
        reason = None if slip.seen else f"no finger was seen to slip on {obj}: a bound is all it tells"
        out[obj] = FrictionPosterior(
            float(np.quantile(draws, 0.05)), draws, draws if slip.seen else None, slip, reason, ground
        )
    return out


def _forces(a: WeighedTrial, rig: Rig, finger: int, sd_force: float) -> _Forces:
    """Forces of one finger less their mean in free motion, whose variation beyond noise counts as noise."""
    free, stated = a.free > 0, a.signals.sd_force
    stated = stated if np.isfinite(stated) else sd_force
    centred, sds = [], []
    for name in (f"fx{finger}", f"fy{finger}"):
        values = getattr(a.signals, name)
        if free.sum() >= MIN_FREE:
            bias = float(values[free].mean())
            shown = robust_sd(values[free] - bias)
            sd = max(stated, shown) * np.sqrt(1 + 1 / free.sum())
        else:
            bias = 0.0
            sd = np.hypot(stated, rig.systematic.force_bias[FORCE_CHANNELS.index(name)])
        centred.append(values - bias)
        sds.append(float(sd))
    inward = 1.0 if finger == 1 else -1.0
    return _Forces(inward * centred[0], centred[1], sds[0], sds[1])


def _firm(forces: _Forces, holding: np.ndarray) -> np.ndarray:
    """Samples (num_timesteps,) at which the finger presses firmly, `holding` under each alignment: while a
    pad closes or opens, its damping adds shear that Coulomb's law does not bound."""
    recorded = np.isfinite(forces.normal + forces.shear)
    core = (holding.mean(axis=0) > 0.5) & recorded
    if not core.any():
        return np.zeros(core.size, bool)
    least = max(FIRM * float(np.median(forces.normal[core])), SURE * forces.sd_normal)
    return recorded & (np.nan_to_num(forces.normal) > least)


def _ratio(forces: _Forces, use: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Signed ratios of the selected samples and their noise, to first order."""
    ratio = forces.shear[use] / forces.normal[use]
    return ratio, np.hypot(forces.sd_shear, ratio * forces.sd_normal) / forces.normal[use]


def _held(
    weighed: Sequence[WeighedTrial], fingers: list[list[_Forces]], steps: tuple[Subtask, ...], obj: str
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Held samples of one block: ratios, their noise, alignments (num_alignments, num_samples)."""
    moves = sorted({s.move for s in steps if s.object == obj and s.move is not None})
    ratios, sds, masks = [np.zeros(0)], [np.zeros(0)], []
    for a, pair in zip(weighed, fingers, strict=True):
        for move in moves:
            members = [s.index for s in steps if s.move == move and s.state != FREE]
            holding = np.any(a.masks[:, members], axis=1)
            for forces in pair:
                use = _firm(forces, holding) & holding.any(axis=0)
                ratio, sd = _ratio(forces, use)
                ratios.append(np.abs(ratio))
                sds.append(sd)
                masks.append(holding[:, use])
    held = np.concatenate(masks, axis=1) if masks else np.zeros((1, 0), bool)
    return np.concatenate(ratios), np.concatenate(sds), held


def _stretches(
    weighed: Sequence[WeighedTrial], fingers: list[list[_Forces]], steps: tuple[Subtask, ...], obj: str,
    rig: Rig,
) -> list[Stretch]:  # fmt: skip
    """Each finger on the resting block, with the samples that all alignments share."""
    compliance = 1 / rig.fingertip.shear_stiffness
    out = []
    for a, pair in zip(weighed, fingers, strict=True):
        for step in steps:
            if step.object != obj or step.state != ON_GROUND:
                continue
            resting = a.masks[:, step.index]
            for number, forces in enumerate(pair, 1):
                height = getattr(a.signals, f"y{number}")
                use = resting.all(axis=0) & _firm(forces, resting) & np.isfinite(height)
                bend = np.diff(height, 2)
                bend = bend[np.isfinite(bend)]  # shows a height's noise where the rig states none
                learned = max(robust_sd(bend) / np.sqrt(6.0), 1e-7) if bend.size else 1e-4
                sd_height = np.where(np.isfinite(a.signals.sd_y), a.signals.sd_y, learned)[use]
                sd = np.hypot(sd_height, forces.sd_shear * compliance)
                out.append(Stretch(
                    a.signals.t[use], (height - forces.shear * compliance)[use], sd,
                    forces.shear[use], *_ratio(forces, use), compliance,
                ))  # fmt: skip
    return out
