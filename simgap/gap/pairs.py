"""Pairs of effects: the leading singles with whatever gains most beside them, and which of them pay."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from simgap.effects import catalogue, decoys
from simgap.gap import judge
from simgap.gap.bank import Bank
from simgap.gap.candidate import LEAST, Candidate, believed, left, recurring, scored, single
from simgap.gap.candidates import best_fits, deterministic
from simgap.gap.fit import LARGE, Fitted, Problem, Start, fit, slots
from simgap.gap.locate import ALARM
from simgap.gap.spread import spreads

BEAM, PARTNERS = 2, 5  # singles that pairs start from, partners refined for each
SWAPS = 2  # times that a half of the best pair is exchanged
MORE, COARSE = 3e-4, 1e-2  # share of its evidence that a pair must gain over its better half, a coarse one;
CALM, CALMER = 0.1, 1e-4  # what that half leaves must look less like noise than this, even less if coarse,
AMPLE = 0.2  # unless the pair gains so large a share,
SURELY, PLAIN = 15.0, 30.0  # beside one that is not coarse that and so many nats, or so many by themselves;
WORTH = 0.7  # and the pair must leave no more than this share of what its better half leaves,
PLENTY = 0.03  # or gain this share
STRAINED = 10.0  # nats by which its half bends what was measured of the blocks: no residual shows that;
SOLVED = 0.4  # share of what a coarse half leaves that a pair may leave, like noise, to gain as little
STUCK = 2.0  # nats at T = 1 by which a half of a pair, taken alone, may do better than as a single so far
LITTLE = 3e-3  # share of the gap that is lost in the noise's own scatter: what leaves less is not compared
# What shifts or smooths samples in time.
SHAPING = frozenset({"clock_jitter", "force_lag", "force_lowpass", "structural_vibration"})


def tried(
    given: Problem,
    singles: list[Candidate],
    healthy: Fitted,
    names: list[str],
    temperature: float,
    bank: Bank,
) -> tuple[list[Candidate], list[Candidate]]:
    """The singles and the pairs of the leading ones with whatever gains most beside them.

    What is named beside a leading single may go better with another one: as long as that finds better pairs,
    the half of the best pair that no pair was sought for is the next to be taken. It joins the singles.
    """
    known = [c for c in singles if c.name not in decoys()]
    enough = known[0].spread is None and left(given, known[0], healthy, bank)[1] > ALARM
    beam = [c for c in known if c.spread is None][: 1 if enough else BEAM]
    sought = {c.name for c in beam}
    found = _pairs(given, beam, healthy, names, temperature)
    leading = max((c.evidence for c in known if c.spread is None), default=0.0)
    for _ in range(SWAPS):
        best = _shifting(found.values())
        if best is None or best.evidence < leading + LEAST:
            break
        for name in set(best.effects) - sought:
            half = next((c for c in singles if c.name == name), None)
            if half is None:
                half = single(given, fit(given, [Start((name,), best.fitted.u)])[0], healthy, temperature)
                singles = sorted([*singles, half], key=lambda c: -c.evidence)
            sought.add(name)
            for key, pair in _pairs(given, [half], healthy, names, temperature).items():
                if key not in found or pair.evidence > found[key].evidence:
                    found[key] = pair
    return singles, list(found.values())


def unstuck(
    given: Problem,
    singles: list[Candidate],
    pairs: Sequence[Candidate],
    healthy: Fitted,
    temperature: float,
) -> list[Candidate]:
    """The singles, best first, fitted again from the values that they have in the best pair."""
    best = _shifting(pairs)
    if best is None:
        return singles
    stuck = [c for c in singles if c.name in best.effects]
    if best.evidence < max(c.evidence for c in stuck) + LEAST:
        return singles
    again = {f.effects: f for f in fit(given, [Start(c.effects, best.fitted.u) for c in stuck])}
    freed = {
        c.name: single(given, again[c.effects], healthy, temperature)
        for c in stuck
        if again[c.effects].cost < c.fitted.cost - STUCK
    }
    return sorted((freed.get(c.name, c) for c in singles), key=lambda c: -c.evidence) if freed else singles


def _shifting(pairs: Iterable[Candidate]) -> Candidate | None:
    """The best of those pairs that shift the mean with both halves."""
    return max((c for c in pairs if c.spread is None), key=lambda c: c.evidence, default=None)


def worthwhile(
    given: Problem, singles: Sequence[Candidate], pairs: Sequence[Candidate], healthy: Fitted, bank: Bank
) -> list[Candidate]:
    """The pairs that say enough more than the better one of their halves."""
    out = []
    rests: dict[str, tuple[float, float]] = {}
    for pair in pairs:
        better = max((c for c in singles if c.name in pair.effects), key=lambda c: c.evidence)
        coarse = better.spread is None and any(catalogue()[name].coarse for name in better.effects)
        gain = pair.evidence - better.evidence
        share = gain / max(pair.evidence, LEAST)
        if gain < LEAST or share < MORE:
            continue
        if believed(given, pair.fitted) - believed(given, better.fitted) > STRAINED:
            out.append(pair)
            continue
        if better.name not in rests:
            rests[better.name] = left(given, better, healthy, bank)
        rest, p_rest = rests[better.name]
        after, p_after = left(given, pair, healthy, bank)
        solved = p_after > ALARM and after < SOLVED * rest
        if share < (COARSE if coarse and not solved else MORE):
            continue
        ample = share > AMPLE and (coarse or gain > SURELY)
        plain = gain > PLAIN and not coarse
        if p_rest > (CALMER if coarse else CALM) and not (ample or plain):
            continue
        if share > PLENTY or after < WORTH * rest or (after < LITTLE and p_after > ALARM):
            out.append(pair)
    return out


def _pairs(
    given: Problem, best: Sequence[Candidate], healthy: Fitted, names: list[str], temperature: float
) -> dict[str, Candidate]:
    """Pairs of the best singles by name, none of them a spread, with whatever gains most beside them.

    Two effects that both reshape signals in time (SHAPING) make up for each other's form: no
    sampled recording tells such a pair from one of them.
    """
    out: dict[str, Candidate] = {}
    width = {s.effect.name: len(s.effect.parameters) for s in slots(given.num_properties)[0]}
    for half in best:
        partners = [
            n
            for n in deterministic(names)
            if n != half.name and width[n] + width[half.name] <= LARGE and not {n, half.name} <= SHAPING
        ]
        wanted = [tuple(sorted((half.name, n))) for n in partners]
        fits = best_fits(given, wanted, healthy, [half.fitted] * len(wanted), steps=3)
        fits = sorted(fits, key=lambda f: f.cost)[:PARTNERS]
        for f in fit(given, [Start(f.effects, f.u) for f in fits]):
            name = judge.joined(f.effects)
            candidate = recurring(given, scored(given, f, healthy, temperature), half.fitted, temperature)
            if name not in out or candidate.evidence > out[name].evidence:
                out[name] = candidate
        for s in spreads(given, half.fitted):
            if s.effect not in names or {s.effect, half.name} <= SHAPING:
                continue
            name = judge.joined((half.name, s.effect))
            out[name] = Candidate(name, half.evidence + s.evidence / temperature, half.fitted, s)
    return out
