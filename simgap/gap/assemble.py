"""The gap of aligned trials as an attribution takes it: whitened rows, nuisances, linearised candidates."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from hmmseg.io.rig import Tolerance
from simgap.attribution.problem import BANDS, Candidate, Gap, Rows
from simgap.effects import catalogue, decoys, fitted, name_of
from simgap.gap.evaluation import residual_at
from simgap.gap.fit import Fitted
from simgap.gap.noise_model import with_noise
from simgap.gap.problem import Problem, columns_of, free_of, limits, neutral
from simgap.gap.redrawn_noise import carried, on_other
from simgap.gap.scatter import Scatter
from simgap.gap.tolerance import tolerated
from simgap.gap.trial_arrays import CHANNELS
from simgap.phases import Phase

SHOWN = 1.0  # chosen: squared residual [noise's] of a measured property's sd, above which it shows at all


def rows_of(given: Problem) -> Rows:
    """What each residual is, cells in the order of time."""
    frame, there = given.frame, given.whitening.weight > 0
    trial, sample, channel = np.nonzero(there)
    return Rows(
        trial, channel, frame.arrays.subtask[trial, sample], frame.world.t[trial, sample],
        frame.files, CHANNELS, tuple(f"{k}:{s.label}" for k, s in enumerate(frame.steps)), BANDS,
    )  # fmt: skip


def gap_of(
    given: Problem,
    healthy: Fitted,
    fits: Sequence[Fitted],
    scatters: Sequence[Scatter] = (),
    redrawn: Sequence[Problem] = (),
) -> Gap:
    """The gap with a candidate for every fit (of one effect each) and scatter, and for properties that were
    measured apart. What sensors' noise makes of them is seen on `redrawn` recordings."""
    rows = with_noise(given, rows_of(given), given.nuisances.left(healthy.residual))
    usual = given.frame.rig.tolerance == Tolerance()
    scattering, tolerance = [_scattering(s, rows) for s in scatters], tolerated(given)
    # Which properties show is decided here alone: with more noise on the recordings others might.
    seen = {c.parameters for c in _measured(given, healthy) if np.square(c.jacobian).sum() > SHOWN}

    def at(problem: Problem, healthy: Fitted, fits: Sequence[Fitted]) -> Gap:
        k = problem.num_properties
        start = healthy.residual - healthy.push @ healthy.u[:k]
        nuisance = np.concatenate([-healthy.push, problem.nuisances.columns], 1)
        shifting = [_shifting(problem, f, start, healthy.push) for f in fits]
        measured = [c for c in _measured(problem, healthy) if c.parameters in seen]
        every = (*shifting, *scattering, *measured)
        return Gap(rows, start, nuisance, every, tolerance=tolerance, usual=usual)

    gap = at(given, healthy, fits)
    if not redrawn:
        return gap
    noise = carried(
        gap.raw_columns,
        redrawn,
        lambda other: at(other, on_other(other, healthy), [on_other(other, f) for f in fits]).raw_columns,
    )
    return replace(gap, carried=noise)


def _measured(given: Problem, healthy: Fitted) -> list[Candidate]:
    """A candidate for each property that was measured apart."""
    wrong = [e.wrong for e in catalogue().values() if e.wrong is not None]
    return [c for candidates in wrong for c in candidates(given, healthy.push)]


def together(
    given: Problem,
    gap: Gap,
    healthy: Fitted,
    joint: Fitted,
    left: Sequence[Scatter] = (),
    redrawn: Sequence[Problem] = (),
) -> Gap:
    """The gap with further candidates: the effects of a joint fit, linearised where they are together.

    Each shifts the residual by what leaving it out changes; what they do only together is parted evenly.
    What scatters is as large as it is in what they leave (`left`).
    """
    anew = {s.effect: _scattering(s, gap.rows) for s in left}
    gap = replace(gap, candidates=tuple(anew.get(c.name, c) for c in gap.candidates))
    if len(joint.effects) < 2:
        return gap
    own = _joint(given, healthy, joint)
    more = replace(gap, candidates=(*gap.candidates, *own))
    if gap.carried is None:
        return more
    kept = gap.carried.shape[2]

    def on(other: Problem) -> np.ndarray:
        shaken = _joint(other, on_other(other, healthy), on_other(other, joint))
        return replace(more, candidates=(*gap.candidates, *shaken)).raw_columns[:, kept:]

    noise = carried(more.raw_columns[:, kept:], redrawn, on)
    return replace(more, carried=np.concatenate([gap.carried, noise], 2))


def _joint(given: Problem, healthy: Fitted, joint: Fitted) -> list[Candidate]:
    """The effects of a joint fit as candidates of their own."""
    k, there = given.num_properties, given.whitening.weight > 0
    # What all of them take off.
    all_of_them = healthy.residual - joint.residual - healthy.push @ (healthy.u[:k] - joint.u[:k])
    alone = []
    for key in joint.effects:
        u = joint.u.copy()
        own = columns_of(given, (key,))[k:]
        u[own] = neutral(given)[own]
        rest = tuple(e for e in joint.effects if e != key)
        alone.append(residual_at(given, rest, u)[there] - joint.residual)
    both = (all_of_them - sum(alone)) / len(alone)
    out, at = [], k
    for key, shift in zip(joint.effects, alone, strict=True):
        free = free_of(key)
        out.append(_candidate(given, key, joint.columns[at : at + len(free)], joint.u, shift + both,
                              joint.push[:, at : at + len(free)], joint.doubts / len(alone)))  # fmt: skip
        at += len(free)
    return out


def _turning(given: Problem, angle: float) -> np.ndarray:
    """Variance (n,) of cosine coefficients where standing blocks turn in the grip by up to an angle [rad].

    It shows in the fingers' distance and offset, and in their height, but not in its mean: there the block
    stands.
    """
    rows, weight, arrays = rows_of(given), given.whitening.weight, given.frame.arrays
    width = np.einsum("tnm,mo,o->tn", arrays.onehot, arrays.objects, given.centre[:, 1])
    size, there = weight * (angle * width)[..., None], weight > 0
    stands = arrays.phase[..., [Phase.PICKUP, Phase.PLACE]].sum(-1) > 0
    stands = np.repeat(stands[..., None], len(CHANNELS), -1)[there]
    mean = np.zeros(stands.size, bool)
    mean[np.unique(rows.cell, return_index=True)[1]] = True
    y, distance, offset = (rows.channel == CHANNELS.index(c) for c in ("y", "distance", "offset"))
    return np.square(size[there]) * (stands & (distance | offset | (y & ~mean)))


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
    free, effect = free_of(key), fitted()[name_of(key)]
    low, high = (edge[own] for edge in limits(given))
    turned = sum(float(p.value(u[c])) for p, c in zip(free, own, strict=True) if p.name == effect.turns)
    return Candidate(
        effect.name, tuple(p.name for p in free), u[own], neutral(given)[own], np.ones(own.size), shift,
        -push,
        low, high, evidence=-doubts, named=effect.name not in decoys(),
        hidden=tuple(p.name for p in free if p.hidden or p.shape),
        size=np.array([1 / p.sd if p.log else np.nan for p in free]),
        frees=_turning(given, turned) if effect.turns else None,
    )  # fmt: skip


def _scattering(s: Scatter, rows: Rows) -> Candidate:
    """What scatters as a candidate; its variance over that of the noise as it is in these rows."""
    nothing, count = np.zeros(0), s.variance.size
    variance = s.variance / (1.0 if rows.sd is None else np.square(rows.sd))
    return Candidate(s.effect, (), nothing, nothing, nothing, np.zeros(count), np.zeros((count, 0)), nothing,
                     nothing, variance, s.known, s.same, frees=s.frees)  # fmt: skip
