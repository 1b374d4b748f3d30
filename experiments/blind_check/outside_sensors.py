"""Effects from outside the catalogue that act on what force sensors read."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.signal import lfilter

from experiments.blind_check.hand import jacobians
from experiments.blind_check.signals import Signals, Stage
from experiments.blind_check.stages import Rng, Values, added_force


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
    """Mains: all force channels, with a phase of its own in each trial."""

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


def creeping(v: Values) -> Stage:
    """A sensor whose glue creeps: what it carries for long reads higher, and lingers when it is gone."""

    def stage(s: Signals, rng: Rng) -> Signals:
        slow = np.zeros_like(s.force)
        for k in range(1, len(slow)):
            share = 1 - np.exp(-(s.t[k] - s.t[k - 1]) / v["time"])
            slow[k] = slow[k - 1] + share * (s.force[k - 1] - slow[k - 1])
        return replace(s, force=s.force + v["share"] * slow)

    return stage


def leaking(v: Values) -> Stage:
    """A bad cable: the second finger's reading holds a share of the first's."""
    first = [2, 3, 0, 1]
    return lambda s, rng: replace(s, force=s.force + v["share"] * s.force[:, first] * [0, 0, 1, 1])


def settling(v: Values) -> Stage:
    """Amplifiers switched on at the start of each trial: their gain settles."""

    def stage(s: Signals, rng: Rng) -> Signals:
        return replace(s, force=s.force * (1 + v["change"] * np.exp(-(s.t - s.t[0]) / v["time"]))[:, None])

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
    """Two boards polled in turn: all that the second finger's says is older than its time stamp."""

    def stage(s: Signals, rng: Rng) -> Signals:
        assert s.q is not None and s.dq is not None

        def aged(values: np.ndarray) -> np.ndarray:
            late = [np.interp(s.t - v["age"], s.t, c) for c in values[:, 2:].T]
            return np.concatenate([values[:, :2], np.stack(late, 1)], 1)

        return replace(s, q=aged(s.q), dq=aged(s.dq), force=aged(s.force))

    return stage


def flickering(v: Values) -> Stage:
    """A broken strand in one finger's plug: for moments its supply sags, and so does what it reads."""

    def stage(s: Signals, rng: Rng) -> Signals:
        share, k = np.zeros((len(s.t), 1)), 0.0
        while (k := k + rng.exponential(v["apart"])) < s.t[-1]:
            until = k + rng.exponential(v["lasting"])
            share[(s.t >= k) & (s.t < until)] = v["loss"] * rng.uniform(0.5, 1.0)
            k = until
        finger = np.repeat(np.arange(2) == int(v["finger"]), 2)
        return replace(s, force=s.force * (1 - share * finger))

    return stage


def cogging(v: Values) -> Stage:
    """Forces told from the joints' torques, which ripple with every tooth that the gears turn on."""

    def stage(s: Signals, rng: Rng) -> Signals:
        assert s.q is not None
        torque = v["torque"] * np.sin(v["teeth"] * s.q + np.array([0.8, 2.9, 5.0, 1.4]))
        turned = np.swapaxes(jacobians(s.rig, s.q), 2, 3)
        force = np.linalg.solve(turned, torque.reshape(-1, 2, 2)[..., None])[..., 0]
        return replace(s, force=s.force + force.reshape(-1, 4))

    return stage


def rectified(v: Values) -> Stage:
    """Strain amplifiers rectify what the motors' drives emit: zeros shift with speed, either way alike."""

    def shift(s: Signals, rng: Rng) -> np.ndarray:
        assert s.dq is not None
        speed = np.repeat(np.hypot(s.dq[:, 0::2], s.dq[:, 1::2]), 2, axis=1)
        share = np.array([1.0, v["share"], -0.7, 0.8])
        return v["height"] * share * speed**2 / (speed**2 + v["speed"] ** 2)

    return added_force(shift)


def tared(v: Values) -> Stage:
    """Sensors tared as they hang at the start: what they weigh turns up again as their links turn."""

    def stage(s: Signals, rng: Rng) -> Signals:
        assert s.q is not None
        turned = s.q[:, 1::2] - s.q[0, 1::2]
        shift = np.stack([np.sin(turned), 1 - np.cos(turned)], 2) * np.array([[v["weight1"]], [v["weight2"]]])
        return replace(s, force=s.force + shift.reshape(-1, 4))

    return stage


def frozen(v: Values) -> Stage:
    """A bus that loses frames in bursts: one finger's last numbers are written until new ones come."""

    def stage(s: Signals, rng: Rng) -> Signals:
        assert s.q is not None and s.dq is not None
        last, k = np.arange(len(s.t)), 0.0
        while (k := k + rng.exponential(v["apart"])) < s.t[-1]:
            until = k + v["lasting"] * rng.uniform(0.5, 1.5)
            lost = (s.t >= k) & (s.t < until)
            last[lost] = np.searchsorted(s.t, k) - 1
            k = until
        finger = np.repeat(np.arange(2) == int(v["finger"]), 2)
        q, dq, force = (np.where(finger, values[last], values) for values in (s.q, s.dq, s.force))
        return replace(s, q=q, dq=dq, force=force)

    return stage


def capacitive(v: Values) -> Stage:
    """Capacitive sensors zeroed in an open hand: they feel the other finger come near as if it pressed."""

    def shift(s: Signals, rng: Rng) -> np.ndarray:
        near = 0.016 / np.hypot(*(s.motion.position[:, 2:] - s.motion.position[:, :2]).T)
        share = np.array([1.0, v["lean1"], -v["share"], v["lean2"]])
        return v["height"] * (near - near[0])[:, None] * share

    return added_force(shift)


def stuck(v: Values) -> Stage:
    """A converter with a bit stuck: one finger's readings miss every other stretch of their range."""

    def shift(s: Signals, rng: Rng) -> np.ndarray:
        origin = np.array([v["origin1"], v["origin2"]] * 2)
        is_set = np.floor(s.force / v["bit"] + origin) % 2
        finger = np.repeat(np.arange(2) == int(v["finger"]), 2)
        return v["bit"] * (v["value"] - is_set) * finger

    return added_force(shift)


def grounded(v: Values) -> Stage:
    """Metal blocks close a ground loop: while both fingers touch one, a current shifts the zeros."""

    def shift(s: Signals, rng: Rng) -> np.ndarray:
        pressed = np.maximum(np.minimum(s.motion.force[:, 0], -s.motion.force[:, 2]), 0.0)
        current = pressed / (pressed + v["load"])  # contacts conduct the better the firmer they are
        share = np.array([v["share1"], 1.0, v["share2"], v["share3"]])
        return v["height"] * current[:, None] * share

    return added_force(shift)
