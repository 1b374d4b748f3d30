"""Effects from outside the catalogue that act on the hand, its joints or what it touches."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.signal import lfilter

from experiments.blind_check.hand import angles, jacobians
from experiments.blind_check.signals import Signals, Stage
from experiments.blind_check.stages import Rng, Values, added_force


def magnet(v: Values) -> Stage:
    """The table draws the fingertips down the more the nearer they are."""

    def shift(s: Signals, rng: Rng) -> np.ndarray:
        return np.array([0, 1, 0, 1]) * v["pull"] * np.exp(-s.motion.position[:, [1, 1, 3, 3]] / v["reach"])

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


def dry(v: Values) -> Stage:
    """Dry friction of a sleeve on each finger: constant against the direction of motion."""
    return added_force(lambda s, rng: v["force"] * np.tanh(s.motion.velocity / 0.004))


def tacky(v: Values) -> Stage:
    """Tacky pads: a finger that lets go is held back by threads until it has drawn them out."""

    def shift(s: Signals, rng: Rng) -> np.ndarray:
        out = np.zeros_like(s.force)
        for part in s.motion.boundaries[3::4]:
            for channel, inwards in ((0, 1.0), (2, -1.0)):
                place, pressed = s.motion.position[:, channel:][:, :2], inwards * s.motion.force[:, channel]
                way = np.hypot(*(place - place[np.searchsorted(s.t, part)]).T) * (s.t > part)
                drawn = np.exp(-np.maximum.accumulate(way) / v["reach"])  # what has torn stays torn
                eased = np.exp(-np.maximum(pressed, 0.0) / 0.3) * (s.t > part - 0.1)
                out[:, channel] -= inwards * v["pull"] * drawn * eased
        return out

    return added_force(shift)


def uncounted(v: Values) -> Stage:
    """Incremental encoders that miss counts of joints that turn fast; homed before each trial."""

    def stage(s: Signals, rng: Rng) -> Signals:
        assert s.q is not None and s.dq is not None
        lost = v["missed"] * np.sign(s.dq) * np.maximum(np.abs(s.dq) - v["speed"], 0.0)
        return replace(s, q=s.q - np.cumsum(lost, 0) * (s.t[1] - s.t[0]), dq=s.dq - lost)

    return stage


def curtained(v: Values) -> Stage:
    """A soft guard right of the workspace: the second finger pushes into it and rubs along it."""

    def shift(s: Signals, rng: Rng) -> np.ndarray:
        out = np.zeros_like(s.force)
        out[:, 2] = v["stiffness"] * np.maximum(s.motion.position[:, 2] - v["place"], 0.0)
        out[:, 3] = v["friction"] * out[:, 2] * np.tanh(s.motion.velocity[:, 3] / 0.004)
        return out

    return added_force(shift)


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


def bending(v: Values) -> Stage:
    """Unsymmetrical bending: a finger that presses sideways gives way in height, past its encoders."""

    def stage(s: Signals, rng: Rng) -> Signals:
        keep = np.exp(-(s.t[1] - s.t[0]) / 0.005)
        load = np.abs(s.motion.force[:, 0::2])
        load = np.asarray(lfilter([1 - keep], [1, -keep], load, axis=0, zi=keep * load[:1])[0])
        give = np.repeat(load, 2, axis=1) * np.array([0, v["give1"], 0, v["give2"]])
        place, rate = s.motion.position + give, s.motion.velocity + np.gradient(give, s.t, axis=0)
        return replace(s, motion=replace(s.motion, position=place, velocity=rate))

    return stage


def nozzle(v: Values) -> Stage:
    """A cooling nozzle above the workspace: its gusty jet presses on a finger that passes below it."""

    def shift(s: Signals, rng: Rng) -> np.ndarray:
        keep = np.exp(-(s.t[1] - s.t[0]) / 0.15)
        steps = np.sqrt(1 - keep**2) * rng.standard_normal(len(s.t))
        gusts = 1 + 0.15 * np.asarray(lfilter([1.0], [1.0, -keep], steps))
        jet = v["push"] * np.exp(-(((s.motion.position[:, 0::2] - v["place"]) / v["radius"]) ** 2))
        return np.repeat(jet * gusts[:, None], 2, axis=1) * np.array([v["slant"], 1.0] * 2)

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
        rate = s.motion.velocity + np.gradient(place - true, s.t, axis=0)
        return replace(s, motion=replace(s.motion, position=place, velocity=rate))

    return stage


def tied(v: Values) -> Stage:
    """Wiring tied across both fingers: slack while they are close, it pulls them together when they open."""

    def shift(s: Signals, rng: Rng) -> np.ndarray:
        way = s.motion.position[:, 2:] - s.motion.position[:, :2]
        apart = np.hypot(*way.T)[:, None]
        pull = v["stiffness"] * np.maximum(apart - v["slack"], 0.0) * way / apart
        return np.concatenate([-pull, pull], 1)

    return added_force(shift)


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


def blunted(v: Values) -> Stage:
    """Drives that smooth the speeds they report: rates come late and blunt, angles do not."""

    def stage(s: Signals, rng: Rng) -> Signals:
        assert s.dq is not None
        keep = np.exp(-(s.t[1] - s.t[0]) / v["time"])
        return replace(s, dq=np.asarray(lfilter([1 - keep], [1, -keep], s.dq, axis=0, zi=keep * s.dq[:1])[0]))

    return stage


def crumpled(v: Values) -> Stage:
    """Blocks of cardboard: where they are gripped they dent, and do not spring back while they are held."""

    def stage(s: Signals, rng: Rng) -> Signals:
        keep = np.exp(-(s.t[1] - s.t[0]) / 0.005)
        load = s.motion.force[:, 0::2] * np.array([1.0, -1.0])
        load = np.asarray(lfilter([1 - keep], [1, -keep], load, axis=0, zi=keep * load[:1])[0])
        dent = np.zeros_like(s.motion.position)
        for touch, part in zip(s.motion.boundaries[0::4], s.motion.boundaries[3::4], strict=True):
            pressed = load * ((s.t >= touch) & (s.t <= part))[:, None]
            most = np.maximum.accumulate(np.maximum(pressed - v["bears"], 0.0))  # what is dented stays dented
            left = 1 - np.clip((s.t - part) / 0.05, 0, 1)  # the finger that opens catches up
            dent[:, 0::2] += v["give"] * most * left[:, None] * np.array([1.0, -1.0])
        place, rate = s.motion.position + dent, s.motion.velocity + np.gradient(dent, s.t, axis=0)
        return replace(s, motion=replace(s.motion, position=place, velocity=rate))

    return stage


def knocked(v: Values) -> Stage:
    """Somebody knocks against the bench now and then: both fingertips' masses swing, whatever they do."""

    def shift(s: Signals, rng: Rng) -> np.ndarray:
        out = np.zeros_like(s.force)
        for at in rng.uniform(0.05, 0.95, int(v["knocks"])) * s.t[-1]:
            since, way = np.maximum(s.t - at, 0.0), rng.uniform(0, 2 * np.pi)
            swing = np.exp(-since / v["decay"]) * np.sin(2 * np.pi * v["frequency"] * since)
            out += rng.uniform(0.6, 1.4) * swing[:, None] * np.array([np.cos(way), np.sin(way)] * 2)
        return v["amplitude"] * out

    return added_force(shift)


def sagging(v: Values) -> Stage:
    """A hand that turns about its clamp: every load lets it sag on; it is set up anew before each trial."""

    def stage(s: Signals, rng: Rng) -> Signals:
        load = np.cumsum(np.hypot(*(s.motion.force[:, :2] + s.motion.force[:, 2:]).T))
        sag = v["angle"] * rng.uniform(0.8, 1.2) * load / load[-1]
        turn, rate = np.exp(1j * sag)[:, None], np.gradient(sag, s.t)[:, None]
        place, speed, force = (
            a[:, 0::2] + 1j * a[:, 1::2] for a in (s.motion.position, s.motion.velocity, s.force)
        )
        clamp = v["x"] + 1j * v["y"]
        seen = clamp + (place - clamp) * turn, (speed + 1j * rate * (place - clamp)) * turn, force * turn
        place, speed, force = (np.stack([a.real, a.imag], 2).reshape(-1, 4) for a in seen)
        return replace(s, motion=replace(s.motion, position=place, velocity=speed), force=force)

    return stage
