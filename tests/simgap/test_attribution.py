"""Attribution against enumeration, closed forms, quadrature and planted effects; bounds; verdicts."""

import itertools
from dataclasses import replace

import numpy as np
import pytest
from refusals import refused
from scipy.optimize import lsq_linear

from simgap.attribution import search, verdict
from simgap.attribution.attribute import _certainty, _examined, _predicting, attribute, noise_of
from simgap.attribution.heldout import RESPONSE, Heldout, scatter_between
from simgap.attribution.posterior import OFF, Background, fitted, forms, mode, quadratic_forms, screened
from simgap.attribution.problem import MODELLED, Candidate, Gap, Rows, cosines
from simgap.attribution.verdict import ALARM, RECORD, acting, conclude, known, probabilities
from simgap.bounded import least

PLAIN = Background(np.zeros(1), np.ones(1), np.zeros(1), np.zeros(1))  # noise exactly as stated
SURE = 1e-12  # a p-value that leaves no doubt of a gap


def rows_of(trials: int = 4, channels: int = 3, parts: int = 2, samples: int = 12) -> Rows:
    """Rows of a small recording at 20 Hz, every cell with as many samples."""
    trial, channel, part, k = (z.ravel() for z in np.indices((trials, channels, parts, samples)))
    time = (part * samples + k) / 20.0
    return Rows(trial, channel, part, time, tuple(f"t{i}" for i in range(trials)),
                tuple(f"c{i}" for i in range(channels)), tuple(f"p{i}" for i in range(parts)))  # fmt: skip


def linear(name: str, jacobian: np.ndarray, scale: float = 1.0) -> Candidate:
    k = jacobian.shape[1]
    nothing, far = np.zeros(k), np.full(k, np.inf)
    return Candidate(name, tuple(f"{name}{i}" for i in range(k)), nothing, nothing, np.full(k, scale),
                     np.zeros(len(jacobian)), jacobian, -far, far)  # fmt: skip


def gap_of(theta: dict[int, float], seed: int = 0, more: np.ndarray | float = 0.0, same: bool = False) -> Gap:
    """A gap of four one-parameter effects, of which `theta` act; `same`: two of them are one."""
    rng, rows = np.random.default_rng(seed), rows_of()
    n = rows.time.size
    push = rng.standard_normal((4, n)) * np.isin(rows.channel, (0, 1)) / 4
    if same:
        push[1] = push[0]
    residual = rng.standard_normal(n) + sum(v * push[j] for j, v in theta.items()) + more
    nuisance = (rows.channel == 2)[:, None] * np.ones((1, 1))
    return Gap(rows, residual, nuisance, tuple(linear("abcd"[j], push[j][:, None]) for j in range(4)))


def test_cosines_are_orthonormal_and_the_background_is_the_integral_over_variances():
    rows = rows_of()
    values = np.random.default_rng(1).standard_normal((rows.time.size, 2))
    out, (band,) = cosines(rows, values)
    for cell in np.unique(rows.cell):
        mine = rows.cell == cell
        np.testing.assert_allclose(out[mine].T @ out[mine], values[mine].T @ values[mine], atol=1e-10)
        assert band[mine][0] == 0 and band[mine].max() == 2
        assert out[mine][0] == pytest.approx(values[mine].mean(0) * np.sqrt(mine.sum()))
    b = Background.usual()
    energy, count = np.array([3.0, 400.0]), np.array([5.0, 20.0])
    total, precision = b.marginal(energy, count)
    for s, off in enumerate(b.off):
        for g in range(2):
            prior = (1 - off) * b.near + off * b.far
            each = prior * np.exp(-0.5 * count[g] * b.log_phi - 0.5 * energy[g] * np.exp(-b.log_phi))
            assert total[s, g] == pytest.approx(float(np.log(np.sum(each))))
            assert precision[s, g] == pytest.approx(float(each @ np.exp(-b.log_phi) / np.sum(each)))
    assert (precision[:, 0] > 0.5).all() and precision[:, 1] == pytest.approx(20 / 400, rel=0.25)
    assert b.near.sum() == pytest.approx(1.0) and b.far.sum() == pytest.approx(1.0)
    quiet = [b.marginal(np.array([20.0 * e]), np.array([20.0]), np.log(9.0))[0] for e in (6, 3, 1)]
    assert (quiet[0] < quiet[1]).all() and quiet[1] == pytest.approx(quiet[2])


def enumerated(gap: Gap) -> dict[tuple[int, ...], float]:
    """Log posterior of all sets: Cauchy priors by quadrature over precisions, all else in closed form."""
    grid = np.linspace(-16, 4, 60)
    log_gamma = 0.5 * grid - 0.5 * np.exp(grid) - 0.5 * np.log(2 * np.pi) + np.log(grid[1] - grid[0])
    odds = np.log((1 / len(gap.candidates)) / (1 - 1 / len(gap.candidates)))
    columns = np.concatenate([gap.nuisance, *(c.jacobian for c in gap.candidates)], 1)
    inner, pull = columns.T @ columns, columns.T @ gap.residual
    out, z = {}, gap.nuisance.shape[1]
    for effects in itertools.chain.from_iterable(itertools.combinations(range(4), k) for k in range(3)):
        mine, each = [*range(z), *(z + j for j in effects)], []
        for at in itertools.product(range(grid.size), repeat=len(effects)):
            prior = np.concatenate([np.ones(z), np.exp(grid[list(at)])])
            h = inner[np.ix_(mine, mine)] + np.diag(prior)
            value = 0.5 * pull[mine] @ np.linalg.solve(h, pull[mine]) - 0.5 * np.linalg.slogdet(h)[1]
            each.append(value + 0.5 * np.log(prior).sum() + log_gamma[list(at)].sum())
        out[effects] = float(np.logaddexp.reduce(each)) + len(effects) * odds
    return out


def test_sets_are_weighed_as_enumeration_does():
    gap = gap_of({0: 1.5, 2: 0.8})
    exact = enumerated(gap)
    found = {m.effects: m.score for m in search.sought(forms(gap, PLAIN))}
    for effects, value in exact.items():
        if value > max(exact.values()) - 8 and effects in found:
            difference = (found[effects] - found[()]) - (value - exact[()])
            assert abs(difference) < 0.35, (effects, difference)  # Laplace, of a Cauchy prior
    total = np.logaddexp.reduce(list(exact.values()))
    for j in range(4):
        truth = sum(np.exp(v - total) for e, v in exact.items() if j in e)
        models = search.sought(forms(gap, PLAIN))
        told = sum(w for m, w in zip(models, search.weights(models), strict=True) if j in m.effects)
        assert told == pytest.approx(truth, abs=0.06)


def test_some_of_the_candidates_score_as_they_do_among_all():
    gap, some = gap_of({0: 1.5, 2: 0.8}), (0, 3)

    def scores(gap: Gap) -> dict[tuple[int, ...], float]:
        f = forms(gap, PLAIN)
        return {m.effects: m.score - len(m.effects) * f.log_odds for m in search.sought(f)}

    every = scores(gap)
    few = {tuple(some[j] for j in effects): score for effects, score in scores(gap.only(some)).items()}
    assert {j for effects in few for j in effects} <= {*some} and (0,) in few
    assert all(few[e] == pytest.approx(every[e]) for e in few.keys() & every.keys())
    assert [c.name for c in gap.only((2, 0)).candidates] == [gap.candidates[j].name for j in (2, 0)]


def test_the_bayes_factor_bounds_alarms_and_healthy_recordings_are_taken_until_it_is_clear():
    values = np.array([search.statistic(forms(gap_of({}, seed=s))) for s in range(30)])
    assert np.mean(np.exp(-np.maximum(values, 0)) < 0.05) <= 0.1
    assert search.statistic(forms(gap_of({0: 3.0}))) > 20
    assert search.detected(1e3).p_value == 0.0 and search.detected(-2.0).p_value == 1.0
    taken = []

    def healthy():
        for k in range(100):
            taken.append(k)
            yield float(k % 2)

    found = search.detected(0.5, healthy())
    assert len(taken) == 8 and found.p_value >= 0.5
    rare = search.detected(5.0, [0.0] * 19)
    assert rare.resolution == pytest.approx(1 / 20) and rare.p_value == pytest.approx(np.exp(-5))
    assert search.detected(50.0, healthy()).resolution == pytest.approx(1 / 2)  # the first leaves no doubt
    assert search.detected(50.0, [20.0] * 6).resolution == pytest.approx(1 / 7)  # as large ones do
    others = [9.0, 10.0, 11.0, 10.0]  # they tell by how much the Bayes factor is off
    expected = np.log((np.exp(others).sum() + 1) / 5)
    assert search.detected(14.0, others).p_value == pytest.approx(np.exp(expected - 14.0))
    assert search.detected(10.5, others).p_value >= 2 / 5


def test_neighbours_are_screened_by_a_step_and_linearised_beside_those_that_act():
    f = forms(gap_of({0: 3.0, 2: -2.0}))
    m, sets = fitted(f, (0,)), [(), (0, 2), (1,), (1, 3), (0, 1, 2)]
    each = [mode(f, quadratic_forms(f, e), m.precision, steps=1).score for e in sets]
    # but for the volume of the mode, by how groups count before the step
    np.testing.assert_allclose(screened(f, m, sets), each, atol=0.2)
    gap = gap_of({0: 3.0, 1: 2.0})
    a, b, c, d = gap.candidates
    after_a, joint = replace(b, beside=("a",)), [replace(a, beside=("b", "c")), replace(b, beside=("a", "c"))]
    f = forms(replace(gap, candidates=(a, b, c, d, after_a, *joint)))
    assert {e for e in search._neighbours(f, (0, 4)) if len(e) == 3} == {(2, 5, 6), (0, 3, 4)}
    assert search._linearised(f, [0, 1]) == (0, 4)  # beside `a`, and nothing that does not act
    assert search._linearised(f, [0, 1, 2]) == (2, 5, 6) and search._linearised(f, [1]) == (1,)


def test_what_acts_is_named_once_and_what_cannot_act_is_not_taken():
    gap = gap_of({0: 3.0, 1: 3.0})
    alike = tuple(replace(c, name="a") if c.name == "b" else c for c in gap.candidates)
    found = attribute(replace(gap, candidates=alike), heldout=False)
    assert all(len({alike[j].name for j in m.effects}) == len(m.effects) for m in found.models)
    line = "'actual': cannot act on these recordings; expected a, b, c, d"
    refused(line, attribute, gap_of({1: 3.0}), heldout=False, forced=("actual",))


def test_a_random_effect_explains_its_cells_and_is_no_noise_besides():
    rows = rows_of(samples=40)
    loud = (rows.channel == 1) & (rows.part == 0)
    residual = np.random.default_rng(5).standard_normal(rows.time.size) * np.where(loud, 6.0, 1.0)
    nothing, n = np.zeros(0), rows.time.size
    own = Candidate("roll", (), nothing, nothing, nothing, np.zeros(n), np.zeros((n, 0)), nothing, nothing,
                    frees=np.where(loud, 1e3, 0.0))  # fmt: skip
    found = attribute(Gap(rows, residual, np.zeros((n, 0)), (own,)), heldout=False)
    assert found.causes == ("roll",) and found.remainder.share < 0.1
    found, nothing, rows = [], np.zeros(0), rows_of(trials=3, parts=12)
    extra = np.where(rows.channel == 1, 8.0, 0.0)
    for seed in range(10):
        residual = np.random.default_rng(seed).standard_normal(extra.size) * np.sqrt(1 + extra)
        noisy = Candidate("noisy", (), nothing, nothing, nothing, np.zeros(extra.size),
                          np.zeros((extra.size, 0)), nothing, nothing, extra)  # fmt: skip
        f = forms(Gap(rows, residual, np.zeros((extra.size, 0)), (noisy,)))
        found.append(noise_of(f, fitted(f, (0,))) ** 2)
    np.testing.assert_allclose(np.mean(found, axis=0), 1.0, atol=0.1)


def test_of_a_planted_cell_and_effect_size_and_share_are_told():
    rows = rows_of(samples=40)
    left = np.random.default_rng(2).standard_normal(rows.time.size)
    mine = (rows.trial == 1) & (rows.channel == 2) & (rows.part == 0)
    left[np.flatnonzero(mine)[:3]] += 9.0
    band = np.zeros(left.size, int)
    (cell,) = verdict.significant(rows, band, left, np.ones(left.size))
    assert (cell.trial, cell.channel, cell.part) == ("t1", "c2", "p0")
    assert cell.share == pytest.approx(1.0) and cell.z > 5
    found = attribute(gap_of({1: 3.0}))
    assert found.verdict == "named" and found.causes == ("b",) and found.indistinguishable == ()
    value = found.effects["b"].parameters["b0"]
    assert (value.mean == pytest.approx(3.0, abs=4 * value.sd)
            and found.effects["b"].probability > 0.93 * RECORD)  # fmt: skip
    assert found.effects["b"].share > 0.8 and found.remainder.share < 0.1 and found.remainder.p_value > 0.05
    assert found.how_far.fraction > 0.8 and sum(found.probabilities.values()) == pytest.approx(1.0)
    assert {(c.channel) for c in found.where} <= {"c0", "c1"}


def test_two_effects_one_or_none_are_told_and_nothing_remains_of_a_gap_once_explained():
    assert attribute(gap_of({0: 3.0, 2: 3.0}), heldout=False).causes == ("a", "c")
    healthy = attribute(gap_of({}, seed=5))
    assert healthy.verdict == "none" and healthy.where == () and healthy.how_far is None
    alike = attribute(gap_of({0: 3.0}, same=True), heldout=False)
    assert alike.verdict == "set" and {*alike.causes, *alike.indistinguishable} == {"a", "b"}
    rows, rng = rows_of(channels=1, parts=6), np.random.default_rng(0)
    calm = rows.part == 0
    push = rng.standard_normal(rows.time.size) * calm
    residual = rng.standard_normal(push.size) * np.where(calm, 0.2, 1.5) + 0.6 * push
    none = np.zeros((push.size, 0))
    found = attribute(Gap(rows, residual, none, (linear("a", push[:, None]),)), heldout=False)
    assert found.causes == ("a",) and found.shares.before < found.shares.floor
    assert found.remainder.share == 0.0 and found.remainder.p_value > 0.01


def test_a_cause_at_a_bound_that_no_hand_reaches_is_held_back():
    gap = gap_of({0: 3.0})
    first, *rest = gap.candidates

    def verdict(**bounds):
        own = replace(first, **{name: np.full(1, value) for name, value in bounds.items()})
        return attribute(replace(gap, candidates=(own, *rest)), heldout=False).verdict

    assert verdict(low=-2.0, high=3.5) == "named" and verdict(high=2.0) == "unknown"
    hidden = replace(first, high=np.full(1, 2.0), hidden=first.parameters)
    assert attribute(replace(gap, candidates=(hidden, *rest)), heldout=False).verdict == "named"
    both = gap_of({0: 20.0, 1: 2.0})  # one beside it does not hold a cause back that explains 99 %
    first, second, *rest = both.candidates
    second = replace(second, high=np.full(1, 1.6))
    assert attribute(replace(both, candidates=(first, second, *rest)), heldout=False).causes == ("a",)


def test_a_tolerant_prior_leaves_what_matters_as_likely_and_rounding_no_probability_above_one():
    alone = fitted(forms(gap_of({1: 9.0})), (1,))
    each = next(w for w in (search.weights([alone] * n) for n in range(2, 99)) if sum(w) > 1.0)
    assert acting([one("b", w) for w in each], 0.0, 1.0)["b"] == 1.0
    b = Background.usual()
    prior = b.tolerant(np.array([1.0, 1.5, 10.0, 1e4]))
    np.testing.assert_allclose(prior.sum(0), 1.0, atol=1e-12)
    np.testing.assert_allclose(prior[:, 0], b.near)  # nothing is tolerated
    assert (prior[b.log_phi > np.log(1e4), 3] == 0.0).all()
    assert prior[b.log_phi.searchsorted(np.log(5.0)), 2] > 0.05


def test_what_no_effect_explains_is_unknown_and_told_where_and_of_a_sliver_too():
    rows = rows_of()
    mine = (rows.channel == 0) & (rows.part == 1)
    wave = 6 * np.sin(7 * rows.time) * mine
    found = attribute(gap_of({}, seed=7, more=wave))
    assert found.verdict == "unknown" and found.remainder.share > 0.5
    leading = [c for c in found.where if c.share > 0.05]
    assert leading and {(c.channel, c.part) for c in leading} == {("c0", "p1")}
    assert known(0.99) > 0.95 and known(0.01) < 0.15
    assert known(0.5) < 0.5 < known(0.85)  # what a form that is off by a tenth leaves, and what it does not
    assert known(0.85, form=0.03) < 0.5 < known(0.97, form=0.03)  # an exact form leaves less
    assert known(0.5, p_rest=1.0) > 0.98 > known(0.5, p_rest=ALARM) > 0.5  # unless all of it may be noise


def test_a_set_that_leaves_no_group_off_is_likelier_than_one_that_leaves_a_few():
    f = forms(gap_of({1: 9.0}))
    energy = f.count.copy()
    whole, (expected, _) = Background.usual(0.1), f.marginal((), energy)
    each = [replace(f, background=Background.usual(off)).marginal((), energy)[0] for off in OFF]
    assert expected == pytest.approx(np.log(np.mean(np.exp(each))))
    energy[:2] *= 30
    few = f.marginal((), energy)[0]
    assert (
        expected - few
        > replace(f, background=whole).marginal((), f.count)[0]
        - replace(f, background=whole).marginal((), energy)[0]
    )


def test_gaps_that_are_tolerated_or_absorbed_are_none_told_with_their_size():
    gap, taken = gap_of({1: 3.0}), []

    def healthy():
        taken.append(0)
        yield 0.0

    n = gap.residual.size
    tolerant = replace(gap, tolerance=np.full(n, 10.0))
    small = attribute(tolerant, healthy(), heldout=False)
    assert small.verdict == "none" and small.small_gap is not None and 0 < small.small_gap.size < 1
    assert not taken and small.detection.resolution == 0
    found = attribute(replace(gap, tolerance=np.full(n, 0.05)), healthy(), heldout=False)
    assert found.verdict == "named" and len(taken) == 1 and found.detection.resolution == 0.5
    gap = gap_of({1: 3.0})
    gap = replace(gap, tolerance=np.full(gap.residual.size, 10.0))
    moved = np.abs(search.sought(forms(gap))[0].x[:1] - fitted(forms(gap), ()).x[:1])
    assert attribute(gap, heldout=False, absorbed=2 * moved).small_gap is not None
    assert attribute(gap, heldout=False, absorbed=moved / 2).verdict == "named"


def test_a_noise_stated_too_low_is_no_gap_and_small_groups_have_the_level_of_their_mean_square():
    gap = gap_of({}, seed=11)
    louder = Gap(gap.rows, 1.25 * gap.residual, gap.nuisance, gap.candidates)
    found = attribute(louder, heldout=False)
    assert found.verdict == "none" and np.mean(list(found.noise.values())) == pytest.approx(1.25, abs=0.15)
    found = []
    for seed in range(20):
        rng, rows = np.random.default_rng(seed), rows_of(trials=3, parts=12)
        gap = Gap(rows, rng.standard_normal(rows.time.size), np.zeros((rows.time.size, 0)), ())
        f = forms(gap)
        found.append(noise_of(f, fitted(f, ())) ** 2)
    assert np.mean(found) == pytest.approx(1.0, abs=0.04)


def test_how_far_covers_what_was_planted_and_causes_are_what_other_trials_need():
    gap = gap_of({0: 4.0}, seed=4)
    held = Heldout.of(forms(gap), np.ones(3), (0, 1))
    far, push = held.how_far((0,)), gap.candidates[0].jacobian[:, 0] * 4.0
    assert far.noise_floor == 1.0
    assert far.before - 1 == pytest.approx(float(push @ push) / gap.residual.size, rel=0.35)
    assert far.interval_90[0] < far.fraction <= 1.0 and far.fraction > 0.85
    gap = gap_of({0: 4.0, 2: 3.0}, seed=4)
    held = Heldout.of(forms(gap), np.ones(3), range(4))
    assert _predicting(held, (0, 1, 2, 3)) == (0, 2)
    assert held.gain((0, 2), (0,)) > 3 > held.gain((0, 1, 2), (0, 2))


def test_a_trial_is_predicted_with_all_that_the_others_leave_open():
    """Against the dense covariance of a trial's rows, all else as the others have it."""
    gap = gap_of({0: 2.0, 1: -1.0}, seed=2)
    held = Heldout.of(forms(gap), np.array([1.0, 1.3, 0.8]), (0, 1))
    for effects in ((), (0,), (0, 1)):
        squares = held._squares(effects)[0]
        for k, (train, _) in enumerate(held.folds):
            model, mine = fitted(train, effects), gap.rows.trial == k
            columns = np.concatenate([gap.nuisance, *(gap.candidates[j].jacobian for j in effects)], 1)[mine]
            noise = np.array([1.0, 1.3, 0.8])[gap.rows.channel[mine]]
            off = gap.residual[mine] - columns @ model.x
            covariance = np.diag(noise) + columns @ model.covariance @ columns.T
            assert squares[k] == pytest.approx(off @ np.linalg.solve(covariance, off), rel=1e-6)


def test_what_is_of_one_trial_takes_nothing_off_the_held_out_share():
    gap = gap_of({0: 4.0}, seed=4)
    of_trial = np.eye(4)[gap.rows.trial] * (gap.rows.channel == 1)[:, None]
    rough = replace(gap, residual=gap.residual + of_trial @ [1.5, -2.0, 1.0, -1.0],
                    nuisance=np.concatenate([gap.nuisance, of_trial], 1))  # fmt: skip
    found = [Heldout.of(forms(g), np.ones(3), (0,)) for g in (gap, rough)]
    plain, mixed = (h.how_far((0,)) for h in found)
    assert mixed.fraction == pytest.approx(plain.fraction, abs=0.05)


def test_what_one_trial_alone_says_or_changes_sign_between_trials_is_no_cause():
    gap = gap_of({0: 4.0}, seed=4)
    push, own = gap.candidates[2].jacobian[:, 0], gap.rows.trial == 1
    for where, causes in ((own, (0,)), (np.ones_like(own), (0, 2))):
        more = 6.0 * push * where
        held = Heldout.of(forms(replace(gap, residual=gap.residual + more)), np.ones(3), range(4))
        assert held.gain((0, 2), (0,)) > 3 and _predicting(held, (0, 2)) == causes
    gap = gap_of({}, seed=5)
    push, own = gap.candidates[0].jacobian[:, 0], gap.rows.trial == 1
    residual = gap.residual + np.where(own, 12.0 * push, 0.0)
    found = attribute(replace(gap, residual=residual))
    assert found.detection.p_value < 1e-6 and found.verdict == "unknown"
    rows = rows_of(samples=30)
    push = np.ones(rows.time.size) * (rows.channel == 0)
    sizes = np.array([3.0, -1.0, 2.5, 0.2])[rows.trial]
    residual = np.random.default_rng(0).standard_normal(rows.time.size) + sizes * push
    gap = Gap(rows, residual, np.zeros((rows.time.size, 0)), (linear("a", push[:, None]),))
    assert attribute(gap).verdict == "unknown"


def test_causes_are_known_by_what_they_leave_of_the_gap_however_little_it_was():
    gap = gap_of({0: 3.0}, seed=6)
    rest = 9.0 * np.sin(gap.rows.time * 40.0 + gap.rows.trial) * (gap.rows.channel == 2)
    for more, likely in ((0.0, True), (rest, False)):
        gapped = replace(gap, residual=gap.residual + more)
        assert attribute(gapped).verdict == ("named" if likely else "unknown")
        f, rng = forms(gapped), np.random.default_rng(0)
        others = Heldout.of(f, np.full(3, 9.0), (0,))
        found = _examined(f, (0,), search.sought(f), np.full(f.count.size, 9.0), rng, others)
        assert found.causes == (0,) and (found.known > 0.5) == likely


@pytest.mark.parametrize("wander", [0.0, 0.3])
def test_an_effect_that_wanders_has_an_interval_that_holds_its_mean(wander):
    rows = rows_of(samples=30)
    part = rows.channel * len(rows.parts) + rows.part
    held, plain, widened = [], [], []
    for seed in range(60):
        rng, push = np.random.default_rng(seed), np.ones(rows.time.size)
        sizes = 2.0 * (1 + wander * rng.standard_normal(6))
        residual = rng.standard_normal(rows.time.size) + sizes[part] * push
        f = forms(Gap(rows, residual, np.zeros((rows.time.size, 0)), (linear("a", push[:, None]),)))
        model = fitted(f, (0,))
        more = scatter_between(f, model, 0, part)[0]
        sd = np.sqrt(model.covariance[0, 0] + more)
        held.append(abs(model.x[0] - 2.0) < 1.645 * sd)
        plain.append(abs(model.x[0] - 2.0) < 1.645 * np.sqrt(model.covariance[0, 0]))
        widened.append(more / model.covariance[0, 0])
    # Parts that are off count for less, which leaves few: noise alone holds 11 of 60 with them, this 42.
    assert sum(held) >= (40 if wander else 50)
    assert sum(plain) < 20 if wander else np.median(widened) < 1


def test_what_trials_or_other_evidence_say_of_an_effect_counts_though_no_trial_is_predicted_better():
    rows = rows_of(samples=30)
    column = np.where(rows.channel == 0, 3.0, 0.0)[:, None]  # by one sd of what was measured
    residual = np.random.default_rng(0).standard_normal(rows.time.size) + 9.0 * column[:, 0]
    wrong = linear("measured", column, scale=10.0)
    found = attribute(Gap(rows, residual, column, (wrong, linear("other", column[::-1].copy()))))
    assert (found.verdict, found.causes) == ("named", ("measured",)) and found.how_far.fraction > 0.9
    gap = gap_of({0: 30.0})
    nothing, n = np.zeros(0), gap.residual.size
    lattice = Candidate("lattice", (), nothing, nothing, nothing, np.zeros(n), np.zeros((n, 0)), nothing,
                        nothing, np.full(n, 1e-3))  # fmt: skip
    for evidence, kept in ((400.0, True), (0.0, False)):
        f = forms(replace(gap, candidates=(*gap.candidates, replace(lattice, evidence=evidence))))
        others = Heldout.of(f, np.ones(3), (0, 4))
        assert (4 in _predicting(others, (0, 4))) == kept


def one(
    name: str, weight: float, known: float = 1.0, causes: tuple[str, ...] | None = None
) -> verdict.Explanation:
    effects = tuple(sorted(name))
    return verdict.Explanation(effects, weight, effects if causes is None else causes, known)


def test_probabilities_are_weights_as_often_right_as_they_say_and_the_rest_is_unknown():
    found = probabilities([one("a", 0.7), one("ab", 0.2), one("", 0.1)], SURE)
    assert sum(found.values()) == pytest.approx(1.0)
    assert found["a"] == pytest.approx(0.7) and found["a+b"] == pytest.approx(0.2)
    assert found["unknown"] == pytest.approx(0.1) and found["none"] < 1e-6
    sets = [one("a", 0.8, 0.25), one("b", 0.2, 0.5)]
    assert probabilities(sets, SURE)["unknown"] == pytest.approx(0.8 * 0.75 + 0.2 * 0.5)
    assert conclude(sets, SURE).verdict == "unknown"
    named = conclude([one("a", 0.7), one("ab", 0.2), one("", 0.1)], SURE).probabilities
    assert sum(named.values()) == pytest.approx(1.0)
    assert named["a"] == pytest.approx(0.7 * RECORD) and named["unknown"] == pytest.approx(1 - 0.9 * RECORD)
    assert acting([one("a", 0.7), one("ab", 0.2), one("", 0.1)], SURE)["a"] <= RECORD
    # Without an alarm: even odds beforehand, times a Bayes factor of 1/4 for a gap.
    quiet = search.Detection(-float(np.log(4.0)), 1.0, 0.0)
    assert quiet.unseen == pytest.approx(0.2) and search.Detection(3.0, 0.1, 0.0).unseen == 0.5
    told = conclude([one("", 1.0)], quiet.p_value, unseen=quiet.unseen)
    assert told.verdict == "none" and told.probabilities["none"] == pytest.approx(0.8 / (1 + ALARM))


@pytest.mark.parametrize(("form", "needed"), [(MODELLED, False), (RESPONSE, True)])
def test_a_small_cause_beside_a_large_one_is_needed_where_the_form_of_the_large_one_is_exact(form, needed):
    gap = gap_of({0: 60.0, 2: 2.5})
    large, *others = gap.candidates
    f = forms(replace(gap, candidates=(replace(large, form=form), *others)))
    both, alone = fitted(f, (0, 2)), fitted(f, (0,))
    speaks = both.score - fitted(f, ()).score
    assert RESPONSE * speaks < both.score - alone.score < MODELLED * speaks
    assert (_certainty(f, (0, 2), 2) > 0) == needed
    nothing, n = np.zeros(0), gap.residual.size  # nor is what only scatters
    loud = 8.0 * (gap.rows.channel == 2)
    roll = Candidate(
        "roll", (), nothing, nothing, nothing, np.zeros(n), np.zeros((n, 0)), nothing, nothing, loud
    )
    more = gap.residual * np.where(loud > 0, 3.0, 1.0)
    f = forms(replace(gap, residual=more, candidates=(replace(large, form=form), roll)))
    causes = _examined(f, (0, 1), search.sought(f), np.ones(f.count.size), np.random.default_rng(0)).causes
    assert (1 in causes) == needed


def test_of_two_causes_that_can_spare_each_other_one_is_needed():
    gap = gap_of({0: 4.0, 2: 4.0})
    other = linear(
        "d",
        gap.candidates[2].jacobian + 0.1 * np.random.default_rng(0).standard_normal((gap.residual.size, 1)),
    )
    f = forms(replace(gap, candidates=(gap.candidates[0], gap.candidates[2], other)))
    found = _examined(f, (0, 1, 2), search.sought(f), np.ones(f.count.size), np.random.default_rng(0))
    assert _certainty(f, (0, 1, 2), 1) < 0 and _certainty(f, (0, 1, 2), 2) < 0 and found.causes == (0, 1)


def test_a_cause_has_the_parameters_that_it_has_without_what_its_set_can_spare():
    gap = gap_of({0: 60.0, 2: 2.5})
    push = gap.candidates[2].jacobian + 0.3 * gap.candidates[0].jacobian
    gap = replace(gap, candidates=(gap.candidates[0], linear("c", push)))
    found, f = attribute(gap, heldout=False), forms(gap)
    assert found.models[0].effects == (0, 1) and found.causes == ("a",)
    alone, both = fitted(f, (0,)).x[-1], fitted(f, (0, 1)).x[1]
    assert abs(alone - both) > 0.3 and found.effects["a"].parameters["a0"].mean == pytest.approx(alone)


def test_at_the_alarm_level_a_gap_is_as_likely_as_none():
    sets = [one("a", 0.9), one("", 0.1)]
    assert probabilities(sets, ALARM)["none"] == pytest.approx(0.5)
    assert acting(sets, ALARM, 0.8)["a"] == pytest.approx(0.45 * 0.8)
    more = [one("ab", 0.6, 0.5, causes=("a",)), one("a", 0.2), one("", 0.2)]
    assert acting(more, 0.0, 1.0) == {"a": pytest.approx(0.5)}  # what is too small to be a cause is none
    assert conclude(sets, 1.01 * ALARM).verdict == "none" and conclude(sets, 0.99 * ALARM).verdict == "named"
    small = conclude(sets, SURE, matters=False)  # a gap that does not matter is none however sure
    assert small.verdict == "none" and small.causes == () and small.probabilities["none"] > 0.99


B_IN_TWO = [one("a", 0.4), one("bx", 0.3, causes=("b",)), one("by", 0.3, causes=("b",))]


@pytest.mark.parametrize(("sets", "more", "causes", "others"), [
    # Sets of the same causes count together; what was chosen, or forced, is named all the same.
    (B_IN_TWO, {}, ("b",), ("a",)),
    (B_IN_TWO, {"chosen": ("a",)}, ("a",), ()),
    ([one("ab", 1.0, 0.0)], {"p_value": 0.9, "forced": ("b", "a")}, ("a", "b"), ()),
    # What takes a cause's place is told down to one in twenty: an effect too small to be a cause is none
    # beside an alternative either, and a larger set is no alternative.
    ([one("a", 19 / 20), one("b", 1 / 20)], {}, ("a",), ("b",)),
    ([one("a", 21 / 22), one("b", 1 / 22)], {}, ("a",), ()),
    ([one("as", 0.6, causes=("a",)), one("bs", 0.4, causes=("b",))], {}, ("a",), ("b",)),
    ([one("a", 0.5), one("bc", 0.5)], {}, ("a",), ()),
    # What a set can do without is no cause, unless that is ruled out or leaves too much.
    ([one("ab", 0.6), one("a", 0.3), one("", 0.1, 0.0)], {}, ("a",), ()),
    ([one("ab", 0.96), one("a", 0.03)], {}, ("a", "b"), ()),
    ([one("ab", 0.6), one("a", 0.3, 0.01)], {}, ("a", "b"), ()),
    ([one("ab", 0.6), one("c", 0.3)], {}, ("a", "b"), ("c",)),  # not a part of the set but an alternative
])  # fmt: skip
def test_causes_and_what_takes_their_place(sets, more, causes, others):
    told = conclude(sets, **{"p_value": SURE} | more)
    assert (told.causes, told.indistinguishable) == (causes, others)
    assert told.verdict == ("set" if others else "named")


def problem(seed, size=6, tight=1.0):
    rng = np.random.default_rng(seed)
    factor = rng.normal(size=(3 * size, size))
    matrix = factor.T @ factor + np.eye(size)
    pull = matrix @ rng.normal(size=size)
    return matrix, pull, -tight * rng.random(size), tight * rng.random(size)


@pytest.mark.parametrize(("seed", "tight"), [*((seed, 1.0) for seed in range(20)), (0, 1e6)])
def test_no_better_point_within_bounds_and_none_that_scipy_finds(seed, tight):
    matrix, pull, low, high = problem(seed, tight=tight)
    x, held = least(matrix, pull, low, high)
    factor = np.linalg.cholesky(matrix)
    theirs = lsq_linear(factor.T, np.linalg.solve(factor, pull), (low, high), method="bvls").x
    np.testing.assert_allclose(x, theirs, atol=1e-7)
    assert not (tight > 1 and held.any())  # far bounds change nothing
    assert (x >= low).all() and (x <= high).all()
    slope = matrix @ x - pull
    assert np.abs(slope[~held]).max(initial=0.0) < 1e-9
    # At a bound going on would lead outside, or nothing would be gained by coming back.
    assert (slope[held & (x == low)] >= -1e-9).all() and (slope[held & (x == high)] <= 1e-9).all()


def test_the_search_for_the_least_ends_where_rounding_left_a_matrix_indefinite():
    indefinite = np.array([[0.25, -0.03, 1.94], [-0.03, -1.07, 1.31], [1.94, 1.31, -1.41]])
    with pytest.raises(np.linalg.LinAlgError, match="positive definite"):
        least(indefinite, np.array([-1.27, -0.62, 0.04]), np.full(3, -0.5), np.full(3, 0.5))
