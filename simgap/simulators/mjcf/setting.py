"""One thing of a MuJoCo model that can be set, and objects by name."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from simgap.simulators.mjcf.engine import mujoco


@dataclass(frozen=True)
class Setting:
    """One thing that can be set. `get(model)` is its value, `put(model, value)` sets it in a compiled model;
    `derived`: whether constants derived from it (mj_setConst) must be made anew. `xml`: the attribute, for a
    patch, as (object kind, object name, attribute, index or None). `mixed`: what only comes in steps is mixed
    in proportion of two runs, without it and with it at this value."""

    name: str
    unit: str
    get: Callable[[Any], float]
    put: Callable[[Any, float], None]
    derived: bool
    xml: tuple[str, str, str, int | None] | None
    mixed: float | None = None


def object_id(model: Any, kind: str, name: str) -> int:
    """Index of an object; KeyError where there is none of that name."""
    found = mujoco.mj_name2id(model, getattr(mujoco.mjtObj, f"mjOBJ_{kind.upper()}"), name)
    if found < 0:
        raise KeyError(name)
    return found


def names_of(model: Any, kind: str) -> list[str]:
    """Names of all objects of a kind, those without one left out."""
    count = {
        "joint": model.njnt,
        "body": model.nbody,
        "geom": model.ngeom,
        "actuator": model.nu,
        "sensor": model.nsensor,
        "site": model.nsite,
        "tendon": model.ntendon,
        "equality": model.neq,
    }[kind]
    of = getattr(mujoco.mjtObj, f"mjOBJ_{kind.upper()}")
    return [n for n in (mujoco.mj_id2name(model, of, i) for i in range(count)) if n]


def array_setting(name: str, unit: str, array: str, at: Any, derived: bool, xml) -> Setting:
    """The setting that is entry `at` of the model's array of that name."""

    def get(model: Any) -> float:
        return float(np.ravel(np.asarray(getattr(model, array)[at]))[0])

    def put(model: Any, value: float) -> None:
        getattr(model, array)[at] = value

    return Setting(name, unit, get, put, derived, xml)


def name_of(model: Any, kind: str, number: int) -> str:
    """The name of a joint, body, geom or actuator; empty where it has none."""
    return mujoco.mj_id2name(model, getattr(mujoco.mjtObj, f"mjOBJ_{kind.upper()}"), number) or ""
