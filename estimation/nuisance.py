"""Systematic uncertainty of the hand: parameters that all trials share, and what they shift.

Each entry of the rig's [systematic] table is a deviation of the true hand from the nominal one.
Its effect on every observation is a finite difference: the trial is read again by a hand that
deviates by a small step (kinematics, pads, force calibration), with the same sample weights.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from hmmseg.hand.signals import Signals, task_space
from hmmseg.io.rig import FORCE_CHANNELS, JOINTS, Rig
from hmmseg.io.trial import Trial


@dataclass(frozen=True)
class Nuisance:
    """One deviation: its name, prior standard deviation, and how a trial is read under it.

    `read(trial, rig, size)` gives the task-space signals as a hand that truly deviates by `size`
    from the nominal rig means them; `step` is a small deviation for finite differences.
    """

    name: str
    sd: float
    step: float
    read: Callable[[Trial, Rig, float], Signals]


def _with_channel(name: str, change: Callable[[np.ndarray, float], np.ndarray]):
    def read(trial: Trial, rig: Rig, size: float) -> Signals:
        channels = trial.channels | {name: change(trial.channels[name], size)}
        return task_space(replace(trial, channels=channels), rig)

    return read


def _longer_link(finger: int, link: int):
    def read(trial: Trial, rig: Rig, size: float) -> Signals:
        fingers, nominal = dict(rig.fingers or {}), rig.finger(finger)
        links = list(nominal.links)
        links[link] *= 1 + size
        fingers[str(finger)] = nominal.model_copy(update={"links": tuple(links)})
        return task_space(trial, rig.model_copy(update={"fingers": fingers}))

    return read


def _stiffer_pad(finger: int):
    def read(trial: Trial, rig: Rig, size: float) -> Signals:
        """A stiffer pad gives less: its face lies elsewhere under the same force."""
        signals, tip, moved = task_space(trial, rig), rig.fingertip, {}
        for axis, stiffness in (("x", tip.normal_stiffness), ("y", tip.shear_stiffness)):
            force = getattr(signals, f"f{axis}{finger}")
            position = getattr(signals, f"{axis}{finger}")
            moved[f"{axis}{finger}"] = position - force / stiffness * (1 / (1 + size) - 1)
        return replace(signals, **moved)

    return read


def _wider(trial: Trial, rig: Rig, size: float) -> Signals:
    """Fingers that touch a block when they are `size` further apart than their distance says."""
    signals = task_space(trial, rig)
    return replace(signals, x1=signals.x1 - size / 2, x2=signals.x2 + size / 2)


def nuisances(rig: Rig, biased: np.ndarray, touch_sd: float = 0.0) -> tuple[Nuisance, ...]:
    """The deviations that the rig admits; `biased` (4,): extra prior sd of each force bias [N].

    `touch_sd` [m]: how well the distance is known at which the fingers touch a block.
    """
    s, out = rig.systematic, []
    for i, name in enumerate(FORCE_CHANNELS):
        sd = float(np.hypot(s.force_bias[i], biased[i]))
        if sd > 0:
            out.append(Nuisance(f"force_bias.{name}", sd, 1e-3,
                                _with_channel(name, lambda f, b: f - b)))  # fmt: skip
        if s.force_gain[i] > 0:
            out.append(Nuisance(f"force_gain.{name}", s.force_gain[i], 1e-3,
                                _with_channel(name, lambda f, g: f / (1 + g))))  # fmt: skip
    if rig.jointed:
        for i, name in enumerate(JOINTS):
            if s.joint_offset[i] > 0:
                out.append(Nuisance(f"joint_offset.{name}", s.joint_offset[i], 1e-5,
                                    _with_channel(name, lambda q, d: q - d)))  # fmt: skip
        for i, (finger, link) in enumerate([(1, 0), (1, 1), (2, 0), (2, 1)]):
            if s.link_length[i] > 0:
                out.append(Nuisance(f"link_length.{finger}{link + 1}", s.link_length[i], 1e-5,
                                    _longer_link(finger, link)))  # fmt: skip
    for finger in (1, 2):
        if s.pad_stiffness[finger - 1] > 0 and np.isfinite(rig.fingertip.normal_stiffness):
            out.append(Nuisance(f"pad_stiffness.{finger}", s.pad_stiffness[finger - 1], 1e-3,
                                _stiffer_pad(finger)))  # fmt: skip
    if touch_sd > 0:
        out.append(Nuisance("touch", touch_sd, 1e-5, _wider))
    return tuple(out)
