"""Evidence of sets and what whitens rows, against integrals; repeats; contacts; laws of friction."""

from dataclasses import replace

import numpy as np
import pytest
from refusals import partly
from scipy import stats
from scipy.integrate import quad

from simgap.bounded import least
from simgap.effect import Parameter as Free
from simgap.robot_effects import candidates, effects_of, readouts
from simgap.robot_effects.base import RobotEffect, Setting
from simgap.robots.linear import Linear, base_at, linearise, with_wobble
from simgap.robots.model import Composed
from simgap.robots.rows import Rows, phases_of, rows_of
from simgap.robots.search import FittedSet, _overstated, predicts_better
from simgap.robots.sets import Sets, neighbours, pairs
from simgap.robots.verdict import _absurd, _explanations, _score_of_noise
from simgap.robots.whiten import (
    CONTACTS,
    LIES,
    TAU,
    Block,
    Covariances,
    Discrepancy,
    Source,
    _smooth,
    covariances,
)
from simgap.robots.windows import AT_REST, FLIES, REGIMES, RESTS, STRIKES, cut, meets, resting
from simgap.simulators.protocol import Channel, Parameter
from simgap.simulators.recording import Recording
from simgap.simulators.user import checked

mujoco = pytest.importorskip("mujoco")

from simgap.simulators.mjcf.engine import rollout  # noqa: E402
from simgap.simulators.mjcf.laws import Laws, run  # noqa: E402
from simgap.simulators.mjcf.load import load_mjcf  # noqa: E402
from simgap.simulators.mjcf.model import closed  # noqa: E402
from simgap.simulators.mjcf.transmission import Motion, periods  # noqa: E402

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
    assert sets_of(columns, -residual, fold, low=0.0).fit(("a",), 0).x[1] == 0.0
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
    root = np.linalg.cholesky(smooth)
    sources = {c: Source(np.arange(40) + 40 * k, root) for k, c in enumerate("pq")}
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
        assert cov.estimate(rows, wide, known) == pytest.approx(cov.estimate(rows, wide), rel=0.01)
    assert cov.estimate(rows, wide, {}) == {}


def test_what_shows_in_every_window_is_no_windows_own_and_the_likelihood_has_its_gradient():
    rng, cov, left = np.random.default_rng(1), Covariances(tuple(block(k) for k in range(30))), {"p": 2.0}
    each = [np.linalg.cholesky(b.covariance(left)) @ rng.standard_normal(80) for b in cov.blocks]
    linear, whiten = partly(Linear, residual=np.concatenate(each)), cov.whitener(left)
    parts = {"discrepancy": left, "covariances": cov, "linear": linear, "wide": {}, "whiten": whiten}
    one = partly(FittedSet, **parts, score=7.0)
    density = lambda b, of, r: stats.multivariate_normal(cov=b.covariance(of)).logpdf(r)  # noqa: E731
    both = zip(cov.blocks, each, strict=True)
    worse = sum(density(b, {}, r) - density(b, left, r) for b, r in both)
    assert _score_of_noise(one) == pytest.approx(7.0 + worse)
    assert len(cov.outliers(cov.whitener(), linear.residual)) > 15
    smooth = _smooth(Covariances(tuple(block(k) for k in range(3))))
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
    known = {"rubs": RobotEffect("rubs", "", {"loss": Free(0.02, 0.01, "N m", low=0.0)}),
             "weighs": RobotEffect("weighs", "", {"mass": Free(1.0, 0.1, "kg", low=0.3)})}  # fmt: skip
    best = partly(FittedSet, point={"rubs": {"loss": 0.0}, "weighs": {"mass": 0.3}})
    assert _absurd(known, best, ["rubs"]) == ()
    assert _absurd(known, best, ["rubs", "weighs"]) == ("weighs mass 0.3 kg is no value of a robot's",)
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
        linear = partly(Linear, residual=residual, rows=partly(Rows, window=window))
        return partly(FittedSet, linear=linear, discrepancy=discrepancy, whiten=lambda values: values)

    white = rng.standard_normal(2000)
    again = white + apart * (1.0 / np.sqrt(10.0) * np.repeat(rng.standard_normal(100), 20)) * np.sqrt(3.0)
    for left, expected in ((white, 1.0), (again, 4.0)):
        by = one(left, {"q": 1.0})
        assert _overstated(by, one(left + apart, {})) == pytest.approx(expected, rel=0.35)
        assert _overstated(one(left, {}), one(left + apart, {})) == 1.0
    gain = np.array([1.2, 34.6, 1.2, -0.5, 1.0, 0.5])
    assert predicts_better(gain) and not predicts_better(gain, 1.6)


def test_what_replaces_a_cause_is_reported_although_it_could_replace_a_small_effect_too():
    sets = [partly(FittedSet, names=names, score=score)
            for names, score in [(("load", "hold", "hum"), 0.0), (("load", "hold", "lag"), -1.0),
                                 (("load", "lag", "hum"), -9.0),
                                 (("load", "gain", "lag"), -9.0)]]  # fmt: skip
    found = _explanations(sets[1:], sets[0], ("hold", "load"), {"hum", "lag"}, 1.0)
    assert [one.causes for one in found] == [("hold", "load"), ("hold", "load"), ("lag", "load"),
                                             ("gain", "load")]  # fmt: skip


NOISE, SIZE, LOGS = 0.01, 0.1, 8
TIMES = np.arange(0.0, 4.0, 0.02)


class Course:
    """A course that no start tells of, of a size, as often faster as a log's column `pace` says."""

    parameters = {"size": {"nominal": 1.0, "sd": 0.3, "unit": "1"}}  # noqa: RUF012
    channels = {  # noqa: RUF012
        "pace": {"unit": "1", "kind": "command"},
        "y": {"unit": "m", "kind": "position", "noise": NOISE},
    }

    def simulate(self, parameters, recording):
        return {"y": parameters["size"] * np.sin(3 * recording["pace"] * recording.t)}


def composed(errors: np.ndarray, rng: np.random.Generator, paces=None) -> Composed:
    """Logs with these errors (LOGS, n) of the model and the sensor's noise."""
    simulator, logs = checked(Course(), "a test"), []
    for k, error in enumerate(errors):
        bare = Recording(f"log{k}", TIMES, {"pace": np.full(TIMES.size, 1.0 if paces is None else paces[k])})
        y = simulator.simulate({"size": 1.0}, bare)["y"] + error + NOISE * rng.standard_normal(TIMES.size)
        logs.append(bare.with_columns({"y": y}))
    effects = {n: e for n, e in candidates(Setting(simulator, logs)).items() if n == "size" or e.fitted}
    return Composed.of(simulator, logs, effects, {"y": NOISE})


def misses(seed: int, shared: bool, repeats: bool) -> float:
    """By how many of its own sd the size is missed."""
    rng = np.random.default_rng(seed)
    alike = np.exp(-np.abs(TIMES[:, None] - TIMES) / TAU) + 1e-9 * np.eye(TIMES.size)
    factor = SIZE * np.linalg.cholesky(alike)
    own = factor @ rng.standard_normal((TIMES.size, 1 if shared else LOGS))
    made = composed(np.broadcast_to(own.T, (LOGS, TIMES.size)), rng)
    made = made if repeats else replace(made, motion=())
    linear = linearise(made, {"size": {"size": 1.0}}, ["size"])
    whiten = covariances(made, linear).whitener(Discrepancy({"y": SIZE}))
    sets = Sets.of(made.effects, linear, [whiten], ["size"], linear.rows.log, 0.0)
    found = sets.fit(("size",), 0)
    return float(found.x[0] / np.sqrt(found.covariance[0, 0]))


@pytest.mark.parametrize("repeats", [True, False])
def test_what_repeats_share_makes_an_interval_as_wide_as_one_log_would(repeats: bool):
    missed = np.array([misses(seed, True, repeats) for seed in range(60)])
    scatter = float(np.sqrt(np.mean(missed**2)))
    assert (0.8 < scatter < 1.2) if repeats else scatter > 2


def test_logs_are_repeats_where_commands_are_alike_and_count_each_where_the_model_is_right():
    rng, still = np.random.default_rng(0), np.zeros((LOGS, TIMES.size))
    made = composed(still, rng, [1.0, 1.0, 2.0, 1.0, 2.0, 1.0005, 3.0, 1.0])
    assert made.motion == (0, 0, 1, 0, 1, 0, 2, 0) and made.repeats() == [5, 5, 2, 5, 2, 5, 1, 5]
    of_three = [k for k, w in enumerate(made.windows) if w.log in (0, 1, 6)]
    assert made.among(of_three).repeats() == [2, 2, 1]
    rng = np.random.default_rng(1)
    made = composed(np.zeros((LOGS, TIMES.size)), rng)
    cov = covariances(made, linearise(made, {}, ["size"]))
    least = cov.whitener(Discrepancy({"y": 1e-9}))
    assert least.half_log_det == pytest.approx(cov.whitener().half_log_det)


POSE = {a: a for a in ("x", "y", "z", "qw", "qx", "qy", "qz")}


class Posed:
    """A body whose pose is read."""

    parameters = {}  # noqa: RUF012
    channels = {a: Channel("1" if a[0] == "q" else "m", "position") for a in POSE}  # noqa: RUF012
    poses = {"cube": POSE}  # noqa: RUF012
    by_log = {"shift": Parameter(0.0, 0.3, "s"), "offset": Parameter(0.0, 0.01, "m")}  # noqa: RUF012

    def simulate(self, parameters, recording, start=None):
        raise AssertionError("only read, never run")


def tumbling(name: str = "log.csv") -> Recording:
    t = np.arange(0.0, 0.5, 0.01)
    half, axis = 1.5 * t, np.array([0.6, 0.0, 0.8])
    turn = {"qw": np.cos(half)} | {f"q{a}": axis[k] * np.sin(half) for k, a in enumerate("xyz")}
    return Recording(name, t, {"x": 0.3 * t, "y": 0.1 + 0 * t, "z": 1 - 4.9 * t**2} | turn)


@pytest.mark.parametrize(("name", "theta"), [
    ("pose:cube.lag", {"delay": 0.02}),
    ("pose:cube.turned", {"about_x": 0.03, "about_y": -0.02, "about_z": 0.05}),
    ("pose:cube.offset", {"x": 0.01, "y": 0.0, "z": -0.02}),
])  # fmt: skip
def test_what_a_pose_is_read_through_is_undone(name, theta):
    log = tumbling()
    effects = {e.name: e for e in readouts.candidates(Setting(Posed(), [log]))}
    read = log.with_columns(effects[name].alter(log, log.columns, theta))
    assert max(np.abs(read[a] - log[a]).max() for a in POSE) > 1e-3
    back = effects[name].restore(read, theta)
    inside = slice(0, -3)  # a lag's last samples are not recorded
    assert all(np.allclose(back[a][inside], log[a][inside], atol=2e-4) for a in POSE)
    turn = np.array([read[a] for a in ("qw", "qx", "qy", "qz")])
    assert np.allclose((turn**2).sum(0), 1.0, atol=1e-4)


def test_offsets_turn_with_the_body_and_each_log_has_its_own_shift():
    turn = np.array([[np.cos(np.pi / 2)], [0.0], [0.0], [np.sin(np.pi / 2)]])
    assert np.allclose(readouts.rotated(turn, np.array([0.1, 0.0, 0.2]))[:, 0], [-0.1, 0.0, 0.2])
    logs = [tumbling("a.csv"), tumbling("b.csv")]
    setting = Setting(Posed(), logs)
    shift, offset = readouts.by_log(setting)
    assert list(shift.parameters) == ["a.csv", "b.csv"] and shift.fitted and shift.by_log
    assert list(offset.parameters)[:3] == ["a.csv.x", "a.csv.y", "a.csv.z"]
    late = shift.alter(logs[1], logs[1].columns, {"a.csv": 0.3, "b.csv": 0.1})
    assert np.allclose(late["x"][10:], logs[1]["x"][:-10]) and np.allclose(late["x"][:10], 0.0)
    assert setting.alone() == ["x", "y", "z"] and setting.late_alone() == []


def test_brief_touches_count_but_breaks_do_not_and_what_slows_down_does_not_rest():
    t = np.arange(12) * 0.01
    pair, none = frozenset({(0, 1)}), frozenset()
    sets = [none, none, pair, none, none, none, none, none, pair, none, pair, none]
    assert [bool(s) for s in closed(t, sets)] == [bool(i in (2, 8, 9, 10)) for i in range(12)]
    t = np.arange(0, 1.0, 0.01)
    log = Recording("log.csv", t, {"q": np.where(t < 0.5, 1 - np.exp(-t / 0.1), 1 - np.exp(-5))})
    rests, rate = resting(log, {"q": 1.0}), np.exp(-t / 0.1) / 0.1
    assert rests[t > 0.53].all() and not rests[(rate * 0.04 > AT_REST) & (t < 0.47)].any()


DROP = """<mujoco><option timestep="0.002"/><worldbody>
<geom name="board" type="plane" size="2 2 .1"/>
<body name="cube" pos="0 0 .5"><freejoint/><geom name="box" type="box" size=".05 .05 .05" mass=".4"/></body>
</worldbody></mujoco>"""


@pytest.fixture(scope="module")
def dropped(tmp_path_factory):
    """A model of a cube and a log of its fall and rest, read on a scale of 0.97."""
    folder = tmp_path_factory.mktemp("drop")
    (folder / "cube.xml").write_text(DROP, encoding="utf-8")
    text = "".join(f'[columns.{a}]\nbody = "cube"\naxis = "{a}"\n' for a in POSE)
    (folder / "map.toml").write_text(text, encoding="utf-8")
    model = mujoco.MjModel.from_xml_string(DROP)
    data, rows = mujoco.MjData(model), []
    for _ in range(100):
        rows.append([data.time, *data.qpos])
        mujoco.mj_step(model, data, 5)
    table = np.array(rows)
    table[:, 1:4] *= 0.97
    head = "t," + ",".join(POSE)
    np.savetxt(folder / "log.csv", table, delimiter=",", header=head, comments="")
    loaded = load_mjcf(folder / "cube.xml", folder / "map.toml")
    return loaded.simulator, loaded.read(folder / "log.csv")


def test_flight_and_contact_are_distinguished(dropped):
    simulator, log = dropped
    times, what = simulator.contact_states(log)
    fall, first = np.sqrt(2 * 0.45 / 9.81), times[what.index(frozenset({(0, 1)}))]
    assert fall - 0.03 < first < fall + 0.01 and not what[0]
    noise = dict.fromkeys(POSE, 1e-3)
    windows = cut(simulator, [log], noise, 0.2)
    assert windows[0].regime == FLIES and windows[-1].regime == RESTS
    assert meets(simulator, log) and not meets(simulator, log.window(0, windows[0].end))
    assert any(abs(log.t[w.begin] - first) < 0.011 for w in windows)
    phases, rows = phases_of(simulator, [log], windows), rows_of([log], windows, noise)
    names = np.array(phases.names)[phases.of(rows)]
    assert {*names} == {w.regime for w in windows} and all(names == np.array(REGIMES)[rows.regime])


def test_a_stop_that_is_reached_and_left_is_a_contact_and_one_that_is_never_left_is_none(tmp_path):
    """A swing of 3.2 rad in a range of 3 is beyond it where |sin| exceeds 3 / 3.2."""
    body = '<joint name="j" range="-3 3"/><geom size=".1" pos="0 0 -1"/>'
    xml = f'<mujoco><compiler angle="radian"/><worldbody><body>{body}</body></worldbody></mujoco>'
    (tmp_path / "swing.xml").write_text(xml, encoding="utf-8")
    (tmp_path / "map.toml").write_text('[columns.q]\njoint = "j"\n', encoding="utf-8")
    simulator = load_mjcf(tmp_path / "swing.xml", tmp_path / "map.toml").simulator
    t = np.arange(0, 4, 0.005)
    swing = Recording("a.csv", t, {"q": 3.2 * np.sin(3 * t)})
    times, what = simulator.contact_states(swing)
    beyond, near = (np.abs(np.sin(3 * times)) > 3 / 3.2 - by for by in (0.0, 0.01))
    touching = np.array([bool(pairs) for pairs in what])
    assert beyond.any() and touching[beyond].all() and not touching[~near].any()
    windows = cut(simulator, [swing], {"q": 1e-4})
    struck = [np.abs(swing["q"][w.begin : w.end]).max() > 3 for w in windows]
    assert [w.regime == STRIKES for w in windows] == struck and any(struck) and not all(struck)
    lies = Recording("b.csv", t, {"q": np.full(t.size, 3.01)})
    assert not any(simulator.contact_states(lies)[1]) and not simulator.contacts(lies)


def test_a_fall_alone_tells_the_scale_and_impacts_are_no_measurement(dropped):
    """Windows that admit that each impact differs by a usual size: their weight on the scale is small."""
    simulator, log = dropped
    every = readouts.candidates(Setting(simulator, [log]))
    (scale,) = [e for e in every if e.name == "readout.scale"]
    composed = Composed.of(simulator, [log], {scale.name: scale}, dict.fromkeys(POSE, 1e-4), 0.2)
    composed = with_wobble(composed, linearise(composed, {}, [scale.name]))
    linear = linearise(composed, {}, [scale.name])
    usual = {CONTACTS: 1.0, "z, lying": 2e-2 * 0.05}
    whiten = covariances(composed, linear).whitener(Discrepancy(usual))
    slope = whiten(linear.moved[scale.name].jacobian)[:, 0]
    residual = whiten(linear.residual)
    free = composed.rows.regime == REGIMES.index(FLIES)
    told = slope[free] @ residual[free] / (slope[free] @ slope[free])
    assert told == pytest.approx(-0.03, abs=0.004)
    each = [float(slope[w] @ slope[w]) for w in composed.rows.of if not free[w.start]]
    assert max(each) <= 1.01 / 0.02**2  # no window in contact tells more than the scale's usual size


def test_a_body_at_rest_is_compared_where_it_lies_which_differs_from_time_to_time(dropped):
    simulator, log = dropped
    composed = Composed.of(simulator, [log], {}, dict.fromkeys(POSE, 1e-4), 0.2)
    rows, base = composed.rows, base_at(composed, {})
    still = (rows.regime == REGIMES.index(RESTS)) & (rows.channel == 2)
    assert still.any()
    settled = rows.observed[still][20:]  # the body itself sinks in for a while, by less than a millimetre
    np.testing.assert_allclose(settled / base.rows[still][20:], 0.97, atol=2e-3)
    calm = composed.calm()
    assert {w.regime for w in calm.windows} == {FLIES, RESTS} and calm.calm() is calm
    for block in covariances(composed, linearise(composed, {}, [])).blocks:
        lying = {n: s for n, s in block.sources.items() if n.endswith(LIES)}
        assert len(lying) == (len(POSE) if composed.windows[block.window].regime == RESTS else 0)
        for name, source in lying.items():
            column = np.zeros(block.rows.size)
            column[source.rows] = 1.0
            channel = composed.rows.channels.index(name.split(",")[0])
            assert (column == (composed.rows.channel[block.rows] == channel)).all()
            assert source.factor.shape == (column.sum(), 1) and (source.factor == 1.0).all()


ARM = """<mujoco><option timestep="{}" integrator="{}" gravity="0 0 0"/>
  <worldbody><body><joint name="turn" axis="0 0 1" armature="0.02" damping="0.1"/>
    <geom type="capsule" fromto="0 0 0 0.3 0 0" size="0.02" mass="0.8"/></body></worldbody>
  <actuator><position name="servo" joint="turn" kp="40" kv="2"/></actuator></mujoco>"""
TURN = '[columns.q]\njoint = "turn"\n[columns.u]\nactuator = "servo"\nunit = "rad"\n'


def test_in_contact_a_fourth_of_the_step_by_another_integrator_is_the_run_itself(tmp_path):
    def load(step: float, integrator: str):
        (tmp_path / "arm.xml").write_text(ARM.format(step, integrator))
        (tmp_path / "map.toml").write_text(TURN)
        return load_mjcf(tmp_path / "arm.xml", tmp_path / "map.toml")

    found, t = load(0.008, "implicitfast"), np.arange(0, 1, 0.008)
    goal = np.where(t > 0.3, 1.0, 0.0)
    log = Recording("a.csv", t, {"q": 0.3 * np.cos(3.0 * t), "u": goal})
    effects = effects_of(found.simulator, [log], found.effects([log]))
    point = {"option.timestep": {"timestep": -0.75}, "option.integrator": {"integrator": 1.0}}
    composed = Composed.of(found.simulator, [log], effects, {"q": 1e-4}).moved(point)
    composed = replace(composed, windows=tuple(replace(w, regime=STRIKES) for w in composed.windows))
    starts, finer = composed.starts(point), load(0.002, "Euler")
    finer.effects([log])
    for window, start, ours in zip(composed.windows, starts, composed.rolled(point, starts), strict=True):
        own = finer.simulator.simulate({}, log.window(window.first, window.end), start)
        np.testing.assert_allclose(ours["q"], own["q"], atol=1e-9)


INERTIA, REACH, MASS = 0.02, 0.1, 0.5
ROTOR = INERTIA - MASS * REACH**2 - 1e-4
LAWFUL = f"""<mujoco><option timestep="0.0005" integrator="implicitfast" gravity="0 0 -9.81"/>
<worldbody><body><joint name="hinge" type="hinge" axis="0 -1 0" armature="{ROTOR}"/>
<inertial pos="0 0 -{REACH}" mass="{MASS}" diaginertia="1e-4 1e-4 1e-4"/></body></worldbody>
<actuator><motor name="motor" joint="hinge" ctrllimited="true" ctrlrange="-2 2"/></actuator>
<sensor><jointpos joint="hinge"/><jointvel joint="hinge"/></sensor></mujoco>"""


def swung(gravity=True, angle=0.0, rate=0.0, torque=0.0, seconds=0.2, **laws):
    model = mujoco.MjModel.from_xml_string(LAWFUL)
    if not gravity:
        model.opt.gravity[:] = 0.0
    data, steps = mujoco.MjData(model), round(seconds / model.opt.timestep)
    spec = int(mujoco.mjtState.mjSTATE_FULLPHYSICS)
    first = np.zeros((1, mujoco.mj_stateSize(model, spec)))
    first[0, 1:3] = angle, rate
    control = np.full((1, steps, 1), torque)
    names = {n: f"actuator:motor.{n}" if n == "fade" else f"joint:hinge.{n}" for n in laws}
    mine = Laws.of(model, [(names[n], v) for n, v in laws.items()])
    if mine:
        found = run(model, data, mine, first, control)
    else:
        found = rollout.rollout(model, data, first, control, nstep=steps)[1]
    return *found[0].T, np.arange(steps) * model.opt.timestep


def test_friction_by_load_holds_at_rest_up_to_its_limit():
    weight = MASS * 9.81 * REACH * np.sin(0.5)
    # half of that of the weight: 1.05 times as much as holds
    held, _, _ = swung(angle=0.5, load_friction=2.1)
    assert np.abs(held - 0.5).max() < 3e-3  # MuJoCo's friction creeps, by 12 mrad/s here
    _, rate, t = swung(angle=0.5, load_friction=1.5, seconds=0.02)
    assert rate[-1] / t[-1] == pytest.approx(-(weight - 0.75 * weight) / INERTIA, rel=0.03)
    # A motor that lifts loads the gears by its own torque and by the weight.
    _, rate, t = swung(angle=0.5, torque=2 * weight, load_friction=0.5, seconds=0.02)
    assert rate[-1] / t[-1] == pytest.approx((1.0 - 0.5 * 0.5 * 3) * weight / INERTIA, rel=0.03)


def test_laws_brake_as_stated_and_those_that_do_nothing_run_as_the_plain_model():
    for way, torque in ((1.0, 0.05), (-1.0, 0.0)):  # 0.05 N m one way, and as nothing holds it back, none
        _, rate, t = swung(gravity=False, rate=way, direction_friction=0.05)
        assert rate[-1] == pytest.approx(way * (1 - torque / INERTIA * t[-1]), rel=0.01)
    _, rate, t = swung(gravity=False, rate=0.5, stribeck_extra=0.02, stribeck_speed=0.4, seconds=0.05)
    assert rate[-1] == pytest.approx(0.5 - 0.02 * np.exp(-((0.5 / 0.4) ** 2)) / INERTIA * t[-1], rel=0.01)
    _, rate, t = swung(gravity=False, rate=5.0, quadratic_drag=0.01)
    np.testing.assert_allclose(rate, 5 / (1 + 0.01 * 5 / INERTIA * t), rtol=1e-3)
    _, rate, t = swung(gravity=False, torque=1.0, fade=0.3, seconds=0.05)  # half of the most: 15 % less
    assert rate[-1] / t[-1] == pytest.approx(0.85 / INERTIA, rel=1e-3)
    plain, acting = (swung(angle=1.0, torque=0.1, **laws)[0] for laws in ({}, {"load_friction": 1e-12}))
    np.testing.assert_allclose(acting, plain, atol=1e-12)


def test_cogging_and_ripple_come_and_go_with_the_angle():
    wave = 0.02 * np.cos(7 * 0.5) + 0.05 * np.sin(7 * 0.5)
    for law, torque, gives in (("cogging", 0.0, wave), ("ripple", 0.2, 0.2 * (1 + wave))):
        named = zip(("per_turn", "cos", "sin"), (7.0, 0.02, 0.05), strict=True)
        laws = {f"{law}_{part}": value for part, value in named}
        _, rate, t = swung(gravity=False, angle=0.5, torque=torque, seconds=0.01, **laws)
        assert rate[-1] / t[-1] == pytest.approx(gives / INERTIA, rel=0.01)


@pytest.mark.parametrize("scaled", [False, True])
def test_how_often_a_torque_comes_and_goes_is_read_off_the_logs(scaled):
    rng, t = np.random.default_rng(2), np.arange(0, 6, 0.01)
    q, motor = np.sin(1.7 * t), 0.2 * np.cos(2.9 * t)
    lost = 0.1 * np.sin(7 * q + 1) * (motor if scaled else 0.2)
    torque = motor + lost + 0.01 * q + 0.004 * rng.standard_normal(t.size)
    motion = Motion(t, np.arange(t.size), {0: q}, {0: np.gradient(q, t)}, {}, {0: torque}, {0: motor})
    assert periods([motion], 0, scaled) == pytest.approx(7, abs=0.5)
    still = replace(motion, position={0: 0.01 * q}, rate={0: 0 * q})
    even = replace(motion, torque={0: motor + 0.004 * rng.standard_normal(t.size)})
    exact, fast = replace(motion, torque={0: motor}), replace(motion, rate={0: 60 * np.gradient(q, t)})
    assert not any(periods([one], 0, scaled) for one in (still, even, exact, fast))
