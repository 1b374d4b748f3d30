"""Effects that no catalogue of the contract lists; each is something that happens to real rigs."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from experiments.blind_check.effects import Change, Made, Rng, Values, _force, _sign
from experiments.blind_check.signals import ENCODER, HAND, READOUT, SCALE, Signals, Stage


def _lazy(v: Values) -> Stage:
    """Force sensor with play (hysteresis): its reading follows the load at a distance."""

    def stage(s: Signals, rng: Rng) -> Signals:
        half, out = v["width"] / 2, s.force.copy()
        held = s.force[0]
        for k, row in enumerate(s.force):
            held = np.minimum(np.maximum(held, row - half), row + half)
            out[k] = held
        return replace(s, force=out)

    return stage


def _hum(v: Values) -> Stage:
    """Mains: all force channels, with a phase of its own in each trial."""

    def shift(s: Signals, rng: Rng) -> np.ndarray:
        phase = rng.uniform(0, 2 * np.pi)
        share = np.array([1.0, 0.7, -0.8, 0.6])
        return v["amplitude"] * np.sin(2 * np.pi * v["frequency"] * s.t + phase)[:, None] * share

    return _force(shift)


def _jump(v: Values) -> Stage:
    """A loose contact: one channel's zero jumps once in every trial, at any time."""

    def shift(s: Signals, rng: Rng) -> np.ndarray:
        at = rng.uniform(0.2, 0.8) * s.t[-1]
        out = np.zeros_like(s.force)
        out[:, int(v["channel"])] = v["height"] * (s.t > at)
        return out

    return _force(shift)


def _magnet(v: Values) -> Stage:
    """The table draws the fingertips down the more the nearer they are."""

    def shift(s: Signals, rng: Rng) -> np.ndarray:
        return np.array([0, 1, 0, 1]) * v["pull"] * np.exp(-s.motion.position[:, [1, 1, 3, 3]] / v["reach"])

    return _force(shift)


def _kinked(v: Values) -> Stage:
    """An overload spring: beyond a load each force channel has another gain."""

    def stage(s: Signals, rng: Rng) -> Signals:
        beyond = np.sign(s.force) * np.maximum(np.abs(s.force) - v["load"], 0.0)
        return replace(s, force=s.force + v["change"] * beyond)

    return stage


def _creeping(v: Values) -> Stage:
    """A sensor whose glue creeps: what it carries for long reads higher, and lingers when it is gone."""

    def stage(s: Signals, rng: Rng) -> Signals:
        slow = np.zeros_like(s.force)
        for k in range(1, len(slow)):
            share = 1 - np.exp(-(s.t[k] - s.t[k - 1]) / v["time"])
            slow[k] = slow[k - 1] + share * (s.force[k - 1] - slow[k - 1])
        return replace(s, force=s.force + v["share"] * slow)

    return stage


def _leaking(v: Values) -> Stage:
    """A bad cable: the second finger's reading holds a share of the first's."""
    first = [2, 3, 0, 1]
    return lambda s, rng: replace(s, force=s.force + v["share"] * s.force[:, first] * [0, 0, 1, 1])


def _ripple(v: Values) -> Stage:
    """Encoder discs off centre in their marks: an error that repeats several times a turn."""

    def stage(s: Signals, rng: Rng) -> Signals:
        assert s.q is not None and s.dq is not None
        n, phase = v["periods"], np.array([0.3, 1.9, 4.0, 5.2])
        wave = v["amplitude"] * np.sin(n * s.q + phase)
        rate = s.dq * (1 + v["amplitude"] * n * np.cos(n * s.q + phase))
        return replace(s, q=s.q + wave, dq=rate)

    return stage


def _dry(v: Values) -> Stage:
    """Dry friction of a sleeve on each finger: constant against the direction of motion."""
    return _force(lambda s, rng: v["force"] * np.tanh(s.motion.velocity / 0.004))


def _settling(v: Values) -> Stage:
    """Amplifiers switched on at the start of each trial: their gain settles."""

    def stage(s: Signals, rng: Rng) -> Signals:
        return replace(s, force=s.force * (1 + v["change"] * np.exp(-(s.t - s.t[0]) / v["time"]))[:, None])

    return stage


def _made(name: str, draw, stage: int, build) -> Made:
    return Made(name, draw, lambda v: Change(stages=((stage, build(v)),)), scored=False)


OUTSIDE = {
    made.name: made
    for made in (
        _made("force_hysteresis", lambda r, s: {"width": 0.4 * s}, READOUT, _lazy),
        _made("mains_hum", lambda r, s: {"amplitude": 0.12 * s, "frequency": 50 + r.uniform(-1, 1) * 7},
              READOUT, _hum),
        _made("zero_jump", lambda r, s: {"height": 0.25 * s * _sign(r), "channel": float(r.integers(4))},
              READOUT, _jump),
        _made("magnetic_table", lambda r, s: {"pull": 0.7 * s, "reach": r.uniform(0.006, 0.012)},
              HAND, _magnet),
        _made("kinked_gain", lambda r, s: {"change": 0.3 * s * _sign(r), "load": r.uniform(0.8, 1.6)},
              SCALE, _kinked),
        _made("encoder_ripple", lambda r, s: {"amplitude": 0.006 * s, "periods": float(r.integers(9, 22))},
              ENCODER, _ripple),
        _made("dry_sleeve", lambda r, s: {"force": 0.16 * s}, HAND, _dry),
        _made("settling_gain", lambda r, s: {"change": 0.15 * s * _sign(r), "time": r.uniform(1.0, 3.0)},
              SCALE, _settling),
        _made("sensor_creep", lambda r, s: {"share": 0.1 * s * _sign(r), "time": r.uniform(0.4, 2.0)},
              SCALE, _creeping),
        _made("finger_leak", lambda r, s: {"share": 0.06 * s * _sign(r)}, SCALE, _leaking),
    )
}  # fmt: skip
