"""What the simulator itself offers: parameters that it names, alone or grouped by their `effect`."""

from __future__ import annotations

from simgap.robot_effects.base import RobotEffect, Setting


def candidates(setting: Setting) -> list[RobotEffect]:
    """One for each effect that the simulator's parameters name; a parameter without one is its own."""
    groups: dict[str, dict[str, str]] = {}
    known = setting.simulator.parameters
    for name, parameter in known.items():
        effect = parameter.effect or name
        groups.setdefault(effect, {})[name.removeprefix(f"{effect}.")] = name
    told = getattr(setting.simulator, "says", {})
    return [
        RobotEffect(
            effect,
            told.get(effect, "the simulator's own parameter"),
            {short: known[name] for short, name in names.items()},
            model=names,
        )
        for effect, names in groups.items()
    ]
