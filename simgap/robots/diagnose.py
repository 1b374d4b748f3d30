"""The diagnosis of a robot's logs against any simulator of it, from logs to verdict.

Noise and windows, sensitivities and what they cannot tell apart, search, what held-out logs bear out, the
gap that healthy twins show too, verdict, how far, next experiment; `describe` makes the document.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from hmmseg.errors import InputError, nearest
from simgap.attribution.posterior import Forms, fitted, forms
from simgap.attribution.search import statistic
from simgap.progress import Progress, silent
from simgap.robot_effects import effects_of
from simgap.robot_effects.base import RobotEffect
from simgap.robots.asked import Asked
from simgap.robots.borne_out import folds_of
from simgap.robots.causes import about
from simgap.robots.experiments import NextLog, next_log
from simgap.robots.explained import explained
from simgap.robots.fit import moved_to
from simgap.robots.gap import fitted_along, gap_of
from simgap.robots.heldout import Shrinkage, shrinkage
from simgap.robots.identifiable import Identifiability, identifiability
from simgap.robots.kept import NOWHERE, Kept
from simgap.robots.linear import Linear, linearise, wobbling
from simgap.robots.model import Composed, Point
from simgap.robots.noise import noises
from simgap.robots.phases import Phases, phases_of
from simgap.robots.prune import sought
from simgap.robots.repeats import motions
from simgap.robots.scatter import over_rivals
from simgap.robots.search import Found
from simgap.robots.settle import settled
from simgap.robots.stand_ins import stand_ins
from simgap.robots.twins import Twins, healthy_twins
from simgap.robots.verdict import RobotVerdict, verdict_on
from simgap.robots.whiten import Whitener, covariances
from simgap.simulators.protocol import Simulator
from simgap.simulators.recording import Recording

STAGES = 14  # look: what a progress bar counts at most


@dataclass(frozen=True)
class RobotDiagnosis:
    """All that was found; `plain` is the gap as the simulator comes (what is fitted along, by least squares),
    `found` where the search ended; `linear`
    and `forms` are the gap where the causes alone act."""

    composed: Composed
    phases: Phases
    plain: Linear
    linear: Linear
    found: Found
    forms: Forms
    verdict: RobotVerdict
    shrinkage: Shrinkage | None
    identifiable: Identifiability
    next_log: NextLog | None
    discrepancy: Mapping[str, float]
    warnings: tuple[str, ...]


def diagnose(
    simulator: Simulator,
    recordings: Sequence[Recording],
    *,
    forced: Sequence[str] = (),
    seed: int = 0,
    phases: Phases | None = None,
    tell: Progress = silent,
    warn: Progress = silent,
    more: Sequence[RobotEffect] = (),
    length: float | None = None,
    kept: Kept = NOWHERE,
    groups: Sequence[int] | None = None,
) -> RobotDiagnosis:
    """Diagnose logs against a simulator. `forced` names effects instead of choosing; `more` are further
    candidates; `warn` is told at once what cannot be told apart; what an earlier run of the same inputs has
    `kept` is not worked out again; logs of one number in `groups` (one a log) are held out together.
    InputError for input at fault."""
    if groups is not None and (len(groups) != len(recordings) or len({*groups}) < 2):
        counted = f"{len(groups)} in {len({*groups})} groups for {len(recordings)} logs"
        raise InputError("groups", f"are {counted}", "one number a log, of at least two groups")
    noise = noises(simulator, recordings)
    effects = effects_of(simulator, recordings, more)
    for name in forced:
        if name not in effects or effects[name].fitted:
            raise InputError(f"--effect {name}", "is no candidate", nearest(name, list(effects)))
    length = getattr(simulator, "window", None) if length is None else length
    whole = Composed.of(
        simulator, recordings, effects, noise, **({} if length is None else {"length": length})
    )
    whole = replace(whole, motion=motions(whole))
    # What strikes or slides goes its own way from the smallest error of its start: what flight and rest tell
    # is not to be outvoted by it, and what it tells is asked where those tell nothing.
    if not forced and (calm := whole.calm()) is not whole:
        part = kept.of("calm")
        found = _diagnosed(whole, calm, forced, seed, phases, tell, warn, part, groups)
        if found.verdict.causes:
            return found
        tell("where bodies move in contact")
    return _diagnosed(whole, whole, forced, seed, phases, tell, warn, kept, groups)


def _diagnosed(
    whole: Composed,
    composed: Composed,
    forced: Sequence[str],
    seed: int,
    phases: Phases | None,
    tell: Progress,
    warn: Progress,
    kept: Kept,
    groups: Sequence[int] | None,
) -> RobotDiagnosis:
    """The diagnosis of a part of the windows; `whole` has all, and in all of them what is left is told."""
    parts = phases_of(composed.simulator, composed.recordings) if phases is None else phases
    warnings: list[str] = []

    def said(text: str) -> None:
        warnings.append(text)
        warn(text)

    tell("sensitivities")
    composed, plain, alike = _told_by_logs(composed, said, kept)
    wanted = [n for n in plain.moved if n not in fitted_along(composed)]
    tell("healthy twins")
    twins = kept("twins", lambda: healthy_twins(composed, plain, seed))
    fold = folds_of(plain, len(composed.recordings), groups)
    ask = Asked(composed, parts, tuple(wanted), tuple(forced), twins.factor, fold, plain)
    found, borne, point = sought(ask, tell, kept)
    tell("all candidates there")
    ended = about(ask, found, point, borne)
    tell("shares")
    given = (whole, composed, parts, ended, plain.point, twins, fold, seed, wanted, bool(forced))
    verdict = kept("verdict", lambda: _concluded(*given))
    far, sensor = None, ended.covariances.whitener()
    if verdict.causes:
        tell("how far")
        far = kept(
            "how far", lambda: shrinkage(composed, ended, plain, sensor, fold, ended.best, bool(forced))
        )
    return RobotDiagnosis(
        composed,
        parts,
        _least_squares(composed, plain, sensor),
        ended.linear,
        found,
        ended.forms,
        verdict,
        far,
        alike,
        next_log(ended.forms, verdict, [r.name for r in composed.recordings]),
        ended.discrepancy.scale,
        tuple(warnings),
    )


def _told_by_logs(composed: Composed, said: Progress, kept: Kept) -> tuple[Composed, Linear, Identifiability]:
    """The gap as the simulator comes with all sensitivities, what the logs can tell by them, and the same
    windows with what contacts make of them; what is left out, and what no such log tells apart, is said."""
    along = fitted_along(composed)
    neutral = {n: composed.effects[n].neutral() for n in along}
    wanted = [n for n in composed.effects if n not in along]
    plain = kept("plain", lambda: _plain(composed, neutral, wanted))
    composed = wobbling(composed, plain)
    plain = replace(plain, wobble=composed.wobble)
    for name in plain.diverged:
        said(f"{name}: the simulator diverges with it, and it is left out")
    if plain.dropped:
        said(
            f"the simulator diverges in {plain.dropped} of {len(composed.windows)} windows: they are left out"
        )
    alike = _alike(composed, plain, [*along, *(n for n in plain.moved if n not in along)])
    for one in alike.alike:
        if one.exact:
            said(f"{', '.join(one.names)} act only together on these logs: no such log can tell them apart")
    return composed, plain, alike


def _concluded(
    whole: Composed, composed: Composed, phases: Phases, ended: Found, plain: Point, twins: Twins,
    fold: np.ndarray, seed: int, wanted: Sequence[str], forced: bool,
) -> RobotVerdict:  # fmt: skip
    """The verdict on what was borne out, told of the windows of `whole`; `wanted` are all candidates.

    What could take a cause's place is fitted exactly and judged by held-out logs: straight lines from where
    the cause acts tell little of it, and where the model is off by itself nothing else tells them apart."""
    linear, sensor = ended.linear, ended.covariances.whitener()
    rows = np.flatnonzero(np.isfinite(linear.residual))
    s = forms(gap_of(composed, linear, sensor, phases, ended.names))
    explains = explained(composed, linear, sensor, plain, ended.best, whole, twins.plain)
    every = s if whole is composed else _every(whole, linear.point, ended.best, phases)
    null = [_twin_statistic(s, white, rows) for white in twins.residuals]
    causes = ended.models[0].effects

    def concluded(large_alone: Sequence[str] = ()) -> RobotVerdict:
        alone = tuple(j for j in causes if ended.names[j] in large_alone)
        given = (null, np.random.default_rng(seed), explains, every, fold[rows], forced, alone)
        return verdict_on(ended.forms, s, causes, *given)

    # A small cause that goes with one way to explain the large ones, and not with another, is none: few logs
    # cannot tell.
    few = len(composed.recordings) < 3
    verdict = concluded(ended.names if few else ())
    if not verdict.causes or few or forced:
        return verdict
    others = stand_ins(composed, phases, ended, wanted, verdict.causes, fold, twins.factor)
    doubtful = [n for n in verdict.causes for one in others if n not in (*one.bear, one.place)]
    verdict = concluded(doubtful) if doubtful else verdict
    others = tuple(one for one in others if one.place in verdict.causes)
    wider = over_rivals(ended.forms, verdict.model, [(one.forms, one.model) for one in others])
    return replace(verdict.beside(one.name for one in others), stand_ins=others, model=wider)


def _every(whole: Composed, point: Point, causes: Sequence[str], phases: Phases) -> Forms:
    """The gap of all windows about a point, by the sensors' noise alone, with these causes as its
    candidates."""
    linear = linearise(whole, point, [*fitted_along(whole), *causes])
    return forms(gap_of(whole, linear, covariances(whole, linear).whitener(), phases, causes))


def _plain(composed: Composed, point: Point, wanted: Sequence[str]) -> Linear:
    """The gap as the simulator comes, with what was never measured fitted, and all sensitivities there."""
    return linearise(composed, settled(composed, point).point, [*point, *wanted])


def _least_squares(composed: Composed, plain: Linear, sensor: Whitener) -> Linear:
    """The gap as the simulator comes at its best: whatever the causes gain must be gained over this."""
    if not plain.point:
        return plain
    return linearise(composed, moved_to(composed, plain, sensor, plain.point).point, [])


def _alike(composed: Composed, linear: Linear, names: Sequence[str]) -> Identifiability:
    """What the logs can tell, from sensitivities at the plain point."""
    whiten = covariances(composed, linear).whitener()
    kinds, columns = [], []
    for name in names:
        effect, moved = composed.effects[name], linear.moved[name]
        sd = np.array([p.sd for p in effect.parameters.values()])
        columns.append(whiten(np.where(np.isfinite(moved.jacobian), moved.jacobian, 0.0)) * sd)
        kinds += [name if len(effect.parameters) == 1 else f"{name}.{short}" for short in effect.parameters]
    return identifiability(kinds, np.concatenate(columns, 1))


def _twin_statistic(s, white: np.ndarray, rows: np.ndarray) -> float:
    """The statistic of a healthy twin: its residual with the recording's sensitivities."""
    gap = replace(s.gap, residual=white[rows] if white.size != s.gap.residual.size else white)
    f = forms(gap)
    single = [fitted(f, (j,)) for j in range(len(gap.candidates))]
    return statistic(f, [fitted(f, ()), *single])
