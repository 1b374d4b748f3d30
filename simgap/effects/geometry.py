"""Effects on where the fingers are: joint offsets, link lengths, backlash, hand roll."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import tomlkit

from hmmseg.contact.equations import rolled_offset
from hmmseg.hand.kinematics import forward, inverse, joint_velocity, tip_velocity
from hmmseg.io.rig import JOINTS
from hmmseg.levels import SHOWN
from simgap import channels
from simgap.effect import Array, Parameter
from simgap.effects.base import (
    KINEMATICS,
    DeadBand,
    HandEffect,
    Performance,
    Values,
    World,
    gradient,
    interval_comment,
    number,
)
from simgap.gap.frame import CHANNELS
from simgap.phases import Phase

# A hand that differs from its drawing: angles with offsets, links longer than nominal (all alike, or each).

LINKS = ("link11", "link12", "link21", "link22")


def _numbers(values: Mapping[str, float], names: Sequence[str], common: str = "") -> np.ndarray:
    return np.array([values.get(n, 0.0) + values.get(common, 0.0) for n in names])


def correct_hand(world: World, values: Values, on: Array) -> World:
    """The world as the true hand makes it."""
    return world._replace(
        joints=world.joints - _numbers(values, JOINTS) * world.jointed,
        link=world.link * (1 + _numbers(values, LINKS, "scale")),
    )


def apply_hand(p: Performance, values: Values, rng: np.random.Generator) -> Performance:
    """Tips as computed with nominal geometry from the angles of a deviating hand."""
    return moved_joints(p, values, lambda q: q + _numbers(values, JOINTS))


def moved_joints(p: Performance, values: Values, change: Callable[[np.ndarray], np.ndarray]) -> Performance:
    """Tips as computed with nominal geometry from the angles (n, 4) of the true hand, passed through
    `change`."""
    longer = _numbers(values, LINKS, "scale").reshape(2, 2)
    fingers, q, dq = [p.rig.finger(i) for i in (1, 2)], [], []
    for i, nominal in enumerate(fingers, 1):
        true = nominal.model_copy(update={"links": tuple(nominal.links * (1 + longer[i - 1]))})
        q.append(inverse(true, i, p.position[:, i - 1]))
        dq.append(joint_velocity(true, q[-1], p.velocity[:, i - 1]))
    read = np.split(change(np.concatenate(q, 1)), 2, axis=1)
    position = np.stack([forward(f, a) for f, a in zip(fingers, read, strict=True)], 1)
    velocity = np.stack([tip_velocity(f, a, da) for f, a, da in zip(fingers, read, dq, strict=True)], 1)
    return p._replace(position=position, velocity=velocity)


def _patched_link_length(document: tomlkit.TOMLDocument, found: Mapping[str, Any]) -> dict[str, str] | None:
    """Put link lengths into the rig: all longer by `scale`, or each by its own share (link11: finger 1's
    first)."""
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


JOINT_OFFSET = HandEffect(
    name="joint_offset",
    exact=True,
    acts_on="kinematics",
    says="recorded q = q + q0, per joint",
    shows="positions, widths, heights, by pose",
    mistaken_for=("link_length",),
    called="joint angles with a wrong zero",
    check="Home the joints against their stops, or put the fingertips on a gauge block and compare angles.",
    parameters={q: Parameter(0.0, 0.012, "rad") for q in JOINTS},
    admitted=lambda rig: ("joint_offset", dict(zip(JOINTS, rig.systematic.joint_offset, strict=True))),
    stage=KINEMATICS,
    restored=lambda channels, v: channels | {q: channels[q] - value for q, value in v.items()},
    correct=correct_hand,
    apply=apply_hand,
)

LINK_LENGTH = HandEffect(
    name="link_length",
    exact=True,
    acts_on="kinematics",
    says="true link = (1 + scale) nominal, all links or each",
    shows="positions in proportion to reach",
    mistaken_for=("joint_offset",),
    called="links of another length than the model's",
    check="Measure the links from axis to axis, or touch two points a known distance apart.",
    parameters={n: Parameter(0.0, 0.02, low=-0.2, high=0.2) for n in ("scale", *LINKS)},
    forms=(("scale",), LINKS),
    admitted=lambda rig: ("link_length/1", dict(zip(LINKS, rig.systematic.link_length, strict=True))),
    stage=KINEMATICS,
    patched=_patched_link_length,
    correct=correct_hand,
    apply=apply_hand,
)


# Joints that turn within a dead band before the sensor follows.

ANYWHERE = 4 / 3  # physics: mean square distance from a side of a band to anywhere in it, in half its width


def _noise(values: np.ndarray) -> np.ndarray:
    """Noise (T, 4) of sampled signals (T, N, 4), from their second differences."""
    bend = np.abs(values[:, 2:] - 2 * values[:, 1:-1] + values[:, :-2])
    return np.maximum(np.median(bend, axis=1) / (0.6745 * np.sqrt(6)), 1e-6)


def _moves(joints: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Direction (T, N, 4) of motion of each recorded angle, -1, 1, or 0 at rest, and the angle without its
    noise, constant at rest."""
    from simgap.recursions import play

    hush = SHOWN * _noise(joints)
    calm = np.empty_like(joints)
    for trial, joint in np.ndindex(hush.shape):
        calm[trial, :, joint] = play(joints[trial, :, joint], 2 * hush[trial, joint])
    return np.sign(np.diff(calm, axis=1, prepend=joints[:, :1])), calm


def _nearest_move(moves: np.ndarray, reverse: bool) -> tuple[np.ndarray, np.ndarray]:
    """The last move before each sample (in reverse: the next one), 0 if there is none, and its distance in
    samples.

    A sample's own move does not count, as its noise would choose its own side.
    """
    if reverse:
        move, ago = _nearest_move(moves[:, ::-1], False)
        return move[:, ::-1], ago[:, ::-1]
    here = np.arange(moves.shape[1])[:, None]
    last = np.maximum.accumulate(np.where(moves != 0, here, -1), axis=1)
    last = np.concatenate([np.full_like(last[:, :1], -1), last[:, :-1]], 1)
    move = np.where(last < 0, 0.0, np.take_along_axis(moves, np.maximum(last, 0), axis=1))
    return move, (here - last).astype(float)


def within(world: World, half: float, unseen: float) -> DeadBand:
    """Where in the dead band of `half` to either side [rad] each joint is, and what is known of that.

    A recorded angle that moves pins its joint to the side it moves towards. At rest the joint goes from one
    pin to the next: as its speed says, unless speeds are `unseen`; then the time is unknown, and from any
    sample to the next it may have gone anywhere in the band, and never farther. A band too narrow for motion
    to be detected has no effect.
    """
    band = half * np.clip(2 * half / (SHOWN * _noise(world.joints)[:, None]) - 1, 0.0, 1.0)
    moves, calm = _moves(world.joints)
    (last, ago), (following, ahead) = _nearest_move(moves, False), _nearest_move(moves, True)
    rest = ago + ahead - 1
    share = (ago - 0.5) / rest
    share = np.where(last == 0, 1.0, np.where(following == 0, 0.0, share))

    # Integrated speed minus the sensor's motion: how far the joint moved in its dead band, up to a constant.
    step = (world.t[:, 1:] - world.t[:, :-1])[..., None]
    went = np.cumsum(step * (world.rates[:, 1:] + world.rates[:, :-1]) / 2, axis=1)
    went = np.pad(went, ((0, 0), (1, 0), (0, 0)))
    hidden = went - calm
    # For a moving sample, the sensor's previous value: its own noise must not be removed from it.
    own = went - np.concatenate([calm[:, :1], calm[:, :-1]], axis=1)
    n = hidden.shape[1]
    here = np.arange(n)[None, :, None]
    before, after = (
        np.take_along_axis(hidden, np.clip(here + k.astype(int), 0, n - 1), axis=1) for k in (-ago, ahead)
    )
    side = band * (last * (1 - share) + following * share)
    free = (moves == 0) | (last != following)
    path = side + (1 - unseen) * np.where(free, own - before * (1 - share) - after * share, 0.0)
    place = np.clip(path, -band, band)
    seen = np.square(_noise(world.rates)[:, None] * np.median(step))
    # Changes within the noise pin nothing.
    went_on = np.abs(np.diff(calm, axis=1))
    far = np.pad(went_on, ((0, 0), (1, 0), (0, 0))) + np.pad(went_on, ((0, 0), (0, 1), (0, 0)))
    return DeadBand(
        place,
        (last == following) & (rest == 1) & (far > SHOWN * _noise(world.joints)[:, None]),
        (1 - unseen) * np.clip(np.diff(own, axis=1, prepend=own[:, :1]), -2 * band, 2 * band),
        np.broadcast_to((1 - unseen) * np.minimum(seen, np.square(band) * ANYWHERE), place.shape),
        np.square(unseen * band[:, 0]) * ANYWHERE,
    )


def _correct_backlash(world: World, values: Values, on: Array) -> World:
    half, unseen = 0.5 * values["width"] * world.jointed, values["unseen"]
    band = within(world, half, unseen)
    return world._replace(
        joints=world.joints + band.place,
        rates=world.rates + unseen * gradient(world.t, band.place),
        dead_band=band,
    )


BACKLASH = HandEffect(
    name="backlash",
    acts_on="kinematics",
    says="recorded q follows q only outside a dead band of `width`",
    shows="position jumps where a joint reverses",
    mistaken_for=("fingertip_compliance",),
    called="play in the joints",
    check="Hold each motor still and move its fingertip by hand; look for slack in gears or cables.",
    parameters={
        "width": Parameter(0.0, 0.004, "rad", starts=(0.002, 0.006), low=0.0, high=0.05),
        # Rates from the encoder miss what it misses (1); those of a tachometer do not (0).
        "unseen": Parameter(0.0, 0.5, starts=(1.0,), low=0.0, high=1.0, hidden=True),
    },
    forms=(("width",), ("width", "unseen")),
    stage=KINEMATICS,
    correct=_correct_backlash,
    apply=lambda p, v, rng: moved_joints(
        p, {}, lambda q: np.stack([channels.play(a, v["width"]) for a in q.T], 1)
    ),
)


# A hand that rotates slightly about the grip while it carries, both fingers and the block together.

SLOW = 2.0  # prior: Hz; a hand that holds a block turns no faster (an arm's own modes are higher)
VARIED = 0.5  # prior: log sd of a carry's roll about that of all, as a second holds only a swing or two
ROLLS = np.geomspace(2e-4, 0.1, 40)  # prior: rad


def _scatter_hand_roll(given: Any, residual: np.ndarray) -> Any:
    """Variance from roll, which shows only in the fingers' height difference, slowly: width times angle.

    Its power lies in the first cosines of each carry, evenly up to SLOW. A hand rolls in all carries;
    rotation in only some of them is not a roll of the hand. The level of a grip and the nuisances are as
    slow, so each size is judged by its likelihood beside them, in the residuals of the whole grip.
    """
    from simgap.gap.assemble import on_grid
    from simgap.gap.nuisances import shifted_by

    arrays, there, time = given.frame.arrays, given.there, given.frame.world.t
    width = np.einsum("tnm,mo,o->tn", arrays.onehot, arrays.objects, given.centre[:, 1])
    lever = rolled_offset(width, 1.0) * arrays.phase[..., Phase.CARRY]
    here, grips, waves = CHANNELS.index("offset"), [], np.zeros((0, *lever.shape))
    for t, m in np.ndindex(len(time), arrays.onehot.shape[2]):
        held = arrays.onehot[t, :, m]
        at = np.flatnonzero(held * lever[t])
        if at.size < 4:
            continue
        count = int(np.ceil(2 * SLOW * (time[t, at[-1]] - time[t, at[0]])))
        waves = np.concatenate([waves, np.zeros((max(count - len(waves), 0), *lever.shape))])
        angle = np.cos(np.pi * np.outer(np.arange(count), np.arange(at.size) + 0.5) / at.size)
        waves[:count, t, at] = lever[t, at] * angle * np.sqrt((2 - (np.arange(count) == 0)) / count)[:, None]
        rows = np.zeros(there.shape, bool)
        rows[t, :, here] = held > 0
        grips.append((count, rows[there]))
    if not grips:
        return None
    of_roll, nats = np.hstack([shifted_by(given, {"offset": wave}) for wave in waves]), []
    for count, rows in grips:
        roll, other, z = of_roll[rows, :count], given.nuisances.columns[rows], residual[rows]
        turn = np.linalg.qr(np.column_stack([roll, other[:, other.any(0)]]))[0].T
        roll, other, z = turn @ roll, turn @ other, turn @ z
        still = np.eye(z.size) + other @ other.T
        of = [still + size**2 * roll @ roll.T for size in (0.0, *ROLLS)]
        cost = np.array([z @ np.linalg.solve(s, z) + np.linalg.slogdet(s)[1] for s in of]) / 2
        nats.append(cost[0] - cost[1:])
    found = on_grid("hand_roll", np.stack(nats, 1), np.zeros(residual.size), ROLLS, VARIED)
    # Size and speed are unknown in each carry: its slow coefficients have their own variance.
    frees = np.zeros(there.shape)
    frees[..., here] = np.square(ROLLS[-1] * lever * given.weight[..., here])
    return replace(found, known=0.0, frees=frees[there])


def _apply_hand_roll(performance: Performance, values: Values, rng: np.random.Generator) -> Performance:
    """A smooth random rotation of the given rms while something is carried."""
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


HAND_ROLL = HandEffect(
    name="hand_roll",
    acts_on="motion",
    says="both fingers and the block turn about the grip by `amplitude` (rms) while carried",
    shows="height difference of the fingers while carried",
    mistaken_for=("offcentre_mass", "fingertip_compliance"),
    called="a hand that rolls while it carries",
    check="Watch both fingertips' heights while carrying: the wrist or the arm turns; measure or stiffen it.",
    parameters={"amplitude": Parameter(0.005, 1.0, "rad", log=True, low=1e-4, high=0.2)},
    stage=KINEMATICS,
    scatter=_scatter_hand_roll,
    apply=_apply_hand_roll,
)
