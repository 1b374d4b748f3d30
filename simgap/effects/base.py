"""What an effect is: one unmodelled mechanism, its parameters, and how it acts on what is recorded.

The diagnosis never simulates with an effect. It takes the recording back to what the nominal hand
would have shown (`correct`), and asks whether the contact equations then hold. The simulator's
truth is taken forward (`apply`, `scene`) to make recordings with a known effect.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from hmmseg.hand.kinematics import turning
from hmmseg.io.rig import Rig

Array = Any  # jax.Array under a trace, np.ndarray outside of one
Values = dict[str, Array]  # parameter name -> scalar


class World(NamedTuple):
    """Aligned trials and the constants of the hand, as far as an effect may change them.

    T trials, N samples, M moves. `joints`, `rates`, `force` (T, N, 4): link angles and their rates
    (tip positions and velocities of a Cartesian hand), forces fx1, fy1, fx2, fy2. `load` (T, N, 4) [N]: what
    of them acts between the contact and the sensor, in time with the contact. `link` (4,)
    relative lengths; `give_normal`, `give_shear` (2,) [m/N]: the pads' compliances.
    `delay`, `smoothing` (4,) [s]: of the force channels. `creep`, `creep_time` [s]: share and time of
    the pads' delayed part. `tilt` [rad], `give_support` [m/N] and `support_time` [s] of the support, which
    yields with that delay (a spring beside a damper). `inertia`: factor of the mass times acceleration.
    `couple` [m]: how far the mass lies right of the middle.
    `loudness` (T, N, 4): recorded noise over the noise of corrected forces, of net fx, net fy, grip, shear.
    `ring` (3,): frequency [Hz], damping and drive of a mode that every change of load rings.
    `doubt_joints` [rad^2] (T, N, 4): variance of what a correction cannot tell of angles.
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
    doubt_joints: Array
    slip: Array
    modes: Array
    free: Array
    ground: Array
    carry: Array
    events: Array


GROSS = 100.0  # prior: times the usual size: a fault so large has been seen on the bench
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


@dataclass(frozen=True)
class Parameter:
    """A parameter: prior normal about `neutral` with `sd`, in `unit`; `low`, `high` bound it.

    `starts` are the values a search starts from. `log`: the prior is of the logarithm, with median
    `neutral` and `sd` in natural units. `hidden` parameters are fitted but not reported. `shape`: it bends
    what others amplify and is nothing by itself.
    """

    name: str
    unit: str
    sd: float
    neutral: float = 0.0
    starts: tuple[float, ...] = (0.0,)
    low: float = -np.inf
    high: float = np.inf
    log: bool = False
    hidden: bool = False
    shape: bool = False

    def value(self, u: Array) -> Array:
        """The parameter from its standard normal coordinate."""
        return self.neutral * jnp.exp(self.sd * u) if self.log else self.neutral + self.sd * u

    def coordinate(self, value: float) -> float:
        """The inverse of `value`."""
        return float(np.log(value / self.neutral) / self.sd if self.log else (value - self.neutral) / self.sd)

    @property
    def gridded(self) -> bool:
        """Whether a search has to try several start values of it."""
        return self.starts != (0.0,)

    @property
    def limits(self) -> tuple[float, float]:
        """Bounds of the coordinate: five standard deviations of a logarithm, GROSS of others, at most."""
        low = self.coordinate(self.low) if self.low > (0 if self.log else -np.inf) else -np.inf
        high = self.coordinate(self.high) if np.isfinite(self.high) else np.inf
        most = 5.0 if self.log else GROSS
        return max(low, -most), min(high, most)


@dataclass(frozen=True)
class Effect:
    """One mechanism. `stage` orders corrections: what is nearest to the recorded number comes first.

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

    `called`: the effect in plain words, `phrase(means, rig)` where its parameters decide them, and what to
    `check` on the rig. `sampled(t, values, rng)`: when samples are taken that are stamped t. `grip` [N]:
    least and most that blocks are held with, so that it shows. `restored(channels, values)`: recorded
    channels as they would be without it. `patched(document, found)`: puts what was found into numbers that
    rig.toml has of its own, and says where each parameter stands; None where it has none.
    `wrong(problem, push)`: candidates of the gap that stand for measurements rather than for what acts.
    """

    name: str
    acts_on: str
    says: str
    shows: str
    mistaken_for: tuple[str, ...]
    parameters: tuple[Parameter, ...]
    stage: int
    correct: Callable[[World, Values, Array], World] | None = None
    apply: Callable[[Performance, dict[str, float], np.random.Generator], Performance] | None = None
    scene: Callable[[dict[str, float]], dict[str, float]] | None = None
    finish: Callable[[np.ndarray, dict[str, float]], np.ndarray] | None = None
    chosen: bool = True
    report: Callable[[dict[str, Any], Rig], dict[str, Any]] | None = None
    forms: tuple[tuple[str, ...], ...] = ()
    scatter: Callable[[Any, np.ndarray], Any] | None = None
    admitted: Callable[[Rig], tuple[str, dict[str, float]]] | None = None
    wrist: bool = False
    played: Mapping[str, float] | None = None
    called: str = ""
    check: str = ""
    phrase: Callable[[Mapping[str, float], Mapping[str, Any]], str] | None = None
    sampled: Callable[[np.ndarray, dict[str, float], np.random.Generator], np.ndarray] | None = None
    grip: tuple[float, float] | None = None
    restored: Callable[[dict[str, np.ndarray], dict[str, float]], dict[str, np.ndarray]] | None = None
    patched: Callable[[Any, Mapping[str, Any]], dict[str, str] | None] | None = None
    wrong: Callable[[Any, np.ndarray], list[Any]] | None = None
    turns: str = ""

    def neutral(self) -> dict[str, float]:
        """Values at which nothing is changed (where that exists)."""
        return {p.name: p.neutral for p in self.parameters}


# Stages: the sensor's chain backwards, then what the hand carries, then the contact.
READOUT, FILTER, SCALE, MIX, HAND, KINEMATICS, CONTACT = range(7)


def swung(world: World) -> tuple[Array, Array]:
    """How the far ends of the links move with the angles: x and y (T, N, 4) [m/rad]."""
    return turning((world.length * world.link)[None, None, :], world.joints)


def tips(world: World) -> tuple[Array, Array]:
    """Tip positions and velocities (T, N, 4): x1, y1, x2, y2 [m, m/s]."""
    jx, jy = swung(world)

    def paired(x: Array, y: Array) -> Array:
        return jnp.stack(
            [x[..., 0] + x[..., 1], y[..., 0] + y[..., 1], x[..., 2] + x[..., 3], y[..., 2] + y[..., 3]], -1
        )

    position = world.base[None, None, :] + paired(jy, -jx)
    velocity = paired(jx * world.rates, jy * world.rates)
    there = world.jointed > 0.5
    return jnp.where(there, position, world.joints), jnp.where(there, velocity, world.rates)


def with_mode(world: World, mode: int, on: Array) -> World:
    """The world with one of `modes` switched on where `on` is 1."""
    return world._replace(modes=jnp.asarray(world.modes).at[mode].add(on))


def with_load(world: World, force: Array) -> World:
    """The world with a force (T, N, 4) [N] on each finger that is none of the contact's."""
    return world._replace(load=world.load + force)


def gradient(t: Array, values: Array) -> Array:
    """Central differences along the second axis of (T, N, C) or (T, N), times (T, N) [s]."""
    step = t[:, 2:] - t[:, :-2]
    step = step[..., None] if values.ndim == 3 else step
    inner = (values[:, 2:] - values[:, :-2]) / jnp.maximum(step, 1e-6)
    return jnp.concatenate([inner[:, :1], inner, inner[:, -1:]], 1)


def per_channel(values: Values, names: tuple[str, ...]) -> Array:
    """Scalars stacked and shaped (1, 1, len(names)) to act on (T, N, channels)."""
    return jnp.stack([jnp.asarray(values[n], float) for n in names])[None, None, :]


def flat(performance: Performance) -> np.ndarray:
    """Forces of a performance as columns fx1, fy1, fx2, fy2 (n, 4)."""
    return performance.force.reshape(-1, 4)


def with_force(performance: Performance, force: np.ndarray) -> Performance:
    """The performance with other forces (n, 4)."""
    return performance._replace(force=force.reshape(-1, 2, 2))
