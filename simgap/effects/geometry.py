"""Effects in where the fingers are: joints, links, a dead band, a hand that rolls."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np

from hmmseg.contact.equations import rolled_offset
from hmmseg.hand.kinematics import forward, inverse, joint_velocity, tip_velocity
from simgap.effects.base import KINEMATICS, Effect, Parameter, Performance, World, gradient, per_channel
from simgap.gap.frame import CHANNELS
from simgap.phases import Phase

# Helper of effects that act on joint angles: from true tips to what the nominal hand would read.

Change = Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]


def moved_joints(
    performance: Performance,
    change: Change,
    scale: float | Sequence[float] = 0.0,
    base: Sequence[float] = (0.0, 0.0),
) -> Performance:
    """Tips as read by a nominal hand whose angles and rates (n, 4) pass through `change`.

    The true links are longer than nominal by `scale`, all or each (4,), the second finger stands beside its
    place by `base` (2,) [m].
    """
    rig = performance.rig
    if not rig.jointed:
        raise ValueError("a Cartesian hand has no joints")
    q, dq = [], []
    longer, shift = np.broadcast_to(np.asarray(scale, float), 4).reshape(2, 2), np.array([[0.0, 0.0], base])
    for i in (1, 2):
        nominal = rig.finger(i)
        true = nominal.model_copy(update={"links": tuple(nominal.links * (1 + longer[i - 1]))})
        angles = inverse(true, i, performance.position[:, i - 1] - shift[i - 1])
        q.append(angles)
        dq.append(joint_velocity(true, angles, performance.velocity[:, i - 1]))
    q, dq = change(np.concatenate(q, 1), np.concatenate(dq, 1))
    position = np.stack([forward(rig.finger(i + 1), q[:, 2 * i : 2 * i + 2]) for i in (0, 1)], 1)
    velocity = np.stack(
        [tip_velocity(rig.finger(i + 1), q[:, 2 * i : 2 * i + 2], dq[:, 2 * i : 2 * i + 2]) for i in (0, 1)],
        1,
    )
    return performance._replace(position=position, velocity=velocity)


# Joint angles read with constant offsets.

JOINTS = ("q11", "q12", "q21", "q22")

JOINT_OFFSET = Effect(
    name="joint_offset",
    acts_on="kinematics",
    says="recorded q = q + q0, per joint",
    shows="positions, widths, heights, by pose",
    mistaken_for=("link_length",),
    called="joint angles with a wrong zero",
    check=(
        "Home the joints again against their stops, or put the fingertips on a gauge block and compare "
        "angles."
    ),
    parameters=tuple(Parameter(q, "rad", 0.012) for q in JOINTS),
    admitted=lambda rig: ("joint_offset", dict(zip(JOINTS, rig.systematic.joint_offset, strict=True))),
    stage=KINEMATICS,
    restored=lambda channels, v: channels | {q: channels[q] - value for q, value in v.items()},
    correct=lambda w, v, on: w._replace(joints=w.joints - per_channel(v, JOINTS) * w.jointed),
    apply=lambda p, v, rng: moved_joints(p, lambda q, dq: (q + [v[n] for n in JOINTS], dq)),
)


# Links longer or shorter than nominal: all alike, or each by its own.

LINKS = ("link11", "link12", "link21", "link22")


def _longer(values, xp):
    return xp.stack([xp.asarray(values.get("scale", 0.0) + values.get(n, 0.0)) for n in LINKS])


def _patched_link_length(document, found):
    """Links longer by `scale`, all of them, or each by its own: link11 is finger 1's first."""
    from simgap.patch.write import interval_comment, number

    if "fingers" not in document:
        return None
    common = found["scale"]["mean"] if "scale" in found else 0.0
    for name, finger in document["fingers"].items():
        before = [float(v) for v in finger["links"]]
        own = [found.get(f"link{name}{k}") for k in (1, 2)]
        factors = [1 + common + (p["mean"] if p else 0.0) for p in own]
        finger["links"] = [number(v * f) for v, f in zip(before, factors, strict=True)]
        said = [interval_comment(p) for p in (found.get("scale"), *own) if p]
        finger["links"].comment(f"was {before}; share longer: {'; '.join(said)}")
    return {k: f"fingers.links.{k}" for k in found}


LINK_LENGTH = Effect(
    name="link_length",
    acts_on="kinematics",
    says="true link = (1 + scale) nominal, all links or each",
    shows="positions in proportion to reach",
    mistaken_for=("joint_offset",),
    called="links of another length than the model's",
    check="Measure the links from axis to axis, or touch two points a known distance apart.",
    parameters=tuple(Parameter(n, "1", 0.02, low=-0.2, high=0.2) for n in ("scale", *LINKS)),
    forms=(("scale",), LINKS),
    admitted=lambda rig: ("link_length/1", dict(zip(LINKS, rig.systematic.link_length, strict=True))),
    stage=KINEMATICS,
    patched=_patched_link_length,
    correct=lambda w, v, on: w._replace(link=w.link * (1 + _longer(v, jnp))),
    apply=lambda p, v, rng: moved_joints(p, lambda q, dq: (q, dq), _longer(v, np).tolist()),
)


# Joints that turn within a dead band before the sensor follows.

HUSH = 3.0  # chosen: sds of an angle by which it must turn on before its joint is taken to move
CROSSED, STAYED = 0.6, 0.1  # chosen: variance midway through a rest of a joint that turns back, or goes on


def _noise_backlash(values: jax.Array) -> jax.Array:
    """Noise (T, 4) of sampled signals (T, N, 4), from their second differences."""
    bend = jnp.abs(values[:, 2:] - 2 * values[:, 1:-1] + values[:, :-2])
    return jnp.maximum(jnp.median(bend, axis=1) / (0.6745 * np.sqrt(6)), 1e-6)


def _moves_backlash(joints: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Direction (T, N, 4) in which each recorded angle moves, -1, 1, or 0 where it rests; and the angle
    without its noise: it stays where it rests."""
    hush = HUSH * _noise_backlash(joints)

    def follow(last, now):
        new = jnp.clip(last, now - hush, now + hush)
        return new, (jnp.sign(new - last), new)

    _, out = jax.lax.scan(follow, joints[:, 0], jnp.moveaxis(joints, 1, 0))
    return jnp.moveaxis(out[0], 0, 1), jnp.moveaxis(out[1], 0, 1)


def _nearest_backlash(moves: jax.Array, reverse: bool) -> tuple[jax.Array, jax.Array]:
    """The last move before each sample (the next one in reverse), 0 where there is none, and how long ago.

    A sample's own noise would choose its own side, so its own move does not count.
    """

    def keep(state, now):
        move, ago = state
        after = jnp.where(now != 0, now, move), jnp.where(now != 0, 1.0, ago + 1)
        return after, state

    start = jnp.zeros_like(moves[:, 0]), jnp.ones_like(moves[:, 0])
    _, (move, ago) = jax.lax.scan(keep, start, jnp.moveaxis(moves, 1, 0), reverse=reverse)
    return jnp.moveaxis(move, 0, 1), jnp.moveaxis(ago, 0, 1)


def within(world: World, half: jax.Array, unseen: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Where in the dead band of so much to either side [rad] each joint lies (T, N, 4): mean and variance.

    A recorded angle that moves pins its joint to the side it moves to. At rest the joint goes from one pin
    to the next: as its speed says, unless that is `unseen`; then no one knows when. A band narrower than what
    an angle must turn on by to be seen moving is not seen either.
    """
    half = half * jnp.clip(2 * half / (HUSH * _noise_backlash(world.joints)[:, None]) - 1, 0.0, 1.0)
    moves, calm = _moves_backlash(world.joints)
    (last, ago), (following, ahead) = _nearest_backlash(moves, False), _nearest_backlash(moves, True)
    rest = ago + ahead - 1
    share = (ago - 0.5) / rest
    share = jnp.where(last == 0, 1.0, jnp.where(following == 0, 0.0, share))
    midway = jnp.where(last == following, STAYED * (1 - 1 / rest), CROSSED)
    open_end = (last == 0) | (following == 0)
    blind = jnp.square(half) * jnp.where(open_end, STAYED, 4 * share * (1 - share) * midway)

    # Speeds integrated less what the sensor saw: how far the joint went in its dead band, but for a constant.
    step = (world.t[:, 1:] - world.t[:, :-1])[..., None]
    went = jnp.cumsum(step * (world.rates[:, 1:] + world.rates[:, :-1]) / 2, axis=1)
    went = jnp.pad(went, ((0, 0), (1, 0), (0, 0)))
    hidden = went - calm
    # Of a sample that moves, what the sensor saw before: its own noise must not be taken out of it.
    own = went - jnp.concatenate([calm[:, :1], calm[:, :-1]], axis=1)
    n = hidden.shape[1]
    here = jnp.arange(n)[None, :, None]
    before, after = (
        jnp.take_along_axis(hidden, jnp.clip(here + k.astype(int), 0, n - 1), axis=1) for k in (-ago, ahead)
    )
    pinned = half * (last * (1 - share) + following * share)
    free = (moves == 0) | (last != following)
    path = pinned + (1 - unseen) * jnp.where(free, own - before * (1 - share) - after * share, 0.0)
    walk = jnp.square(_noise_backlash(world.rates)[:, None] * jnp.median(step))
    length = jnp.where(open_end, jnp.minimum(ago, ahead), rest * share * (1 - share))
    seen = jnp.minimum(walk * length, blind)
    return jnp.clip(path, -half, half), unseen * blind + (1 - unseen) * seen


def _correct_backlash(world: World, values, on) -> World:
    half, unseen = 0.5 * values["width"] * world.jointed, values["unseen"]
    place, variance = within(world, half, unseen)
    return world._replace(
        joints=world.joints + place,
        rates=world.rates + unseen * gradient(world.t, place),
        doubt_joints=world.doubt_joints + variance,
    )


def play(q: np.ndarray, width: float) -> np.ndarray:
    """The play operator over rows of q (n, 4): the output follows only outside the dead band."""
    out, last = np.empty_like(q), q[0].copy()
    for k, row in enumerate(q):
        last = np.clip(last, row - width / 2, row + width / 2)
        out[k] = last
    return out


BACKLASH = Effect(
    name="backlash",
    acts_on="kinematics",
    says="recorded q follows q only outside a dead band of `width`",
    shows="position jumps where a joint reverses",
    mistaken_for=("fingertip_compliance",),
    called="play in the joints",
    check="Hold each motor still and move its fingertip by hand; look for slack in gears or cables.",
    parameters=(
        Parameter("width", "rad", 0.004, starts=(0.002, 0.006), low=0.0, high=0.05),
        # Rates from the encoder miss what it misses (1); a tachometer's do not (0).
        Parameter("unseen", "1", 0.5, starts=(0.8,), low=0.0, high=1.0, hidden=True),
    ),
    forms=(("width",), ("width", "unseen")),
    stage=KINEMATICS,
    correct=_correct_backlash,
    apply=lambda p, v, rng: moved_joints(p, lambda q, dq: (play(q, v["width"]), dq)),
)


# A hand that turns a little about the grip while it carries, both fingers and the block together.

SLOW = 2.0  # prior: Hz; a hand with a block in it turns no faster (an arm's own modes lie above)
VARIED = 0.5  # prior: log sd of a carry's roll about that of all: a second of it is one swing or two
ROLLS = np.geomspace(2e-4, 0.1, 40)  # prior: rad


def _scatter_hand_roll(given, residual: np.ndarray):
    """Roll shows in the fingers' height difference alone: its width times the angle, slowly.

    Its power lies in the first cosines of every carry, evenly up to SLOW. A hand rolls in every carry alike:
    what turns in some of them only is no roll of the hand.
    """
    from scipy.fft import dct

    from simgap.gap.assemble import on_grid, rows_of

    rows, arrays, there = rows_of(given), given.frame.arrays, given.whitening.weight > 0
    width = np.einsum("tnm,mo,o->tn", arrays.onehot, arrays.objects, given.centre[:, 1])
    lever = rolled_offset(width * arrays.phase[..., Phase.CARRY], 1.0)[..., None] * given.whitening.weight
    lever[..., [c for c, name in enumerate(CHANNELS) if name != "offset"]] = 0.0
    lever = lever[there]
    unit, square = np.zeros(lever.size), np.zeros(lever.size)
    mine = np.flatnonzero(lever > 0)
    for cell in np.unique(rows.cell[mine]):
        at = mine[rows.cell[mine] == cell]
        if at.size < 4:
            continue
        step = float(np.median(np.diff(rows.time[at])))
        slow = np.arange(at.size) / (2 * at.size * step) < SLOW
        unit[at] = slow * np.mean(lever[at] ** 2) * at.size / slow.sum()
        square[at] = np.asarray(dct(residual[at], norm="ortho")) ** 2
    if not (unit > 0).any():
        return None
    found = on_grid("hand_roll", square, unit, ROLLS, rows.cell, VARIED)
    # How much of it there is in which carry and how fast nobody knows: what lies there has its own variance.
    return replace(found, variance=np.zeros_like(unit), known=0.0, frees=np.square(ROLLS[-1] * lever))


def _apply_hand_roll(performance: Performance, values, rng) -> Performance:
    """A smooth random turn of the given root mean square, while something is carried."""
    t = performance.t
    angle = np.zeros(t.size)
    for frequency in np.arange(0.2, 1.6, 0.2):
        angle += rng.normal() * np.sin(2 * np.pi * frequency * t + rng.uniform(0, 2 * np.pi))
    held = performance.carried > 0
    scale = np.sqrt(np.mean(angle[held] ** 2)) if held.any() else 1.0
    angle = values["amplitude"] * angle / scale * held
    position = performance.position.copy()
    for finger, sign in ((0, -0.5), (1, 0.5)):
        position[:, finger, 1] += sign * rolled_offset(performance.width, angle * held)
    return performance._replace(position=position)


HAND_ROLL = Effect(
    name="hand_roll",
    acts_on="motion",
    says="both fingers and the block turn about the grip by `amplitude` (rms) while carried",
    shows="height difference of the fingers while carried",
    mistaken_for=("offcentre_mass", "fingertip_compliance"),
    called="a hand that rolls while it carries",
    check=(
        "Watch both fingertips' heights while carrying: the wrist or the arm turns; measure it, or "
        "stiffen it."
    ),
    parameters=(Parameter("amplitude", "rad", 1.0, neutral=0.005, log=True, low=1e-4, high=0.2),),
    stage=KINEMATICS,
    scatter=_scatter_hand_roll,
    apply=_apply_hand_roll,
)
