"""Systematic uncertainty of the hand: parameters that all trials share, and what they shift.

Each entry of the rig's [systematic] table is a deviation of the true hand from the nominal one.
Its effect on every observation is a finite difference: the trial is read again by a hand that
deviates by a small step (kinematics, pads, force calibration), with the same sample weights.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from estimation.compliance import SLOPE_SD, UNSTATED, unit_pads
from hmmseg.hand.signals import Signals, task_space
from hmmseg.io.rig import FORCE_CHANNELS, JOINTS, Rig
from hmmseg.io.trial import Trial

# prior: a pad whose stiffness is in doubt need not be linear: at half the force its compliance may be off
# by as much again. Elastic contact (Hertz) has an exponent of 2/3; most pads lie between that and 1.
MOST_BENT = 0.5
UNLIKE = 0.3  # prior: by which share of what both pads have alike one may differ: foams of one make do


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


@dataclass(frozen=True)
class PadDoubt:
    """What recordings show of the pads and the rig does not admit: how much softer they are, as shares.

    `normal`, `shear`: along the grip and in shear the compliance seems 1 + share times the nominal; `odds`
    are the probabilities that the rig is so wrong; where it is `doubted`, the extra prior sd is as large as
    the share. `apart`: what slopes along the grip and in shear are off by alike. `normal_give`, `shear_give`:
    how much pads may give, by what the recordings show, whose stiffness the rig leaves unstated; 0 where it
    states one. `usual_normal`, `usual_shear`: forces of one finger as they usually are in a grip, and where a
    block is put down [N]. `seen`: those shares and their sds whatever the odds, infinite where nothing tells.
    """

    normal: float = 0.0
    shear: float = 0.0
    normal_give: float = 0.0
    shear_give: float = 0.0
    usual_normal: float = 1.0
    usual_shear: float = 1.0
    odds: tuple[float, float] = (0.0, 0.0)
    doubted: bool = False
    apart: tuple[float, float] = (0.0, 0.0)
    seen: tuple[tuple[float, float], tuple[float, float]] = ((0.0, np.inf), (0.0, np.inf))

    def extra_sd(self, kind: str) -> float:
        """Prior standard deviation of the share, "normal" or "shear", beyond what the rig admits."""
        return abs(getattr(self, kind)) if self.doubted else 0.0

    def slope_sd(self) -> np.ndarray:
        """Standard deviations (3,) by channel of what slopes are off by alike and each of its own.

        A share of what truly gives, and beside it what noise of forces or places may make of all of them.
        """
        usual = SLOPE_SD * np.array([1.0, self.normal_give or 1.0, self.shear_give or 1.0])
        return np.hypot(usual, [0.0, *self.apart])


def _softer_pads(fingers: tuple[int, ...], axis: str):
    def read(trial: Trial, rig: Rig, size: float) -> Signals:
        """Pads whose compliance is 1 + size of the nominal: their faces lie elsewhere under a force."""
        signals, moved = task_space(trial, rig), {}
        for finger in fingers:
            name = f"{axis}{finger}"
            give = getattr(signals, f"f{name}") * _compliance(rig, finger, axis)
            moved[name] = getattr(signals, name) - give * size
        return replace(signals, **moved)

    return read


def _bent_pads(axis: str, usual: float):
    def read(trial: Trial, rig: Rig, size: float) -> Signals:
        """Pads that give as force^(1 + size), as the nominal at the force `usual`; to first order."""
        signals, moved = task_space(trial, rig), {}
        for finger in (1, 2):
            name = f"{axis}{finger}"
            force = getattr(signals, f"f{name}")
            bend = force * np.log(np.maximum(np.abs(force), 1e-3 * usual) / usual)
            moved[name] = getattr(signals, name) - _compliance(rig, finger, axis) * bend * size
        return replace(signals, **moved)

    return read


def _compliance(rig: Rig, finger: int, axis: str) -> float:
    """Of one pad [m/N]: along the grip (x) or in shear (y)."""
    return getattr(unit_pads(rig), ("normal" if axis == "x" else "shear") + str(finger))


def _wider(trial: Trial, rig: Rig, size: float) -> Signals:
    """Fingers that touch a block when they are `size` further apart than their distance says."""
    signals = task_space(trial, rig)
    return replace(signals, x1=signals.x1 - size / 2, x2=signals.x2 + size / 2)


def nuisances(rig: Rig, biased: np.ndarray, doubt: PadDoubt, touch_sd: float = 0.0) -> tuple[Nuisance, ...]:
    """The deviations that the rig admits, and those that recordings show beside.

    `biased` (4,): extra prior sd of each force bias [N]; `doubt`: of the pads' compliances; `touch_sd`
    [m]: how well the distance is known at which the fingers touch a block.
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
    # What slopes show is compliance and exponent together, so either may be off by as much as both; the bend
    # is that of what gives.
    stated = min(max(doubt.extra_sd("normal"), *s.pad_stiffness) / np.log(2), MOST_BENT)
    bends = {"normal": MOST_BENT * doubt.normal_give or stated, "shear": MOST_BENT * doubt.shear_give}
    # Pads of one hand are of one make: of what their stiffness is stated to be in doubt by, most is common.
    common = min(s.pad_stiffness) * np.sqrt(1 - UNLIKE**2)
    for axis, kind in (("x", "normal"), ("y", "shear")):
        found, give = doubt.extra_sd(kind), getattr(doubt, f"{kind}_give")
        admitted = 0.0 if give else common
        both = max(found, UNSTATED if give else 0.0)
        both = float(np.hypot(np.hypot(both, bends[kind]) if both else 0.0, admitted))
        if both:
            out.append(Nuisance(f"pad_{kind}", both, 1e-3, _softer_pads((1, 2), axis)))
        for finger in (1, 2):
            own = 0.0 if give else s.pad_stiffness[finger - 1]
            sd = float(np.sqrt(own**2 - admitted**2 + (UNLIKE * max(found, give)) ** 2))
            if sd > 0:
                out.append(Nuisance(f"pad_{kind}.{finger}", sd, 1e-3, _softer_pads((finger,), axis)))
        if bends[kind] and any(n.name.startswith(f"pad_{kind}") for n in out):
            usual = max(getattr(doubt, f"usual_{kind}"), 1e-3)
            out.append(Nuisance(f"pad_{kind}_exponent", bends[kind], 1e-3, _bent_pads(axis, usual)))
    if touch_sd > 0:
        out.append(Nuisance("touch", touch_sd, 1e-5, _wider))
    return tuple(out)
