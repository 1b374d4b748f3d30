"""The diagnosis: whether there is a gap, where, which effects cause it, and how far it shrinks."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from estimation.consistency import check_motion
from estimation.report import Actual
from hmmseg.contact.decompose import PROPERTIES, UNITS, subtasks
from hmmseg.jaxconfig import double_precision
from hmmseg.robust import robust_sd
from hmmseg.segmentation.align import AlignedTrials
from hmmseg.tables import Tabled
from simgap.attribution.attribute import Attribution, EffectPosterior, attribute
from simgap.attribution.posterior import Forms, Model, coordinates, fitted, forms
from simgap.attribution.problem import Candidate, Gap
from simgap.attribution.search import detected, sought, statistic
from simgap.attribution.verdict import ALARM, Cell, entries, log_odds, rows
from simgap.effects import catalogue, effect_named, forms_of, free_parameters, name_of
from simgap.effects.base import World, middle, tips
from simgap.gap.assemble import scatters, together
from simgap.gap.experiments import next_experiment
from simgap.gap.frame import CHANNELS, check_forced, of_wrist
from simgap.gap.problem import (
    Fitted,
    Problem,
    columns_of,
    fit,
    properties_tolerated,
    raw_residual_at,
    residual_at,
    world_without,
)
from simgap.gap.residuals import net_forces
from simgap.gap.search import Identified, Search, best_fit, search
from simgap.progress import Progress, silent
from simgap.report.finding import sentence, tables

if TYPE_CHECKING:  # slow to import
    from matplotlib.axes import Axes
    from rich.table import Table

# Where a gap lies: cells whose residuals show it, and those whose signals the named causes shift.

# cited: sds of a sample; mean shift at which a cell counts as shifted (the interface's definition)
SHIFTED = 3.0


def where(given: Problem, found: Sequence[Cell], causes: Fitted | None) -> list[dict[str, Any]]:
    """Entries for the significant cells and those that the causes shift, largest share first.

    Shares are of the excess squares; a shift that the properties absorb has none.
    """
    frame = given.frame
    out = [{**row, "subtask": row["subtask"].partition(":")[2]} for row in rows(found)]
    if causes is None or not causes.effects:
        return out
    known = {(c.trial, c.channel, c.part) for c in found}
    mean = shifts(given, causes)
    for r, s, c in np.argwhere(mean >= SHIFTED):
        name = frame.steps[s].label
        if (frame.files[r], CHANNELS[c], f"{s}:{name}") not in known:
            out.append({"trial": frame.files[r], "channel": CHANNELS[c], "subtask": name,
                         "band": [0.0, 1.0], "share": 0.0, "z": float(mean[r, s, c])})  # fmt: skip
    return out


def shifts(given: Problem, causes: Fitted) -> np.ndarray:
    """Mean shift (T, S, C) of each cell by effects, in standard deviations of one sample.

    Effects on sensors or kinematics shift what is recorded. Those on contact or dynamics also violate the
    contact equations; the larger of the two shifts counts.
    """
    frame, u = given.frame, causes.u
    change = np.abs(channels(frame.world) - channels(world_without(given, causes.effects, u)))
    there = given.there
    read = ("sensing", "kinematics")
    mechanical = [e for e in causes.effects if catalogue()[name_of(e)].acts_on not in read]
    violated = np.zeros_like(change)
    if mechanical:
        rest = [e for e in causes.effects if e not in mechanical]
        violated = raw_residual_at(given, rest, u) - raw_residual_at(given, causes.effects, u)
        violated = np.where(there, violated, 0.0) / frame.arrays.sample
    change = change / frame.arrays.sample
    mean = np.zeros((frame.num_trials, len(frame.steps), len(CHANNELS)))
    for r in range(frame.num_trials):
        for s in range(len(frame.steps)):
            mine = np.flatnonzero(frame.arrays.subtask[r, : frame.lengths[r]] == s)
            if mine.size:
                number = np.maximum(there[r, mine].sum(0), 1)
                mean[r, s] = np.maximum(change[r, mine].mean(0), np.abs(violated[r, mine].sum(0)) / number)
    return mean


def channels(world: World) -> np.ndarray:
    """Task-space channels (T, N, C) of a world, in the order of CHANNELS."""
    position, velocity = tips(world)
    apart = position[..., 2:] - position[..., :2]
    return np.concatenate([middle(position), apart, middle(velocity), net_forces(world.force)], -1)


# The attribution as the interface describes it.

DRAWS = 2000  # numerics: draws of the posterior, for intervals
LISTED = 8  # look: effects that are described


def body(
    found: Search, verdict: Attribution, causes: Fitted | None, following: dict[str, Any] | None, seed: int
) -> dict[str, Any]:
    """The JSON document of a diagnosis.

    Args:
        found: The search.
        verdict: The attribution.
        causes: Joint fit of the named effects that shift signals.
        following: Entry of the next experiment.
        seed: Of the draws behind intervals.
    """
    given, posterior, far = found.problem, verdict.effects, verdict.how_far
    named = {n: e for n, e in posterior.items() if n in catalogue()}
    ranked = sorted(named, key=lambda n: -named[n].probability)
    shown = [
        n for k, n in enumerate(ranked) if k < LISTED or n in verdict.causes or n in verdict.indistinguishable
    ]

    def entry(names: tuple[str, ...], parameters: dict[str, Any]) -> dict[str, Any]:
        odds = log_odds(posterior[n].probability for n in names)
        score = None if far is None or len(names) < 2 else far.score
        shift = _shifts(found, causes) if names == verdict.causes else {}
        return {"parameters": parameters, "log_evidence": odds, "heldout_score": score,
                "property_shift": shift}  # fmt: skip

    effects = {n: entry((n,), parameters(found, posterior[n], n, seed)) for n in shown}
    if len(verdict.causes) > 1:
        own = {f"{n}.{k}": p for n in verdict.causes for k, p in effects[n]["parameters"].items()}
        effects["+".join(verdict.causes)] = entry(verdict.causes, own)
    rest = verdict.remainder
    attribution = {n: (e.probability, e.share, e.share_90) for n, e in named.items()}
    out = entries(verdict, verdict.detection, (rest.share, rest.p_value, where(given, rest.where, None)),
                  attribution, where(given, verdict.where, causes))  # fmt: skip
    out |= {
        "effects": effects, "noise": verdict.noise, "shrinkage": None if far is None else far.to_json(),
        "next_experiment": following,
    }  # fmt: skip
    if verdict.small_gap is not None:
        small, c, arrays = verdict.small_gap, CHANNELS.index(verdict.small_gap.channel), given.frame.arrays
        noise = float(np.median(arrays.sd[..., c][arrays.there[..., c] > 0]))  # in the channel's unit
        metres = small.channel in ("x", "y", "distance", "offset")
        unit = "m" if metres else "m/s" if small.channel in ("vx", "vy") else "N"
        places = where(given, verdict.where, None)
        out["small_gap"] = {"size": small.amount * noise, "unit": unit, "where": places}
    return out


def parameters(found: Search, posterior: EffectPosterior, name: str, seed: int) -> dict[str, Any]:
    """Parameters of an effect as the interface names them."""
    every = drawn(found, posterior, name, seed)
    return {key: _summary(values, unit) for key, (values, unit) in every.items()}


def drawn(
    found: Search, posterior: EffectPosterior, name: str, seed: int
) -> dict[str, tuple[np.ndarray, str]]:
    """Draws (DRAWS,) of an effect's parameters, given that it acts, and units, as the interface has them."""
    effect, rng = catalogue()[name], np.random.default_rng(seed)
    of = effect.parameters
    scatter = next((s for s in found.scatters if s.effect == name), None)
    if scatter is not None:
        (p,) = of.values()
        return {p.name: (scatter.value * np.exp(scatter.log_sd * rng.standard_normal(DRAWS)), p.unit)}
    draws = {}
    for key, p in posterior.parameters.items():
        u = p.mean + p.sd * rng.standard_normal(DRAWS)
        if key not in of:  # error of a measured property
            obj, kind = key.rsplit(".", 1)
            one = found.problem.sd[found.problem.frame.task.objects.index(obj), PROPERTIES.index(kind)]
            return {key: (-u * float(one), UNITS[kind])}
        draws[key] = np.asarray(of[key].value(np.clip(u, *of[key].limits)))
    if effect.report is not None:
        return effect.report(draws, found.problem.frame.rig)
    return {p.name: (draws[p.name], p.unit) for p in of.values() if p.name in draws and not p.hidden}


def _summary(values: np.ndarray, unit: str) -> dict[str, Any]:
    """Median, standard deviation and 90 % interval of draws; robust, as an inverse has no mean square."""
    (low, high), middle = np.percentile(values, (5, 95)), float(np.median(values))
    return {"mean": middle, "sd": robust_sd(values - middle),
            "interval_90": [float(low), float(high)], "unit": unit}  # fmt: skip


def _shifts(found: Search, causes: Fitted | None) -> dict[str, dict[str, Any]]:
    """Identified or measured properties with rig.toml taken at its word (`before`) and with the causes
    (`after`).

    Both are of one model, pads included, so that either can be simulated. The result of `identify`, which
    allows for the rig's stated uncertainty (`estimation.sampler`), lies between them.
    """
    if causes is None:
        return {}
    given, (_, known) = found.problem, found.blocks
    before, after = given.properties(found.healthy.u), given.properties(causes.u)
    return {
        f"{name}.{kind}": {"before": float(before[o, j]), "after": float(after[o, j]), "unit": UNITS[kind]}
        for o, name in enumerate(given.frame.task.objects)
        for j, kind in enumerate(PROPERTIES)
        if known[o, j]
    }


STAGES = 12  # look: most stages that `progress` reports


@dataclass(frozen=True, repr=False)
class Diagnosis(Tabled):
    """The diagnosis of aligned recordings.

    Attributes:
        body: The JSON document.
        search: Every candidate's fit.
        causes: Fit of the verdict's effects that shift signals.
        attribution: The verdict and what it rests on.
        before, after: Whitened residuals (T, N, C) without and with these effects.
        warnings: One line each.
        seed: Of the draws behind intervals.
    """

    body: dict[str, Any]
    search: Search
    causes: Fitted
    attribution: Attribution
    before: np.ndarray
    after: np.ndarray
    warnings: tuple[str, ...] = ()
    seed: int = 0

    @property
    def problem(self) -> Problem:
        """The fitting problem: aligned trials, noise and priors."""
        return self.search.problem

    def to_json(self) -> dict[str, Any]:
        """The body of `diagnose`'s JSON document."""
        return self.body

    def words(self) -> str:
        """The verdict in a sentence."""
        return sentence(self.body)

    def tables(self) -> list[Table]:
        """Tables of the probabilities, the causes' parameters, and the largest cells."""
        return tables(self.body)

    def to_arviz(self) -> Any:
        """ArviZ InferenceData: draws `effect.parameter` of each described effect, given that it acts.

        Each effect is drawn separately.
        """
        from estimation.report import inference_data

        every, posterior = dict[str, np.ndarray](), self.attribution.effects
        for name in (name for name in self.body["effects"] if name in posterior):
            draws = drawn(self.search, posterior[name], name, self.seed)
            every |= {f"{name}.{key}": values[None] for key, (values, _) in draws.items()}
        return inference_data(every)

    def plot_where(self, path: str | Path | None = None) -> Axes:
        """Plot the share of the gap by channel and subtask; returns the axes and saves them if a path is
        given.
        """
        from simgap.report.figures import draw_heat_map

        names = dict.fromkeys(step.label for step in subtasks(self.problem.frame.task))
        return draw_heat_map(self.body, list(names), None if path is None else Path(path))

    def plot_causes(self, path: str | Path | None = None) -> Axes:
        """Plot the probability of each effect and the share of the gap it explains; returns the axes."""
        from simgap.report.figures import draw_suspects

        return draw_suspects(self.body, None if path is None else Path(path))


@double_precision
def diagnose(
    aligned: AlignedTrials,
    actual: Actual | None = None,
    forced: Sequence[str] = (),
    seed: int = 0,
    progress: Progress | None = None,
    healthy: AlignedTrials | None = None,
    excluded: Sequence[str] = (),
    identified: Identified | None = None,
) -> Diagnosis:
    """Diagnose aligned recordings of one block task against the nominal model.

    Args:
        aligned: The recordings.
        actual: Measured properties as `estimation.report.read_actual` returns them.
        forced: Effects that are imposed instead of chosen.
        seed: Of all draws.
        progress: Called with a description of each stage.
        healthy: Healthy recordings of the same task and rig as the null, in place of the stated noise.
        excluded: Effects that are not considered.
        identified: Properties identified from the same trials, if known.

    Raises:
        InputError: No trial fits its task, positions contradict velocities, or a forced effect is unknown or
            cannot act on these recordings.
    """
    tell = progress or silent
    forced = tuple(effect_named(name).name for name in dict.fromkeys(forced))
    if of_wrist([one.trial for one in aligned.trials]):
        check_forced(forced)
    else:
        check_motion(aligned)
    found = search(aligned, actual, excluded, forced, tell, identified)
    tell("attributing the gap")

    null = () if healthy is None else healthy_statistics(found, healthy, actual)
    gap, verdict = attributed(found, forced, seed, null, tell)
    named = (gap.candidates[verdict.effects[name].candidate] for name in verdict.causes)
    shifting = [c for c in named if _shifts_signals(c)]
    causes = _together(found, shifting) if shifting else found.healthy
    following = None
    if verdict.verdict == "set":
        tell("the next experiment")
        mine = {n: parameters(found, verdict.effects[n], n, seed) for n in verdict.causes}
        values = {n: {k: p["mean"] for k, p in each.items()} for n, each in mine.items()}
        following = next_experiment(found, values, verdict.indistinguishable, seed, actual)
    document = body(found, verdict, causes, following, seed)
    warnings, separated = [*found.warnings], [] if following is None else following["separates"]
    if left := sorted(set(verdict.indistinguishable) - set(separated)):
        cause = " + ".join(verdict.causes)
        warnings.append(f"no experiment listed is expected to separate {', '.join(left)} from {cause}")
    if found.problem.frame.num_trials == 1:
        warnings.append("one trial: an accident of it looks like an effect")
    before = residual_at(found.problem, (), found.healthy.u)
    after = residual_at(found.problem, causes.effects, causes.u)
    return Diagnosis(document, found, causes, verdict, before, after, tuple(warnings), seed)


def healthy_statistics(found: Search, healthy: AlignedTrials, actual: Actual | None) -> Iterator[float]:
    """Statistics [nats] of healthy recordings, in groups as large as the diagnosed one."""
    every = healthy.trials
    size = min(found.problem.frame.num_trials, len(every))
    for start in range(0, len(every) - size + 1, size):
        f = forms(search(replace(healthy, trials=every[start : start + size]), actual).gap)
        yield statistic(f, sought(f))


def attributed(
    found: Search,
    forced: tuple[str, ...] = (),
    seed: int = 0,
    healthy: Iterable[float] = (),
    tell: Progress = silent,
) -> tuple[Gap, Attribution]:
    """Attribute the gap of a search, with effects that act together linearised where they do.

    Args:
        found: The search.
        forced: Effects that are imposed instead of chosen.
        seed: Of the draws behind intervals.
        healthy: Statistics of healthy recordings, drawn if there is an alarm.
        tell: Called with a description of each stage.
    """
    gap, searched = found.gap, None
    if not forced:
        f = forms(gap)
        searched = f, sought(f)
        both = _leading(found, f, searched[1][0]), _paired(found, *searched, tell)
        joint = sorted((one for one in both if one is not None), key=lambda one: one.cost)
        if joint:
            left = scatters(found.problem, joint[0].residual, [s.effect for s in found.scatters])
            for one in {frozenset(one.effects): one for one in reversed(joint)}.values():
                gap = together(found.problem, gap, found.healthy, one, left, found.redrawn)
            searched = None
    absorbed = properties_tolerated(found.problem)
    return gap, attribute(gap, healthy, forced, seed, searched=searched, absorbed=absorbed)


def _shifts_signals(c: Candidate) -> bool:
    """Whether a candidate shifts signals, rather than scattering them or concerning a measurement."""
    return bool(c.parameters) and catalogue()[c.name].correct is not None


def _leading(found: Search, f: Forms, best: Model) -> Fitted | None:
    """Fit the effects of the best set that shift signals jointly; None without any.

    Several are fitted once from where each fits by itself and once from the mode of the set, as effects that
    act together may be far from the former; the better fit counts.
    """
    alone = {j: c for j in best.effects if _shifts_signals(c := f.gap.candidates[j])}
    if len(alone) < 2:
        return _together(found, [*alone.values()]) if alone else None
    own, common = coordinates(f, best.effects), found.problem.num_common
    at_mode = [replace(c, at=c.neutral + c.scale * best.x[own[j]]) for j, c in alone.items()]
    u = np.append(best.x[:common], found.healthy.u[common:])
    both = _together(found, [*alone.values()]), _together(found, at_mode, u)
    return min(both, key=lambda one: one.cost)


def _paired(found: Search, f: Forms, models: list[Model], tell: Progress = silent) -> Fitted | None:
    """Fit the likeliest single cause with each other one, if the best set leaves more than noise.

    By itself an effect is fitted, and linearised, where the other cause still acts on it; the best pair
    counts. None if there is no second effect.
    """
    every = [j for j, c in enumerate(f.gap.candidates) if _shifts_signals(c)]
    if not every or detected(statistic(f, models, models[0].effects)).p_value >= ALARM:
        return None
    tell("seeking a second cause")
    first = _together(found, [f.gap.candidates[max(every, key=lambda j: fitted(f, (j,)).score)]])
    name = name_of(first.effects[0])
    keys = [key for one in found.fits for key in one.effects if name_of(key) != name]
    return min((best_fit(found.problem, key, first) for key in keys), key=lambda one: one.cost, default=None)


def _together(found: Search, which: Sequence[Candidate], start: np.ndarray | None = None) -> Fitted:
    """Fit candidates jointly, from where each was linearised and properties as at the coordinates `start`."""
    u, keys = (found.healthy.u if start is None else start).copy(), []
    for c in which:
        keys.append(next(key for key in forms_of(c.name) if free_parameters(key) == c.parameters))
        u[columns_of(found.problem, keys[-1:])[found.problem.num_common :]] = c.at
    return fit(found.problem, tuple(keys), u)
