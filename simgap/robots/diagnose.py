"""The diagnosis of a robot's logs against any simulator of it, from logs to verdict.

Noise and windows, sensitivities and what they cannot tell apart, search, what held-out logs bear out, the
gap that healthy twins show too, verdict, how far, next experiment; `describe` makes the document.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from hmmseg.errors import InputError, nearest
from simgap.attribution.detection import statistic
from simgap.attribution.posterior import Forms, fitted, forms
from simgap.robot_effects import candidates as candidates_of
from simgap.robot_effects.base import RobotEffect, Setting
from simgap.robots.borne_out import folds_of
from simgap.robots.discrepancy import learned
from simgap.robots.experiments import NextLog, next_log
from simgap.robots.explained import explained
from simgap.robots.gap import fitted_along, gap_of
from simgap.robots.heldout import Shrinkage, shrinkage
from simgap.robots.identifiable import Identifiability, identifiability
from simgap.robots.judge import RobotVerdict, judge
from simgap.robots.linear import Linear, linearise, wobbling
from simgap.robots.model import Composed, Point
from simgap.robots.noise import noises
from simgap.robots.phases import Phases, phases_of
from simgap.robots.prune import pruned
from simgap.robots.search import Found, moved_to, point_of, search
from simgap.robots.twins import healthy_twins
from simgap.robots.whiten import NONE, Whitener, covariances
from simgap.simulators.protocol import Simulator
from simgap.simulators.recording import Recording

REFITS = 3  # numerics
STAGES = 14  # look: what a progress bar counts at most

Tell = Callable[[str], None]


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
    borne: tuple[str, ...]
    discrepancy: Mapping[str, float]
    warnings: tuple[str, ...]


def diagnose(
    simulator: Simulator,
    recordings: Sequence[Recording],
    *,
    forced: Sequence[str] = (),
    seed: int = 0,
    phases: Phases | None = None,
    tell: Tell = lambda text: None,
    warn: Tell = lambda text: None,
    more: Sequence[RobotEffect] = (),
    length: float | None = None,
) -> RobotDiagnosis:
    """Diagnose logs against a simulator. `forced` names effects instead of choosing; `more` are further
    candidates; `warn` is told at once what cannot be told apart. InputError for input at fault."""
    noise = noises(simulator, recordings)
    effects = candidates_of(Setting(simulator, recordings)) | {e.name: e for e in more}
    for name in forced:
        if name not in effects or effects[name].fitted:
            raise InputError(f"--effect {name}", "is no candidate", nearest(name, list(effects)))
    whole = Composed.of(
        simulator, recordings, effects, noise, **({} if length is None else {"length": length})
    )
    # What strikes or slides goes its own way from the smallest error of its start: what flight and rest tell
    # is not to be outvoted by it, and what it tells is asked where those tell nothing.
    if not forced and (calm := whole.calm()) is not whole:
        found = _diagnosed(whole, calm, forced, seed, phases, tell, warn)
        if found.verdict.causes:
            return found
        tell("where bodies move in contact")
    return _diagnosed(whole, whole, forced, seed, phases, tell, warn)


def _diagnosed(
    whole: Composed,
    composed: Composed,
    forced: Sequence[str],
    seed: int,
    phases: Phases | None,
    tell: Tell,
    warn: Tell,
) -> RobotDiagnosis:
    """The diagnosis of a part of the windows; `whole` has all, and in all of them what is left is told."""
    rng = np.random.default_rng(seed)
    simulator, recordings, effects = composed.simulator, composed.recordings, composed.effects
    parts = phases_of(simulator, recordings) if phases is None else phases
    warnings: list[str] = []

    def said(text: str) -> None:
        warnings.append(text)
        warn(text)

    tell("sensitivities")
    along = fitted_along(composed)
    wanted = [n for n in effects if n not in along]
    plain = _plain(composed, {n: effects[n].neutral() for n in along}, wanted)
    composed = wobbling(composed, plain)
    plain = replace(plain, wobble=composed.wobble)
    for name in plain.diverged:
        said(f"{name}: the simulator diverges with it, and it is left out")
    if plain.dropped:
        said(
            f"the simulator diverges in {plain.dropped} of {len(composed.windows)} windows: they are left out"
        )
    wanted = [n for n in wanted if n in plain.moved]
    alike = _alike(composed, plain, [*along, *wanted])
    for one in alike.alike:
        if one.exact:
            said(f"{', '.join(one.names)} act only together on these logs: no such log can tell them apart")
    tell("healthy twins")
    twins = healthy_twins(composed, plain, parts, seed)
    found = search(composed, parts, wanted, tell, forced, twins.factor)
    fold = folds_of(found.linear, len(recordings))
    rows = np.flatnonzero(np.isfinite(found.linear.residual))
    if forced:
        chosen = found.models[0].effects
        borne = tuple(found.names[j] for j in chosen)
        point = point_of(composed, found.forms, chosen, found.linear.point)
    else:
        tell("held-out logs")
        borne, point = pruned(composed, parts, found, fold, twins.factor)
    tell("refit")
    linear, off = _refitted(composed, point, [*along, *wanted], twins.factor)
    usable = [n for n in wanted if n in linear.moved]
    kinds = {n: c.kind for n, c in simulator.channels.items()}
    cov = covariances(linear, composed.windows, kinds, twins.factor)
    sensor = cov.whitener()
    causes = tuple(sorted(usable.index(n) for n in borne))
    f = forms(gap_of(composed, linear, cov.whitener(off), parts, usable))
    s = forms(gap_of(composed, linear, sensor, parts, usable))
    null = [_twin_statistic(s, white, rows) for white in twins.residuals]
    told_apart = fold[rows] if off and len(recordings) >= 3 else None
    tell("shares")
    names = tuple(usable[j] for j in causes)
    told_by = explained(composed, linear, sensor, plain.point, names, whole)
    every = s if whole is composed else _every(whole, linear.point, [*along, *names], parts, names)
    verdict = judge(f, s, causes, null, rng, told_by, every, bool(forced), told_apart)
    far = None
    if verdict.causes:
        tell("how far")
        ended = Found(linear, cov.whitener(off), cov, off, f, (fitted(f, causes),), borne)
        far = shrinkage(composed, ended, plain, sensor, fold, names, forced=bool(forced))
    plain = _least_squares(composed, plain, sensor)
    following = next_log(f, verdict, [r.name for r in recordings])
    return RobotDiagnosis(
        composed,
        parts,
        plain,
        linear,
        found,
        f,
        verdict,
        far,
        alike,
        following,
        borne,
        off.scale,
        tuple(warnings),
    )


def _every(
    whole: Composed, point: Point, effects: Sequence[str], parts: Phases, causes: Sequence[str]
) -> Forms:
    """The gap of all windows about a point, by the sensors' noise alone, with these causes as its
    candidates."""
    linear = linearise(whole, point, effects)
    kinds = {n: c.kind for n, c in whole.simulator.channels.items()}
    white = covariances(linear, whole.windows, kinds).whitener()
    return forms(gap_of(whole, linear, white, parts, causes))


def _plain(composed: Composed, point: Point, wanted: Sequence[str]) -> Linear:
    """The gap as the simulator comes, with what was never measured fitted, and all sensitivities there."""
    kinds = {n: c.kind for n, c in composed.simulator.channels.items()}
    for _ in range(REFITS if point else 0):
        rough = linearise(composed, point, [])
        cov = covariances(rough, composed.windows, kinds)
        point = moved_to(composed, rough, cov.whitener(learned(cov, rough.residual)), point)
    return linearise(composed, point, [*point, *wanted])


def _least_squares(composed: Composed, plain: Linear, sensor: Whitener) -> Linear:
    """The gap as the simulator comes at its best: whatever the causes gain must be gained over this."""
    if not plain.point:
        return plain
    return linearise(composed, moved_to(composed, plain, sensor, plain.point), [])


def _refitted(composed: Composed, point: Point, effects: Sequence[str], factor: np.ndarray):
    """Everything linear about the point of best fit, and its discrepancies."""
    kinds = {n: c.kind for n, c in composed.simulator.channels.items()}
    for _ in range(REFITS if point else 0):
        rough = linearise(composed, point, [])
        cov = covariances(rough, composed.windows, kinds, factor)
        point = moved_to(composed, rough, cov.whitener(learned(cov, rough.residual)), point)
    linear = linearise(composed, point, effects)
    cov = covariances(linear, composed.windows, kinds, factor)
    return linear, (learned(cov, linear.residual) if len(cov.blocks) else NONE)


def _alike(composed: Composed, linear: Linear, names: Sequence[str]) -> Identifiability:
    """What the logs can tell, from sensitivities at the plain point."""
    kinds = {n: c.kind for n, c in composed.simulator.channels.items()}
    whiten = covariances(linear, composed.windows, kinds).whitener()
    told, columns = [], []
    for name in names:
        effect, moved = composed.effects[name], linear.moved[name]
        sd = np.array([p.sd for p in effect.parameters.values()])
        columns.append(whiten(np.where(np.isfinite(moved.jacobian), moved.jacobian, 0.0)) * sd)
        told += [name if len(effect.parameters) == 1 else f"{name}.{short}" for short in effect.parameters]
    return identifiability(told, np.concatenate(columns, 1))


def _twin_statistic(s, white: np.ndarray, rows: np.ndarray) -> float:
    """The statistic of a healthy twin: its residual with the recording's sensitivities."""
    gap = replace(s.gap, residual=white[rows] if white.size != s.gap.residual.size else white)
    f = forms(gap)
    single = [fitted(f, (j,)) for j in range(len(gap.candidates))]
    return statistic(f, [fitted(f, ()), *single])
