"""One thing of a MuJoCo model that can be set, objects by name, and a model with some of it changed."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from simgap.simulators.mjcf.engine import mujoco


@dataclass(frozen=True)
class Setting:
    """One thing that can be set. `get(model)` is its value, `put(model, value)` sets it in a compiled model;
    `derived`: whether constants derived from it (mj_setConst) must be recomputed. `xml`: the attribute, for a
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


class Changed:
    """The model with some settings changed, for as long as it is entered."""

    def __init__(
        self, model: Any, settings: Mapping[str, Setting], changed: Sequence[tuple[str, float]]
    ) -> None:
        self.model, self.settings, self.changed = model, settings, changed

    def __enter__(self) -> None:
        if not self.changed:
            return
        self.kept = {n: np.array(getattr(self.model, n)) for n in FIELDS}
        opt = self.model.opt
        self.options = (np.array(opt.gravity), opt.timestep, opt.integrator, opt.iterations)
        for name, value in self.changed:
            self.settings[name].put(self.model, value)
        if any(self.settings[n].derived for n, _ in self.changed):
            mujoco.mj_setConst(self.model, mujoco.MjData(self.model))

    def __exit__(self, *exception: object) -> None:
        if not self.changed:
            return
        for name, values in self.kept.items():
            getattr(self.model, name)[:] = values
        opt = self.model.opt
        opt.gravity[:], opt.timestep, opt.integrator, opt.iterations = self.options
        if any(self.settings[n].derived for n, _ in self.changed):
            mujoco.mj_setConst(self.model, mujoco.MjData(self.model))


FIELDS = (
    "dof_damping",
    "dof_frictionloss",
    "dof_armature",
    "jnt_stiffness",
    "qpos_spring",
    "body_mass",
    "body_inertia",
    "body_ipos",
    "body_pos",
    "geom_friction",
    "geom_solref",
    "geom_solimp",
    "geom_size",
    "geom_rbound",
    "actuator_gainprm",
    "actuator_biasprm",
    "actuator_forcerange",
)
