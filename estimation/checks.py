"""What speaks against an identification: replicated data, the scale of forces, and remarks for the reader.

Whether forces are on the scale that the rig has them on: against the pads, the noise, and each other.

A force that is read g times too large squeezes pads that seem 1 / g times as soft, and its noise is g times
the stated one; pads that truly differ leave the noise alone. Where [fingertip] states the pads, four
explanations of what grips show are weighed against each other: the rig is right, its pads are wrong, both
axes of force are scaled by g, or the vertical alone. A weight is then drawn from all of them, so that its
interval holds the truth whichever it is. And two fingers press what they carry alike, but for its inertia.

Posterior-predictive checks: could recordings like these come from the fitted model?

For each channel the discrepancy is the weighted scatter of the grips' means about their prediction,
with the scatter between grips at its prior median (it may not absorb what it is asked about): its
posterior-predictive p-value compares observed with replicated scatter (Gelman, Meng, Stern 1996). A
small p-value says that grips differ by more than sensors and hand explain.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from estimation import priors
from estimation.design import Design, PadDoubt
from estimation.observations import CHANNELS, MIN_FREE, WeighedTrial
from estimation.pads import MISSTATED, SLOPE_SD, unit_pads
from estimation.posterior import NUM_CHANNELS, Posterior
from estimation.sampler import CERTAIN, Draws
from hmmseg.hand.plausibility import Finding, all_changed
from hmmseg.hand.sensing import WHITE
from hmmseg.io.rig import FORCE_CHANNELS, Rig
from hmmseg.io.task import BlockTask
from hmmseg.io.units import UNITS
from hmmseg.robust import robust_sd
from hmmseg.segmentation.align import AlignedTrials

NUM_REPLICATES = 400  # numerics: tell a p-value of SMALL to 0.0035
SMALL = 0.005  # chosen: p-value from which a check warns; a result has up to a dozen of them
MEANING = {
    "force": "the net vertical force while carried differs between grips",
    "distance": "the distance of the fingers while held differs between grips",
    "rise": "the height by which a block rises or sinks differs between trials (slip in the grip does that)",
}


@dataclass(frozen=True)
class PredictiveCheck:
    """Posterior-predictive p-value per channel, and warnings for those that are small.

    `excess`: sd between grips beyond the sensors' noise, posterior median, per channel (N, m, m);
    `repeats`: observations that tell it, none where the prior alone decides.
    """

    p_values: dict[str, float]
    excess: dict[str, float]
    repeats: dict[str, int]
    warnings: tuple[str, ...]

    def to_json(self) -> dict:
        """p-values, excess scatter and what it was learned from, by channel."""
        return {
            name: {"p_value": p, "scatter_between_grips": self.excess[name], "repeats": self.repeats[name]}
            for name, p in self.p_values.items()
        }


def check(post: Posterior, draws: Draws, rng: np.random.Generator) -> PredictiveCheck:
    """Check every channel that was observed."""
    d = post.design

    def of(values: np.ndarray) -> np.ndarray:
        return values.reshape(len(draws.flat), values.shape[-1])[chosen]

    chosen = rng.integers(len(draws.flat), size=NUM_REPLICATES)
    scales, shares = of(draws.scales), of(draws.shares)
    predicted = of(draws.chain) @ d.coefficients.T + of(draws.deviations) @ d.shifts.T
    predicted += shares[:, d.channel] * d.unit
    variance = d.variance * np.exp(2 * scales[:, d.channel])
    variance += (priors.SCATTER_MEDIAN[d.channel] * d.unit) ** 2
    z = (d.mean - predicted) / np.sqrt(variance)
    new = rng.normal(size=z.shape)
    p_values, excess, repeats, warnings = {}, {}, {}, []
    for c, name in enumerate(CHANNELS):
        mine = (d.channel == c) & ~d.slope
        if not mine.any():
            continue
        observed, replicated = ((v[:, mine] ** 2).sum(axis=1) for v in (z, new))
        p_values[name] = float(np.mean(replicated >= observed))
        share = priors.SCATTER_MEDIAN[c] * np.exp(scales[:, NUM_CHANNELS + c])
        excess[name] = float(np.median(share) * np.mean(np.abs(d.unit[mine])))
        repeats[name] = int(d.repeats()[c])
        if p_values[name] < SMALL:
            size = f"{excess[name]:.2g} N" if c == 0 else f"{1e6 * excess[name]:.2g} um"
            warnings.append(f"{MEANING[name]} by {size} beyond sensor noise; intervals allow for it")
    return PredictiveCheck(p_values, excess, repeats, tuple(warnings))


MISREAD = 0.5  # prior: share of forces among what is to blame where pads and forces contradict each other
GAIN_LOG_SD = 1.0  # prior: of log g: another range or unit of the amplifier
PADS_LOG_SD = 0.8  # prior: of a wrong stiffness: foams of another kind are a third or three times as stiff
NOISE_LOG_SD, AXIS_LOG_SD = 0.35, 0.3  # prior: noise is off its statement by a factor of two once in twenty
GRID = np.linspace(np.log(1e-3), np.log(1e3), 2001)  # numerics: log g; twice a third of a percent a step
RAISED = 2.0  # chosen: times its prior that the probability of a wrong scale must be, to be taken up
TELLING = 1.0  # limit: sd of the pads' share along the grip, from which grips show nothing of it
UNEVEN = 1.3  # limit: of two fingers' mean forces on what they carry: drifts and drags make up to 1.16


@dataclass(frozen=True)
class ForceScale:
    """The posterior of g (GRID,), by which vertical forces are read too large, and that of any g but 1.

    `probability` that forces are misread; `density` (len(GRID),) of log g if they are.
    """

    probability: float
    density: np.ndarray

    def corrected(self, chain: np.ndarray, weights: list[int], rng: np.random.Generator) -> np.ndarray:
        """Draws (walkers, steps, Q), those of `weights` [N] with g drawn from its posterior."""
        out, size = chain.copy(), chain.shape[:2]
        log_g = np.where(
            rng.uniform(size=size) < self.probability, rng.choice(GRID, size, p=self.density), 0.0
        )
        out[..., weights] *= np.exp(-log_g)[..., None]
        return out

    def remark(self) -> str:
        """What contradicts what, for people."""
        g = float(np.exp(self.density @ GRID))
        size = f"{g:.2g} times too large" if g > 1 else f"{1 / g:.2g} times too small"
        return (
            f"forces and [fingertip] contradict each other: forces are read {size} with a probability of "
            f"{self.probability:.0%}, or the pads are not as stated; weights allow for both, and a weighed "
            "block would tell"
        )


def force_scale(doubt: PadDoubt, weighed: Sequence[WeighedTrial], rig: Rig) -> ForceScale | None:
    """The scale of forces where pads and noise say anything against 1; None where nothing does.

    Not to be used where forces come late, which makes slopes of readings over them flat.
    """
    tip = rig.fingertip
    if not np.isfinite([tip.normal_stiffness, tip.shear_stiffness]).all():
        return None
    (normal, normal_sd), (shear, shear_sd) = doubt.seen
    if normal_sd > TELLING:
        return None
    share = np.expm1(-GRID)  # of compliance beyond the stated one, where forces are g times too large

    def pads(of_normal: np.ndarray | float, of_shear: np.ndarray | float) -> np.ndarray:
        """Log likelihood (len(GRID),) of both shares where truly these."""
        out = np.zeros(GRID.size)
        for seen, sd, true in ((normal, normal_sd, of_normal), (shear, shear_sd, of_shear)):
            if np.isfinite(sd):
                error = np.hypot(sd, SLOPE_SD * (1 + np.asarray(true)))
                out = out - 0.5 * ((seen - true) / error) ** 2 - np.log(error)
        return out

    def noise(of_x: np.ndarray | float, of_y: np.ndarray | float) -> np.ndarray:
        """Log likelihood of the noise of both axes, read `of` (logarithms) times too large."""
        excess = _noise_excess(weighed, rig)
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

    foam = max(evidence(pads(share, share), PADS_LOG_SD), evidence(pads(share, 0.0), PADS_LOG_SD),
               evidence(pads(0.0, share), PADS_LOG_SD))  # fmt: skip
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
    if wrong < RAISED * MISSTATED * MISREAD:
        return None
    prior = normal_prior(GAIN_LOG_SD)
    of_g = [np.exp(prior + each - np.logaddexp.reduce(prior + each)) for each in (both, vertical)]
    density = (odds[2] * of_g[0] + odds[3] * of_g[1]) / wrong
    return ForceScale(wrong, density / density.sum())


def _noise_excess(weighed: Sequence[WeighedTrial], rig: Rig) -> tuple[float, float] | None:
    """Logarithm of the noise of fx and of fy over the stated one; None where it is filtered or unstated."""
    if rig.noise.force is None:
        return None
    out = []
    for axis in "xy":
        bends, followed = [], []
        for a in weighed:
            free = a.weights.free > 0
            for finger in (1, 2):
                force = getattr(a.signals, f"f{axis}{finger}")
                bend = np.diff(np.where(free, force, np.nan), 2)
                bends.append(bend[np.isfinite(bend)] / a.signals.sd_force)
                both = bend[1:] * bend[:-1]
                followed.append(both[np.isfinite(both)] / a.signals.sd_force**2)
        every, neighbours = np.concatenate(bends), np.concatenate(followed)
        if neighbours.size < MIN_FREE or not every.any():
            return None
        if float(neighbours.mean() / np.mean(every**2)) > WHITE:
            return None
        shown = robust_sd(every) / np.sqrt(6)
        if shown == 0:  # coarser than its noise
            return None
        out.append(float(np.log(shown)))
    return out[0], out[1]


def uneven(weighed: Sequence[WeighedTrial]) -> str | None:
    """What says that two fingers press unequally on what they carry, though nothing else holds it."""
    pressed = []
    for a in weighed:
        left, right = a.signals.fx1, -a.signals.fx2
        known = np.isfinite(left) & np.isfinite(right)
        for grip in a.weights.grips.values():
            weight = grip["force"].mean(axis=0) * known
            if weight.sum() > 0:
                pressed.append([weight @ np.where(known, f, 0.0) / weight.sum() for f in (left, right)])
    if not pressed:
        return None
    left, right = np.median(pressed, axis=0)
    if min(left, right) <= 0 or max(left, right) < UNEVEN * min(left, right):
        return None
    return (
        f"fx1 and -fx2 press what is carried with {left:.3g} and {right:.3g} N, which should be alike: "
        "one of the fingers is read on another scale"
    )


STEEL = 7850.0  # physics: [kg/m^3]
DEEPEST = 10.0  # limit: depths of a block in widths; none is held by two pads that is deeper
LIGHT = 1500.0  # limit: [kg/m^3]: plastics and stone, of which the unit that makes it is the likeliest
NOT_LEVEL = 2e-3  # chosen: m; more than a tilted table or a slip in the grip make of a move on a level


def soft_pads(design: Design, rig: Rig) -> list[str]:
    """Pads that give otherwise than the rig says, as every grip shows while its force changes."""
    out, tip = [], unit_pads(rig)
    for kind, share, odds, compliance in (
        ("normal", design.doubt.normal, design.doubt.odds[0], tip.normal1),
        ("shear", design.doubt.shear, design.doubt.odds[1], tip.shear1),
    ):  # fmt: skip
        stated = getattr(rig.fingertip, f"{kind}_stiffness")
        if odds < CERTAIN:
            continue
        true = compliance * (share + (1.0 if np.isfinite(stated) else 0.0))
        seen = f"about {1 / true:.2g} N/m" if true > 0 else "no give at all, or forces that are late"
        out.append(
            f"[fingertip] {kind}_stiffness = {stated:g}, but readings within each grip show {seen}: "
            f"{'widths' if kind == 'normal' else 'heights'} allow for it"
        )
    return out


def unstated_pads(design: Design) -> list[str]:
    """Pads whose stiffness the rig leaves open: what is certain of them is what the recordings show."""
    doubt, props = design.doubt, {u.prop for u in design.unknowns}
    found = {
        "normal": ("width", doubt.normal, doubt.normal_give),
        "shear": ("height", doubt.shear, doubt.shear_give),
    }
    return [
        f"the rig states no [fingertip] {kind}_stiffness: {prop}s allow for pads that give as much as the "
        "readings within each grip leave open; with the stiffness measured they are surer"
        for kind, (prop, surprising, give) in found.items()
        if give and not surprising and prop in props
    ]


def unnamed(task: BlockTask, design: Design) -> list[str]:
    """Moves that should be level and are not: something that the task does not name lies beneath."""
    return [
        f"{task.performed[move].object} was {'raised' if rise > 0 else 'lowered'} by {abs(rise) * 1e3:.1f} "
        "mm, though the task moves it on a level: an object that the task does not name may lie beneath"
        for move, rise in design.level_rises.items()
        if abs(rise) > NOT_LEVEL
    ]


def misfits(aligned: AlignedTrials) -> list[str]:
    """What does not fit the task, trial by trial, and what was remarked on while aligning."""
    found = [trial.segmentation for trial in aligned.trials]
    remarks = dict.fromkeys(remark for s in found for remark in s.remarks)
    return [*(f"{s.file}: {failure}" for s in found for failure in s.failures), *remarks]


def dense(task: BlockTask, rig: Rig, found: Mapping[tuple[str, str], float]) -> list[str]:
    """Blocks too heavy for their size, of whatever they are made: forces in a smaller unit than N.

    `found`: means by (object, property) [N, m].
    """
    for obj in task.objects:
        weight, width = found.get((obj, "weight")), found.get((obj, "width"))
        if weight is None or width is None or width <= 0:
            continue
        height = found.get((obj, "height"), width)
        area = width * (height if height > 0 else width)
        depth = weight / (rig.gravity * STEEL * area)
        if depth < DEEPEST * width:
            continue
        density = weight / (rig.gravity * area**1.5)
        unit = min(("mN", "gf"), key=lambda name: abs(np.log(density * UNITS[name][1] / LIGHT)))
        names = rig.gripper.wrench[:3] if rig.gripper is not None else FORCE_CHANNELS
        remedy = Finding(names[0], "", all_changed(names, rig, unit=unit)).remedy
        return [
            f"{obj} weighs {weight:.3g} N at {width * 1e3:.3g} x {area / width * 1e3:.3g} mm: of steel it "
            f"would be {depth:.2g} m deep, so forces look like {unit}; expected {remedy}"
        ]
    return []


def unrepeated(design: Design) -> list[str]:
    """Where no grip repeats another, the prior alone says how far off the contact equations may be."""
    seen = np.bincount(design.channel, minlength=len(CHANNELS)) > 0
    alone = [name for name, n, s in zip(CHANNELS, design.repeats(), seen, strict=True) if s and n == 0]
    if not alone:
        return []
    return [
        f"no grip repeats another, so how far the model itself may be off in {', '.join(alone)} is taken "
        "from its prior; a second trial would show it"
    ]
