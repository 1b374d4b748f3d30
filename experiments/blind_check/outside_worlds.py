"""Effects from outside the catalogue that were first drawn for sets of many worlds."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.signal import lfilter

from experiments.blind_check.effects import _sign, fault
from experiments.blind_check.signals import ENCODER, HAND, LINKS, MIX, READOUT, SCALE, Signals, Stage
from experiments.blind_check.stages import Rng, Values, added_force


def posed(v: Values) -> Stage:
    """Strain gauges beside the joint: a finger's gain depends on its outer link's angle."""

    def stage(s: Signals, rng: Rng) -> Signals:
        assert s.q is not None
        turned = np.repeat(s.q[:, 1::2] - s.q[0, 1::2], 2, axis=1)
        return replace(s, force=s.force * (1 + turned * np.repeat([v["slope1"], v["slope2"]], 2)))

    return stage


def magnetised(v: Values) -> Stage:
    """Magnets in the blocks: what is held is drawn down the more the nearer its support still is."""

    def shift(s: Signals, rng: Rng) -> np.ndarray:
        out, ends = np.zeros_like(s.force), s.motion.boundaries
        for leave, meet in zip(ends[1::4], ends[2::4], strict=True):
            block = int(np.argmax(np.ptp(s.motion.centres[(s.t > leave) & (s.t < meet), :, 1], axis=0)))
            height = s.motion.centres[:, block, 1]
            for end in (leave, meet):
                gap = np.maximum(height - height[np.searchsorted(s.t, end)], 0.0)
                near = v["pull"] * np.exp(-gap / v["reach"]) * ((s.t >= leave) & (s.t <= meet))
                out[:, [1, 3]] += near[:, None] / 2
        return out

    return added_force(shift)


def sloshing(v: Values) -> Stage:
    """Blocks half full of water: it swings on after every start and stop of a carry."""

    def shift(s: Signals, rng: Rng) -> np.ndarray:
        w, z, dt = 2 * np.pi * v["frequency"], v["damping"], s.t[1] - s.t[0]
        held = np.zeros_like(s.t)
        for leave, meet in zip(s.motion.boundaries[1::4], s.motion.boundaries[2::4], strict=True):
            held += (s.t > leave) & (s.t < meet)
        keep = np.exp(-dt / 0.01)
        a = np.gradient(s.motion.velocity[:, [0, 2]].mean(1), s.t) * held
        a = np.asarray(lfilter([1 - keep], [1, -keep], a))
        pole = np.exp((-z + 1j * np.sqrt(1 - z * z)) * w * dt)
        swing = lfilter(
            [0, w * dt * abs(pole) * np.sin(np.angle(pole))], [1, -2 * pole.real, abs(pole) ** 2], a
        )
        push = v["mass"] * np.asarray(swing) * held
        return np.stack([push / 2, 0 * push, push / 2, 0 * push], 1)

    return added_force(shift)


def pumped(v: Values) -> Stage:
    """A pump on the same bench: a short pulse at every stroke, whatever the hand does."""

    def shift(s: Signals, rng: Rng) -> np.ndarray:
        phase = (s.t * v["strokes"] + rng.uniform()) % 1
        pulse = np.exp(-0.5 * ((phase - 0.5) / v["width"]) ** 2)
        return v["height"] * (pulse - pulse.mean())[:, None] * np.array([v["side"], 1.0, v["side"], 1.0])

    return added_force(shift)


def deadened(v: Values) -> Stage:
    """Amplifiers with a dead zone about zero: small loads are not seen, large ones read too low."""
    zone = v["zone"] * np.array([1, v["other"]] * 2)
    return lambda s, rng: replace(s, force=np.sign(s.force) * np.maximum(np.abs(s.force) - zone, 0.0))


def warming(v: Values) -> Stage:
    """Pads that warm as they work: they give way the more the later in a trial."""

    def stage(s: Signals, rng: Rng) -> Signals:
        keep = np.exp(-(s.t[1] - s.t[0]) / 0.005)
        load = np.asarray(lfilter([1 - keep], [1, -keep], s.motion.force, axis=0))
        give = load * v["give"] * (s.t / s.t[-1])[:, None]
        place, rate = s.motion.position + give, s.motion.velocity + np.gradient(give, s.t, axis=0)
        return replace(s, motion=replace(s.motion, position=place, velocity=rate))

    return stage


def belated(v: Values) -> Stage:
    """Angles that come through a slower bus than everything else."""

    def stage(s: Signals, rng: Rng) -> Signals:
        assert s.q is not None
        return replace(s, q=np.stack([np.interp(s.t - v["age"], s.t, c) for c in s.q.T], 1))

    return stage


def dripping(v: Values) -> Stage:
    """Wet blocks: they lose weight as long as they hang in the air."""

    def shift(s: Signals, rng: Rng) -> np.ndarray:
        out, ends = np.zeros_like(s.force), s.motion.boundaries
        for leave, meet in zip(ends[1::4], ends[2::4], strict=True):
            lost = v["rate"] * np.maximum(s.t - leave, 0.0) * (s.t < meet)
            out[:, [1, 3]] -= lost[:, None] / 2
        return out

    return added_force(shift)


def mounted(v: Values) -> Stage:
    """A mount that yields: both fingers move with the load they carry together, past their encoders."""

    def stage(s: Signals, rng: Rng) -> Signals:
        keep = np.exp(-(s.t[1] - s.t[0]) / 0.01)
        load = s.motion.force[:, :2] + s.motion.force[:, 2:]
        load = np.asarray(lfilter([1 - keep], [1, -keep], load, axis=0))
        give = np.tile(load * np.array([v["along"], v["down"]]), 2)
        place, rate = s.motion.position + give, s.motion.velocity + np.gradient(give, s.t, axis=0)
        return replace(s, motion=replace(s.motion, position=place, velocity=rate))

    return stage


def hanging(v: Values) -> Stage:
    """A hose that hangs from each finger and swings with its motion."""

    def shift(s: Signals, rng: Rng) -> np.ndarray:
        w, z, dt = 2 * np.pi * v["frequency"], v["damping"], s.t[1] - s.t[0]
        pole = np.exp((-z + 1j * np.sqrt(1 - z * z)) * w * dt)
        gain = w * dt * abs(pole) * np.sin(np.angle(pole))
        keep = np.exp(-dt / 0.01)
        a = np.gradient(s.motion.velocity[:, 0::2], s.t, axis=0)
        a = np.asarray(lfilter([1 - keep], [1, -keep], a, axis=0))
        swing = lfilter([0, gain], [1, -2 * pole.real, abs(pole) ** 2], a, axis=0)
        out = np.zeros_like(s.force)
        out[:, 0::2] = np.asarray(swing) * np.array([v["mass1"], v["mass2"]])
        return out

    return added_force(shift)


OUTSIDE = {
    made.name: made
    for made in (
        fault("pose_gain", lambda r, s: {"slope1": 0.35 * s * _sign(r),
                                         "slope2": 0.35 * s * r.uniform(-1, 1)}, SCALE, posed),
        fault("magnetised_blocks", lambda r, s: {"pull": 1.0 * s, "reach": r.uniform(0.004, 0.01)},
              HAND, magnetised),
        fault("sloshing_blocks", lambda r, s: {"mass": 0.2 * s, "frequency": r.uniform(1.8, 4),
                                               "damping": r.uniform(0.02, 0.1)}, HAND, sloshing),
        fault("bench_pump", lambda r, s: {"height": 0.3 * s * _sign(r), "strokes": r.uniform(0.8, 2),
                                          "width": r.uniform(0.04, 0.1), "side": r.uniform(-1, 1)},
              READOUT, pumped),
        fault("dead_zone", lambda r, s: {"zone": 0.25 * s, "other": r.uniform(0, 1)}, READOUT, deadened),
        fault("warming_pads", lambda r, s: {"give": 3e-4 * s}, LINKS, warming),
        fault("late_angles", lambda r, s: {"age": 0.06 * s}, ENCODER, belated),
        fault("dripping_blocks", lambda r, s: {"rate": 0.15 * s}, HAND, dripping),
        fault("yielding_mount", lambda r, s: {"down": 1e-3 * s, "along": 1e-3 * s * r.uniform(-1, 1)},
              LINKS, mounted),
        fault("swinging_hose", lambda r, s: {"mass1": 0.04 * s, "mass2": 0.04 * s * r.uniform(-1, 1),
                                             "frequency": r.uniform(1.2, 3.5),
                                             "damping": r.uniform(0.02, 0.1)}, MIX, hanging),
    )
}  # fmt: skip
