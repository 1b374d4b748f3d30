"""Evidence of sets in closed form against integrals, and what whitens rows against what it says it is."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy import stats
from scipy.integrate import quad

from simgap.bounded import least
from simgap.effect import Parameter
from simgap.robot_effects.base import RobotEffect
from simgap.robots.search import FittedSet, _overstated, predicts_better
from simgap.robots.sets import Sets, neighbours, pairs
from simgap.robots.verdict import _absurd, _explanations, _score_of_noise
from simgap.robots.whiten import Block, Covariances, Discrepancy, Source

NAMES = ("a", "b", "c")


def sets_of(columns: np.ndarray, residual: np.ndarray, fold: np.ndarray, low: float = -np.inf) -> Sets:
    each = [c for k in (1, 2, 3) for c in (0 * residual, columns[:, k])]
    whole = np.column_stack([residual, columns[:, 0], *each])
    gram = np.array([[whole[fold == n].T @ whole[fold == n] for n in np.unique(fold)]])
    bounds = np.array([0.0, -np.inf, *(low if k % 2 else 0.0 for k in range(6))])
    return Sets(NAMES, gram, np.zeros((1, 2)), 1, (1, 1, 1), NAMES, bounds, np.full(8, np.inf), -2.0)


@pytest.fixture
def drawn():
    rng = np.random.default_rng(0)
    columns = rng.standard_normal((80, 4))
    return columns, columns @ [0.5, 1.5, 0.0, 0.0] + rng.standard_normal(80), np.arange(80) % 2


@pytest.mark.parametrize("name", NAMES)
def test_evidence_is_the_integral_over_the_slab(drawn, name):
    columns, residual, _ = drawn
    sets, k = sets_of(*drawn), 1 + NAMES.index(name)
    inner = np.linalg.inv(np.eye(80) + np.outer(columns[:, 0], columns[:, 0]))
    half = 0.5 * np.linalg.slogdet(np.linalg.inv(inner))[1]

    def density(x: float) -> float:
        left = residual - columns[:, k] * x
        return float(np.exp(-0.5 * left @ inner @ left - half + 100) * stats.cauchy.pdf(x))

    near = float(columns[:, k] @ inner @ residual / (columns[:, k] @ inner @ columns[:, k]))
    exact = np.log(quad(density, near - 2, near + 2, limit=200)[0]) - 100 - 2.0
    assert sets.scores([(name,)], 0)[0] == pytest.approx(exact, abs=0.05)


def test_bounds_hold_and_many_sets_are_as_each_alone(drawn):
    columns, residual, fold = drawn
    bounded = sets_of(columns, -residual, fold, low=0.0)
    assert bounded.fit(("a",), 0).x[1] == 0.0
    sets = sets_of(*drawn)
    every = [*neighbours(("a",), NAMES), *pairs((), NAMES)]
    together = sets.scores(every, 0)
    np.testing.assert_allclose(together, [sets.fit(e, 0).score for e in every], atol=1e-9)
    assert {*every[int(together.argmax())]} >= {"a"}
    own = [sets.fit(("a",), 0).score - sets.scores([("a",)], 0, k)[0] for k in (0, 1)]
    np.testing.assert_allclose(sets.held_out(("a",), 0), own)
    assert sets.held_out(("a",), 0).sum() > sets.held_out((), 0).sum() + 10


@pytest.mark.parametrize("count", [3, 6])
def test_what_nearly_cancels_is_freed_from_a_bound_again(count: int):
    """Numbers along that act almost alike, within narrow bounds: by the solver of exact fits."""
    rng = np.random.default_rng(1)
    low, high = np.array([-2.2, 0.0, 0.0, 0.0, 0.0, -2.0])[:count], np.full(count, 2.0)
    for _ in range(200):
        columns = rng.standard_normal((60, 1)) + 0.1 * rng.standard_normal((60, count))
        residual = columns @ rng.uniform(-1, 1, count) * 30 + 0.1 * rng.standard_normal(60)
        whole = 10 * np.column_stack([residual, columns])
        gram = (whole.T @ whole)[None, None]
        ends = np.append(-np.inf, low), np.append(np.inf, high)
        sets = Sets((), gram, np.zeros((1, 1)), count, (), (), *ends, -2.0)
        best = least(gram[0, 0, 1:, 1:] + np.eye(count), gram[0, 0, 0, 1:], low, high)[0]
        np.testing.assert_allclose(sets.fit((), 0).x, best, atol=1e-9)


def block(window: int) -> Block:
    """Two channels, and a start that moves both."""
    rng, time = np.random.default_rng(window), np.arange(40) / 40
    smooth = np.exp(-np.abs(time[:, None] - time) / 0.3)
    sources = {c: Source(np.arange(40) + 40 * k, smooth) for k, c in enumerate("pq")}
    start = rng.standard_normal((80, 2))
    return Block(np.arange(80) + 80 * window, window, np.full(80, 0.5), start, sources, np.repeat([0, 1], 40))


def test_discrepancies_are_found_and_windows_that_are_off_by_themselves_leave_them():
    rng, cov = np.random.default_rng(1), Covariances(tuple(block(k) for k in range(30)))
    true = Discrepancy({"p": 0.7})
    root = [np.linalg.cholesky(b.covariance(true)) for b in cov.blocks]
    rows = np.concatenate([each @ rng.standard_normal(80) for each in root])
    found = cov.estimate(rows)
    assert {*found} == {"p"} and found["p"] == pytest.approx(0.7, rel=0.2)
    white = cov.whitener(found)(rows)
    assert np.mean(white**2) == pytest.approx(1.0, rel=0.1) and cov.outliers(cov.whitener(found), rows) == {}
    rows[160:240] *= 3.0
    wide = cov.outliers(cov.whitener(cov.estimate(rows)), rows)
    assert {*wide} == {2} and wide[2] == pytest.approx(9.0, rel=0.4)
    for known in (found, {"p": 7.0, "q": 0.1}):  # wherever the search begins
        again = cov.estimate(rows, wide, known)
        assert again == pytest.approx(cov.estimate(rows, wide), rel=0.01)
    assert cov.estimate(rows, wide, {}) == {}


def test_what_shows_in_every_window_is_no_windows_own_and_the_likelihood_has_its_gradient():
    rng, cov, left = np.random.default_rng(1), Covariances(tuple(block(k) for k in range(30))), {"p": 2.0}
    each = [np.linalg.cholesky(b.covariance(left)) @ rng.standard_normal(80) for b in cov.blocks]
    linear, whiten = SimpleNamespace(residual=np.concatenate(each)), cov.whitener(left)
    one = SimpleNamespace(discrepancy=left, covariances=cov, linear=linear, wide={}, whiten=whiten, score=7.0)
    density = lambda b, of, r: stats.multivariate_normal(cov=b.covariance(of)).logpdf(r)  # noqa: E731
    both = zip(cov.blocks, each, strict=True)
    worse = sum(density(b, {}, r) - density(b, left, r) for b, r in both)
    assert _score_of_noise(one) == pytest.approx(7.0 + worse)  # type: ignore[arg-type]
    assert len(cov.outliers(cov.whitener(), linear.residual)) > 15
    smooth = Covariances(tuple(block(k) for k in range(3)))._smooth
    left, x = np.random.default_rng(2).standard_normal(smooth.plain.shape[:2]), np.array([-0.5, 0.3])
    rest = np.random.default_rng(5).standard_normal(smooth.share.size)
    slope = smooth.cost(x, left, rest)[1]
    for k in (0, 1):
        step = 1e-5 * (np.arange(2) == k)
        change = smooth.cost(x + step, left, rest)[0] - smooth.cost(x - step, left, rest)[0]
        assert slope[k] == pytest.approx(change / 2e-5, rel=1e-5)


def test_starts_are_taken_from_residuals_and_noise_leaves_the_floor():
    rng, cov = np.random.default_rng(3), Covariances((block(0),))
    one, sensor = cov.blocks[0], cov.whitener()
    noise = np.sqrt(one.variance)[:, None] * rng.standard_normal((80, 2000))
    left = np.sum(sensor(noise + one.start @ rng.standard_normal((2, 2000)) / 3) ** 2, 0)
    assert cov.floor() == pytest.approx(np.mean(left), rel=0.02)
    rng, cov = np.random.default_rng(3), Covariances(tuple(block(k) for k in range(4)))
    noise = np.sqrt(0.5) * rng.standard_normal(320)
    moved = np.concatenate([b.start @ rng.standard_normal(2) for b in cov.blocks])
    left = cov.without_starts(cov.whitener(), noise + moved)
    assert (np.mean(left**2) == pytest.approx(np.mean(noise**2), rel=0.1)
            and np.mean((noise + moved) ** 2) > 1.5)  # fmt: skip
    assert np.isnan(cov.without_starts(cov.whitener(), np.where(moved > 9, moved, np.nan))).all()


def test_values_at_bounds_and_logs_that_disagree_are_doubted():
    known = {"rubs": RobotEffect("rubs", "", {"loss": Parameter(0.02, 0.01, "N m", low=0.0)}),
             "weighs": RobotEffect("weighs", "", {"mass": Parameter(1.0, 0.1, "kg", low=0.3)})}  # fmt: skip
    best = SimpleNamespace(point={"rubs": {"loss": 0.0}, "weighs": {"mass": 0.3}})
    assert _absurd(known, best, ["rubs"]) == ()  # type: ignore[arg-type]
    assert _absurd(known, best, ["rubs", "weighs"]) == ("weighs mass 0.3 kg is no value of a robot's",)  # type: ignore[arg-type]
    assert predicts_better(np.array([0.5, 0.6, 0.5, 0.4, 0.5, 0.6]))  # little, but in every log
    assert predicts_better(np.array([9.0, 370.0, 21.0]))  # much, and in one log far more
    assert not predicts_better(np.array([0.3, 37.0, -8.7]))  # one log is predicted worse
    assert not predicts_better(np.array([0.3, 370.0, 0.2]))  # one log alone says so


@pytest.mark.parametrize("folds", [2, 3, 6])
@pytest.mark.parametrize("sd", [0.3, 1.0, 3.0])
def test_a_set_predicts_better_by_chance_as_rarely_as_it_says(folds: int, sd: float):
    # of two normal densities that are sd apart, the log ratio where the rival is right
    gains = np.random.default_rng(0).normal(-0.5 * sd**2, sd, (4000, folds))
    assert np.mean([predicts_better(g) for g in gains]) < 0.06


def test_log_odds_count_less_where_residuals_vary_more_than_their_discrepancy():
    rng, window = np.random.default_rng(0), np.arange(2000) // 20
    apart = np.sin(np.arange(2000) / 7.0)

    def one(residual: np.ndarray, discrepancy: dict[str, float]) -> FittedSet:
        linear = SimpleNamespace(residual=residual, rows=SimpleNamespace(window=window))
        return SimpleNamespace(linear=linear, discrepancy=discrepancy, whiten=lambda values: values)  # type: ignore[return-value]

    white = rng.standard_normal(2000)
    again = white + apart * (1.0 / np.sqrt(10.0) * np.repeat(rng.standard_normal(100), 20)) * np.sqrt(3.0)
    for left, expected in ((white, 1.0), (again, 4.0)):
        by = one(left, {"q": 1.0})
        assert _overstated(by, one(left + apart, {})) == pytest.approx(expected, rel=0.35)
        assert _overstated(one(left, {}), one(left + apart, {})) == 1.0
    gain = np.array([1.2, 34.6, 1.2, -0.5, 1.0, 0.5])
    assert predicts_better(gain) and not predicts_better(gain, 1.6)


def test_what_replaces_a_cause_is_told_although_it_could_replace_a_small_effect_too():
    sets = [SimpleNamespace(names=names, score=score)
            for names, score in [(("load", "hold", "hum"), 0.0), (("load", "hold", "lag"), -1.0),
                                 (("load", "lag", "hum"), -9.0),
                                 (("load", "gain", "lag"), -9.0)]]  # fmt: skip
    found = _explanations(sets[1:], sets[0], ("hold", "load"), {"hum", "lag"}, 1.0)  # type: ignore[arg-type]
    assert [one.causes for one in found] == [("hold", "load"), ("hold", "load"), ("lag", "load"),
                                             ("gain", "load")]  # fmt: skip
