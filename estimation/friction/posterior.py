"""Friction of the fingers against each block: its lower bound, and its value where a grip slipped.

Coulomb's law: |shear| <= mu x normal force in every held sample (the paper's Table 3 takes the
largest ratio of the recorded ones). The bound here is the posterior of the largest true ratio
(ratio_bound.py); a finger that slips (slip.py) is at the limit, so the bound is then mu itself.
Where a block is slid, the net force tells the friction against its support (ground.py).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from estimation.friction.ground import GroundFriction, ground_friction
from estimation.friction.ratio_bound import largest_ratio
from estimation.friction.slip import SlipEvidence, Stretch, slip_evidence
from estimation.observations import MIN_FREE, WeighedTrial
from estimation.summary import summary
from hmmseg.contact.decompose import FREE, ON_GROUND, Subtask, subtasks
from hmmseg.hand.signals import Signals
from hmmseg.io.rig import FORCE_CHANNELS, Rig
from hmmseg.io.task import BlockTask
from hmmseg.levels import SURE
from hmmseg.robust import robust_sd

# chosen: while a pad closes or opens, its damping adds shear that Coulomb's law does not bound, and the
# ratio of two small forces says little: samples below this share of the grip's median are left out.
FIRM = 0.5
DRAWS = 2000  # numerics: of each coefficient


@dataclass(frozen=True)
class FrictionPosterior:
    """Friction coefficient of the fingers on one block.

    `lower_bound` is the 5 % quantile of `bound_draws` (num_draws,), the posterior of the largest
    ratio reached; None with a `reason` where the block was not held. `mu_draws` (num_draws,) only
    where slip was seen; `reason` then is None and otherwise says why there is no value. `ground`
    is the friction of the block on its support where it was slid.
    """

    lower_bound: float | None
    bound_draws: np.ndarray | None = None
    mu_draws: np.ndarray | None = None
    slip: SlipEvidence | None = None
    reason: str | None = None
    ground: GroundFriction | None = None

    def to_json(self) -> dict:
        """The entry `friction` of one block in the JSON of `identify`."""
        out: dict = {"unit": "1", "lower_bound": self.lower_bound}
        if self.mu_draws is not None:
            out |= summary(self.mu_draws, "1")
        if self.slip is not None:
            out["slip"] = {
                "seen": self.slip.seen,
                "probability": self.slip.probability,
                "log_bayes_factor": self.slip.log_bayes_factor,
            }
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


@dataclass(frozen=True)
class _Held:
    """Held samples of one block: ratios, their noise, alignments (num_alignments, num_samples)."""

    ratio: np.ndarray
    sd: np.ndarray
    held: np.ndarray


def friction_posteriors(
    weighed: Sequence[WeighedTrial], task: BlockTask, rig: Rig, sd_force: float,
    rng: np.random.Generator,
) -> dict[str, FrictionPosterior]:  # fmt: skip
    """Friction of every object of the task, all trials pooled, alignments marginalised.

    `sd_force`: noise of one force sample [N] where the signals do not state it.
    """
    steps = subtasks(task)
    fingers = [[_forces(a, rig, finger, sd_force) for finger in (1, 2)] for a in weighed]
    held = {obj: _held(weighed, fingers, steps, obj) for obj in task.objects}
    resting = {obj: _stretches(weighed, fingers, steps, obj, rig) for obj in task.objects}
    out = {}
    for obj in task.objects:
        ground = ground_friction(weighed, task, steps, obj, rig, sd_force, rng, DRAWS)
        samples = held[obj]
        if samples.ratio.size == 0:
            reason = f"the recording never shows {obj} held firmly"
            out[obj] = FrictionPosterior(None, reason=reason, ground=ground)
            continue
        draws = largest_ratio(samples.ratio, samples.sd, samples.held, rng, DRAWS)
        others = [s for other in task.objects if other != obj for s in resting[other]]
        slip = slip_evidence(resting[obj], others, draws)
        draws = draws * _gain_factor(rig, rng)
        reason = None if slip.seen else f"no finger was seen to slip on {obj}: a bound is all it tells"
        out[obj] = FrictionPosterior(
            float(np.quantile(draws, 0.05)), draws, draws if slip.seen else None, slip, reason, ground
        )
    return out


def _forces(a: WeighedTrial, rig: Rig, finger: int, sd_force: float) -> _Forces:
    """Forces of one finger less their mean in free motion, where they ought to vanish.

    What free motion shows beyond the sensors' noise counts as noise (a cable that pulls).
    """
    free, stated = a.weights.free > 0, a.signals.sd_force
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
    """Samples (num_timesteps,) at which the finger presses firmly; `holding` under each alignment."""
    recorded = np.isfinite(forces.normal + forces.shear)
    core = (holding.mean(axis=0) > 0.5) & recorded
    if not core.any():
        return np.zeros(core.size, bool)
    least = max(FIRM * float(np.median(forces.normal[core])), SURE * forces.sd_normal)
    return recorded & (np.nan_to_num(forces.normal) > least)


def _ratio(forces: _Forces, use: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Signed ratios of the samples in use and their noise, to first order."""
    ratio = forces.shear[use] / forces.normal[use]
    return ratio, np.hypot(forces.sd_shear, ratio * forces.sd_normal) / forces.normal[use]


def _held(
    weighed: Sequence[WeighedTrial], fingers: list[list[_Forces]], steps: tuple[Subtask, ...], obj: str
) -> _Held:
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
    return _Held(np.concatenate(ratios), np.concatenate(sds), held)


def _stretches(
    weighed: Sequence[WeighedTrial],
    fingers: list[list[_Forces]],
    steps: tuple[Subtask, ...],
    obj: str,
    rig: Rig,
) -> list[Stretch]:
    """Each finger on the resting block, samples that every alignment has there."""
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
                ratio, ratio_sd = _ratio(forces, use)
                sd = np.hypot(_height_noise(a.signals, height)[use], forces.sd_shear * compliance)
                out.append(Stretch(
                    a.signals.t[use], (height - forces.shear * compliance)[use], sd,
                    forces.shear[use], ratio, ratio_sd, compliance,
                ))  # fmt: skip
    return out


def _height_noise(signals: Signals, height: np.ndarray) -> np.ndarray:
    """Noise sd (num_timesteps,) of one finger's height [m]; learned where the rig states none."""
    bend = np.abs(np.diff(height, 2))
    learned = robust_sd(bend[np.isfinite(bend)]) / np.sqrt(6.0) if np.isfinite(bend).any() else 1e-4
    return np.where(np.isfinite(signals.sd_y), signals.sd_y, max(learned, 1e-7))


def _gain_factor(rig: Rig, rng: np.random.Generator) -> np.ndarray:
    """Factors (DRAWS,) by which uncertain force gains stretch every ratio."""
    gain = np.asarray(rig.systematic.force_gain)
    worst = max(np.hypot(gain[0], gain[1]), np.hypot(gain[2], gain[3]))
    return np.exp(worst * rng.standard_normal(DRAWS))
