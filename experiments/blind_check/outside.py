"""Effects outside the contract's catalogue; each occurs on real rigs.

They were drawn in sets whose answers are out. A set that is to judge effects first seen takes them from a
file that is kept apart (`--outside FILE.py`). The 34 other kinds of earlier sets stand in commit f82105c.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.signal import lfilter

from experiments.blind_check.effects import _sign, fault
from experiments.blind_check.hand import angles, jacobians
from experiments.blind_check.signals import (
    ENCODER,
    HAND,
    LINKS,
    READOUT,
    SCALE,
    Rng,
    Signals,
    Stage,
    Values,
    added_force,
)


def _smooth(x: np.ndarray, s: Signals, time: float) -> np.ndarray:
    """A first-order low-pass from rest."""
    keep = np.exp(-(s.t[1] - s.t[0]) / time)
    return np.asarray(lfilter([1 - keep], [1, -keep], x, axis=0, zi=keep * x[:1])[0])


def _seen(s: Signals, change: np.ndarray) -> Signals:
    """Move the true tips away from where the encoders show them."""
    place, rate = s.motion.position + change, s.motion.velocity + np.gradient(change, s.t, axis=0)
    return replace(s, motion=replace(s.motion, position=place, velocity=rate))


def lazy(v: Values) -> Stage:
    """Force sensor with play (hysteresis): its reading follows the load at a distance."""

    def stage(s: Signals, rng: Rng) -> Signals:
        half, out = v["width"] / 2, s.force.copy()
        held = s.force[0]
        for k, row in enumerate(s.force):
            held = np.minimum(np.maximum(held, row - half), row + half)
            out[k] = held
        return replace(s, force=out)

    return stage


def hum(v: Values) -> Stage:
    """Mains hum on all force channels, with a random phase in each trial."""

    def shift(s: Signals, rng: Rng) -> np.ndarray:
        phase = rng.uniform(0, 2 * np.pi)
        share = np.array([1.0, 0.7, -0.8, 0.6])
        return v["amplitude"] * np.sin(2 * np.pi * v["frequency"] * s.t + phase)[:, None] * share

    return added_force(shift)


def jump(v: Values) -> Stage:
    """A loose contact: one channel's zero jumps once in every trial, at any time."""

    def shift(s: Signals, rng: Rng) -> np.ndarray:
        at = rng.uniform(0.2, 0.8) * s.t[-1]
        out = np.zeros_like(s.force)
        out[:, int(v["channel"])] = v["height"] * (s.t > at)
        return out

    return added_force(shift)


def kinked(v: Values) -> Stage:
    """An overload spring: beyond a load each force channel has another gain."""

    def stage(s: Signals, rng: Rng) -> Signals:
        beyond = np.sign(s.force) * np.maximum(np.abs(s.force) - v["load"], 0.0)
        return replace(s, force=s.force + v["change"] * beyond)

    return stage


def posed(v: Values) -> Stage:
    """Strain gauges next to the joint: a finger's gain depends on its outer link's angle."""

    def stage(s: Signals, rng: Rng) -> Signals:
        assert s.q is not None
        turned = np.repeat(s.q[:, 1::2] - s.q[0, 1::2], 2, axis=1)
        return replace(s, force=s.force * (1 + turned * np.repeat([v["slope1"], v["slope2"]], 2)))

    return stage


def wandering(v: Values) -> Stage:
    """A draught about warm strain gauges: every force channel's zero wanders at random."""

    def shift(s: Signals, rng: Rng) -> np.ndarray:
        keep = np.exp(-(s.t[1] - s.t[0]) / v["time"])
        steps = np.sqrt(1 - keep**2) * rng.standard_normal(s.force.shape)
        start = keep * rng.standard_normal((1, 4))
        return v["rms"] * np.asarray(lfilter([1.0], [1.0, -keep], steps, axis=0, zi=start)[0])

    return added_force(shift)


def behind(v: Values) -> Stage:
    """Two boards polled in turn: the second finger's data are older than their time stamps."""

    def stage(s: Signals, rng: Rng) -> Signals:
        assert s.q is not None and s.dq is not None

        def aged(values: np.ndarray) -> np.ndarray:
            late = [np.interp(s.t - v["age"], s.t, c) for c in values[:, 2:].T]
            return np.concatenate([values[:, :2], np.stack(late, 1)], 1)

        return replace(s, q=aged(s.q), dq=aged(s.dq), force=aged(s.force))

    return stage


def remembered(v: Values) -> Stage:
    """A sensor's elastomer keeps a share of the heaviest load so far for as long as it bears less."""

    def shift(s: Signals, rng: Rng) -> np.ndarray:
        most = np.maximum.accumulate(np.abs(s.force), axis=0)
        return v["share"] * np.sign(s.force) * (most - np.abs(s.force)) * (np.abs(s.force) > 0.05)

    return added_force(shift)


def ripple(v: Values) -> Stage:
    """Encoder discs off centre in their marks: an error that repeats several times a turn."""

    def stage(s: Signals, rng: Rng) -> Signals:
        assert s.q is not None and s.dq is not None
        n, phase = v["periods"], np.array([0.3, 1.9, 4.0, 5.2])
        wave = v["amplitude"] * np.sin(n * s.q + phase)
        rate = s.dq * (1 + v["amplitude"] * n * np.cos(n * s.q + phase))
        return replace(s, q=s.q + wave, dq=rate)

    return stage


def tendons(v: Values) -> Stage:
    """Tendons to the outer links led over the inner joints: their motors' encoders count these turns too."""

    def stage(s: Signals, rng: Rng) -> Signals:
        assert s.q is not None and s.dq is not None
        share = np.array([v["share1"], v["share2"]])
        q, dq = s.q.copy(), s.dq.copy()
        q[:, 1::2] += share * (s.q[:, 0::2] - s.q[0, 0::2])
        dq[:, 1::2] += share * s.dq[:, 0::2]
        return replace(s, q=q, dq=dq)

    return stage


def loosened(v: Values) -> Stage:
    """A set screw come loose: a link slips on its shaft when a grip loads it most, past its encoder."""

    def stage(s: Signals, rng: Rng) -> Signals:
        assert s.q is not None and s.dq is not None
        joint, q, dq = int(v["joint"]), s.q.copy(), s.dq.copy()
        load = np.einsum("nfxj,nfx->nfj", jacobians(s.rig, s.q), s.motion.force.reshape(-1, 2, 2))
        torque = load.reshape(-1, 4)[:, joint]
        for touch, part in zip(s.motion.boundaries[0::4], s.motion.boundaries[3::4], strict=True):
            begin, end = np.searchsorted(s.t, [touch, part])
            most = begin + int(np.abs(torque[begin:end]).argmax())
            slip = v["angle"] * rng.uniform(0.7, 1.3) * np.sign(torque[most])
            way = slip * np.clip((s.t - s.t[most]) / 0.04, 0, 1)
            q[:, joint] += way
            dq[:, joint] += np.gradient(way, s.t)
        return replace(s, q=q, dq=dq)

    return stage


def magnet(v: Values) -> Stage:
    """The table attracts the fingertips, more strongly the nearer they are."""

    def shift(s: Signals, rng: Rng) -> np.ndarray:
        return np.array([0, 1, 0, 1]) * v["pull"] * np.exp(-s.motion.position[:, [1, 1, 3, 3]] / v["reach"])

    return added_force(shift)


def dry(v: Values) -> Stage:
    """Dry friction of a sleeve on each finger: constant against the direction of motion."""
    return added_force(lambda s, rng: v["force"] * np.tanh(s.motion.velocity / 0.004))


def clinging(v: Values) -> Stage:
    """Gummy feet: a block that is lifted peels off what it stood on and holds the fingers back."""

    def shift(s: Signals, rng: Rng) -> np.ndarray:
        out = np.zeros_like(s.force)
        for block, leave in enumerate(s.motion.boundaries[1::4]):
            height = s.motion.centres[:, block, 1]
            way = np.maximum(height - height[np.searchsorted(s.t, leave)], 0.0) * (s.t > leave)
            peeled = np.exp(-np.maximum.accumulate(way) / v["reach"])  # what has come off stays off
            drawn = np.clip(1 + (s.t - leave) / v["build"], 0, 1)
            pull = v["pull"] * rng.uniform(0.85, 1.15) * drawn * peeled
            out[:, [1, 3]] += pull[:, None] / 2
        return out

    return added_force(shift)


def tied(v: Values) -> Stage:
    """Wiring tied across both fingers: slack while they are close, it pulls them together when they open."""

    def shift(s: Signals, rng: Rng) -> np.ndarray:
        way = s.motion.position[:, 2:] - s.motion.position[:, :2]
        apart = np.hypot(*way.T)[:, None]
        pull = v["stiffness"] * np.maximum(apart - v["slack"], 0.0) * way / apart
        return np.concatenate([-pull, pull], 1)

    return added_force(shift)


def snagging(v: Values) -> Stage:
    """A cable that catches on the bench, is stretched by one finger's way, springs free and catches again."""

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


def rolling(v: Values) -> Stage:
    """Round fingertips that roll as their links turn: the point that touches leaves the one assumed."""

    def stage(s: Signals, rng: Rng) -> Signals:
        made_for = np.array([[v["x"] - 0.01, v["y"], v["x"] + 0.01, v["y"]]])
        true, place = s.motion.position, s.motion.position
        for _ in range(6):
            turned = angles(s.rig, place)[:, 1::2] - angles(s.rig, made_for)[:, 1::2]
            way = np.stack([np.cos(turned) - 1, np.sin(turned)], 2) * np.array([[1.0], [-1.0]])
            place = true + v["radius"] * way.reshape(-1, 4)
        return _seen(s, place - true)

    return stage


def mounted(v: Values) -> Stage:
    """A mount that yields: both fingers move with the load they carry together, past their encoders."""

    def stage(s: Signals, rng: Rng) -> Signals:
        keep = np.exp(-(s.t[1] - s.t[0]) / 0.01)
        load = s.motion.force[:, :2] + s.motion.force[:, 2:]
        load = np.asarray(lfilter([1 - keep], [1, -keep], load, axis=0))
        give = np.tile(load * np.array([v["along"], v["down"]]), 2)
        return _seen(s, give)

    return stage


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


OUTSIDE = {
    made.name: made
    for made in (
        fault("force_hysteresis", lambda r, s: {"width": 0.4 * s}, READOUT, lazy),
        fault("mains_hum", lambda r, s: {"amplitude": 0.12 * s, "frequency": 50 + r.uniform(-1, 1) * 7},
              READOUT, hum),
        fault("zero_jump", lambda r, s: {"height": 0.25 * s * _sign(r), "channel": float(r.integers(4))},
              READOUT, jump),
        fault("kinked_gain", lambda r, s: {"change": 0.3 * s * _sign(r), "load": r.uniform(0.8, 1.6)},
              SCALE, kinked),
        fault("pose_gain", lambda r, s: {"slope1": 0.35 * s * _sign(r),
                                         "slope2": 0.35 * s * r.uniform(-1, 1)}, SCALE, posed),
        fault("zero_wander", lambda r, s: {"rms": 0.18 * s, "time": r.uniform(0.2, 0.6)},
              READOUT, wandering),
        fault("late_board", lambda r, s: {"age": 0.015 * s}, READOUT, behind),
        fault("remembered_load", lambda r, s: {"share": 0.12 * s * _sign(r)}, READOUT, remembered),
        fault("encoder_ripple", lambda r, s: {"amplitude": 0.006 * s, "periods": float(r.integers(9, 22))},
              ENCODER, ripple),
        fault("tendon_coupling", lambda r, s: {"share1": 0.04 * s * _sign(r),
                                               "share2": 0.04 * s * _sign(r) * r.uniform(0.5, 1)},
              ENCODER, tendons),
        fault("slipping_hub", lambda r, s: {"angle": 0.02 * s, "joint": float(r.integers(4))},
              ENCODER, loosened),
        fault("magnetic_table", lambda r, s: {"pull": 0.7 * s, "reach": r.uniform(0.006, 0.012)},
              HAND, magnet),
        fault("dry_sleeve", lambda r, s: {"force": 0.16 * s}, HAND, dry),
        fault("clinging_feet", lambda r, s: {"pull": 1.6 * s, "reach": r.uniform(0.003, 0.008),
                                             "build": r.uniform(0.1, 0.2)},
              HAND, clinging),
        fault("tied_wiring", lambda r, s: {"stiffness": 30 * s, "slack": r.uniform(0.022, 0.028)},
              HAND, tied),
        fault("snagging_cable", lambda r, s: {"force": 0.35 * s, "reach": r.uniform(0.008, 0.02),
                                              "finger": float(r.integers(2))}, HAND, snagging),
        fault("sloshing_blocks", lambda r, s: {"mass": 0.2 * s, "frequency": r.uniform(1.8, 4),
                                               "damping": r.uniform(0.02, 0.1)}, HAND, sloshing),
        fault("rolling_tips", lambda r, s: {"radius": 0.004 * s, "x": r.uniform(0.1, 0.14),
                                            "y": r.uniform(0.01, 0.04)},
              LINKS, rolling),
        fault("yielding_mount", lambda r, s: {"down": 1e-3 * s, "along": 1e-3 * s * r.uniform(-1, 1)},
              LINKS, mounted),
        fault("whipping_link", lambda r, s: {"share": 0.4 * s, "frequency": r.uniform(2.0, 4.0),
                                             "damping": r.uniform(0.04, 0.15), "upright": r.uniform(0.3, 1),
                                             "finger": float(r.integers(2))}, LINKS, whipping),
    )
}  # fmt: skip
