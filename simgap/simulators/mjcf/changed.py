"""A compiled model with some settings changed for a while."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from simgap.simulators.mjcf.engine import mujoco
from simgap.simulators.mjcf.setting import Setting


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
