"""Effects from outside the catalogue of the third sealed set of worlds: what snags, whips and garbles."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.signal import lfilter

from experiments.blind_check.effects import fault
from experiments.blind_check.signals import ENCODER, HAND, LINKS, READOUT, Signals, Stage
from experiments.blind_check.stages import Rng, Values, added_force


def _smooth(x: np.ndarray, s: Signals, time: float) -> np.ndarray:
    """A first-order low-pass from rest."""
    keep = np.exp(-(s.t[1] - s.t[0]) / time)
    return np.asarray(lfilter([1 - keep], [1, -keep], x, axis=0, zi=keep * x[:1])[0])


def _seen(s: Signals, change: np.ndarray) -> Signals:
    """Tips that were elsewhere than the encoders tell."""
    place, rate = s.motion.position + change, s.motion.velocity + np.gradient(change, s.t, axis=0)
    return replace(s, motion=replace(s.motion, position=place, velocity=rate))


def tracking(v: Values) -> Stage:
    """Amplifiers with zero tracking, as scales have: whatever reads small is slowly taken for a zero."""

    def stage(s: Signals, rng: Rng) -> Signals:
        out, zero, step = np.empty_like(s.force), np.zeros(4), v["speed"] * (s.t[1] - s.t[0])
        for k, row in enumerate(s.force):
            out[k] = reads = row - zero
            zero = zero + step * np.clip(reads / 0.01, -1, 1) * (np.abs(reads) < v["window"])
        return replace(s, force=out)

    return stage


def garbled(v: Values) -> Stage:
    """A noisy serial line: in single words of one encoder a bit is read the wrong way."""

    def stage(s: Signals, rng: Rng) -> Signals:
        word = np.floor(s.t * s.rig.rate + 0.5).astype(int)
        wrong = (rng.random(word[-1] + 1) < v["share"])[word]
        joint, q = int(v["joint"]), s.q.copy()
        is_set = np.floor(q[:, joint] / v["bit"]) % 2
        q[:, joint] += wrong * v["bit"] * (1 - 2 * is_set)
        return replace(s, q=q)

    return stage


def ballast(v: Values) -> Stage:
    """A loose ball in each block: a start or stop of a carry sends it to the other wall, where it stays."""

    def shift(s: Signals, rng: Rng) -> np.ndarray:
        out = np.zeros_like(s.force)
        a = _smooth(np.gradient(s.motion.velocity[:, [0, 2]].mean(1), s.t), s, 0.02)
        for leave, meet in zip(s.motion.boundaries[1::4], s.motion.boundaries[2::4], strict=True):
            begin, end = np.searchsorted(s.t, [leave, meet])
            most = np.abs(a[begin:end]).max()
            side, lies = np.zeros(len(s.t)), float(rng.choice([-1.0, 1.0]))
            knocks = np.zeros(len(s.t))
            for k in range(begin, end):
                if a[k] * lies > v["sticks"] * most:
                    lies = -lies
                    knocks[k] = lies
                side[k] = lies
            lean = v["weight"] * _smooth(side, s, 0.02)
            knock = v["knock"] * 0.03 / (s.t[1] - s.t[0]) * _smooth(_smooth(knocks, s, 0.015), s, 0.015)
            out += np.stack([-knock / 2, -lean, -knock / 2, lean], 1)
        return out

    return added_force(shift)


def whipping(v: Values) -> Stage:
    """A slender link of one finger: its tip lags and rings after every start and stop, past the encoders."""

    def stage(s: Signals, rng: Rng) -> Signals:
        w, z, dt = 2 * np.pi * v["frequency"], v["damping"], s.t[1] - s.t[0]
        finger = int(v["finger"])
        a = _smooth(np.gradient(s.motion.velocity[:, 2 * finger : 2 * finger + 2], s.t, axis=0), s, 0.01)
        pole = np.exp((-z + 1j * np.sqrt(1 - z * z)) * w * dt)
        den = [1, -2 * pole.real, abs(pole) ** 2]
        swing = np.asarray(lfilter([0, sum(den)], den, a, axis=0)) / w**2
        change = np.zeros_like(s.motion.position)
        change[:, 2 * finger : 2 * finger + 2] = v["share"] * swing * np.array([1.0, v["upright"]])
        return _seen(s, change)

    return stage


def snagging(v: Values) -> Stage:
    """A cable that catches on the bench, is stretched by one finger's way, springs free and catches anew."""

    def shift(s: Signals, rng: Rng) -> np.ndarray:
        finger, out = int(v["finger"]), np.zeros_like(s.force)
        place = s.motion.position[:, 2 * finger : 2 * finger + 2]
        caught, reach = place[0].copy(), v["reach"]
        for k, p in enumerate(place):
            if np.hypot(*(p - caught)) > reach:
                caught, reach = p.copy(), v["reach"] * rng.uniform(0.6, 1.4)
            out[k, 2 * finger : 2 * finger + 2] = v["force"] * (p - caught) / v["reach"]
        return _smooth(out, s, 0.008)

    return added_force(shift)


def crumbs(v: Values) -> Stage:
    """Crumbs on the bench: in some grasps one lies between a pad and the block, of whatever size."""

    def stage(s: Signals, rng: Rng) -> Signals:
        change = np.zeros_like(s.motion.position)
        for touch, part in zip(s.motion.boundaries[0::4], s.motion.boundaries[3::4], strict=True):
            thick = v["size"] * rng.uniform(0.4, 1.6) * (rng.random() < v["often"])
            finger = int(rng.integers(2))
            here = np.clip((s.t - touch) / 0.08 + 1, 0, 1) * np.clip(1 - (s.t - part) / 0.08, 0, 1)
            change[:, 2 * finger] += (-1.0, 1.0)[finger] * thick * here
        return _seen(s, change)

    return stage


OUTSIDE = {
    made.name: made
    for made in (
        fault("zero_tracking", lambda r, s: {"speed": 0.15 * s, "window": r.uniform(0.4, 0.9)},
              READOUT, tracking),
        fault("garbled_words", lambda r, s: {"bit": 0.02 * s, "share": r.uniform(0.02, 0.06),
                                             "joint": float(r.integers(4))}, ENCODER, garbled),
        fault("loose_ballast", lambda r, s: {"weight": 0.16 * s, "knock": 0.2 * s,
                                             "sticks": r.uniform(0.3, 0.6)}, HAND, ballast),
        fault("whipping_link", lambda r, s: {"share": 0.4 * s, "frequency": r.uniform(2.0, 4.0),
                                             "damping": r.uniform(0.04, 0.15), "upright": r.uniform(0.3, 1),
                                             "finger": float(r.integers(2))}, LINKS, whipping),
        fault("snagging_cable", lambda r, s: {"force": 0.35 * s, "reach": r.uniform(0.008, 0.02),
                                              "finger": float(r.integers(2))}, HAND, snagging),
        fault("crumbs", lambda r, s: {"size": 4e-4 * s, "often": r.uniform(0.5, 0.75)}, LINKS, crumbs),
    )
}  # fmt: skip
