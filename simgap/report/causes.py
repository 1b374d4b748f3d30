"""Causes by their plain names, and what to look at on the rig for each."""

from __future__ import annotations

import tomllib
from collections.abc import Callable, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any

Means = Mapping[str, float]


def _pads(means: Means, rig: Mapping[str, Any]) -> str:
    nominal, found = rig.get("normal_stiffness"), means.get("normal_stiffness")
    if nominal is None or found is None:
        return "other fingertips than the model's"
    if nominal == float("inf"):
        return "fingertips that yield, where the model has rigid ones"
    return "softer fingertips" if found < nominal else "stiffer fingertips"


def _late(words: str) -> Callable[[Means, Mapping[str, Any]], str]:
    def name(means: Means, rig: Mapping[str, Any]) -> str:
        acting = [k for k, v in means.items() if v > 0]
        one = [k for k in acting if k.startswith("finger")]
        return f"{words} of finger {one[0][-1]}" if len(one) == 1 == len(acting) else words

    return name


def _gain(means: Means, rig: Mapping[str, Any]) -> str:
    which = {k: v for k, v in means.items() if k != "gain"}
    if which:
        worst = max(which, key=lambda k: abs(which[k]))
        where = f"finger {worst[-1]}" if worst.startswith("finger") else worst
        return f"a force sensor that reads too {'high' if which[worst] > 0 else 'low'} ({where})"
    value = means.get("gain", 0.0)
    return f"force sensors that read too {'high' if value > 0 else 'low'}"


def _bias(means: Means, rig: Mapping[str, Any]) -> str:
    if not means:
        return "a zero error of the force sensors"
    worst = max(means, key=lambda k: abs(means[k]))
    total = sum(abs(v) for v in means.values())
    lone = total > 0 and abs(means[worst]) > 0.8 * total
    return f"a zero error of force sensor {worst}" if lone else "zero errors of the force sensors"


WORDS: dict[str, Callable[[Means, Mapping[str, Any]], str]] = {
    "fingertip_compliance": _pads,
    "force_bias": _bias,
    "force_gain": _gain,
    "force_lag": _late("force readings that come late"),
    "force_lowpass": _late("a slow filter in the force channel"),
}


@cache
def _told() -> dict[str, dict[str, str]]:
    return tomllib.loads(Path(__file__).with_name("causes.toml").read_text(encoding="utf-8"))


def plain_name(effect: str, means: Means | None = None, rig: Mapping[str, Any] | None = None) -> str:
    """An effect, or several joined by +, in plain words; `means`: its parameters, `rig`: the model's pads."""
    out = []
    for name in effect.split("+"):
        own = {k.removeprefix(f"{name}."): v for k, v in (means or {}).items()}
        if own and name in WORDS:
            out.append(WORDS[name](own, rig or {}))
        else:
            out.append(_told().get(name, {}).get("name", name.replace("_", " ")))
    return " and ".join(out)


def checks(effects: Sequence[str]) -> list[str]:
    """What to look at on the rig, one line an effect."""
    return [_told()[name]["check"] for name in effects if name in _told()]
