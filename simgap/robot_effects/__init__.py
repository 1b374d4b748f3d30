"""Candidate effects on robots: on commands, on read-outs, and on the simulator's parameters."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from fnmatch import fnmatchcase

from hmmseg.errors import InputError, nearest
from simgap.effect import Parameter
from simgap.robot_effects import commands, readouts
from simgap.robot_effects.base import RobotEffect, Setting
from simgap.simulators.protocol import Simulator
from simgap.simulators.recording import Recording

FAMILIES = (commands, readouts)


def candidates(setting: Setting) -> dict[str, RobotEffect]:
    """All candidates for a simulator and recordings, by name."""
    made = [*commands.candidates(setting), *of_the_model(setting), *readouts.candidates(setting)]
    return {effect.name: effect for effect in made}


def of_the_model(setting: Setting) -> list[RobotEffect]:
    """One effect for each that the simulator's parameters name; a parameter that names none is its own.

    The solver's own numbers are fitted along: no robot has a step.
    """
    groups: dict[str, dict[str, str]] = {}
    known, numerics = setting.simulator.parameters, {*getattr(setting.simulator, "numerics", ())}
    dear = {*getattr(setting.simulator, "dear", numerics)}
    for name, parameter in known.items():
        effect = parameter.effect or name
        if any(known[n].fitted != parameter.fitted for n in groups.get(effect, {}).values()):
            raise InputError(
                f"simulator: effect {effect}", "has parameters fitted and not", "all or none fitted"
            )
        short = name.rpartition(".")[2]
        short = short if short not in groups.get(effect, {}) else name
        groups.setdefault(effect, {})[short] = name
    says = getattr(setting.simulator, "says", {})
    return [
        RobotEffect(
            effect,
            says.get(effect, "the simulator's own parameter"),
            {short: known[name] for short, name in names.items()},
            model=names,
            fitted=all(known[n].fitted or n in numerics for n in names.values()),
            numeric=bool(numerics & {*names.values()}),
            dear=bool(dear & {*names.values()}),
        )
        for effect, names in groups.items()
    ]


# prior: usual sizes by which what a model states and nobody measured may be off
WIDE = 30.0
# prior: by unit, the largest factor by which a stated value may be off
MOST = {"kg": 3.0, "kg m^2": 10.0}
# What models state and nobody measured; and what they lack, fitted where the former leaves a gap.
STATED = (
    "joint:*.damping", "joint:*.frictionloss", "joint:*.armature", "joint:*.tie", "actuator:*.gain",
    "actuator:*.damping", "geom:*.stiffness", "command.delay",
)  # fmt: skip
LACKING = ("joint:*.load_friction", "actuator:*.fade")
UNMEASURED = (*STATED, *LACKING)


def effects_of(
    simulator: Simulator,
    recordings: Sequence[Recording],
    more: Iterable[RobotEffect] = (),
    uncertain: Sequence[str] = (),
) -> dict[str, RobotEffect]:
    """All effects of a simulator along logs.

    Args:
        simulator: The robot's model.
        recordings: Its logs.
        more: Further candidates.
        uncertain: Patterns of further effects that were never measured, and so are fitted along.

    Raises:
        InputError: The simulator's map names an effect that there is none of.
    """
    known = candidates(Setting(simulator, recordings)) | {e.name: e for e in more}
    sds, named = getattr(simulator, "sd", {}), getattr(simulator, "uncertain", ())
    for what, names in (("sd", sds), ("uncertain", named)):
        for name in names:
            if not any(fnmatchcase(n, name) for n in known):
                where = f"{getattr(getattr(simulator, 'map', None), 'file', 'simulator')}: {what}"
                raise InputError(where, f"nothing is called {name}", nearest(name, list(known)))
    return doubted({n: _plausible(e) for n, e in known.items()}, (*named, *uncertain), sds)


def _plausible(effect: RobotEffect) -> RobotEffect:
    """The effect with stated masses and inertias bounded to what a robot can have."""
    bounded = {}
    for name, p in effect.parameters.items():
        if p.nominal > 0 and p.unit in MOST:
            low, high = p.nominal / MOST[p.unit], p.nominal * MOST[p.unit]
            bounded[name] = replace(p, low=max(p.low, low), high=min(p.high, high))
    return replace(effect, parameters={**effect.parameters, **bounded}) if bounded else effect


def doubted(
    effects: Mapping[str, RobotEffect], uncertain: Iterable[str], sds: Mapping[str, float]
) -> dict[str, RobotEffect]:
    """The effects with their uncertainty as stated.

    Args:
        effects: By name.
        uncertain: Patterns of those that were never measured: they are fitted along, with wide priors where
            `sds` has none.
        sds: Standard deviations by effect.
    """
    patterns, out = tuple(uncertain), dict(effects)
    for name, effect in effects.items():
        if any(fnmatchcase(name, p) for p in patterns) and not effect.fitted:
            wide = WIDE if effect.model else 1.0
            effect = replace(effect, fitted=True, widened=wide, parameters=_sized(effect, wide, None))
        stated = sds.get(name)
        out[name] = (
            effect if stated is None else replace(effect, widened=0.0, parameters=_sized(effect, 1.0, stated))
        )
    return out


def _sized(effect: RobotEffect, factor: float, sd: float | None) -> dict[str, Parameter]:
    known = effect.parameters.items()
    return {n: replace(p, sd=factor * p.sd if sd is None else sd) for n, p in known}


def words(name: str) -> tuple[str, str] | None:
    """A candidate in plain words and what to check on the robot; None of a model's own parameter."""
    kind, where = re.sub(r":.*\.", ".", name), re.search(r":(.*)\.", name)
    for module in FAMILIES:
        if kind in module.WORDS:
            called, check = module.WORDS[kind]
            return called + (f" ({where[1]})" if where else ""), check
    return None
