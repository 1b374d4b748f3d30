"""Block properties from aligned trials: posterior, friction and checks, in one result."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from estimation import checks
from estimation.consistency import contradictions, force_scale
from estimation.design import Design, Unknown, build, without_drift, zero_drift
from estimation.friction import FrictionPosterior, friction_posteriors
from estimation.observations import Noise, WeighedTrial, aligned_weights
from estimation.posterior import posterior
from estimation.report import Actual, inference_data, properties_table, summary
from estimation.sampler import Draws, sample
from hmmseg.contact.decompose import FREE, UNITS, Decomposition, decompose
from hmmseg.errors import nearest
from hmmseg.io.rig import FORCE_CHANNELS, Rig
from hmmseg.io.task import BlockTask
from hmmseg.jaxconfig import double_precision
from hmmseg.segmentation.align import AlignedTrials
from hmmseg.segmentation.spans import Segmentation
from hmmseg.tables import Tabled

if TYPE_CHECKING:  # slow to import
    import pandas as pd
    from matplotlib.axes import Axes
    from rich.table import Table

LISTED = 3  # look: most faults listed in a reason


@dataclass(frozen=True, repr=False)
class Identification(Tabled):
    """The result of `identify`.

    `draws` (num_draws, num_properties) of the properties named by `names` (object, property) in N and m,
    `combined` (num_draws, num_combinations) of the `combinations` that are determined only jointly; `sampled`
    is None if nothing could be determined. `notes`: what a reader should know though nothing is wrong.
    `centres` [N, m]: posterior means of all computed properties, contradicted ones included, from which a
    search for the cause starts.
    """

    task: BlockTask
    rig: Rig
    aligned: AlignedTrials
    weighed: tuple[WeighedTrial, ...]
    noise: Noise
    names: tuple[tuple[str, str], ...]
    draws: np.ndarray
    combinations: tuple[Unknown, ...]
    combined: np.ndarray
    sampled: Draws | None
    friction: dict[str, FrictionPosterior]
    reasons: dict[str, str]
    predictive: checks.PredictiveCheck | None
    warnings: tuple[str, ...]
    notes: tuple[str, ...] = ()
    centres: Mapping[tuple[str, str], float] = field(default_factory=dict)

    @property
    def segmentations(self) -> list[Segmentation]:
        """One segmentation a trial."""
        return self.aligned.segmentations

    def of(self, obj: str, prop: str) -> np.ndarray:
        """Posterior draws of one property.

        Args:
            obj: Name of the object.
            prop: `weight`, `width` or `height`.

        Returns:
            Draws (num_draws,) [N or m].

        Raises:
            KeyError: The property is undetermined (with the reason), or no object or property has that name.
        """
        for name, known in ((obj, self.task.objects), (prop, tuple(UNITS))):
            if name not in known:
                raise KeyError(f"no {name!r}; expected {nearest(name, known)}")
        if (obj, prop) not in self.names:
            raise KeyError(f"{obj}.{prop} is undetermined: {self.reasons.get(f'{obj}.{prop}', '')}")
        return self.draws[:, self.names.index((obj, prop))]

    def to_json(self) -> dict[str, Any]:
        """The body of `identify`'s JSON document."""
        draws, described = self.sampled, decompose(self.task)

        def entry(obj: str, prop: str) -> dict[str, Any] | None:
            if (obj, prop) not in self.names:
                return None
            subtasks = source_subtasks(described, obj, prop)
            return summary(self.of(obj, prop), UNITS[prop]) | {"subtasks": subtasks}

        friction = {obj: self.friction[obj].to_json() if obj in self.friction else None
                    for obj in self.task.objects}  # fmt: skip
        return {
            "trials": [s.to_json() for s in self.segmentations], "method": "bayes",
            "sampler": None if draws is None else {
                "walkers": draws.chain.shape[0], "steps": draws.steps, "ess": draws.ess, "rhat": draws.rhat,
                "acceptance": draws.acceptance, "converged": draws.converged,
            },
            "properties": {
                obj: {prop: entry(obj, prop) for prop in UNITS} | {"friction": friction[obj]}
                for obj in self.task.objects
            },
            "combinations": [
                {"of": {f"{obj}.{u.prop}": c for obj, c in u.terms.items()}} | summary(column, UNITS[u.prop])
                for u, column in zip(self.combinations, self.combined.T, strict=True)
            ],
            "reasons": self.reasons,
            "predictive": None if self.predictive is None else self.predictive.to_json(),
            "notes": list(self.notes),
        }  # fmt: skip

    def tables(self) -> "list[Table]":
        """The properties, one a row."""
        return [properties_table(self.to_json())]

    def plot_estimates(self, actual: Actual | None = None, path: str | Path | None = None) -> "Axes":
        """Plot every property with its 68 and 95 % interval, against `actual` values if given; the axes."""
        from estimation.plots import draw_estimates

        return draw_estimates(self.to_json()["properties"], actual, None if path is None else Path(path))

    def plot_posterior(
        self, actual: Actual | str | Path | None = None, path: str | Path | None = None
    ) -> np.ndarray:
        """Corner plot of the joint posterior; returns the axes (num_properties, num_properties).

        A path alone may be given first, as to other plots.
        """
        if isinstance(actual, str | Path):
            actual, path = None, actual
        from estimation.plots import draw_corner

        return draw_corner(self.draws, self.names, None if path is None else Path(path), actual)

    def plot_check(self, trial: int = 0, path: str | Path | None = None) -> "list[Axes]":
        """Plot one trial's samples with the predictive band of the posterior; returns the axes."""
        from estimation.plots import draw_check

        return draw_check(self, trial, None if path is None else Path(path))

    def to_pandas(self) -> "pd.DataFrame":
        """Posterior draws as a DataFrame, one column `block.property` each [N, m]."""
        import pandas as pd

        return pd.DataFrame(self.draws, columns=[".".join(name) for name in self.names])

    def to_arviz(self) -> Any:
        """The properties' posterior in ArviZ's format, dimensions (chain, draw)."""
        if self.sampled is None:
            raise ValueError("no property was determined, so there is no posterior")
        chain = self.sampled.chain
        names = [f"{obj}.{prop}" for obj, prop in (*self.names, *(u.name for u in self.combinations))]
        return inference_data({name: chain[..., i] for i, name in enumerate(names)})


@double_precision
def identify_aligned(
    aligned: AlignedTrials, seed: int = 0, progress: Callable[[int, int], None] | None = None
) -> Identification:
    """Properties of every block from aligned trials, pooled; `progress(steps_done, steps_at_most)`."""
    rng, rig, task = np.random.default_rng(seed), aligned.rig, aligned.task
    weighed, noise = aligned_weights(aligned, rng)
    free = [step.index for step in aligned.subtasks if step.state == FREE]
    drift, recorded = np.array([zero_drift(a, free) for a in weighed]), aligned
    if drift.any():
        aligned = replace(aligned, trials=tuple(map(without_drift, aligned.trials, drift)))
        weighed, noise = aligned_weights(aligned, rng)
    design = build(aligned, weighed, noise)
    post = posterior(design) if design.unknowns else None
    sampled = None if post is None else sample(post, seed, progress)
    friction = _friction(aligned, weighed, design, sampled, rng)
    reasons = _reasons(aligned, design, friction)
    predictive, contradicted, centres, kept = None, {}, {}, list[int]()
    warnings, notes = checks.misfits(aligned), list[str]()
    if post is not None and sampled is not None and sampled.converged:
        predictive = checks.check(post, sampled, rng)
        warnings += predictive.warnings
        notes = [*checks.unrepeated(design), *checks.unstated_pads(design), *checks.unchecked(design, rig)]
        contradicted = contradictions(aligned, weighed, design)
        rejected = contradicted | impossible(design, sampled)
        reasons |= rejected
        kept = [i for i, u in enumerate(design.unknowns) if not rejected.keys() & set(u.properties)]
        centres = {u.name: float(sampled.flat[:, i].mean()) for i, u in enumerate(design.unknowns)
                   if u.single and i not in sampled.impossible}  # fmt: skip
    elif sampled is not None:
        why = f"the sampler has not converged: {sampled.shortfall}"
        warnings.append(why)
        reasons |= {".".join(u.name): why for u in design.unknowns if u.single}
    unknowns = tuple(design.unknowns[i] for i in kept)
    draws = np.zeros((0, 0))
    if sampled is not None and kept:
        chain, heavy = sampled.chain[..., kept], [i for i, u in enumerate(unknowns) if u.prop == "weight"]
        scale = None if aligned.late else force_scale(design.doubts, weighed, rig)
        if scale is not None and heavy:
            chain = scale.corrected(chain, heavy, rng)
            warnings.append(scale.remark())
        sampled = replace(sampled, chain=chain)
        draws = sampled.flat
    num = sum(u.single for u in unknowns)  # singles come first
    means = {u.name: float(draws[:, i].mean()) for i, u in enumerate(unknowns) if u.single}
    warnings += [
        f"{n.name}: forces in free motion are not zero as the rig has it; a bias is estimated with the rest"
        for n in design.unexpected
    ]
    drifts = "drifts by {:.2g} N/s, which is removed", np.abs(drift).max(axis=0)
    moves = "moves by {:.2g} N between stretches of free motion; intervals allow for it", design.moved
    warnings += [f"the zero of {name} {text.format(size)}" for text, sizes in (drifts, moves)
                 for name, size in zip(FORCE_CHANNELS, sizes, strict=True) if size > 0]  # fmt: skip
    warnings += dict.fromkeys(contradicted.values())
    warnings += checks.soft_pads(design, rig) + checks.unnamed(task, design) + checks.dense(task, rig, means)
    friction = {
        k: f for k, f in friction.items() if f.lower_bound is not None and f"{k}.friction" not in reasons
    }
    return Identification(
        task, rig, recorded, tuple(weighed), noise, tuple(u.name for u in unknowns[:num]),
        draws[:, :num], unknowns[num:], draws[:, num:], sampled if kept else None, friction, reasons,
        predictive, tuple(warnings), tuple(notes), centres | means,
    )  # fmt: skip


def _friction(
    aligned: AlignedTrials, weighed: Sequence[WeighedTrial], design: Design, sampled: Draws | None,
    rng: np.random.Generator,
) -> dict[str, FrictionPosterior]:  # fmt: skip
    """Friction of every object, given draws of the weights; without values if a recording hides it."""
    weights = {}
    if sampled is not None and sampled.converged:
        weights = {u.name[0]: sampled.flat[:, i] for i, u in enumerate(design.unknowns) if u.prop == "weight"}
    sd_force = aligned.rig.noise.force or aligned.fit.parameters.scale["force"]
    friction = friction_posteriors(weighed, aligned.task, aligned.rig, sd_force, rng, weights)
    for trial in aligned.trials:
        if "friction" in trial.trial.hidden:
            friction = {obj: FrictionPosterior(None, reason=trial.trial.hidden["friction"], ground=f.ground)
                        for obj, f in friction.items()}  # fmt: skip
    return friction


def impossible(design: Design, sampled: Draws) -> dict[str, str]:
    """Why computed properties are rejected, by `object.property`: values that no block has."""
    out = dict[str, str]()
    for i, u in ((i, design.unknowns[i]) for i in sampled.impossible):
        size = f"{float(sampled.flat[:, i].mean()):.3g} {UNITS[u.prop]}"
        text = f"{'.'.join(u.name)} comes out at {size}, as no block has it: positions or rig.toml are off"
        out |= dict.fromkeys(u.properties, text)
    return out


def source_subtasks(described: Decomposition, obj: str, prop: str) -> list[str]:
    """Names of the subtasks whose samples determine this property, as `carry block1`."""
    evidence = [e for e in described.properties[obj][prop].evidence if e.condition is None]
    return list(dict.fromkeys(described.subtasks[k].label for one in evidence for k in one.subtasks))


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
            needed = source_subtasks(described, obj, prop)
            out[f"{obj}.{prop}"] = reason or _not_recorded(aligned, obj, needed)
        if (reason := friction[obj].reason) is not None and friction[obj].lower_bound is None:
            out[f"{obj}.friction"] = reason
    return out


def _not_recorded(aligned: AlignedTrials, obj: str, needed: list[str]) -> str:
    if not needed:
        return f"no subtask of this task lifts {obj}"
    missing = f"the recording does not show {' and '.join(needed)} as the task has it"
    faults = [f"{t.trial.file}: {f.line}" for t in aligned.trials for f in t.trial.faults if f.spans]
    more = f" and {len(faults) - LISTED} more" if len(faults) > LISTED else ""
    return missing + (f" ({'; '.join(faults[:LISTED])}{more})" if faults else "")
