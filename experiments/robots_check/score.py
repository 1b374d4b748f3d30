"""Scores of the check, pooled over robots."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from scipy.stats import beta

NUMERICS = "option."  # steps and integrators differ indeed, so naming them is no false alarm
FLOOR = 15.0  # nats; a smaller fault is not certain even if all else is known


def share(hits: int, of: int) -> dict[str, Any]:
    """A share with its 90 % interval (Clopper & Pearson 1934)."""
    low = float(beta.ppf(0.05, hits, of - hits + 1)) if hits else 0.0
    high = float(beta.ppf(0.95, hits + 1, of - hits)) if hits < of else 1.0
    return {"hits": hits, "of": of, "share": hits / of if of else None, "interval_90": [low, high]}


def above(fault: Mapping[str, Any]) -> bool:
    """Whether a fault is large enough to be found."""
    return fault["nats"] >= FLOOR


def _physical(names: Sequence[str]) -> list[str]:
    return [n for n in names if not n.startswith(NUMERICS)]


def right(one: Mapping[str, Any]) -> bool:
    """Whether every fault above the floor is among causes or their rivals, and no other cause is named."""
    named = one["found"]["causes"]
    every = {*named, *one["found"]["indistinguishable"]}
    allowed = {r for f in one["faults"] for r in f["right"]}
    met = all(every & set(f["right"]) for f in one["faults"] if above(f))
    strange = [n for n in _physical(named) if n not in allowed]
    # In a set, any of its rivals may stand for a fault.
    spare = len([f for f in one["faults"] if not set(named) & set(f["right"])])
    return met and len(strange) <= spare and one["found"]["verdict"] in ("named", "set")


def alarm(one: Mapping[str, Any]) -> bool:
    """Whether anything but numerics is named for a healthy robot."""
    found = one["found"]
    return found["verdict"] == "unknown" or bool(_physical(found["causes"]))


def held_back(one: Mapping[str, Any]) -> bool:
    """Whether a fault of no known kind is unknown, its remainder reported, or itself named since."""
    found, named = one["found"], bool(one["faults"][0]["right"]) and right(one)
    return found["verdict"] == "unknown" or named or (found["verdict"] != "none" and found["remainder"] > 0.1)


def covered(one: Mapping[str, Any]) -> list[bool]:
    """Whether intervals contain the sizes of rightly named faults; of two delays told as one, the sum."""
    out, effects, named = [], one["found"]["effects"], one["found"]["causes"]
    same = {"delay": "delay", "read_gain": "gain", "read_bias": "bias", "read_lag": "delay", "gain": "gain"}
    accounts = [next((name for name in f["right"] if name in named), None) for f in one["faults"]]
    for name in dict.fromkeys(a for a in accounts if a in effects):
        mine = [f for f, by in zip(one["faults"], accounts, strict=True) if by == name]
        known = effects[name]["parameters"].get(same.get(mine[0]["kind"]))
        if known is not None:
            out.append(known["interval_90"][0] <= sum(f["size"] for f in mine) <= known["interval_90"][1])
    return out


def scored(every: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """The figures, pooled and by kind, and a summary of every case."""
    of = lambda *kinds: [c for c in every if c["kind"] in kinds]  # noqa: E731
    healthy = of("healthy")
    outside = [c for c in of("outside") if above(c["faults"][0])]
    known = [c for c in of("single", "pair", "dense") if any(map(above, c["faults"]))]
    inside = [hit for c in every for hit in covered(c)]
    faults = [f for c in every for f in c["faults"]]
    return {
        "cases": len(every),
        "faults": len(faults),
        "floor": FLOOR,
        "below_the_floor": sum(not above(f) for f in faults),
        "robots": sorted({c["robot"] for c in every}),
        "false_alarms": share(sum(map(alarm, healthy)), len(healthy)),
        "named_right": share(sum(map(right, known)), len(known)),
        "named_right_by_kind": {
            k: share(sum(right(c) for c in known if c["kind"] == k), sum(c["kind"] == k for c in known))
            for k in ("single", "pair", "dense")
        },
        "outside_held_back": share(sum(map(held_back, outside)), len(outside)),
        "intervals_cover": share(sum(inside), len(inside)),
        "processor_seconds": {
            r: float(np.mean([c["seconds"] for c in every if c["robot"] == r]))
            for r in sorted({c["robot"] for c in every})
        },
        "each": [
            {
                "case": c["case"],
                "robot": c["robot"],
                "kind": c["kind"],
                "faults": [
                    f"{f['kind']} {f['thing']} {f['size']:.3g} ({f['nats']:.0f} nats)" for f in c["faults"]
                ],
                "verdict": c["found"]["verdict"],
                "causes": c["found"]["causes"],
                "rivals": c["found"]["indistinguishable"],
                "remainder": c["found"]["remainder"],
            }
            for c in every
        ],
    }
