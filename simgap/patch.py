"""A corrected virtual model from a diagnosis: rig.toml with the causes found, and ranges for training.

`files` gives what `hmmseg diagnose --patch` writes; `performed` and `replayed` run the virtual model of a
corrected rig with its [effects].
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import tomlkit

from hmmseg.errors import InputError
from hmmseg.io.rig import Rig
from hmmseg.io.task import BlockTask
from hmmseg.io.trial import Trial
from simgap.effects import catalogue, effect_named
from simgap.effects.base import KINEMATICS, Performance, interval_comment, number, table
from simgap.gap.simulated import altered, carried, recorded, scene_of
from simgap.gap.simulated import performed as perform
from simgap.world.dynamics import interpolated
from simgap.world.operator import OperatorSettings
from simgap.world.properties import Blocks
from simgap.world.replay import Replay, replay
from simgap.world.simulate import SimulatedTrial, simulate_trials

Body = Mapping[str, Any]
FORMAT = "hmmseg.ranges/1"


def files(rig_text: str, body: Body) -> dict[str, str]:
    """Write a corrected virtual model.

    Args:
        rig_text: The rig.toml that was diagnosed.
        body: The diagnosis's document.

    Returns:
        The contents of three files by name; empty if no cause was named. rig.toml is the given one with its
        comments, and the interval of each corrected value after it; effects without a number of their own in
        a rig are listed under [effects], which `hmmseg simulate` applies. ranges.json holds mean, sd and 90 %
        interval of every parameter found, by its place in rig.toml, and every block's properties, in SI
        units. actual.toml holds the blocks as identified with the causes in the model.
    """
    name = "+".join(body["causes"])
    entry = body["effects"].get(name)
    if not body["causes"] or entry is None:
        return {}
    document = tomlkit.parse(rig_text)
    ranges: dict[str, dict[str, Any]] = {}
    for effect in body["causes"]:
        found = {
            k.removeprefix(f"{effect}."): p for k, p in entry["parameters"].items()
            if len(body["causes"]) == 1 or k.startswith(f"{effect}.")
        }  # fmt: skip
        for parameter, place in _correct(document, effect, found).items():
            p = found[parameter]
            low, high = p["interval_90"]
            if p["mean"] is not None:
                ranges[place] = {k: p[k] for k in ("unit", "mean", "sd")} | {"low": low, "high": high}
    out = {"rig.toml": tomlkit.dumps(document)}
    blocks = _blocks(entry)
    found = {"format": FORMAT, "causes": list(body["causes"]), "parameters": ranges, "blocks": blocks}
    out["ranges.json"] = json.dumps(found, indent=1) + "\n"
    if blocks:
        comment = "# Blocks as identified with the causes in the model: simulate --properties.\n\n"
        out["actual.toml"] = comment + tomlkit.dumps(blocks)
    return out


def _correct(document: tomlkit.TOMLDocument, effect: str, found: Mapping[str, Any]) -> dict[str, str]:
    """Put an effect into the rig; the place of each of its parameters."""
    known = catalogue().get(effect)
    places = known.patched(document, found) if known is not None and known.patched is not None else None
    if places is not None:
        return places
    if known is None or not known.simulated:
        document.add(tomlkit.comment(f"{effect}: found, but nothing that `hmmseg simulate` can put in"))
        return {}
    effects = table(document, "effects")
    mine = tomlkit.table()
    for parameter, p in found.items():
        if p["mean"] is not None:
            mine.add(parameter, number(p["mean"]))
            mine[parameter].comment(interval_comment(p))
    effects[effect] = mine
    return {parameter: f"effects.{effect}.{parameter}" for parameter in found}


def _blocks(entry: Mapping[str, Any]) -> dict[str, Any]:
    """Block properties as they are with the causes in the model."""
    out: dict[str, Any] = {}
    for name, shift in (entry.get("property_shift") or {}).items():
        block, _, prop = name.rpartition(".")
        out.setdefault(block, {})[prop] = {"unit": shift["unit"], "value": shift["after"]}
    return out


def checked(effects: Mapping[str, Mapping[str, float]], where: str) -> None:
    """InputError if [effects] of a rig names an effect that the virtual model cannot apply."""
    for name, values in effects.items():
        known = catalogue().get(name)
        if known is None or not known.simulated:
            can = sorted(n for n, e in catalogue().items() if e.simulated)
            raise InputError(
                f"{where}: key effects.{name}", "no effect that can be simulated", ", ".join(can)
            )
        if not values:
            raise InputError(
                f"{where}: key effects.{name}", "has no parameters", "its values, as --patch writes"
            )


def performed(
    task: BlockTask, rig: Rig, blocks: Sequence[Blocks], seeds: Sequence[int], operator: OperatorSettings
) -> list[SimulatedTrial]:
    """Trials of the model's own operator in the rig's scene, recorded by its sensors under its [effects]."""
    if not rig.effects:
        return simulate_trials(task, rig, blocks, seeds, operator)
    done = perform(task, rig, blocks, seeds, rig.effects, operator)
    return [replace(s, trial=recorded(s, task, rig, rig.effects)) for s in done]


def replayed(
    trial: Trial, task: BlockTask, rig: Rig, blocks: Blocks, boundaries: Sequence[float] | np.ndarray
) -> Replay:
    """Drive the corrected model with a recording's motion; `force` is what its sensors would have read.

    Effects on the recorded angles are undone first, where that is possible. One that cannot be undone (play,
    jitter) is left out of the motion.
    """

    if not rig.effects:
        return replay(trial, task, rig, blocks, boundaries=boundaries)
    hand, around, blocks = scene_of(rig, blocks, rig.effects)
    channels = dict(trial.channels)
    for name, values in rig.effects.items():
        if (restored := effect_named(name).restored) is not None:
            channels = restored(channels, dict(values))
    moved = replace(trial, channels=channels)
    found = replay(moved, task, hand, blocks, boundaries=boundaries, surroundings=around)
    truth = Performance(
        found.t, found.motion.position, found.motion.velocity, found.motion.force,
        np.asarray(boundaries, float), rig, *carried(found.t, boundaries, task, blocks),
    )  # fmt: skip
    acting = sorted(map(effect_named, rig.effects), key=lambda e: -e.stage)
    felt = {e.name: rig.effects[e.name] for e in acting if e.stage != KINEMATICS}
    truth = altered(truth, felt, np.random.default_rng(0))
    force = interpolated(found.signals.t, found.t, truth.force)
    for effect in acting:
        if effect.finish is not None:
            force = effect.finish(force, dict(rig.effects[effect.name]))
    return replace(found, force=force)
