"""What an effect on a hand is: an unmodelled mechanism, its parameters, and how it changes what is recorded.

The diagnosis never simulates with an effect. It corrects the recording to what the nominal hand would have
shown (`correct`) and tests whether the contact equations then hold. Recordings with a known effect are made
by applying it to simulated truth (`apply`, `scene`).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import tomlkit
from tomlkit.items import Table

from hmmseg.hand.kinematics import turning
from hmmseg.io.rig import FORCE_CHANNELS, Rig
from simgap.channels import ChannelEffect, Theta, at_rest
from simgap.effect import Array, Effect

Values = dict[str, float]  # parameter name -> its value


class DeadBand(NamedTuple):
    """Positions of joints within their dead bands: expected `place` (T, N, 4) [rad], certain where `pinned`.

    Elsewhere a joint moves from one sample to the next by `drift` (T, N, 4) [rad] with variance `wander` (T,
    N, 4), or anywhere in its band with variance `jump` (T, 4) [rad^2].
    """

    place: Array
    pinned: Array
    drift: Array
    wander: Array
    jump: Array


class World(NamedTuple):
    """Aligned trials and the constants of the hand, as far as an effect may change them.

    T trials, N samples, M moves.

    Signals: `joints`, `rates` (T, N, 4), link angles and their rates (tip positions and velocities of a
    Cartesian hand); `force` (T, N, 4), fx1, fy1, fx2, fy2 [N]; `load` (T, N, 4) [N], the part of it that acts
    between contact and sensor, synchronous with the contact; `off` (T, N, 4) [m], additional offsets of x, y,
    distance and offset; `loudness` (T, N, 4), recorded noise over the noise of corrected forces, for net fx,
    net fy, grip and shear.

    Hand: `link` (4,), relative lengths; `give_normal`, `give_shear` (2,) [m/N], compliances of the pads;
    `creep`, `creep_time` [s], share and time constant of their delayed part; `delay`, `smoothing` (4,) [s] of
    the force channels; `ring` (3,), frequency [Hz], damping and drive of a mode excited by every change of
    load; `dead_band`, None if joints have none.

    Blocks and support: `tilt` [rad], `give_support` [m/N] and the delay `support_time` [s] with which the
    support yields (spring and damper in parallel); `inertia`, factor of mass times acceleration; `couple`
    [m], distance of the mass to the right of the middle; `hang` [rad], clockwise rotation of a lifted block
    against how it stood.

    State: `free`, `ground`, `carry` (T, N), 1 where the sample is in that state; `slip` (T, N), whether pads
    slide (0 to 1); `events` (T, 4 M) [s], touch, leave, meet and part of every move; `modes` (6,), 1 where a
    candidate delays or smooths forces, lets pads creep or slide, a mode ring or the support yield (LATE,
    SMOOTH, CREEPING, SLIDING, RINGING, YIELDING), so that equations without it are not evaluated.
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
    give_normal: Array
    give_shear: Array
    slip: Array
    free: Array
    ground: Array
    carry: Array
    events: Array
    link: Array = np.ones(4)  # from here on, defaults are what no effect has changed
    delay: Array = np.zeros(4)
    smoothing: Array = np.zeros(4)
    creep: Array = 0.0
    creep_time: Array = 1.0
    tilt: Array = 0.0
    give_support: Array = 0.0
    support_time: Array = 0.0
    inertia: Array = 1.0
    couple: Array = 0.0
    loudness: Array = np.ones(4)
    ring: Array = np.array([1.0, 0.05, 0.0])
    modes: Array = np.zeros(6)
    hang: Array = 0.0
    off: Array = 0.0
    dead_band: DeadBand | None = None


PAD = 5e-3  # prior: m; half a pad's length, which with its stiffness determines how easily it turns


def turning_compliance(stiffness: float) -> float:
    """How easily both pads, as rows of springs of this total normal stiffness [N/m], turn [rad/(N m)]."""
    return 3 / (2 * stiffness * PAD**2)


LATE, SMOOTH, CREEPING, SLIDING, RINGING, YIELDING = range(6)


class Performance(NamedTuple):
    """A simulated truth for effects to act on: n fine times `t` [s], the tips' `position`, `velocity` and
    `force` (n, 2 fingers, 2 axes) as the sensors will see them, and `events` [s]."""

    t: np.ndarray
    position: np.ndarray
    velocity: np.ndarray
    force: np.ndarray
    events: np.ndarray
    rig: Rig
    carried: np.ndarray  # (n,) weight [N] of the lifted block, else 0
    width: np.ndarray  # (n,) width [m] of the lifted block, else 1


Correct = Callable[[World, Values, Array], World]
Apply = Callable[[Performance, Values, np.random.Generator], Performance]


@dataclass(frozen=True)
class HandEffect(Effect):
    """A mechanism of a hand that moves blocks.

    `acts_on` is "sensing", "kinematics", "contact", "dynamics", "motion" or "measurement". `stage` orders
    corrections: what is nearest to the recorded number comes first.

    Its action: `correct(world, values, on)` corrects a recording; `on` is 1 if the effect is in the
    candidate, else 0, for parameters without a neutral value. `scatter(problem, residual)` gives the variance
    of a random disturbance instead (a `simgap.gap.assemble.Scatter`), from a residual with its nuisances.
    `apply(performance, values, rng)` applies it to simulated truth, `scene(values)` changes the scene before
    simulation, `sampled(t, values, rng)` gives the true times of samples stamped t, and `finish(force,
    values)` acts on recorded forces including noise. `restored(channels, values)` removes the effect from
    recorded channels.

    Its forms: in each of `forms` the listed parameters are free and the others neutral, the usual form first;
    by default all are free. `admitted(rig)` is the key of a form with standard deviations by parameter, as
    stated in rig.toml under [systematic]. `wrong(problem, push)` gives candidates that stand for wrong
    measurements.

    Where it is used: `chosen` is false for effects that only `--effect` requests. `wrist`: the first form
    shows in a wrist sensor. `played`: values that are felt in a played world, by default from the priors;
    empty if it cannot be felt. `turns`: the parameter [rad] up to which blocks turn freely in the grip on the
    ground. `grip` [N]: least and largest grip with which the effect shows. `exact`: the equation is what
    happens, as a zero error is an added constant, and no simplified model of it, as Coulomb friction is.

    Its words: `report(values, rig)` gives the parameters as the interface names them, `phrase(means, rig)`
    the effect in plain words where they depend on its parameters. `patched(document, found)` writes values
    into numbers of rig.toml and returns where each parameter is; None if the rig has no such numbers.
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
    exact: bool = False

    @property
    def simulated(self) -> bool:
        """Whether the virtual model can simulate it."""
        return bool(self.apply or self.scene or self.finish)


# Stages: the chain of the sensor backwards, then what the hand carries, then the contact.
READOUT, FILTER, SCALE, MIX, HAND, KINEMATICS, CONTACT = range(7)


def swung(world: World) -> tuple[Array, Array]:
    """Derivatives of the links' far ends with respect to their angles: x and y (T, N, 4) [m/rad]."""
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


def middle(values: Array) -> Array:
    """Means (..., 2) of both fingers' x and y, from x1, y1, x2, y2 (..., 4)."""
    return (values[..., :2] + values[..., 2:]) / 2


def with_mode(world: World, mode: int, on: Array) -> World:
    """The world with one of `modes` enabled where `on` is 1."""
    modes = np.array(world.modes, float)
    modes[mode] += on
    return world._replace(modes=modes)


def with_load(world: World, force: Array) -> World:
    """The world with a force (T, N, 4) [N] on each finger that does not act at the contact."""
    return world._replace(load=world.load + force)


def gradient(t: Array, values: Array) -> Array:
    """Central differences along the second axis of (T, N, C) or (T, N), at times (T, N) [s]."""
    step = t[:, 2:] - t[:, :-2]
    step = step[..., None] if values.ndim == 3 else step
    inner = (values[:, 2:] - values[:, :-2]) / np.maximum(step, 1e-6)
    return np.concatenate([inner[:, :1], inner, inner[:, -1:]], 1)


def flat(performance: Performance) -> np.ndarray:
    """Forces of a performance as columns fx1, fy1, fx2, fy2 (n, 4) [N]."""
    return performance.force.reshape(-1, 4)


def with_force(performance: Performance, force: np.ndarray) -> Performance:
    """The performance with other forces (n, 4) [N]."""
    return performance._replace(force=force.reshape(-1, 2, 2))


# How effects write what was found into a rig.toml.


def table(document: tomlkit.TOMLDocument, name: str) -> Table:
    """A table of a document, appended if missing."""
    if name not in document:
        document.add(tomlkit.nl())
        document.add(name, tomlkit.table(name == "effects"))
    return document[name]


def number(value: float) -> float:
    """The value rounded to what a diagnosis can resolve."""
    return float(f"{value:.6g}")


def interval_comment(p: Mapping[str, Any]) -> str:
    """A parameter's interval as a comment."""
    low, high = p["interval_90"]
    unit = "" if p["unit"] == "1" else f" {p['unit']}"
    return "interval unknown" if None in (low, high) else f"90 % interval {low:.4g} to {high:.4g}{unit}"


# Families of effects: each function gives an effect both its `correct` and its `apply`.

# physics: net fx, net fy, grip and shear from channels fx1, fy1, fx2, fy2
NET = np.array([[1.0, 0, 1, 0], [0, 1, 0, 1], [0.5, 0, -0.5, 0], [0, 0.5, 0, -0.5]])
USUAL = 3.0  # prior: N; the force that relative parameters of a force channel refer to


class Motion(NamedTuple):
    """What a load may depend on: times, tips' `position`, `velocity` and `acceleration` (..., 4) for x1, y1,
    x2, y2, and the time `since` each event (..., events) [s]."""

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
    """An effect that puts a force load(motion, values) (..., 4) [N] on the fingers, away from the contact.

    `given` converts reported parameters into the fitted ones.
    """

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
    """An effect on sensors that read matrix(values) (4, 4) times the true forces.

    Correcting the forces changes the noise of net forces, grip and shear as the matrix implies.
    """

    def correct(world: World, values: Values, on: Array) -> World:
        back = np.linalg.inv(matrix(values))
        quiet = np.sqrt(np.square(NET).sum(1) / np.square(NET @ back).sum(1))
        return world._replace(force=world.force @ back.T, loudness=world.loudness * quiet)

    def apply(p: Performance, values: Values, rng: np.random.Generator) -> Performance:
        return with_force(p, flat(p) @ matrix(values).T)

    return HandEffect(correct=correct, apply=apply, exact=True, **more)


Spread = Callable[[Mapping[str, Array]], list[Theta]]  # from parameters to those of each force channel
Clock = Callable[[Array, Array, Mapping[str, Array]], Array]  # of (time since the start, its end, parameters)


def reading(channel: ChannelEffect, spread: Spread, clock: Clock | None = None) -> Apply:
    """`apply` of a channel's effect on every force channel, with an optional `clock` in place of time."""

    def apply(p: Performance, values: Values, rng: np.random.Generator) -> Performance:
        since = p.t - p.t[0]
        since = since if clock is None else clock(since, p.events.max() - p.t[0], values)
        each = zip(flat(p).T, spread(values), strict=True)
        return with_force(p, np.stack([at_rest(channel.read, since, f, theta) for f, theta in each], 1))

    return apply


def unread(channel: ChannelEffect, spread: Spread, clock: Clock | None = None) -> Correct:
    """`correct` of an invertible channel effect on every force channel."""

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
    """Each force channel has its own parameters, named after the channel."""
    keys = {n: "" if len(channel.parameters) == 1 else f"_{n}" for n in channel.parameters}
    return lambda values: [{n: values[c + end] for n, end in keys.items()} for c in FORCE_CHANNELS]


def of_forces(channel: ChannelEffect, **more: Any) -> HandEffect:
    """A channel's effect as one on a hand's forces, each with its own parameters."""
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
