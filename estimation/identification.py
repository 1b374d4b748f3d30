"""Block properties from trials: segmentation, posterior, friction, checks, in one result."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from estimation.design import Design, build
from estimation.friction.posterior import FrictionPosterior, friction_posteriors
from estimation.mode import find_mode, start
from estimation.observations import Aligned, Noise, aligned_weights
from estimation.posterior import pack
from estimation.predictive import PredictiveCheck, check
from estimation.sampler import Draws, sample
from hmmseg.contact.decompose import ABOVE_GROUND, FREE, ON_GROUND, Subtask, decompose, height_equations
from hmmseg.io.rig import Rig
from hmmseg.io.task import BlockTask
from hmmseg.io.trial import Trial
from hmmseg.segmentation.align import AlignedTrials, align
from hmmseg.segmentation.spans import Segmentation

UNITS = {"weight": "N", "width": "m", "height": "m"}
NOT_LEVEL = 2e-3  # m; more than a tilted table or a slip in the grip make of a move on a level
INTERVALS = {"interval_68": (16.0, 84.0), "interval_95": (2.5, 97.5)}


@dataclass(frozen=True)
class Identification:
    """Everything `identify` found.

    `draws` (num_draws, num_properties) of the properties named by `names` (object, property) in
    N and m; `sampled` is None where no property could be determined.
    """

    task: BlockTask
    rig: Rig
    aligned: AlignedTrials
    weighed: tuple[Aligned, ...]
    noise: Noise
    names: tuple[tuple[str, str], ...]
    draws: np.ndarray
    sampled: Draws | None
    friction: dict[str, FrictionPosterior]
    reasons: dict[str, str]
    predictive: PredictiveCheck | None
    warnings: tuple[str, ...]

    @property
    def segmentations(self) -> list[Segmentation]:
        """One segmentation a trial."""
        return self.aligned.segmentations

    def of(self, obj: str, prop: str) -> np.ndarray:
        """Posterior draws (num_draws,) of one property; KeyError where it is undetermined."""
        if (obj, prop) not in self.names:
            raise KeyError(f"{obj}.{prop} is undetermined: {self.reasons.get(f'{obj}.{prop}', '')}")
        return self.draws[:, self.names.index((obj, prop))]

    def to_json(self) -> dict:
        """The body of `identify`'s JSON document."""
        properties: dict[str, dict] = {}
        for obj in self.task.objects:
            entry: dict = {}
            for prop, unit in UNITS.items():
                known = (obj, prop) in self.names
                entry[prop] = summary(self.of(obj, prop), unit) if known else None
                if known:
                    entry[prop]["subtasks"] = source_subtasks(self.aligned.subtasks, self.task, obj, prop)
            friction = self.friction.get(obj)
            entry["friction"] = None if friction is None else friction.to_json()
            properties[obj] = entry
        return {
            "trials": [s.to_json() for s in self.segmentations],
            "method": "bayes",
            "sampler": self._sampler(),
            "properties": properties,
            "reasons": self.reasons,
            "predictive": None if self.predictive is None else self.predictive.to_json(),
        }

    def _sampler(self) -> dict | None:
        if self.sampled is None:
            return None
        walkers, steps, _ = self.sampled.chain.shape
        return {
            "walkers": walkers, "steps": steps, "ess": self.sampled.ess, "rhat": self.sampled.rhat,
            "acceptance": self.sampled.acceptance, "converged": self.sampled.converged,
        }  # fmt: skip

    def to_arviz(self):
        """ArviZ InferenceData of the properties' posterior, dimensions (chain, draw)."""
        import arviz

        if self.sampled is None:
            raise ValueError("no property was determined, so there is no posterior")
        chain = np.exp(self.sampled.chain[..., : len(self.names)])
        posterior = {f"{obj}.{prop}": chain[..., i] for i, (obj, prop) in enumerate(self.names)}
        return arviz.from_dict(posterior=posterior)


def identify(
    trials: Sequence[Trial], task: BlockTask, rig: Rig, seed: int = 0,
    progress: Callable[[int, int], None] | None = None,
) -> Identification:  # fmt: skip
    """Segment the trials and estimate the properties of every block, all trials pooled.

    `progress(steps_done, steps_at_most)` is called while sampling. Raises InputError for input
    that cannot be used; trials that do not fit the task are reported, not raised.
    """
    return identify_aligned(align(trials, task, rig), seed, progress)


def identify_aligned(
    aligned: AlignedTrials, seed: int = 0, progress: Callable[[int, int], None] | None = None
) -> Identification:
    """As `identify`, of trials that are aligned already."""
    rng, rig = np.random.default_rng(seed), aligned.rig
    trials = [one.trial for one in aligned.trials]
    weighed, noise = aligned_weights(aligned, rng)
    sd_force = rig.noise.force or aligned.fit.parameters.scale["force"]
    design = build(trials, weighed, noise, aligned.task, rig, sd_force)
    friction = friction_posteriors(weighed, aligned.task, rig, sd_force, rng)
    warnings = _misfits(aligned)
    draws, sampled, predictive = np.zeros((0, 0)), None, None
    if design.names:
        mode = find_mode(start(design), pack(design))
        sampled = sample(mode, seed, progress)
        draws = np.exp(sampled.flat[:, : len(design.names)])
        predictive = check(design, mode.data, sampled, rng)
        warnings += [*_unconverged(mode.converged, sampled), *predictive.warnings]
    warnings += [
        f"{n.name}: forces in free motion are not zero as the rig has it; a bias is estimated with the rest"
        for n in design.unexpected
    ]
    warnings += _unnamed(aligned.task, design)
    reasons = _reasons(aligned, design, friction)
    return Identification(
        aligned.task, rig, aligned, tuple(weighed), noise, design.names, draws, sampled,
        {k: f for k, f in friction.items() if f.lower_bound is not None}, reasons, predictive,
        tuple(warnings),
    )  # fmt: skip


def summary(draws: np.ndarray, unit: str) -> dict:
    """Mean, sd, median and intervals of posterior draws (num_draws,)."""
    out = {"unit": unit, "mean": draws.mean(), "sd": draws.std(ddof=1), "median": np.median(draws)}
    return out | {name: np.percentile(draws, q) for name, q in INTERVALS.items()}


def source_subtasks(steps: tuple[Subtask, ...], task: BlockTask, obj: str, prop: str) -> list[str]:
    """Names of the subtasks whose samples tell this property, as `carry block1`."""
    rises = dict(height_equations(task))

    def tells(s: Subtask) -> bool:
        if prop == "height":
            return s.state == ON_GROUND and s.move is not None and rises[s.move].get(obj, 0) != 0
        if s.object != obj:
            return False
        return s.state == ABOVE_GROUND if prop == "weight" else s.state != FREE

    return list(dict.fromkeys(f"{s.name} {s.object}" for s in steps if tells(s)))


def _reasons(
    aligned: AlignedTrials, design: Design, friction: dict[str, FrictionPosterior]
) -> dict[str, str]:
    """Why a property is null: the task cannot reveal it, or this recording does not show it."""
    described = decompose(aligned.task)
    out = {}
    for obj in aligned.task.objects:
        for prop in UNITS:
            if (obj, prop) in design.names:
                continue
            reason = described.properties[obj][prop].reason
            out[f"{obj}.{prop}"] = reason or _not_recorded(aligned, obj, prop)
        known = friction.get(obj)
        if known is None or known.lower_bound is None:
            out[f"{obj}.friction"] = known.reason if known else f"{obj} is never held"
    return out


def _not_recorded(aligned: AlignedTrials, obj: str, prop: str) -> str:
    needed = source_subtasks(aligned.subtasks, aligned.task, obj, prop)
    if not needed:
        return f"no subtask of this task lifts {obj}"
    return f"the recording does not show {' and '.join(needed)} as the task has it"


def _unnamed(task: BlockTask, design: Design) -> list[str]:
    """Moves that should be level and are not: something that the task does not name lies beneath."""
    return [
        f"{task.performed[move].object} was {'raised' if rise > 0 else 'lowered'} by {abs(rise) * 1e3:.1f} "
        "mm, though the task moves it on a level: an object that the task does not name may lie beneath"
        for move, rise in design.level_rises.items()
        if abs(rise) > NOT_LEVEL
    ]


def _misfits(aligned: AlignedTrials) -> list[str]:
    found = [trial.segmentation for trial in aligned.trials]
    return [f"{s.file}: {failure}" for s in found for failure in s.failures]


def _unconverged(found: bool, sampled: Draws) -> list[str]:
    out = [] if found else ["the search for the posterior mode ran out of steps"]
    if not sampled.converged:
        out.append(f"the sampler has not converged: ESS {sampled.ess:.0f}, R-hat {sampled.rhat:.3f}")
    return out
