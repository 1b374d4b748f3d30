"""The diagnosis: is there a gap, where, which effects cause it, how far it shrinks."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from hmmseg.contact.decompose import subtasks
from hmmseg.jaxconfig import double_precision
from hmmseg.segmentation.align import AlignedTrials
from hmmseg.tables import Tabled
from simgap.attribution.attribute import attribute
from simgap.attribution.findings import Attribution
from simgap.attribution.posterior import Model, forms
from simgap.attribution.problem import Gap
from simgap.attribution.search import sought
from simgap.attribution.verdict import ALARM
from simgap.effects import effect_named, free_parameters, name_of
from simgap.gap.assemble import together
from simgap.gap.body import body, drawn, parameters
from simgap.gap.evaluation import residual_at
from simgap.gap.experiments import next_experiment
from simgap.gap.fit import Fitted, Start, fit
from simgap.gap.located import Tally, tallies
from simgap.gap.problem import Problem
from simgap.gap.scatter import scatters
from simgap.gap.search import Identified, Search, search
from simgap.gap.tolerance import properties_tolerated
from simgap.gap.twins import own_healthy, twin_statistics
from simgap.gap.wrist_gap import check_forced, of_wrist
from simgap.progress import Progress, silent
from simgap.report.finding import sentence, tables

STAGES = 12  # look: that `progress` is told of, at most
NIL = float(-np.log(ALARM))  # nats; a smaller statistic raises no alarm, twins or none


@dataclass(frozen=True, repr=False)
class Diagnosis(Tabled):
    """Everything found; `body` is the JSON document's. Arrays are for figures and tests.

    `before`, `after` (T, N, C): whitened residuals without and with the verdict's effects, `cells` the first
    by trial, channel and subtask; `causes`: the fit of those effects that shift signals.
    """

    body: dict[str, Any]
    search: Search
    causes: Fitted
    attribution: Attribution
    before: np.ndarray
    after: np.ndarray
    cells: tuple[Tally, ...]
    warnings: tuple[str, ...] = ()
    seed: int = 0

    @property
    def problem(self) -> Problem:
        """Aligned trials and their whitening."""
        return self.search.problem

    def to_json(self) -> dict[str, Any]:
        """The body of `diagnose`'s JSON document."""
        return self.body

    def words(self) -> str:
        """The verdict in a sentence."""
        return sentence(self.body)

    def tables(self):
        """Probabilities, parameters of the causes, the largest cells."""
        return tables(self.body)

    def to_arviz(self):
        """ArviZ InferenceData: draws of the described effects' parameters, `effect.parameter`, given that it
        acts. Each effect is drawn by itself."""
        from estimation.report import inference_data

        every = {
            f"{name}.{key}": values[None]
            for name in self.body["effects"]
            if name in self.attribution.effects
            for key, (values, _) in drawn(
                self.search, self.attribution.effects[name], name, self.seed
            ).items()
        }
        return inference_data(every)

    def plot_where(self, path: str | Path | None = None):
        """Share of the gap by channel and subtask; the axes. Saved where a path is given."""
        from simgap.report.figures import draw_heat_map

        names = dict.fromkeys(step.label for step in subtasks(self.problem.frame.task))
        return draw_heat_map(self.body, list(names), None if path is None else Path(path))

    def plot_causes(self, path: str | Path | None = None):
        """Whether each effect acts and what share of the gap it explains; the axes."""
        from simgap.report.figures import draw_suspects

        return draw_suspects(self.body, None if path is None else Path(path))


@double_precision
def diagnose(
    aligned: AlignedTrials,
    actual: dict | None = None,
    forced: Sequence[str] = (),
    seed: int = 0,
    progress: Progress | None = None,
    twins: bool = True,
    healthy: AlignedTrials | None = None,
    excluded: Sequence[str] = (),
    identified: Identified | None = None,
) -> Diagnosis:
    """Diagnose aligned recordings of one block task against the nominal model.

    `actual` as `estimation.report.read_actual` gives it; `forced` names effects to be taken instead of
    choosing; `excluded` effects are not thought of. The null are `healthy` recordings of the same task and
    rig if there are any, else simulated `twins`, else the model itself. `identified`: what `identify` made
    of the same trials, where that is known already. InputError where no trial fits its task, or no effect has
    a forced name or could act on these recordings.
    """
    tell = progress or silent
    forced = tuple(effect_named(name).name for name in dict.fromkeys(forced))
    if of_wrist([one.trial for one in aligned.trials]):
        check_forced(forced)
    found = search(aligned, actual, excluded, forced, tell, identified)
    tell("attributing the gap")

    def null(value: float) -> Iterable[float]:
        if healthy is not None:
            return own_healthy(found, healthy, actual)
        return twin_statistics(found, actual, seed, tell) if twins and value > NIL else ()

    gap, verdict = attributed(found, forced, seed, null)
    causes = _causes(found, gap, verdict)
    following = None
    if verdict.verdict == "set":
        tell("the next experiment")
        mine = {n: parameters(found, verdict.effects[n], n, seed) for n in verdict.causes}
        values = {n: {k: p["mean"] for k, p in each.items()} for n, each in mine.items()}
        following = next_experiment(found, values, verdict.indistinguishable, seed, actual)
    document = body(found, verdict, causes, following, seed)
    warnings = (*found.warnings, *_inseparable(verdict, following))
    if found.problem.frame.num_trials == 1:
        warnings = (*warnings, "one trial: nothing tells an accident of it from an effect")
    before = residual_at(found.problem, (), found.healthy.u)
    after = residual_at(found.problem, causes.effects, causes.u)
    cells = tallies(found.problem, before)
    return Diagnosis(document, found, causes, verdict, before, after, cells, warnings, seed)


def _inseparable(verdict: Attribution, following: dict[str, Any] | None) -> list[str]:
    """What no experiment is expected to tell from the causes, if there is any."""
    left = sorted(set(verdict.indistinguishable) - set([] if following is None else following["separates"]))
    if not left:
        return []
    return [
        f"no experiment of the list is expected to tell {', '.join(left)} from {' + '.join(verdict.causes)}"
    ]


def attributed(
    found: Search,
    forced: tuple[str, ...] = (),
    seed: int = 0,
    twins: Callable[[float], Iterable[float]] | None = None,
) -> tuple[Gap, Attribution]:
    """The attribution of a search, effects that act together linearised where they do."""
    gap = found.gap
    models: list[Model] | None = sought(forms(gap))
    leading = [j for j in models[0].effects if gap.candidates[j].named and j < len(found.fits)]
    if leading and not forced:
        joint = _together(found, leading)
        left = scatters(
            found.problem, found.problem.nuisances.left(joint.residual), [s.effect for s in found.scatters]
        )
        gap, models = together(found.problem, gap, found.healthy, joint, left, found.redrawn), None
    absorbed = properties_tolerated(found.problem)
    return gap, attribute(gap, twins, forced, seed, models=models, absorbed=absorbed)


def _together(found: Search, which: Sequence[int]) -> Fitted:
    """Some of the fits joined: fitted together from where each is by itself."""
    u = found.healthy.u.copy()
    for j in which:
        own = found.fits[j].columns[found.problem.num_properties :]
        u[own] = found.fits[j].u[own]
    return fit(found.problem, Start(tuple(found.fits[j].effects[0] for j in which), u))


def _causes(found: Search, gap: Gap, verdict: Attribution) -> Fitted:
    """The fit of the verdict's effects that shift signals, in the forms that they were found in."""
    which = []
    for name in verdict.causes:
        parameters = gap.candidates[verdict.effects[name].candidate].parameters
        which += [
            j for j, f in enumerate(found.fits)
            if name_of(f.effects[0]) == name and free_parameters(f.effects[0]) == parameters
        ]  # fmt: skip
    return _together(found, which) if which else found.healthy
