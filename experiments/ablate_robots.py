"""Special cases of the diagnosis of robots, switched off one by one on a panel of cases.

    python -m experiments.ablate_robots CASES FLAGS OUT.jsonl

CASES, by commas: given:NAME or given:* (../shared/robots_check), drawn:N (of seed 58209190; `make robots-models` first), xl330:0,
two_link:NAME, cube:0, sts:N. FLAGS, by semicolons: names below; `base` first. Rollouts are kept within a case, and their time is added
where they are taken again. A flag that did not fire in the base run has its result.
"""
from __future__ import annotations
import hashlib, json, sys, tempfile, time, pickle, os, traceback
from collections import Counter
from contextlib import ExitStack, contextmanager
from pathlib import Path
import numpy as np

SHARED = Path("../shared")
DRAWN = Path("build/ablation/drawn")
FIRED: Counter = Counter()

import simgap.robots.model as model
import simgap.robots.search as search
import simgap.robots.sets as sets_
import simgap.robots.whiten as whiten
import simgap.robots.windows as windows
import simgap.robots.fit as fit
import simgap.robots.linear as linear
import simgap.robots.verdict as verdict
import simgap.robots.describe as describe
import simgap.robots.calibrate as calibrate
import simgap.robots.changes as changes
import simgap.robots.unchanged as unchanged
import simgap.robots.diagnose as diag
import simgap.robots.rows as rows_
import simgap.simulators.mjcf.catalogue as catalogue
import simgap.simulators.mjcf.play as play
import simgap.simulators.mjcf.runs as runs
import simgap.robot_effects as effects
from simgap.simulators.mjcf.load import load_mjcf

# --- memo of rollouts, by case -------------------------------------------------------------
MEMO: dict = {}
SAVED = [0.0]
SIM = [""]  # flags that change the simulator itself
_run_all = model.run_all

def _digest(simulator, jobs):
    h = hashlib.blake2b(SIM[0].encode())
    nominal = {n: p.nominal for n, p in simulator.parameters.items()}
    seen = {}
    for j in jobs:
        h.update(repr(sorted((n, v) for n, v in j.parameters.items() if v != nominal[n])).encode())
        r = j.recording
        h.update(f"{r.name}{r.first}{len(r)}".encode())
        h.update(r.t.tobytes())
        for n, v in r.columns.items():
            h.update(n.encode()); h.update(np.ascontiguousarray(v).tobytes())
        h.update(b"" if j.start is None else repr([*j.start.items()]).encode())
    return h.digest()

def memo_all(simulator, jobs):
    if type(simulator).__name__ != "MjcfSimulator":
        return _run_all(simulator, jobs)
    key = _digest(simulator, jobs)
    if key in MEMO:
        out, took = MEMO[key]
        SAVED[0] += took
        return [None if c is None else dict(c) for c in out]
    begun = time.process_time()
    out = _run_all(simulator, jobs)
    MEMO[key] = [None if c is None else dict(c) for c in out], time.process_time() - begun
    return out
model.run_all = memo_all

# --- flags ---------------------------------------------------------------------------------
@contextmanager
def put(obj, name, value):
    own = obj.__dict__[name] if isinstance(obj, type) else getattr(obj, name)
    setattr(obj, name, value)
    try:
        yield
    finally:
        setattr(obj, name, own)

FLAGS = {}
def flag(*puts, sim=False):
    return puts, sim

S, C = search.Search, whiten.Covariances

def no_settled(self, best):
    leading = max(self.fitted.values(), key=lambda one: one.score)
    return self._with_less(leading) if self._is_better(leading, best) else best

def not_anew(self, one):
    return one.composed.moved(one.point), one.linear, 0.0

_fit = S.fit
def one_scale(self, names, begin, scales, rival=-np.inf):
    return _fit(self, names, begin, scales[:1], rival)

def simply_better(self, one, best):
    if {*one.names} < {*best.names} or one.score <= best.score:
        return one.score > best.score
    return one.score > best.score + search.BETTER and search.predicts_better(self.gains(one, best, one))

def t_test(gain):
    return gain.size < 2 or search.by_chance(gain) < search.BY_CHANCE
def t_arcsinh(gain):
    return gain.size < 2 or search.by_chance(np.arcsinh(gain)) < search.BY_CHANCE
def odds_plain_t(gain):
    odds = -np.log(search.BY_CHANCE)
    if gain.size < 2 or (gain.sum() - gain.max() > odds and gain.min() > -odds):
        return True
    return search.by_chance(gain) < search.BY_CHANCE
def odds_only(gain):
    odds = -np.log(search.BY_CHANCE)
    return gain.size < 2 or (gain.sum() - gain.max() > odds and gain.min() > -odds)
def always(gain):
    return True

_sources = whiten._sources
def no_clock(*a):
    out = _sources(*a); out.pop(whiten.CLOCK, None); return out
def no_contacts(*a):
    out = _sources(*a); out.pop(whiten.CONTACTS, None); return out
def estimate_all(self, residual, wide=None):
    """No elimination: all sources at their maximum likelihood, none if together they gain less."""
    smooth, names = self._smooth, self.names
    left, rest = smooth.projected(residual, wide or {})
    kept = list(range(len(names)))
    x = smooth.first_guess(left)
    plain = smooth.cost(np.zeros(0), left, rest, [])[0]
    from scipy.optimize import minimize
    given = {"args": (left, rest, kept), "jac": True, "bounds": [(v - 20, v + 12) for v in x], "options": whiten.CLOSE}
    done = min((minimize(smooth.cost, x - b, method="L-BFGS-B", **given) for b in whiten.BELOW), key=lambda o: o.fun)
    if plain - done.fun >= whiten.WORTH:
        return {names[k]: float(np.exp(v / 2)) for k, v in zip(kept, done.x)}
    return whiten.NONE
_cost = whiten._Smooth.cost
def cost_smooth_only(self, x, left, rest, kept):
    variance = np.exp(x)
    whole = self.plain + np.tensordot(variance, self.source[kept], 1) if kept else self.plain
    inverse = np.linalg.inv(whole)
    pull = np.einsum("bij,bj->bi", inverse, left)
    value = 0.5 * float(np.linalg.slogdet(whole)[1].sum() + np.sum(pull * left))
    slope = [0.5 * float(np.sum(inverse * s) - np.einsum("bi,bij,bj->", pull, s, pull)) for s in self.source[kept]] if kept else []
    return value, variance * np.array(slope)

def plain_start(self):
    neutral = {e: self.composed.effects[e].neutral() for e in self.free}
    values = np.array([{**neutral[e], **self.free.get(e, {})}[n] for e, n in self.names])
    return np.clip((values - self.nominal) / self.sd, self.low, self.high)

_posterior = describe._posterior
def posterior_plain(found, one, jack=True, rivals_=True, spread=True):
    effects_, names = found.composed.effects, one.names
    keys = [(n, short) for n in names for short in effects_[n].parameters]
    f = one.sets.fit(names, 0)
    own = np.sqrt(np.diag(f.spread if spread else f.covariance))[-len(keys):] if keys else np.zeros(0)
    left_out = one.sets.jackknife(names, 0)[:, -len(keys):] if keys else np.zeros((0, 0))
    if jack and len(left_out) > 2:
        own = np.maximum(own, np.sqrt((len(left_out) - 1) * left_out.var(0)))
    usual = np.array([effects_[n].parameters[s].sd for n, s in keys])
    mean = {key: float(one.point[key[0]][key[1]]) for key in keys}
    sd = dict(zip(keys, (own * usual).tolist()))
    if rivals_:
        for key in keys:
            rivals = [s for s in found.search.fitted.values() if key[0] in s.names]
            weight = np.exp(np.minimum([s.score - one.score for s in rivals], 0.0))
            apart = np.array([s.point[key[0]][key[1]] - mean[key] for s in rivals])
            sd[key] = float(np.sqrt(sd[key] ** 2 + weight @ apart**2 / weight.sum()))
    return mean, sd

def alternatives_by_score(search_, best):
    return [one for one in search_.fitted.values()
            if one is not best and not {*best.names} < {*one.names} and one.score > best.score - np.log(verdict.RULED_OUT)]

def explanations_unclipped(others, best, small, right):
    score = np.array([best.score, *(s.score for s in others)])
    weight = np.exp(score - np.logaddexp.reduce(score))
    each = [tuple(sorted({*s.names} - small)) for s in (best, *others)]
    return [verdict.Explanation(n, float(w), n, right if n else 0.0) for n, w in zip(each, weight)]
_explanations = verdict._explanations
def explanations_all(others, best, small, right):
    return _explanations(others, best, set(), right)

def without_option(*names):
    own = catalogue._Catalogue.add
    def add(self, name, *a, **k):
        if name not in names:
            own(self, name, *a, **k)
    return add

def no_ahead(self, log, width):
    return np.zeros((len(log), 2))

class Lines:
    def __init__(self, at, times):
        place = np.clip(at / (times[1] - times[0]), 0, times.size - 1)
        i = np.minimum(place.astype(int), times.size - 2)
        self.s = (place - i)[..., None]
        first = times.size * np.arange(len(at))[:, None]
        self.rows = [i + first, i + 1 + first]
    def __call__(self, values):
        flat = values.reshape(-1, values.shape[-1])
        a, b = (flat[r] for r in self.rows)
        return a + self.s * (b - a)

_repeats = model.Composed.repeats
def jumps_none(simulator, log): return np.zeros(len(log))
_cut = windows.cut

FLAGS |= {
    "base": flag(),
    "search from the calibration": flag((search, "LEAVES", np.inf)),
    "other end of how commands are held": flag((S, "_from_other_ends", lambda self, best: best)),
    "rivals fitted to the end": flag((S, "_settled", no_settled)),
    "windows run from where a fit puts their starts": flag((S, "_begun_anew", not_anew)),
    "second whitener to begin from": flag((S, "fit", one_scale)),
    "leading candidates rolled out where they fit": flag((S, "_roll_out_leaders", lambda self, composed, base, linear, sets, held: linear)),
    "two effects more at once": flag((search, "pairs", lambda best, names: [])),
    "replacements that teach": flag((search, "LEARNED", 0)),
    "exchange of causes": flag((S, "_exchange", lambda self, best: None)),
    "held-out odds beside the t test": flag((search, "predicts_better", t_arcsinh), (verdict, "predicts_better", t_arcsinh)),
    "logarithm of large gains": flag((search, "predicts_better", odds_plain_t), (verdict, "predicts_better", odds_plain_t)),
    "t test beside the held-out odds": flag((search, "predicts_better", odds_only), (verdict, "predicts_better", odds_only)),
    "held-out logs judge steps": flag((search, "predicts_better", always)),
    "as simple and likelier goes on": flag((S, "_is_better", simply_better)),
    "windows off by themselves": flag((C, "outliers", lambda self, w, r: {})),
    "levels of the discrepancy": flag((search, "LEVELS", (1.0,))),
    "pruned set proposed": flag((sets_.Sets, "pruned", lambda self, names, level: names)),
    "fits whitened anew": flag((search, "AGAIN", 1)),
    "discrepancies": flag((C, "estimate", lambda self, r, wide=None: whiten.NONE)),
    "clock": flag((whiten, "_sources", no_clock)),
    "second start of discrepancies": flag((whiten, "BELOW", (0.0,))),
    "sources that gain little go": flag((C, "estimate", estimate_all)),
    "white rest of the discrepancy": flag((whiten._Smooth, "cost", cost_smooth_only)),
    "repeats of a motion": flag((model.Composed, "repeats", lambda self: [1] * len(self.windows))),
    "when a command jumped": flag((windows, "jumps", jumps_none)),
    "degree of starts by AIC": flag((windows, "DEGREES", (2,))),
    "first row with samples on either side": flag((windows, "_readable", lambda *a: 0)),
    "doubt of starts": flag((windows, "DOUBT", 1.0), (whiten, "DOUBT", 1.0)),
    "start of a fit taken back": flag((fit._Squares, "start", plain_start)),
    "finite differences as wide as uncertain": flag((fit._Squares, "_step", lambda self, e: None)),
    "plausible masses": flag((effects, "_plausible", lambda e: e)),
    "smoothed commands": flag((catalogue._Catalogue, "add", without_option(catalogue.SMOOTH)), sim=True),
    "commands late within a step": flag((catalogue._Catalogue, "add", without_option(catalogue.LATE)), sim=True),
    "integrator": flag((catalogue._Catalogue, "add", without_option("option.integrator")), sim=True),
    "solver's step": flag((catalogue._Catalogue, "add", without_option("option.timestep")), sim=True),
    "hold between samples": flag((catalogue._Catalogue, "add", without_option(catalogue.HOLD)), sim=True),
    "two-body play": flag((catalogue._Catalogue, "add_play", lambda self, *a: None), sim=True),
    "elasticity": flag((catalogue, "elasticity", lambda *a: []), sim=True),
    "motor ahead by a free run": flag((play.Played, "_run", no_ahead), sim=True),
    "cubic reading of sensors": flag((runs, "Between", Lines), sim=True),
    "contacts apart": flag((model.Composed, "calm", lambda self: self)),
    "wobble of contacts": flag((search, "with_wobble", lambda c, l: c)),
}
def sources_by(propagated=True, lying=True):
    def sources(composed, linear_, block, kinds):
        W = whiten
        rows, wobble = linear_.rows, composed.wobble
        out = {}
        since, channel, regime = rows.since[block], rows.channel[block], W.REGIMES[rows.regime[block[0]]]
        every = np.arange(since.size)
        for c in np.unique(channel):
            name, mine = rows.channels[c], channel == c
            t = since[mine]
            rate = linear_.starts.get(f"{name}{W.RATE}")
            if lying and regime == W.RESTS and name in linear_.starts:
                out[f"{name}, {W.LIES}"] = W.Source(np.flatnonzero(mine), np.ones((t.size, t.size)))
                continue
            key = name if regime == W.FLIES else f"{name}, {regime}"
            if propagated and rate is not None and regime == W.STRIKES:
                response = W._propagated(t, since, channel, rate[block])
                moved = every if response.any() else every[:0]
                forces = np.exp(-np.abs(t[:, None] - t) / W.TAU)
                out[key] = W.Source(moved, response[moved] @ forces @ response[moved].T)
            else:
                times = W.INTEGRALS[kinds[name]] if linear_.starts else 0
                out[key] = W.Source(np.flatnonzero(mine), W._integrated(t.tobytes(), times))
        if wobble is not None and regime == W.STRIKES:
            out[W.CONTACTS] = W.Source(every, wobble[block] @ wobble[block].T)
        out[W.CLOCK] = W.Source(every, linear_.rates[block] ** 2)
        return out
    return sources
import simgap.simulators.mjcf.model as mmodel
none_touch = lambda simulator, log: np.zeros(len(log), bool)
_begun = windows._begun
def not_forward(simulator, log, window, noise, jumped):
    from dataclasses import replace as rep
    return _begun(simulator, log, rep(window, forward=False), noise, jumped)
FLAGS |= {
    "regimes of contact": flag((windows, "_touching", none_touch)),
    "response in contact": flag((whiten, "_sources", sources_by(propagated=False))),
    "where a body lies": flag((whiten, "_sources", sources_by(lying=False))),
    "model settles before rest": flag((model, "preceded_by_rest", lambda w: (w, 0))),
    "rest": flag((windows, "resting", lambda log, reach: np.zeros(len(log), bool))),
    "gaps of contact closed": flag((mmodel, "closed", lambda t, sets: list(sets))),
    "starts near contact from later samples": flag((windows, "_begun", not_forward)),
    "regimes, wobble, rest, closed": flag((windows, "_touching", none_touch), (mmodel, "closed", lambda t, sets: list(sets)), (windows, "_begun", not_forward)),
}
def together(*names):
    puts = [p for n in names for p in FLAGS[n][0]]
    return tuple(puts), any(FLAGS[n][1] for n in names)
GROUP_A = ("search from the calibration", "other end of how commands are held", "rivals fitted to the end", "second whitener to begin from",
    "replacements that teach", "logarithm of large gains", "pruned set proposed", "second start of discrepancies",
    "start of a fit taken back", "repeats of a motion", "first row with samples on either side", "degree of starts by AIC", "finite differences as wide as uncertain")
FLAGS["A"] = together(*GROUP_A)
FLAGS["A1"] = together(*GROUP_A[:6])
FLAGS["A2"] = together(*GROUP_A[6:])
FLAGS["H"] = together("other end of how commands are held","rivals fitted to the end","second whitener to begin from","replacements that teach","held-out odds beside the t test","second start of discrepancies")
# after the search alone
AFTER = {
    "small cause where little is left": [(verdict, "OPEN", -1.0)],
    "least share of a cause": [(verdict, "LEAST", 0.0)],
    "absurd values": [(verdict, "_absurd", lambda *a: ())],
    "share left makes unknown": [(verdict, "MOST", np.inf)],
    "alternatives by held-out logs": [(verdict, "_alternatives", alternatives_by_score)],
    "none outweighs the best": [(verdict, "_explanations", explanations_unclipped)],
    "small effects stand in for none": [(verdict, "_explanations", explanations_all)],
    "small gap is none": [(verdict, "MATTERS", 0.0)],
    "jackknife of intervals": [(describe, "_posterior", lambda f, o: posterior_plain(f, o, jack=False))],
    "other sets in intervals": [(describe, "_posterior", lambda f, o: posterior_plain(f, o, rivals_=False))],
    "intervals without bounds": [(describe, "_posterior", lambda f, o: posterior_plain(f, o, spread=False))],
}

# --- what fires in the base run ---------------------------------------------------------------
def watched():
    own = {}
    def wrap(obj, name, new):
        return put(obj, name, new)
    _o = S._from_other_ends
    def other(self, best):
        out = _o(self, best)
        if out is not best: FIRED["other end: better"] += 1
        return out
    _settled = S._settled
    def settled(self, best):
        FIRED["settled fits"] += sum(1 for s in self.fitted.values() if s.promise > best.score - np.log(verdict.RULED_OUT) and s.promise > s.score + search.SETTLED)
        n = self.fitted[frozenset(best.names)].score
        out = _settled(self, best)
        if out is not best: FIRED["settled: another"] += 1
        return out
    _fp = S._fit_point
    _f = S.fit
    def fitted(self, names, begin, scales, rival=-np.inf):
        before = FIRED["fit points"]
        out = _f(self, names, begin, scales, rival)
        if FIRED["fit points"] - before > 1: FIRED["second whitener"] += 1
        FIRED["fits"] += 1
        return out
    def fp(self, *a):
        FIRED["fit points"] += 1
        return _fp(self, *a)
    _pb = search.predicts_better
    def pb(gain):
        out = _pb(gain)
        for n, f in (("no odds differs", t_arcsinh), ("no arcsinh differs", odds_plain_t), ("no t differs", odds_only), ("always differs", always), ("plain t differs", t_test)):
            if f(gain) != out: FIRED[n] += 1
        return out
    _ib = S._is_better
    def ib(self, one, best):
        out = _ib(self, one, best)
        if simply_better(self, one, best) != out: FIRED["as simple differs"] += 1
        return out
    _ou = C.outliers
    def ou(self, w, r):
        out = _ou(self, w, r)
        if out: FIRED["wide windows"] += 1
        return out
    _pr = sets_.Sets.pruned
    def pr(self, names, level):
        out = _pr(self, names, level)
        if out != names: FIRED["pruned"] += 1
        return out
    _fc = S._from_calibration
    def fc(self):
        FIRED["from calibration"] += 1
        return _fc(self)
    _st = fit._Squares.start
    def st(self):
        out = _st(self)
        if not np.array_equal(out, plain_start(self)): FIRED["start taken back"] += 1
        return out
    _re = model.Composed.repeats
    def re(self):
        out = _re(self)
        if max(out, default=1) > 1: FIRED["repeats"] += 1
        return out
    _ju = windows.jumps
    def ju(sim, log):
        out = _ju(sim, log)
        if out.any(): FIRED["jumps"] += 1
        return out
    _rd = windows._readable
    def rd(*a):
        out = _rd(*a)
        if out: FIRED["readable"] += 1
        return out
    _es = C.estimate
    def es(self, residual, wide=None):
        out = _es(self, residual, wide)
        if self.names:
            with put(whiten, "BELOW", (0.0,)):
                one = _es(self, residual, wide)
            if {*one} != {*out} or any(abs(np.log(one[n] / out[n])) > 0.05 for n in out): FIRED["second start differs"] += 1
        FIRED["estimates"] += 1
        if out: FIRED["with discrepancy"] += 1
        return out
    return [(S, "_from_other_ends", other), (S, "_settled", settled), (S, "fit", fitted), (S, "_fit_point", fp),
            (search, "predicts_better", pb), (verdict, "predicts_better", pb), (S, "_is_better", ib), (C, "outliers", ou), (sets_.Sets, "pruned", pr),
            (S, "_from_calibration", fc), (fit._Squares, "start", st), (model.Composed, "repeats", re),
            (windows, "jumps", ju), (windows, "_readable", rd), (C, "estimate", es)]

# --- cases ------------------------------------------------------------------------------------
SUITE = 58209190
ROBOTS = ("pendulum", "reacher", "acrobot")

def draw(number, seed=SUITE, turns=ROBOTS):
    """One drawn case's files and truth."""
    import pandas as pd
    from experiments.robots_check.__main__ import COUNT, KINDS
    from experiments.robots_check.faults import FAULTS, drawn
    from experiments.robots_check.robots import ROBOTS as every, map_toml, nominal_xml
    from experiments.robots_check.worlds import LOGS, motion, nats, noise_of, run, usual, world_of
    folder = DRAWN / f"{number:03d}"
    if (folder / "truth.json").exists():
        return folder
    folder.mkdir(parents=True, exist_ok=True)
    rng = np.random.default_rng([seed, number])
    robot = next(r for r in every if r.name == turns[number % len(turns)])
    kind = KINDS[number % len(KINDS)]
    xml = nominal_xml(robot, Path("build/robots"), rng)
    sizes, noise = usual(robot, xml), noise_of(robot, xml)
    known = [k for k, f in FAULTS.items() if f.outside == (kind == "outside")]
    chosen = rng.choice(known, COUNT[kind], replace=False)
    plain = world_of(xml, [], sizes)
    faults = [drawn(robot, plain, str(k), rng) for k in chosen]
    seen = np.zeros(len(faults))
    for log in range(LOGS):
        wanted = motion(robot, rng)
        seen += nats(robot, xml, faults, sizes, wanted, noise)
        shown = pd.DataFrame(run(robot, world_of(xml, faults, sizes), wanted))
        for joint, sd in noise.items():
            shown[f"q_{joint}"] += sd * rng.standard_normal(len(shown))
        shown.to_csv(folder / f"train_{log}.csv", index=False, float_format="%.7g")
    (folder / "robot.xml").write_text(xml)
    (folder / "map.toml").write_text(map_toml(robot, noise))
    (folder / "truth.json").write_text(json.dumps({"case": number, "robot": robot.name, "kind": kind,
        "faults": [vars(f) | {"nats": n} for f, n in zip(faults, seen.tolist())]}))
    return folder

def files(case):
    kind, name = case.split(":", 1)
    if kind == "given":
        f = SHARED / "robots_check" / name
        return f / "robot.xml", f / "map.toml", sorted(f.glob("train_*.csv"))
    if kind == "drawn":
        f = draw(int(name))
        return f / "robot.xml", f / "map.toml", sorted(f.glob("train_*.csv"))
    if kind in ("two_link", "two_link_step"):
        f = SHARED / "strangers" / kind
        return f / "robot.xml", f / "map.toml", sorted((f / name).glob("*.csv"))
    if kind == "xl330":
        from experiments.real.xl330_sheet import MAP, MODEL, prepared
        into = Path("build/ablation/xl330"); into.mkdir(parents=True, exist_ok=True)
        (into / "servo.xml").write_text(MODEL); (into / "map.toml").write_text(MAP)
        return into / "servo.xml", into / "map.toml", prepared(SHARED / "real/xl330_pendulum", into)
    if kind == "cube":
        from experiments.contactnets import write_inputs  # `git show f82105c:experiments/real/contactnets.py`
        into = Path("build/ablation/cube"); into.mkdir(parents=True, exist_ok=True)
        paths = write_inputs(SHARED / "real/contactnets", into, 8)
        return into / "cube.xml", into / "map.toml", paths
    raise KeyError(case)

def judged(case, body):
    """(right, intervals that hold) of a diagnosis."""
    from experiments.robots_check import given, score
    kind, name = case.split(":", 1)
    named = {*body["causes"], *body["indistinguishable"]}
    holds = []
    if kind == "given":
        truth = json.loads((SHARED / "robots_check" / name / "truth.json").read_text())
        ok = given.right(body, truth["right"])
        if name == "flexible":  # its kind is in the catalogue by now
            ok = ok or body["causes"] == ["joint:luff.elasticity"]
        for cause, size in truth["truth"].items():
            if cause in body["causes"] and cause in body["effects"]:
                ps = [p for p in body["effects"][cause]["parameters"].values()]
                if name == "tilt":
                    continue
                p = body["effects"][cause]["parameters"].get("gain") or ps[0]
                holds.append(p["interval_90"][0] <= size <= p["interval_90"][1])
        return ok, holds
    if kind == "drawn":
        truth = json.loads((DRAWN / f"{int(name):03d}" / "truth.json").read_text())
        found = {k: body[k] for k in ("verdict", "causes", "indistinguishable", "effects")} | {"remainder": body["remainder"]["share"]}
        one = truth | {"found": found}
        if truth["kind"] == "healthy":
            ok = not score.alarm(one)
        elif truth["kind"] == "outside":
            ok = score.held_back(one) if score.above(truth["faults"][0]) else None
        else:
            ok = score.right(one) if any(map(score.above, truth["faults"])) else None
        return ok, score.covered(one)
    if kind in ("two_link", "two_link_step"):
        if name == "none":
            return body["verdict"] == "none", holds
        if name == "friction":
            return {"joint:shoulder.frictionloss", "joint:elbow.frictionloss"} & named != set() and body["verdict"] in ("named", "set"), holds
        if name == "delay":
            return "command.delay" in named or any("lag" in n for n in named), holds
        return any("offset" in n or "bias" in n for n in named), holds
    if kind == "xl330":
        return "joint:shaft.load_friction" in named, holds
    if kind == "cube":
        return bool(named & {"readout:z.gain", "readout.scale"}), holds
    return None, holds

def brief(body):
    sizes = {}
    for c in body["causes"]:
        if c in body["effects"]:
            for s, p in body["effects"][c]["parameters"].items():
                sizes[f"{c}.{s}"] = [round(p["mean"], 6), *(round(x, 6) for x in p["interval_90"])]
    return sizes

def one(case, name):
    if case.startswith("sts:"):
        return sts(case, name)
    puts, sim = FLAGS[name]
    FIRED.clear()
    SIM[0] = name if sim else ""
    if not sim: SIM[0] = ""
    SAVED[0] = 0.0
    begun = time.process_time()
    xml, mapping, paths = files(case)
    begun = time.process_time()
    with ExitStack() as stack:
        for p in (watched() if name == "base" else []):
            stack.enter_context(put(*p))
        for p in puts:
            stack.enter_context(put(*p))
        loaded = load_mjcf(xml, mapping)
        logs = [loaded.read(p) for p in paths]
        more = loaded.effects(logs)
        found = diag.diagnose(loaded.simulator, logs, more=more, length=loaded.map.length)
        body = describe.body(found)
        seconds = time.process_time() - begun
        rows = [row(case, name, body, seconds + SAVED[0], seconds)]
        if name == "base":
            rows[0]["fired"] = dict(FIRED)
            far = verdict.shrinkage(found.best, found.search.fitted[frozenset()], found.composed, found.search.fold) if found.best.names else None
            for after, changes_ in AFTER.items():
                with ExitStack() as inner:
                    for p in changes_:
                        inner.enter_context(put(*p))
                    v = verdict.verdict_on(found.search, found.best, far, found.phases, 0, False)
                    from dataclasses import replace
                    again = replace(found, verdict=v, shrinkage=far if v.causes else None, next_log=None)
                    rows.append(row(case, after, describe.body(again), seconds + SAVED[0], seconds))
    return rows

def row(case, name, body, seconds, real):
    ok, holds = judged(case, body)
    return {"case": case, "flag": name, "right": ok, "verdict": body["verdict"], "causes": sorted(body["causes"]),
            "others": sorted(body["indistinguishable"]), "sizes": brief(body), "holds": holds,
            "over": body["remainder"]["rms_over_noise"], "left": body["remainder"]["share"],
            "gone": None if body["shrinkage"] is None else body["shrinkage"]["fraction"],
            "explanation": body["explanation"]["effects"],
            "seconds": round(seconds, 2), "spent": round(real, 2)}

# --- changes of a servo ---------------------------------------------------------------------------
STS = {}
def sts(case, name):
    import pandas as pd
    from experiments.real import sts3215 as e
    folder = SHARED / "real/sts3215"
    if "cases" not in STS:
        STS["cases"] = e.drawn(pd.read_csv(folder / "index.csv"), "all", int(os.environ.get("STSN", "2")), int(os.environ.get("STSSEED", "11")))
        STS["known"] = {}
    puts = CHANGES.get(name, ())
    known = STS["known"] if not name.startswith("cal:") and not name.startswith("old:") else {}
    if name.startswith("old:"):
        known = {k: (v[0], None) for k, v in STS["known"].items()}
    one_ = STS["cases"][int(case[4:])]
    if name not in ("base",) and not name.startswith(("cal:", "old:")):
        known = dict(STS["known"])
    with ExitStack() as stack:
        for p in puts:
            stack.enter_context(put(*p))
        found, seconds = e.solved(one_, folder, known)
    if name == "base":
        STS["known"] = known
    s = e.scored(one_, found)
    ok = s["none"] if not s["truth"] else s["in_set"]
    if one_.kind == "spurious": ok = ok and s["spurious"] >= e.PLANTED
    if one_.alone and s["truth"]: alone = s["is_alone"]
    else: alone = None
    return [{"case": case + " " + one_.kind, "flag": name, "right": bool(ok), "alone": alone, "verdict": s["verdict"], "causes": s["named"],
             "others": s["others"], "sizes": {n: [round(v["ratio"], 4), *(round(x, 4) for x in v["interval"]), v["true"]] for n, v in s["sizes"].items()},
             "holds": [v["holds"] for v in s["sizes"].values()], "over": s["over"], "worse": s["worse"], "seconds": round(seconds, 2)}]

Cm, Ch = changes.Comparison, changes.Changes
def full_step(cost, x, step): return x + np.clip(step, -unchanged.FAR, unchanged.FAR)
def no_pairs(self):
    nothing = self.fit((), [np.zeros(0)])
    scan = self.scanned()
    names = sorted(scan, key=lambda n: scan[n][0])[:changes.TRIED]
    return [nothing, *(self.fit((n,), [scan[n][1], *self._rungs(scan[n][1])]) for n in names)]
class NoDependence:
    pass
_fit_old = unchanged.fit_old
CHANGES = {
    "base": (),
    "wider scales at first": [(changes, "WIDER", 1.0)],
    "many starts of a change": [(Cm, "_rungs", staticmethod(lambda x: [np.zeros(x.size)]))],
    "response": [(changes, "RESPONSE", 0.0)],
    "drift": [(changes, "DRIFT", 0.0)],
    "second changes": [(Cm, "searched", no_pairs)],
    "share that matters": [(changes, "MATTERS", -9.0)],
    "halves of steps": [(changes, "best_of_halves", full_step)],
    "old:halves of steps, OLD too": [(changes, "best_of_halves", full_step), (unchanged, "best_of_halves", full_step)],
    "unknown": [(changes, "UNKNOWN", -1.0)],
    "motions paired": [(Cm, "paired", property(lambda self: False))],
    "motions taken as paired": [(Cm, "paired", property(lambda self: True))],
    "second change only where much is left": [(Cm, "leaves", lambda self, c: True)],
    "spurious samples": [(changes, "without_broken", lambda s, logs: (list(logs), []))],
    "old:stretches of motions": [(unchanged, "UNITS", 1)],
    "old:second fit to OLD": [(unchanged, "ROUNDS", 1)],
    "cal:rows that repeat each other": [(calibrate, "_repeats", lambda parts: 1.0)],
    "cal:second fit": [(calibrate, "ROUNDS", 1)],
    "cal:windows first": [(calibrate, "fit_effects", None)],
}

NEEDS = {"search from the calibration": "from calibration", "other end of how commands are held": "other end: better",
    "rivals fitted to the end": "settled fits", "second whitener to begin from": "second whitener", "windows off by themselves": "wide windows",
    "pruned set proposed": "pruned", "second start of discrepancies": "second start differs", "repeats of a motion": "repeats",
    "when a command jumped": "jumps", "first row with samples on either side": "readable", "start of a fit taken back": "start taken back",
    "held-out odds beside the t test": "no odds differs", "logarithm of large gains": "no arcsinh differs", "t test beside the held-out odds": "no t differs",
    "held-out logs judge steps": "always differs", "as simple and likelier goes on": "as simple differs", "clock": "with discrepancy",
    "levels of the discrepancy": "with discrepancy", "discrepancies": "with discrepancy", "exchange of causes": "fits"}

def main():
    cases, names, out = sys.argv[1].split(","), sys.argv[2].split(";"), Path(sys.argv[3])
    every = []
    for c in cases:
        kind, _, rng_ = c.partition(":")
        if rng_ == "*":
            every += {"given": [f"given:{p.parent.name}" for p in sorted((SHARED / "robots_check").glob("*/truth.json"))]}[kind]
        elif "-" in rng_ and kind in ("drawn", "sts"):
            a, b = map(int, rng_.split("-"))
            every += [f"{kind}:{k}" for k in range(a, b)]
        else:
            every.append(c)
    for case in every:
        MEMO.clear()
        base = None
        for name in names:
            try:
                if base and NEEDS.get(name) and not base["fired"].get(NEEDS[name]):
                    rows = [{**{k: v for k, v in base.items() if k != "fired"}, "flag": name, "same": True, "spent": 0.0}]
                else:
                    rows = one(case, name)
                if name == "base" and not case.startswith("sts"):
                    base = rows[0]
            except Exception as e:
                rows = [{"case": case, "flag": name, "right": False, "error": repr(e)[:200]}]
                traceback.print_exc()
            with out.open("a") as f:
                for r in rows:
                    f.write(json.dumps(r, default=float) + "\n")
            r = rows[0]
            print(case, "|", name, "|", r["right"], r.get("verdict"), r.get("causes"), r.get("over"), r.get("seconds"), r.get("spent"), flush=True)

if __name__ == "__main__":
    main()
