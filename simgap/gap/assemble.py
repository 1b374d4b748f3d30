"""The gap of aligned trials as an attribution takes it: whitened rows, nuisances, linearised candidates."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np

from simgap.attribution.problem import Candidate, Gap, Rows
from simgap.effects import catalogue, decoys, fitted, free_parameters, name_of
from simgap.effects.base import Parameter, gradient, tips
from simgap.gap.fit import Fitted, Problem, columns_of, derivatives, limits, neutral, residual_at, slots
from simgap.gap.frame import CHANNELS, subtask_name
from simgap.gap.spread import Spread

BANDS = (0.0, 1.0, 5.0)  # chosen: Hz; lower edges of those that are told apart


def rows_of(given: Problem) -> Rows:
    """What each residual is, cells in the order of time."""
    frame, there = given.frame, given.whitening.weight > 0
    trial, sample, channel = np.nonzero(there)
    return Rows(
        trial, channel, frame.arrays.subtask[trial, sample], frame.world.t[trial, sample],
        frame.files, CHANNELS, tuple(f"{k}:{subtask_name(s)}" for k, s in enumerate(frame.steps)), BANDS,
    )  # fmt: skip


def gap_of(given: Problem, healthy: Fitted, fits: Sequence[Fitted], spreads: Sequence[Spread] = ()) -> Gap:
    """The gap with a candidate for every fit (of one effect each), every spread, and the properties that were
    measured apart."""
    k = given.num_properties
    start = healthy.residual - healthy.push @ healthy.u[:k]
    nuisance = np.concatenate([-healthy.push, *_admitted(given, healthy), *_late_rates(given)], 1)
    candidates = [_shifting(given, f, start, healthy.push) for f in fits]
    candidates += [_spreading(s) for s in spreads]
    candidates += _measured(given, healthy.push)
    return Gap(rows_of(given), start, nuisance, tuple(candidates))


def together(given: Problem, gap: Gap, healthy: Fitted, joint: Fitted, left: Sequence[Spread] = ()) -> Gap:
    """The gap with further candidates: the effects of a joint fit, linearised where they are together.

    Each shifts the residual by what leaving it out changes; what they do only together is parted evenly.
    What scatters is as large as it is in what they leave (`left`).
    """
    k = given.num_properties
    again = {s.effect: _spreading(s) for s in left}
    gap = replace(gap, candidates=tuple(again.get(c.name, c) for c in gap.candidates))
    if len(joint.effects) < 2:
        return gap
    there = given.whitening.weight > 0
    start = gap.residual - (joint.residual - healthy.push @ joint.u[:k])  # what all of them take off
    alone = []
    for key in joint.effects:
        u = joint.u.copy()
        own = columns_of(given, (key,))[k:]
        u[own] = neutral(given)[own]
        rest = tuple(e for e in joint.effects if e != key)
        alone.append(residual_at(given, rest, u)[there] - joint.residual)
    both = (start - sum(alone)) / len(alone)
    more, at = [], k
    for key, shift in zip(joint.effects, alone, strict=True):
        free = _free(key)
        more.append(_candidate(given, key, joint.columns[at : at + len(free)], joint.u, shift + both,
                               joint.push[:, at : at + len(free)], joint.doubts / len(alone)))  # fmt: skip
        at += len(free)
    return Gap(gap.rows, gap.residual, gap.nuisance, (*gap.candidates, *more), gap.expected)


def _free(key: str) -> list[Parameter]:
    """The free parameters of a form, in the order of its columns."""
    return [p for p in fitted()[name_of(key)].parameters if p.name in free_parameters(key)]


def _shifting(given: Problem, f: Fitted, start: np.ndarray, push: np.ndarray) -> Candidate:
    """A fit as a candidate: what it takes off the residual, at properties' own nominal."""
    k = given.num_properties
    shift = start - (f.residual - push @ f.u[:k])
    return _candidate(given, f.effects[0], f.columns[k:], f.u, shift, f.push[:, k:], f.doubts)


def _candidate(
    given: Problem,
    key: str,
    own: np.ndarray,
    u: np.ndarray,
    shift: np.ndarray,
    push: np.ndarray,
    doubts: float,
) -> Candidate:
    """One form of an effect at coordinates u, of which it has the columns `own`."""
    free, effect = _free(key), fitted()[name_of(key)]
    low, high = (edge[own] for edge in limits(given))
    return Candidate(
        effect.name, tuple(p.name for p in free), u[own], neutral(given)[own], np.ones(own.size), shift,
        -push,
        low, high, evidence=-doubts, named=effect.name not in decoys(),
        hidden=tuple(p.name for p in free if p.hidden or p.shape),
        size=np.array([1 / p.sd if p.log else np.nan for p in free]),
    )  # fmt: skip


def _spreading(s: Spread) -> Candidate:
    nothing, count = np.zeros(0), s.variance.size
    return Candidate(s.effect, (), nothing, nothing, nothing, np.zeros(count), np.zeros((count, 0)), nothing,
                     nothing, s.variance, s.known, s.same, frees=s.frees)  # fmt: skip


def _measured(given: Problem, push: np.ndarray) -> list[Candidate]:
    """Each property that was measured apart, wrong."""
    out, nothing = [], np.zeros(1)
    wrong = catalogue()["actual"].parameters[0].sd
    for o, name in enumerate(given.frame.task.objects):
        for k, kind in enumerate(("weight", "width", "height")):
            column = push[:, 3 * o + k]
            if given.measured[o, k] and (column**2).sum() > 1.0:
                usual = np.full(1, wrong * abs(given.centre[o, k]) / given.spread[o, k])
                out.append(Candidate("actual", (f"{name}.{kind}",), nothing, nothing, usual,
                                     np.zeros(len(push)), -column[:, None], np.full(1, -np.inf),
                                     np.full(1, np.inf)))  # fmt: skip
    return out


def _late_rates(given: Problem) -> list[np.ndarray]:
    """Columns (n, 1) of speeds that are differences of positions, late by half a sample, or smoothed.

    How a drive comes by its speeds rig.toml does not say: differences are as usual as a tachometer.
    """
    world, weight = given.frame.world, given.whitening.weight
    tree = jax.tree.map(jnp.asarray, world)
    step = float(np.median(np.diff(world.t[0])))
    velocity = np.asarray(tips(tree)[1])
    mean = (velocity[..., :2] + velocity[..., 2:]) / 2
    rate = np.asarray(gradient(tree.t, jnp.asarray(mean)))
    bend = np.asarray(gradient(tree.t, jnp.asarray(rate)))
    position = np.asarray(tips(tree)[0])
    place = (position[..., :2] + position[..., 2:]) / 2
    # What a drive that takes differences of its own readings from sample to sample would say.
    before = np.concatenate([world.joints[:, :1], world.joints[:, :-1]], 1)
    own = np.asarray(tips(tree._replace(rates=jnp.asarray((world.joints - before) / step)))[1])
    own = (own[..., :2] + own[..., 2:]) / 2
    own[:, 1:-1] = (own[:, :-2] + 4 * own[:, 1:-1] + own[:, 2:]) / 6
    own = own - np.asarray(gradient(tree.t, jnp.asarray(place)))
    out = []
    for change, usual in ((own, 1.0), (rate, step / 2), (bend, step**2 / 2)):
        column = np.zeros_like(weight)
        for k, channel in enumerate(("vx", "vy")):
            c = CHANNELS.index(channel)
            column[..., c] = usual * change[..., k] * weight[..., c]
        out.append(column[weight > 0][:, None])
    return out


def _admitted(given: Problem, healthy: Fitted) -> list[np.ndarray]:
    """Columns (n, .) of what rig.toml admits under [systematic], each per its standard deviation."""
    out, k = [], given.num_properties
    for slot in slots(k)[0]:
        if slot.effect.admitted is None:
            continue
        key, sds = slot.effect.admitted(given.frame.rig)
        if any(sds.values()):
            push = derivatives(given, (key,), healthy.u)[:, k:]
            for j, p in enumerate(_free(key)):
                if sds.get(p.name, 0.0) > 0:
                    out.append(-push[:, [j]] * sds[p.name] / p.sd)
    return out
