"""Forces between two samples: read at other times, their slopes, and by how much these are in doubt."""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp

from simgap.effects.base import LATE, SMOOTH, World, gradient
from simgap.effects.filters import faded, lowpass

BETWEEN = 0.3  # prior: of a bend, sd: a force read between samples
CURVED = 0.5  # prior: of the difference of two ways to take a slope, sd: how far it may be off
EVEN = 0.025  # chosen: N; changes from one sample to the next below this have no corner
SHARP = 0.75  # chosen: by how much one side is flatter, as a share of both, beyond which a force has a corner
EITHER = 0.6  # prior: of a force's change, sd: how a force between two samples goes from one to the other


def net_forces(force: jax.Array) -> jax.Array:
    """Net force, grip and shear (T, N, 4) of both fingers' forces (T, N, 4)."""
    one, two = force[..., :2], force[..., 2:]
    return jnp.concatenate([one + two, (one - two) / 2], -1)


def sampling_interval(world: World) -> jax.Array:
    """The usual time [s] from one sample to the next."""
    return jnp.median(world.t[:, 1:] - world.t[:, :-1])


def shifted(values: jax.Array, steps: jax.Array) -> jax.Array:
    """Values (T, N, C) read `steps` samples later (a number or (C,), a fraction allowed): cubic Catmull-Rom.

    Where they have a corner between two samples, as at a contact change, both sides go straight on to it:
    before a contact there is no force yet. Sides that would not meet between the two are joined straight.
    """
    return jax.vmap(_shifted, (2, 0), 2)(values, jnp.broadcast_to(steps, values.shape[2:]))


def _around(values: jax.Array, steps: jax.Array) -> tuple[jax.Array, ...]:
    """Four neighbours of (T, N) read `steps` samples later, and the fraction between the middle two."""
    n, whole = values.shape[1], jnp.floor(steps)
    index = jnp.arange(n) + whole.astype(int)
    return *(values[:, jnp.clip(index + k, 0, n - 1)] for k in (-1, 0, 1, 2)), steps - whole


def _shifted(values: jax.Array, steps: jax.Array) -> jax.Array:
    p0, p1, p2, p3, s = _around(values, steps)
    cubic = ((-p0 + 3 * p1 - 3 * p2 + p3) * s + (2 * p0 - 5 * p1 + 4 * p2 - p3)) * s + (p2 - p0)
    before, across, after = p1 - p0, p2 - p1, p3 - p2
    convex = after > before
    before, after = (
        jnp.where(convex, one(side, across), other(side, across))
        for side, one, other in ((before, jnp.minimum, jnp.maximum), (after, jnp.maximum, jnp.minimum))
    )
    left, right = p1 + s * before, p2 - (1 - s) * after
    corner = jnp.where(convex, jnp.maximum(left, right), jnp.minimum(left, right))
    corner = jnp.clip(corner, jnp.minimum(p1, p2), jnp.maximum(p1, p2))
    smooth = p1 + 0.5 * s * cubic
    return smooth + _sharp(p1 - p0, p3 - p2, EVEN) * (corner - smooth)


def _sharp(left: jax.Array, right: jax.Array, even: float | jax.Array) -> jax.Array:
    """How surely (0 to 1) changes on both sides are those of a corner; both are alike below `even`.

    A force that rises and falls as fast has a crest there: at a corner one side is flatter than the other.
    """
    left, right = jnp.abs(left), jnp.abs(right)
    return jax.nn.sigmoid((jnp.abs(left - right) / (left + right + even) - SHARP) / 0.08)


def per_channel(values: jax.Array) -> jax.Array:
    """Values (C,), or one, to go with (T, N, C)."""
    return jnp.reshape(values, (1, 1, -1))


def fivepoint(world: World, values: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Rate of change (T, N, C) from five samples, exact to fourth order, and from three."""
    near = gradient(world.t, values)
    far = (values[:, 4:] - values[:, :-4]) / jnp.maximum(world.t[:, 4:] - world.t[:, :-4], 1e-6)[..., None]
    far = jnp.concatenate([near[:, :2], far, near[:, -2:]], 1)
    return (4 * near - far) / 3, near


def slope(world: World, force: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Rate of change (T, N, C) of forces from five samples, and by how much it is in doubt.

    Three samples alone take sin(w) for w [rad a sample]: a low-pass would come out too slow. Where a force
    bends too sharply for either, at a contact change, the flatter side counts (a minmod limiter: Sweby, SIAM
    J. Numer. Anal. 21, 1984): before a contact there is no force yet.
    """
    smooth, near = fivepoint(world, force)
    side = (force[:, 1:] - force[:, :-1]) / jnp.maximum(world.t[:, 1:] - world.t[:, :-1], 1e-6)[..., None]
    left, right = jnp.concatenate([side[:, :1], side], 1), jnp.concatenate([side, side[:, -1:]], 1)
    sharp = _sharp(left, right, EVEN / sampling_interval(world))
    flatter = jnp.where(left * right > 0, jnp.where(jnp.abs(left) < jnp.abs(right), left, right), 0.0)
    doubt = (1 - sharp) * jnp.abs(smooth - near) + sharp * jnp.abs(smooth - flatter)
    return smooth + sharp * (flatter - smooth), doubt


def sensed(world: World, force: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Net force, grip and shear (T, N, 4) behind each sensor's low-pass and delay, and their variance.

    The low-pass is exact between samples for straight lines. The variance is that of what is read between
    two samples: a contact may have changed before or after, for both fingers at once.
    """

    def slow(f: jax.Array) -> tuple[jax.Array, jax.Array]:
        return lowpass(f, world.smoothing, sampling_interval(world)), _unsure(
            f, world.smoothing, sampling_interval(world)
        )

    def late(f: jax.Array) -> tuple[jax.Array, jax.Array]:
        steps = world.delay / sampling_interval(world)

        def one(f: jax.Array, steps: jax.Array) -> tuple[jax.Array, jax.Array]:
            _, old, new, _, ahead = _around(f, -steps)  # read (1 - ahead) of a sample after the later one
            return old + ahead * (new - old), jnp.sqrt(ahead * (1 - ahead) + 1e-12) * EITHER * (new - old)

        return jax.vmap(one, (2, 0), 2)(f, jnp.broadcast_to(steps, f.shape[2:]))

    modes = jnp.asarray(world.modes)
    prompt = (force, jnp.zeros_like(force))

    def fingers(net: jax.Array) -> tuple[jax.Array, jax.Array]:
        each = jnp.concatenate([net[..., :2] / 2 + net[..., 2:], net[..., :2] / 2 - net[..., 2:]], -1)
        smooth, jumps = jax.lax.cond(modes[SMOOTH] > 0, slow, lambda f: (f, jnp.zeros_like(f)), each)
        delayed, either = jax.lax.cond(modes[LATE] > 0, late, lambda f: (f, jnp.zeros_like(f)), smooth)
        return net_forces(delayed), jumps + jnp.square(net_forces(either))

    return jax.lax.cond(modes[SMOOTH] + modes[LATE] > 0, fingers, lambda f: prompt, force)


def when(world: World, mode: int, change: Callable[[jax.Array], jax.Array], values: jax.Array) -> jax.Array:
    """Changed values where a candidate has the mode; else the change is not even evaluated."""
    return jax.lax.cond(jnp.asarray(world.modes)[mode] > 0, change, lambda v: v, values)


def _unsure(values: jax.Array, time: jax.Array, step: jax.Array) -> jax.Array:
    """Variance (T, N, 4) of net force, grip and shear behind the low-pass of each finger's force (T, N, 4),
    from what may have changed at any moment between two samples, for both fingers at once."""
    ratio = step / jnp.maximum(jnp.reshape(time, (1, 1, -1)), 1e-4)
    share = (1 - jnp.exp(-2 * ratio)) / (2 * ratio) - jnp.square((1 - jnp.exp(-ratio)) / ratio)
    change = jnp.concatenate([jnp.zeros_like(values[:, :1]), values[:, 1:] - values[:, :-1]], 1)
    sd = EITHER * jnp.sqrt(jnp.maximum(share, 1e-12)) * change
    return faded(jnp.square(net_forces(sd)), 2 * jnp.mean(ratio))


def doubt_between(world: World) -> jax.Array:
    """Variance (T, N, 4) [N^2] of forces before delay and low-pass, from how sharply they bend."""

    def rough(f: jax.Array) -> jax.Array:
        def one(f: jax.Array, steps: jax.Array) -> jax.Array:
            p0, p1, p2, p3, share = _around(f, steps)
            share = share * (1 - share)
            bend = jnp.maximum(jnp.abs(p2 - 2 * p1 + p0), jnp.abs(p3 - 2 * p2 + p1))
            # A change that neither side goes on with may have come at any moment between the two samples.
            jump = jnp.maximum(jnp.abs(p2 - p1) - jnp.maximum(jnp.abs(p1 - p0), jnp.abs(p3 - p2)), 0.0)
            return jnp.square(BETWEEN * share * bend) + share * jnp.square(EITHER * jump)

        return jax.vmap(one, (2, 0), 2)(
            f, jnp.broadcast_to(world.delay / sampling_interval(world), f.shape[2:])
        )

    def steep(f: jax.Array) -> jax.Array:
        return jnp.square(CURVED * per_channel(world.smoothing) * slope(world, f)[1])

    force = jnp.asarray(world.force)
    late = jax.lax.cond(jnp.asarray(world.modes)[LATE] > 0, rough, jnp.zeros_like, force)
    return late + jax.lax.cond(jnp.asarray(world.modes)[SMOOTH] > 0, steep, jnp.zeros_like, force)
