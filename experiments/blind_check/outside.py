"""Effects that no catalogue of the contract lists; each is something that happens to real rigs."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.signal import lfilter

from experiments.blind_check.effects import Change, Made, Rng, Values, _force, _sign
from experiments.blind_check.hand import angles, jacobians
from experiments.blind_check.signals import ENCODER, HAND, LINKS, MIX, READOUT, SCALE, Signals, Stage


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


def _wandering(v: Values) -> Stage:
    """A draught about warm strain gauges: every force channel's zero wanders at random."""

    def shift(s: Signals, rng: Rng) -> np.ndarray:
        keep = np.exp(-(s.t[1] - s.t[0]) / v["time"])
        steps = np.sqrt(1 - keep**2) * rng.standard_normal(s.force.shape)
        start = keep * rng.standard_normal((1, 4))
        return v["rms"] * np.asarray(lfilter([1.0], [1.0, -keep], steps, axis=0, zi=start)[0])

    return _force(shift)


def _behind(v: Values) -> Stage:
    """Two boards polled in turn: all that the second finger's says is older than its time stamp."""

    def stage(s: Signals, rng: Rng) -> Signals:
        assert s.q is not None and s.dq is not None

        def aged(values: np.ndarray) -> np.ndarray:
            late = [np.interp(s.t - v["age"], s.t, c) for c in values[:, 2:].T]
            return np.concatenate([values[:, :2], np.stack(late, 1)], 1)

        return replace(s, q=aged(s.q), dq=aged(s.dq), force=aged(s.force))

    return stage


def _tacky(v: Values) -> Stage:
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

    return _force(shift)


def _flickering(v: Values) -> Stage:
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


def _uncounted(v: Values) -> Stage:
    """Incremental encoders that miss counts of joints that turn fast; homed before each trial."""

    def stage(s: Signals, rng: Rng) -> Signals:
        assert s.q is not None and s.dq is not None
        lost = v["missed"] * np.sign(s.dq) * np.maximum(np.abs(s.dq) - v["speed"], 0.0)
        return replace(s, q=s.q - np.cumsum(lost, 0) * (s.t[1] - s.t[0]), dq=s.dq - lost)

    return stage


def _curtained(v: Values) -> Stage:
    """A soft guard right of the workspace: the second finger pushes into it and rubs along it."""

    def shift(s: Signals, rng: Rng) -> np.ndarray:
        out = np.zeros_like(s.force)
        out[:, 2] = v["stiffness"] * np.maximum(s.motion.position[:, 2] - v["place"], 0.0)
        out[:, 3] = v["friction"] * out[:, 2] * np.tanh(s.motion.velocity[:, 3] / 0.004)
        return out

    return _force(shift)


def _clinging(v: Values) -> Stage:
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

    return _force(shift)


def _tendons(v: Values) -> Stage:
    """Tendons to the outer links led over the inner joints: their motors' encoders count these turns too."""

    def stage(s: Signals, rng: Rng) -> Signals:
        assert s.q is not None and s.dq is not None
        share = np.array([v["share1"], v["share2"]])
        q, dq = s.q.copy(), s.dq.copy()
        q[:, 1::2] += share * (s.q[:, 0::2] - s.q[0, 0::2])
        dq[:, 1::2] += share * s.dq[:, 0::2]
        return replace(s, q=q, dq=dq)

    return stage


def _cogging(v: Values) -> Stage:
    """Forces told from the joints' torques, which ripple with every tooth that the gears turn on."""

    def stage(s: Signals, rng: Rng) -> Signals:
        assert s.q is not None
        torque = v["torque"] * np.sin(v["teeth"] * s.q + np.array([0.8, 2.9, 5.0, 1.4]))
        turned = np.swapaxes(jacobians(s.rig, s.q), 2, 3)
        force = np.linalg.solve(turned, torque.reshape(-1, 2, 2)[..., None])[..., 0]
        return replace(s, force=s.force + force.reshape(-1, 4))

    return stage


def _rectified(v: Values) -> Stage:
    """Strain amplifiers rectify what the motors' drives emit: zeros shift with speed, either way alike."""

    def shift(s: Signals, rng: Rng) -> np.ndarray:
        assert s.dq is not None
        speed = np.repeat(np.hypot(s.dq[:, 0::2], s.dq[:, 1::2]), 2, axis=1)
        share = np.array([1.0, v["share"], -0.7, 0.8])
        return v["height"] * share * speed**2 / (speed**2 + v["speed"] ** 2)

    return _force(shift)


def _bending(v: Values) -> Stage:
    """Unsymmetrical bending: a finger that presses sideways gives way in height, past its encoders."""

    def stage(s: Signals, rng: Rng) -> Signals:
        keep = np.exp(-(s.t[1] - s.t[0]) / 0.005)
        load = np.abs(s.motion.force[:, 0::2])
        load = np.asarray(lfilter([1 - keep], [1, -keep], load, axis=0, zi=keep * load[:1])[0])
        give = np.repeat(load, 2, axis=1) * np.array([0, v["give1"], 0, v["give2"]])
        place, rate = s.motion.position + give, s.motion.velocity + np.gradient(give, s.t, axis=0)
        return replace(s, motion=replace(s.motion, position=place, velocity=rate))

    return stage


def _nozzle(v: Values) -> Stage:
    """A cooling nozzle above the workspace: its gusty jet presses on a finger that passes below it."""

    def shift(s: Signals, rng: Rng) -> np.ndarray:
        keep = np.exp(-(s.t[1] - s.t[0]) / 0.15)
        steps = np.sqrt(1 - keep**2) * rng.standard_normal(len(s.t))
        gusts = 1 + 0.15 * np.asarray(lfilter([1.0], [1.0, -keep], steps))
        jet = v["push"] * np.exp(-(((s.motion.position[:, 0::2] - v["place"]) / v["radius"]) ** 2))
        return np.repeat(jet * gusts[:, None], 2, axis=1) * np.array([v["slant"], 1.0] * 2)

    return _force(shift)


def _tared(v: Values) -> Stage:
    """Sensors tared as they hang at the start: what they weigh turns up again as their links turn."""

    def stage(s: Signals, rng: Rng) -> Signals:
        assert s.q is not None
        turned = s.q[:, 1::2] - s.q[0, 1::2]
        shift = np.stack([np.sin(turned), 1 - np.cos(turned)], 2) * np.array([[v["weight1"]], [v["weight2"]]])
        return replace(s, force=s.force + shift.reshape(-1, 4))

    return stage


def _rolling(v: Values) -> Stage:
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


def _tied(v: Values) -> Stage:
    """Wiring tied across both fingers: slack while they are close, it pulls them together when they open."""

    def shift(s: Signals, rng: Rng) -> np.ndarray:
        way = s.motion.position[:, 2:] - s.motion.position[:, :2]
        apart = np.hypot(*way.T)[:, None]
        pull = v["stiffness"] * np.maximum(apart - v["slack"], 0.0) * way / apart
        return np.concatenate([-pull, pull], 1)

    return _force(shift)


def _frozen(v: Values) -> Stage:
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


def _loosened(v: Values) -> Stage:
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


def _capacitive(v: Values) -> Stage:
    """Capacitive sensors zeroed in an open hand: they feel the other finger come near as if it pressed."""

    def shift(s: Signals, rng: Rng) -> np.ndarray:
        near = 0.016 / np.hypot(*(s.motion.position[:, 2:] - s.motion.position[:, :2]).T)
        share = np.array([1.0, v["lean1"], -v["share"], v["lean2"]])
        return v["height"] * (near - near[0])[:, None] * share

    return _force(shift)


def _blunted(v: Values) -> Stage:
    """Drives that smooth the speeds they report: rates come late and blunt, angles do not."""

    def stage(s: Signals, rng: Rng) -> Signals:
        assert s.dq is not None
        keep = np.exp(-(s.t[1] - s.t[0]) / v["time"])
        return replace(s, dq=np.asarray(lfilter([1 - keep], [1, -keep], s.dq, axis=0, zi=keep * s.dq[:1])[0]))

    return stage


def _stuck(v: Values) -> Stage:
    """A converter with a bit stuck: one finger's readings miss every other stretch of their range."""

    def shift(s: Signals, rng: Rng) -> np.ndarray:
        origin = np.array([v["origin1"], v["origin2"]] * 2)
        is_set = np.floor(s.force / v["bit"] + origin) % 2
        finger = np.repeat(np.arange(2) == int(v["finger"]), 2)
        return v["bit"] * (v["value"] - is_set) * finger

    return _force(shift)


def _crumpled(v: Values) -> Stage:
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


def _knocked(v: Values) -> Stage:
    """Somebody knocks against the bench now and then: both fingertips' masses swing, whatever they do."""

    def shift(s: Signals, rng: Rng) -> np.ndarray:
        out = np.zeros_like(s.force)
        for at in rng.uniform(0.05, 0.95, int(v["knocks"])) * s.t[-1]:
            since, way = np.maximum(s.t - at, 0.0), rng.uniform(0, 2 * np.pi)
            swing = np.exp(-since / v["decay"]) * np.sin(2 * np.pi * v["frequency"] * since)
            out += rng.uniform(0.6, 1.4) * swing[:, None] * np.array([np.cos(way), np.sin(way)] * 2)
        return v["amplitude"] * out

    return _force(shift)


def _grounded(v: Values) -> Stage:
    """Metal blocks close a ground loop: while both fingers touch one, a current shifts the zeros."""

    def shift(s: Signals, rng: Rng) -> np.ndarray:
        pressed = np.maximum(np.minimum(s.motion.force[:, 0], -s.motion.force[:, 2]), 0.0)
        current = pressed / (pressed + v["load"])  # contacts conduct the better the firmer they are
        share = np.array([v["share1"], 1.0, v["share2"], v["share3"]])
        return v["height"] * current[:, None] * share

    return _force(shift)


def _sagging(v: Values) -> Stage:
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
        _made("zero_wander", lambda r, s: {"rms": 0.18 * s, "time": r.uniform(0.2, 0.6)},
              READOUT, _wandering),
        _made("late_board", lambda r, s: {"age": 0.015 * s}, READOUT, _behind),
        _made("tacky_pads", lambda r, s: {"pull": 0.8 * s, "reach": r.uniform(0.003, 0.006)},
              HAND, _tacky),
        _made("flickering_supply", lambda r, s: {"loss": 0.5 * s, "finger": float(r.integers(2)),
                                                 "apart": r.uniform(0.3, 0.6),
                                                 "lasting": r.uniform(0.06, 0.15)},
              SCALE, _flickering),
        _made("missed_counts", lambda r, s: {"missed": 0.08 * s, "speed": r.uniform(0.25, 0.5)},
              ENCODER, _uncounted),
        _made("soft_guard", lambda r, s: {"stiffness": 45 * s, "place": r.uniform(0.138, 0.15),
                                          "friction": r.uniform(0.2, 0.5)},
              HAND, _curtained),
        _made("clinging_feet", lambda r, s: {"pull": 1.6 * s, "reach": r.uniform(0.003, 0.008),
                                             "build": r.uniform(0.1, 0.2)},
              HAND, _clinging),
        _made("tendon_coupling", lambda r, s: {"share1": 0.04 * s * _sign(r),
                                               "share2": 0.04 * s * _sign(r) * r.uniform(0.5, 1)},
              ENCODER, _tendons),
        _made("gear_cogging", lambda r, s: {"torque": 0.018 * s, "teeth": float(r.integers(20, 41))},
              MIX, _cogging),
        _made("rectified_drives", lambda r, s: {"height": 0.45 * s * _sign(r), "share": r.uniform(-1, 1),
                                                "speed": r.uniform(0.3, 0.6)},
              READOUT, _rectified),
        _made("skewed_bending", lambda r, s: {"give1": 2e-4 * s * _sign(r),
                                              "give2": 2e-4 * s * r.uniform(-1, 1)},
              LINKS, _bending),
        _made("jet_from_above", lambda r, s: {"push": 0.5 * s, "place": r.uniform(0.09, 0.15),
                                              "radius": r.uniform(0.012, 0.025),
                                              "slant": r.uniform(-0.6, 0.6)},
              HAND, _nozzle),
        _made("turning_tare", lambda r, s: {"weight1": 0.9 * s * r.uniform(0.6, 1),
                                            "weight2": 0.9 * s * r.uniform(0.6, 1)},
              MIX, _tared),
        _made("rolling_tips", lambda r, s: {"radius": 0.004 * s, "x": r.uniform(0.1, 0.14),
                                            "y": r.uniform(0.01, 0.04)},
              LINKS, _rolling),
        _made("tied_wiring", lambda r, s: {"stiffness": 30 * s, "slack": r.uniform(0.022, 0.028)},
              HAND, _tied),
        _made("lost_frames", lambda r, s: {"lasting": 0.25 * s, "apart": r.uniform(0.4, 0.8),
                                           "finger": float(r.integers(2))},
              READOUT, _frozen),
        _made("slipping_hub", lambda r, s: {"angle": 0.02 * s, "joint": float(r.integers(4))},
              ENCODER, _loosened),
        _made("near_field", lambda r, s: {"height": 0.8 * s, "share": r.uniform(0.2, 1),
                                          "lean1": r.uniform(-0.6, 0.6), "lean2": r.uniform(-0.6, 0.6)},
              READOUT, _capacitive),
        _made("blunt_rates", lambda r, s: {"time": 0.12 * s}, ENCODER, _blunted),
        _made("stuck_bit", lambda r, s: {"bit": 0.35 * s, "value": float(r.integers(2)),
                                         "finger": float(r.integers(2)),
                                         "origin1": r.uniform(0, 2), "origin2": r.uniform(0, 2)},
              READOUT, _stuck),
        _made("crumpling_blocks", lambda r, s: {"give": 3e-4 * s, "bears": r.uniform(0.3, 1.0)},
              LINKS, _crumpled),
        _made("knocked_bench", lambda r, s: {"amplitude": 0.6 * s, "knocks": float(r.integers(4, 8)),
                                             "frequency": r.uniform(2.5, 6), "decay": r.uniform(0.12, 0.3)},
              HAND, _knocked),
        _made("ground_loop", lambda r, s: {"height": 0.35 * s * _sign(r), "load": r.uniform(0.05, 0.3),
                                           "share1": r.uniform(-1, 1), "share2": r.uniform(-1, 1),
                                           "share3": r.uniform(-1, 1)},
              READOUT, _grounded),
        _made("sagging_clamp", lambda r, s: {"angle": 0.02 * s, "x": r.uniform(-0.05, 0.03),
                                             "y": r.uniform(0.2, 0.3)},
              LINKS, _sagging),
    )
}  # fmt: skip
