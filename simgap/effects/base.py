"""What an effect is: one unmodelled mechanism, its parameters, and how it acts on what is recorded.

The diagnosis never simulates with an effect. It takes the recording back to what the nominal hand
would have shown (`correct`), and asks whether the contact equations then hold. The simulator's
truth is taken forward (`apply`, `scene`) to make recordings with a known effect.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from hmmseg.hand.kinematics import turning
from hmmseg.io.rig import FORCE_CHANNELS, Rig
from simgap.channels import ChannelEffect, Theta, at_rest
from simgap.effect import Array, Effect

Values = dict[str, float]  # parameter name -> its value


class DeadBand(NamedTuple):
    """Where joints lie in their dead bands: `place` (T, N, 4) [rad] as expected, certain where `pinned`.

    Elsewhere a joint goes on from one sample to the next by `drift` (T, N, 4) [rad], with variance `wander`
    (T, N, 4), or anywhere in its band, with variance `jump` (T, 4) [rad^2].
    """

    place: Array
    pinned: Array
    drift: Array
    wander: Array
    jump: Array


class World(NamedTuple):
    """Aligned trials and the constants of the hand, as far as an effect may change them.

    T trials, N samples, M moves. `joints`, `rates`, `force` (T, N, 4): link angles and their rates
    (tip positions and velocities of a Cartesian hand), forces fx1, fy1, fx2, fy2. `load` (T, N, 4) [N]: what
    of them acts between the contact and the sensor, in time with the contact. `link` (4,)
    relative lengths; `give_normal`, `give_shear` (2,) [m/N]: the pads' compliances.
    `delay`, `smoothing` (4,) [s]: of the force channels. `creep`, `creep_time` [s]: share and time of
    the pads' delayed part. `tilt` [rad], `give_support` [m/N] and `support_time` [s] of the support, which
    yields with that delay (spring and damper in parallel). `inertia`: factor of the mass times acceleration.
    `couple` [m]: how far the mass lies right of the middle. `hang` [rad]: by how much a block in the air has
    turned clockwise against how it stood.
    `loudness` (T, N, 4): recorded noise over the noise of corrected forces, of net fx, net fy, grip, shear.
    `ring` (3,): frequency [Hz], damping and drive of a mode that every change of load rings.
    `off` [m] (T, N, 4): by how much x, y, distance and offset are off besides.
    `dead_band`: what is known of where joints lie in theirs, None where they have none.
    `slip` (T, N): whether (0 to 1) pads slide on the block; `modes` (6,): 1 where a candidate delays or
    smooths forces, lets pads creep or slide, a mode ring or the support yield (LATE, SMOOTH, CREEPING,
    SLIDING, RINGING, YIELDING), so that equations without it are not evaluated.
    `free`, `ground`, `carry` (T, N): which state each sample is in (1 or 0); `events` (T, 4 M) [s]:
    touch, leave, meet, part of every move.
    """

    t: Array
    joints: Array
    rates: Array
    force: Array
    load: Array
    base: Array
    length: Array
    jointed: Array
    gravity: Array
    link: Array
    give_normal: Array
    give_shear: Array
    delay: Array
    smoothing: Array
    creep: Array
    creep_time: Array
    tilt: Array
    give_support: Array
    support_time: Array
    inertia: Array
    couple: Array
    loudness: Array
    ring: Array
    slip: Array
    modes: Array
    free: Array
    ground: Array
    carry: Array
    events: Array
    hang: Array | float = 0.0
    off: Array | float = 0.0
    dead_band: DeadBand | None = None


LATE, SMOOTH, CREEPING, SLIDING, RINGING, YIELDING = range(6)


class Performance(NamedTuple):
    """A simulated truth that effects act on: n fine times `t` [s], tips' `position`, `velocity` and
    `force` (n, 2 fingers, 2 axes) as the sensors will have them, `events` [s] and carried `blocks`.
    """

    t: np.ndarray
    position: np.ndarray
    velocity: np.ndarray
    force: np.ndarray
    events: np.ndarray
    rig: Rig
    carried: np.ndarray  # (n,) weight [N] of the block in the air, else 0
    width: np.ndarray  # (n,) width [m] of the block in the air, else 1


Correct = Callable[[World, Values, Array], World]
Apply = Callable[[Performance, Values, np.random.Generator], Performance]


@dataclass(frozen=True)
class HandEffect(Effect):
    """One mechanism of a hand that moves blocks. `acts_on`: "sensing", "kinematics", "contact", "dynamics",
    "motion" or "measurement"; `stage` orders corrections: what is nearest to the recorded number comes first.

    `correct(world, values, on)` takes the recording back; `on` is 1 where the effect is in the
    candidate and 0 elsewhere, for parameters that have no neutral value. `scatter(problem, residual)`
    gives the variance of a random disturbance instead (a `simgap.gap.assemble.Scatter`).
    `apply(performance, values, rng)` takes a simulated truth forward; `scene(values)` changes the
    scene before it is simulated; `finish(force, values)` acts on the recorded forces, noise and all.
    `chosen` is false for effects that only `--effect` asks for. `report(values, rig)` gives the parameters
    as the interface names them. `forms`: sets of parameters of which one is free and the others neutral, the
    usual one first; all are free where none is listed. `admitted(rig)`: key of a form, and standard
    deviations by parameter, as rig.toml has them under [systematic]. `wrist`: its first form shows in a
    sensor in the wrist. `played`: values at which it is felt in a played world where none are given,
    by default from its priors; empty for one that cannot be felt. `turns`: the parameter
    [rad] by up to which blocks turn in the grip on the ground where it acts, as they please.

    `phrase(means, rig)`: the effect in plain words where its parameters decide them.
    `sampled(t, values, rng)`: when samples are taken that are stamped t. `grip` [N]: least and most that
    blocks are held with, so that it shows. `restored(channels, values)`: recorded channels as they would be
    without it. `patched(document, found)`: puts what was found into numbers that rig.toml has of its own, and
    says where each parameter is found; None where it has none. `wrong(problem, push)`: candidates of the gap
    that stand for measurements rather than for what acts.
    """

    acts_on: str = "sensing"
    mistaken_for: tuple[str, ...] = ()
    stage: int = 0
    correct: Correct | None = None
    apply: Apply | None = None
    scene: Callable[[Values], Values] | None = None
    finish: Callable[[np.ndarray, Values], np.ndarray] | None = None
    chosen: bool = True
    report: Callable[[dict[str, Any], Rig], dict[str, Any]] | None = None
    forms: tuple[tuple[str, ...], ...] = ()
    scatter: Callable[[Any, np.ndarray], Any] | None = None
    admitted: Callable[[Rig], tuple[str, Values]] | None = None
    wrist: bool = False
    played: Mapping[str, float] | None = None
    phrase: Callable[[Mapping[str, float], Mapping[str, Any]], str] | None = None
    sampled: Callable[[np.ndarray, Values, np.random.Generator], np.ndarray] | None = None
    grip: tuple[float, float] | None = None
    restored: Callable[[dict[str, np.ndarray], Values], dict[str, np.ndarray]] | None = None
    patched: Callable[[Any, Mapping[str, Any]], dict[str, str] | None] | None = None
    wrong: Callable[[Any, np.ndarray], list[Any]] | None = None
    turns: str = ""

    @property
    def simulated(self) -> bool:
        """Whether the virtual model can have it."""
        return bool(self.apply or self.scene or self.finish)


# Stages: the sensor's chain backwards, then what the hand carries, then the contact.
READOUT, FILTER, SCALE, MIX, HAND, KINEMATICS, CONTACT = range(7)


def swung(world: World) -> tuple[Array, Array]:
    """How the far ends of the links move with the angles: x and y (T, N, 4) [m/rad]."""
    return turning((world.length * world.link)[None, None, :], world.joints)


def tips(world: World) -> tuple[Array, Array]:
    """Tip positions and velocities (T, N, 4): x1, y1, x2, y2 [m, m/s]."""
    jx, jy = swung(world)

    def paired(x: Array, y: Array) -> Array:
        return np.stack(
            [x[..., 0] + x[..., 1], y[..., 0] + y[..., 1], x[..., 2] + x[..., 3], y[..., 2] + y[..., 3]], -1
        )

    position = world.base[None, None, :] + paired(jy, -jx)
    velocity = paired(jx * world.rates, jy * world.rates)
    there = world.jointed > 0.5
    return np.where(there, position, world.joints), np.where(there, velocity, world.rates)


def with_mode(world: World, mode: int, on: Array) -> World:
    """The world with one of `modes` switched on where `on` is 1."""
    modes = np.array(world.modes, float)
    modes[mode] += on
    return world._replace(modes=modes)


def with_load(world: World, force: Array) -> World:
    """The world with a force (T, N, 4) [N] on each finger that is none of the contact's."""
    return world._replace(load=world.load + force)


def gradient(t: Array, values: Array) -> Array:
    """Central differences along the second axis of (T, N, C) or (T, N), times (T, N) [s]."""
    step = t[:, 2:] - t[:, :-2]
    step = step[..., None] if values.ndim == 3 else step
    inner = (values[:, 2:] - values[:, :-2]) / np.maximum(step, 1e-6)
    return np.concatenate([inner[:, :1], inner, inner[:, -1:]], 1)


def flat(performance: Performance) -> np.ndarray:
    """Forces of a performance as columns fx1, fy1, fx2, fy2 (n, 4)."""
    return performance.force.reshape(-1, 4)


def with_force(performance: Performance, force: np.ndarray) -> Performance:
    """The performance with other forces (n, 4)."""
    return performance._replace(force=force.reshape(-1, 2, 2))


# What many effects have in common: each gives an effect its `correct` and `apply` at once.

# physics: what of channels fx1, fy1, fx2, fy2 net fx, net fy, grip and shear are
NET = np.array([[1.0, 0, 1, 0], [0, 1, 0, 1], [0.5, 0, -0.5, 0], [0, 0.5, 0, -0.5]])
USUAL = 3.0  # prior: N; of a hand's forces: what shares of a channel are shares of


class Motion(NamedTuple):
    """What a load may depend on: times, tips' `position`, `velocity`, `acceleration` (..., 4) for x1, y1, x2,
    y2, and how long ago each event was (..., events) [s]."""

    t: Array
    position: Array
    velocity: Array
    acceleration: Array
    since: Array
    gravity: Array


def loading(
    load: Callable[[Motion, Values], Array], given: Callable[[Values], Values] | None = None,
    **more: Any,
) -> HandEffect:  # fmt: skip
    """A force load(motion, values) (..., 4) [N] on the fingers that is none of the contact's; `given` turns
    parameters as they are reported into those that are fitted."""

    def correct(world: World, values: Values, on: Array) -> World:
        position, velocity = tips(world)
        since = world.t[:, :, None] - world.events[:, None, :]
        motion = Motion(world.t, position, velocity, gradient(world.t, velocity), since, world.gravity)
        return with_load(world, load(motion, values))

    def apply(p: Performance, values: Values, rng: np.random.Generator) -> Performance:
        acceleration = np.gradient(p.velocity, p.t, axis=0)
        place, speed, quick = (z.reshape(-1, 4) for z in (p.position, p.velocity, acceleration))
        motion = Motion(p.t, place, speed, quick, p.t[:, None] - p.events[None, :], p.rig.gravity)
        return with_force(p, flat(p) + load(motion, values if given is None else given(values)))

    return HandEffect(correct=correct, apply=apply, **more)


def mixing(matrix: Callable[[Values], Array], **more: Any) -> HandEffect:
    """Sensors that read matrix(values) (4, 4) times the true forces.

    The noise of net forces, grip and shear is by so much louder than that of corrected ones as the matrix
    turns it.
    """

    def correct(world: World, values: Values, on: Array) -> World:
        back = np.linalg.inv(matrix(values))
        quiet = np.sqrt(np.square(NET).sum(1) / np.square(NET @ back).sum(1))
        return world._replace(force=world.force @ back.T, loudness=world.loudness * quiet)

    def apply(p: Performance, values: Values, rng: np.random.Generator) -> Performance:
        return with_force(p, flat(p) @ matrix(values).T)

    return HandEffect(correct=correct, apply=apply, **more)


Spread = Callable[[Mapping[str, Array]], list[Theta]]  # parameters to those of each force channel
Clock = Callable[[Array, Array, Mapping[str, Array]], Array]  # (time since the start, its end, parameters)


def reading(channel: ChannelEffect, spread: Spread, clock: Clock | None = None) -> Apply:
    """`apply` of an effect on every force channel, by a `clock` of its own where one is given."""

    def apply(p: Performance, values: Values, rng: np.random.Generator) -> Performance:
        since = p.t - p.t[0]
        since = since if clock is None else clock(since, p.events.max() - p.t[0], values)
        each = zip(flat(p).T, spread(values), strict=True)
        return with_force(p, np.stack([at_rest(channel.read, since, f, theta) for f, theta in each], 1))

    return apply


def unread(channel: ChannelEffect, spread: Spread, clock: Clock | None = None) -> Correct:
    """`correct` of an effect on every force channel that can be undone."""

    def correct(world: World, values: Values, on: Array) -> World:
        since = world.t - world.t[:, :1]
        if clock is not None:
            last = world.events.max(axis=1, keepdims=True) - world.t[:, :1]
            since = clock(since, last, values)
        assert channel.undo is not None
        each = [channel.undo(since, world.force[..., c], theta) for c, theta in enumerate(spread(values))]
        return world._replace(force=np.stack(each, -1))

    return correct


def own(channel: ChannelEffect) -> Spread:
    """Each force channel has parameters of its own, called as the channel is where it has one."""
    keys = {n: "" if len(channel.parameters) == 1 else f"_{n}" for n in channel.parameters}
    return lambda values: [{n: values[c + end] for n, end in keys.items()} for c in FORCE_CHANNELS]


def of_forces(channel: ChannelEffect, **more: Any) -> HandEffect:
    """An effect on channels as one on a hand's forces, each of which has its own."""
    sized, several = channel.sized(USUAL, "N", 10.0), len(channel.parameters) > 1
    parameters = {f"{c}_{n}" if several else c: p for c in FORCE_CHANNELS for n, p in sized.items()}
    fields: dict[str, Any] = {
        "name": f"force_{channel.name}", "says": channel.says, "shows": channel.shows,
        "called": channel.called, "check": channel.check, "parameters": parameters,
        "stage": FILTER if channel.remembers else READOUT,
        "apply": reading(channel, own(channel)),
        "correct": None if channel.undo is None or channel.remembers else unread(channel, own(channel)),
    }  # fmt: skip
    return HandEffect(**(fields | more))
