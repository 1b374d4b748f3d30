"""The diagnosis of a robot's logs against any simulator of it.

Noise and windows, calibration of what nobody measured, search over sets of causes, shrinkage of the gap on
held-out logs, verdict, next experiment. `describe` makes the JSON document.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

from hmmseg.errors import InputError, nearest
from simgap.progress import Progress, silent
from simgap.robot_effects import STATED, UNMEASURED, doubted, effects_of
from simgap.robot_effects.base import RobotEffect
from simgap.robots.calibrate import Calibration, calibrate
from simgap.robots.linear import Linear
from simgap.robots.model import Composed, Point
from simgap.robots.rows import Phases, folds_of, noises, phases_of
from simgap.robots.search import FittedSet, Search
from simgap.robots.sets import Identifiability
from simgap.robots.verdict import RobotVerdict, Shrinkage, next_log, shrinkage, verdict_on
from simgap.simulators.protocol import Simulator
from simgap.simulators.recording import Recording

# look: share of the time that is over when a stage begins, of a hand's finger, arms and linkages
OVER = {"round 1": 0.1, "round": 0.55, "from the calibration": 0.6, "how far": 0.87, "calibration": 0.91}


@dataclass(frozen=True)
class RobotDiagnosis:
    """All that was found.

    `composed`: the model along the windows that were compared; `phases`: stretches of the logs by name;
    `search`: all sets that were fitted; `best`: the best of them; `verdict`: the verdict; `shrinkage`: of the
    gap on held-out logs; None without causes; `identifiable`: which candidates' parameters the logs tell
    apart; `next_log`: the next experiment; `calibrated`: the model with what nobody measured fitted, where
    there is such; `warnings`: one line each.
    """

    composed: Composed
    phases: Phases
    search: Search
    best: FittedSet
    verdict: RobotVerdict
    shrinkage: Shrinkage | None
    identifiable: Identifiability
    next_log: dict[str, Any] | None
    calibrated: Calibration | None
    warnings: tuple[str, ...]

    @property
    def plain(self) -> Linear:
        """The gap of the simulator as it comes, with what is fitted along at its best."""
        return self.search.fitted[frozenset()].linear

    @property
    def linear(self) -> Linear:
        """The gap with the best set acting."""
        return self.best.linear


def diagnose(
    simulator: Simulator,
    recordings: Sequence[Recording],
    *,
    forced: Sequence[str] = (),
    seed: int = 0,
    phases: Phases | None = None,
    tell: Progress = silent,
    warn: Progress = silent,
    note: Progress = silent,
    more: Sequence[RobotEffect] = (),
    length: float | None = None,
    groups: Sequence[int] | None = None,
) -> RobotDiagnosis:
    """Diagnose logs against a simulator.

    Args:
        simulator: The robot's model.
        recordings: Its logs.
        forced: Effects that are given instead of chosen.
        seed: Of random draws.
        phases: Stretches of the logs by name; by motion and contact by default.
        tell: Called with a description of each stage.
        warn: Called at once with each warning.
        note: Called early, with where the gap is and how large.
        more: Further candidates.
        length: Length of the windows [s].
        groups: A number for each log; logs of the same number are held out together.

    Raises:
        InputError: Input is at fault, or the simulator diverges.
    """
    if groups is not None and (len(groups) != len(recordings) or len({*groups}) < 2):
        counted = f"{len(groups)} in {len({*groups})} groups for {len(recordings)} logs"
        raise InputError("groups", f"are {counted}", "one number a log, of at least two groups")
    noise = noises(simulator, recordings)
    effects = effects_of(simulator, recordings, more)
    for name in forced:
        if name not in effects or effects[name].fitted:
            raise InputError(f"--effect {name}", "is no candidate", nearest(name, list(effects)))
    length = getattr(simulator, "window", None) if length is None else length
    given = {} if length is None else {"length": length}

    def calibrated(patterns: Sequence[str], begin: Point | None = None) -> Calibration | None:
        """Fit what models state or lack and nobody measured; None where there is nothing of it."""
        wide = doubted(effects, patterns, getattr(simulator, "sd", {}))
        if not any(e.fitted and not e.numeric for e in wide.values()):
            return None
        return calibrate(simulator, recordings, wide, length=length, begin=begin, judged=False)

    whole = Composed.of(simulator, recordings, effects, noise, **given)
    parts = phases_of(simulator, recordings, whole.windows) if phases is None else phases
    # Impacts and sliding amplify the smallest error of a start. They must not outvote flight and rest, and
    # are asked only where those show no cause.
    every = [whole] if forced or (calm := whole.calm()) is whole else [calm, whole]
    for composed in every:
        found = _diagnosed(
            composed.among(composed.thinned()), parts, calibrated, forced, seed, tell, warn, note, groups
        )
        if found.verdict.causes:
            break
    tell("calibration")
    return replace(found, calibrated=found.search.calibration or calibrated(STATED, found.best.point))


def _diagnosed(
    composed: Composed,
    phases: Phases,
    calibrated: Callable[..., Calibration | None],
    forced: Sequence[str],
    seed: int,
    tell: Progress,
    warn: Progress,
    note: Progress,
    groups: Sequence[int] | None,
) -> RobotDiagnosis:
    """The diagnosis along some of the windows, without the calibrated model."""
    warnings: list[str] = []

    def said(text: str) -> None:
        warnings.append(text)
        warn(text)

    wanted = tuple(n for n, e in composed.effects.items() if not e.fitted)
    fold = folds_of(composed.rows, len(composed.recordings), groups)
    search = Search(composed, wanted, fold, lambda: calibrated(UNMEASURED))
    best = search.forced(tuple(forced)) if forced else search.run(tell, note)
    nothing = search.fitted[frozenset()]
    for name in search.diverged:
        said(f"{name}: the simulator diverges with it, and it is left out")
    if nothing.linear.dropped:
        dropped = f"{nothing.linear.dropped} of {len(composed.windows)} windows"
        said(f"the simulator diverges in {dropped}: they are left out")
    for one in search.identifiable.alike:
        if one.exact:
            first, *rest = one.names
            alike = f"as {', '.join(rest)} {'do together' if rest[1:] else 'does'}"
            said(f"{first} acts on these logs {alike}: such logs do not tell them apart")
    tell("how far")
    far = shrinkage(best, nothing, composed, fold) if best.names else None
    verdict = verdict_on(search, best, far, phases, seed, bool(forced))
    return RobotDiagnosis(
        composed, phases, search, best, verdict, far if verdict.causes else None, search.identifiable,
        next_log(search, best, verdict), None, tuple(warnings),
    )  # fmt: skip
