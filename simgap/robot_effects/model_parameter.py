"""What the simulator itself offers: parameters that it names, alone or grouped by their `effect`."""

from __future__ import annotations

from hmmseg.errors import InputError
from simgap.robot_effects.base import RobotEffect, Setting


def candidates(setting: Setting) -> list[RobotEffect]:
    """One for each effect that the simulator's parameters name; a parameter without one is its own. The
    solver's own numbers are fitted along: no robot has a step."""
    groups: dict[str, dict[str, str]] = {}
    known, numerics = setting.simulator.parameters, getattr(setting.simulator, "numerics", ())
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
        )
        for effect, names in groups.items()
    ]
