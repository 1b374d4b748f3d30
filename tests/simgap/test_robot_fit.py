"""Fits, sets and diagnoses of robots against planted values; calibrations; what changed in logs."""

import json
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from refusals import partly, refused
from scipy import stats
from scipy.special import logsumexp
from scipy.stats import ttest_1samp, ttest_ind
from simgap_swing import Swing, log

from experiments.real.servo import Servo
from hmmseg_cli.main import main
from simgap.robot_effects import candidates, effects_of
from simgap.robot_effects.base import Setting
from simgap.robots import changes as comparing
from simgap.robots.calibrate import LEAVES, Calibration, calibrate
from simgap.robots.changes import changes, jackknife
from simgap.robots.describe import body
from simgap.robots.diagnose import diagnose
from simgap.robots.fit import _prior, _slope, fit_effects
from simgap.robots.linear import linearise
from simgap.robots.model import Composed
from simgap.robots.rows import Rows, folds_of, noises, phases_of
from simgap.robots.search import BETTER, FittedSet, Search
from simgap.robots.sets import Sets, point_of
from simgap.robots.unchanged import without_broken
from simgap.robots.verdict import Shrinkage, verdict_on
from simgap.robots.whiten import covariances
from simgap.robots.windows import JUMPS
from simgap.simulators.protocol import Channel, Parameter
from simgap.simulators.recording import Recording
from simgap.simulators.user import checked

VISCOUS = 0.02


def composed(robot, logs) -> Composed:
    simulator = checked(robot, "robot")
    return Composed.of(simulator, logs, candidates(Setting(simulator, logs)), noises(simulator, logs))


def fit(model: Composed, point):
    linear = linearise(model, {}, [])
    return fit_effects(model, linear, covariances(model, linear).whitener(), point)


@pytest.fixture(scope="module")
def damped() -> Composed:
    return composed(Swing(), [log(s, viscous=VISCOUS) for s in range(2)])


@pytest.mark.parametrize("start", [0.0, 0.001, 0.1])
def test_a_planted_value_is_found_from_wrong_starts(damped, start):
    found = fit(damped, {"viscous": {"viscous": start}})
    assert found["viscous"]["viscous"] == pytest.approx(VISCOUS, rel=0.05)


def test_a_fit_and_a_search_come_back_from_where_the_simulator_diverges(damped):
    class Brittle(Swing):
        def simulate(self, parameters, recording, start=None):
            out = super().simulate(parameters, recording, start)
            return {"angle": out["angle"] * (np.nan if parameters["viscous"] > 0.05 else 1.0)}

    model = composed(Brittle(), [log(0, viscous=VISCOUS)])
    found = fit(model, {"viscous": {"viscous": 0.2}})
    assert found["viscous"]["viscous"] == pytest.approx(VISCOUS, rel=0.05)
    search = Search(damped, tuple(damped.effects), damped.rows.log)
    nothing, names = search.nothing(), tuple(damped.effects)
    best = replace(nothing, names=names, point={n: e.neutral() for n, e in damped.effects.items()})
    for out in names:
        rest = tuple(n for n in names if n != out)
        far = replace(nothing.linear, moved={}, diverged=rest)
        search.fitted[frozenset(rest)] = replace(nothing, names=rest, linear=far, score=-np.inf)
    assert search._exchange(best) is None


def test_causes_are_proposed_near_their_size_and_twins_are_judged_too():
    model = composed(Swing(), [log(s, viscous=0.1) for s in range(2)])
    search = Search(model, tuple(model.effects), model.rows.log)
    sets, _ = search.propose(search.nothing(), search.wanted)
    found = point_of(model.effects, sets.fit(("viscous",), 0), ("viscous",), search.along)
    assert found["viscous"]["viscous"] == pytest.approx(0.1, rel=0.1)
    model = composed(Swing(), [log(s, torque_scale=1.4) for s in range(2)])
    search = Search(model, tuple(model.effects), model.rows.log)
    best = search.forced(("torque_scale",))
    search._judge_twins(best, "torque_scale")
    (twin,) = {*search.fitted} - {frozenset(), frozenset(best.names)}
    assert twin == {"command:torque.gain"} and search.fitted[twin].score == pytest.approx(best.score, abs=2.0)
    assert search.fitted[twin].point["command:torque.gain"]["gain"] == pytest.approx(0.4, abs=0.01)


def test_a_set_is_fitted_again_from_a_larger_one_that_promises_more(damped, monkeypatch):
    search = Search(damped, tuple(damped.effects), damped.rows.log)
    one = search.fit(("viscous",), {"viscous": {"viscous": 0.0}}, [search.nothing().whiten])
    other = next(n for n, e in damped.effects.items() if not e.fitted and n != "viscous")
    both = search.fit(("viscous", other), {**one.point, other: damped.effects[other].neutral()}, [one.whiten])
    search.fitted[frozenset(one.names)] = replace(one, score=one.score - 50.0)  # stuck elsewhere
    assert search._without(both, other).score == pytest.approx(one.score, abs=2 * BETTER)
    monkeypatch.setattr(search, "fit", lambda *_: pytest.fail("fitted though nothing is promised"))
    assert search._without(both, other).names == ("viscous",)


def test_what_is_settled_stays_and_lines_from_starts_hide_in_no_discrepancy(damped):
    search = Search(damped, tuple(damped.effects), damped.rows.log)
    nothing = search.nothing()
    loud, quiet = (replace(nothing, discrepancy=d) for d in ({"angle": 1e3}, {}))
    assert search._begun_anew(loud, quiet)[2] > 2 * search._begun_anew(loud, loud)[2] > 0
    search = Search(damped, tuple(damped.effects), damped.rows.log)
    nothing = search.nothing()
    first = search.fit(("viscous",), {"viscous": {"viscous": 0.0}}, [nothing.whiten])
    assert first.score > nothing.score + 100
    again = search.fit(("viscous",), first.point, [first.whiten])
    assert abs(again.score - first.score) < BETTER


def test_searches_thin_windows_of_many_rows_and_fit_rivals_to_the_end(damped, monkeypatch):
    every = damped.thinned()
    monkeypatch.setattr("simgap.robots.model.MOST_ROWS", -(-damped.rows.log.size // 2))
    assert damped.thinned() == every[::2]
    none = tuple(slice(0, 0) for _ in every)  # readings that are missing throughout
    assert replace(damped, rows=replace(damped.rows, of=none)).thinned() == every
    search, again = Search(damped, tuple(damped.effects), damped.rows.log), []
    best = search.nothing()
    for name, score, promise in (("near", -4.0, -1.0), ("far", -9.0, -4.0), ("settled", -2.0, -2.0)):
        one = replace(best, names=(name,), score=best.score + score, promise=best.score + promise)
        search.fitted[frozenset(one.names)] = one
    monkeypatch.setattr(search, "fit", lambda names, *_: again.append(names))
    assert search._settled(best) is best and again == [("near",)]


@pytest.mark.parametrize(("gain", "better"), [(0.0, True), (9.0, True), (-9.0, False)])
def test_of_what_explains_alike_the_simpler_is_preferred(damped, monkeypatch, gain, better):
    search = Search(damped, tuple(damped.effects), damped.rows.log)
    held_out = {"coulomb": np.full(4, gain), "stribeck": np.zeros(4)}
    monkeypatch.setattr(search, "_held_out", lambda one, _: held_out[one.names[0]])
    one, two = (partly(FittedSet, names=(n,), score=score, sets=partly(Sets, size=size), discrepancy={})
                for n, score, size in (("coulomb", 0.5, (1,)), ("stribeck", 0.0, (2,))))  # fmt: skip
    assert search._is_better(one, two) is better and not search._is_better(two, one)


def test_a_small_gap_whose_only_cause_is_doubted_is_none():
    model = composed(Swing(), [log(s) for s in range(3)])
    search = Search(model, tuple(model.effects), model.rows.log)
    nothing = search.nothing()
    best = search.fit(("viscous",), {"viscous": {"viscous": 0.0}}, [nothing.whiten])
    best = replace(best, score=nothing.score + 20)
    far = Shrinkage(1.0, 1.0, 1.0, 0.0, (0.0, 0.0), {}, *np.zeros((3, 1)))
    phases = phases_of(model.simulator, model.recordings, model.windows)
    found = verdict_on(search, best, far, phases, 0, False)
    assert found.detection.p_value < 0.01 and found.doubts and (found.verdict, found.causes) == ("none", ())


class Two:
    """Two pendulums that do not act on each other."""

    parameters = {f"{n}_{side}": p for side in "ab" for n, p in Swing.parameters.items()}  # noqa: RUF012
    channels = {f"{n}_{side}": c for side in "ab" for n, c in Swing.channels.items()}  # noqa: RUF012

    def simulate(self, parameters, recording, start=None):
        out = {}
        for side in "ab":
            mine = {n: parameters[f"{n}_{side}"] for n in Swing.parameters}
            driven = Recording("", recording.t, {"torque": recording[f"torque_{side}"]})
            begun = None
            if start is not None:
                begun = {n: start[n.replace("angle", f"angle_{side}", 1)] for n in ("angle", "angle_rate")}
            out[f"angle_{side}"] = Swing().simulate(mine, driven, begun)["angle"]
        return out


def two(seed: int, **changed: float) -> Recording:
    sides = {}
    for number, side in enumerate("ab"):
        mine = {n[:-2]: v for n, v in changed.items() if n.endswith(f"_{side}")}
        one = log(2 * seed + number, seconds=3.0, **mine)
        sides |= {f"{n}_{side}": v for n, v in one.columns.items()}
    return Recording(f"log{seed}.csv", one.t, sides)


@pytest.mark.slow
def test_a_set_is_judged_by_the_discrepancy_that_it_leaves():
    """By the discrepancy that is left without it, a cause seems to gain a third of what it does."""
    model = composed(Two(), [two(s, viscous_a=0.004, viscous_b=0.0005) for s in range(4)])
    search, names = Search(model, tuple(model.effects), model.rows.log), ("viscous_a", "viscous_b")
    none = search.nothing()
    assert {*none.discrepancy} >= {"angle_a", "angle_b"}
    sets, levels = search.propose(none, names)
    hidden = float(sets.scores([names[:1]], 0)[0] - sets.scores([()], 0)[0])
    large, small, both = (search.fit(one, {n: {n: 0.004 if n[-1] == "a" else 0.0005}
                                           for n in one}, [levels[-1]])
                          for one in (names[:1], names[1:], names))  # fmt: skip
    assert large.score - none.score > 1.5 * hidden > 30 and both.score > large.score + 20 > small.score + 40
    left = [one.discrepancy for one in (large, small, both)]
    assert left[0].get("angle_a", 0.0) < 0.02 * none.discrepancy["angle_a"] < left[1]["angle_a"]
    assert "angle_b" in left[0] and "angle_b" not in left[1] and not left[2]


class Tipping:
    """What stands on its end and falls, theta'' = 25 sin(theta): errors of a start grow a hundredfold."""

    parameters = {"pull": Parameter(25.0, 1.0)}  # noqa: RUF012
    channels = {"angle": Channel("rad", "position")}  # noqa: RUF012

    def simulate(self, parameters, recording, start=None):
        fall = lambda x: np.array([x[1], parameters["pull"] * np.sin(x[0])])  # noqa: E731
        x = np.array([start["angle"], start["angle_rate"]] if start else [0.01, 0.0])
        out = [x]
        for h in np.diff(recording.t):
            a = fall(x)
            b = fall(x + 0.5 * h * a)
            c = fall(x + 0.5 * h * b)
            x = x + h / 6 * (a + 2 * b + 2 * c + fall(x + h * c))
            out.append(x)
        return {"angle": np.array(out)[:, 0]}


def test_a_start_that_says_much_of_what_follows_is_no_gap():
    """A fall is far from linear about the start that the first samples show alone."""
    t, logs = np.arange(0, 1, 0.01), []
    for seed in range(4):
        still = Recording("", t, {})
        angle = Tipping().simulate({"pull": 25.0}, still, {"angle": 0.05 - 0.02 * seed, "angle_rate": 0.0})
        noisy = angle["angle"] + 1e-3 * np.random.default_rng(seed).standard_normal(t.size)
        logs.append(Recording(f"{seed}.csv", t, {"angle": noisy}))
    simulator = checked(Tipping(), "robot")
    model = Composed.of(simulator, logs, candidates(Setting(simulator, logs)), {"angle": 1e-3}, 1.0)
    linear = linearise(model, {}, [])
    white = covariances(model, linear).whitener()(linear.residual)
    search = Search(model, tuple(model.effects), model.rows.log)
    nothing = search.nothing()
    assert np.mean(white**2) > 2 and nothing.squares.mean() < 1.2 and not nothing.discrepancy


def test_priors_are_cauchy_and_of_what_is_fitted_along_normal():
    x = np.array([-30.0, -2.0, -1e-7, 0.0, 0.5, 4.0, 200.0])
    for tails, density in ((1.0, stats.cauchy()), (30.0, stats.cauchy(scale=1 / 30)), (0.0, stats.norm())):
        root = _prior(x, np.full(x.size, tails))
        np.testing.assert_allclose(-0.5 * root**2, density.logpdf(x) - density.logpdf(0.0), atol=1e-12)
        for at in (-30.0, -2.0, 0.5, 4.0):
            step, both = 1e-5, np.full(2, tails)
            low, high = _prior(np.array([at - step, at + step]), both)
            assert _slope(np.array([at]), both[:1])[0] == pytest.approx((high - low) / (2 * step), rel=1e-6)


RATE, WIDTH = 50.0, 0.03


class Sticky:
    """A joint that follows its command but for a band of unseen errors, or of friction."""

    parameters = {  # noqa: RUF012
        n: {"nominal": 0.0, "sd": 0.01, "unit": "rad", "low": 0.0, "high": 0.2} for n in ("band", "friction")
    }
    channels = {  # noqa: RUF012
        "cmd": {"unit": "rad", "kind": "command"},
        "pos": {"unit": "rad", "kind": "position", "noise": 1e-4},
    }
    window = 2.0

    def simulate(self, parameters, recording, start=None):
        return {"pos": follow(parameters["band"] + parameters["friction"], recording["cmd"], start["pos"]
                              if start else 0.0)}  # fmt: skip


def follow(width: float, command: np.ndarray, begin: float, pushed: np.ndarray | None = None) -> np.ndarray:
    out = np.full(command.size, begin)
    for i in range(command.size - 1):
        error = command[i] - out[i]
        out[i + 1] = out[i] + 0.2 * np.sign(error) * max(abs(error) - width, 0.0)
        out[i + 1] += 0.0 if pushed is None else pushed[i]
    return out


def sticky_logs(count: int = 4) -> list[Recording]:
    rng, t, out = np.random.default_rng(3), np.arange(0, 8, 1 / RATE), []
    for k in range(count):
        command = 0.1 * np.abs(((0.2 + 0.1 * k) * t) % 2 - 1)
        pushed = np.convolve(2e-4 * rng.standard_normal(t.size), np.ones(5), "same")
        pos = follow(WIDTH, command, command[0], pushed) + 1e-4 * rng.standard_normal(t.size)
        out.append(Recording(f"log_{k}.csv", t, {"cmd": command, "pos": pos}))
    return out


def test_what_does_the_same_is_a_set_and_logs_of_one_group_are_held_out_together():
    found = diagnose(checked(Sticky(), "servo"), sticky_logs())
    told = body(found)
    assert told["verdict"] == "set" and {*told["causes"], *told["indistinguishable"]} == {"band", "friction"}
    for name in ("band", "friction"):
        (width,) = told["effects"][name]["parameters"].values()
        assert abs(width["mean"] - WIDTH) < 0.2 * WIDTH, name
    rows = object.__new__(Rows)
    object.__setattr__(rows, "log", np.repeat(np.arange(4), 3))  # all that folds are made of
    fold = folds_of(rows, 4, groups=[100, 200, 100, 200])
    assert fold.tolist() == [0] * 3 + [1] * 3 + [0] * 3 + [1] * 3


@pytest.mark.parametrize("groups", [[1, 2, 1], [4, 4]])
def test_groups_that_nothing_can_be_held_out_by_are_refused(groups):
    line = r"groups: are \d in \d groups for 2 logs; expected"
    refused(line, diagnose, checked(Swing(), "Swing"), [log(1), log(2)], groups=groups)


class Guessed(Swing):
    """A pendulum of which all is guessed but its weight."""

    parameters = {  # noqa: RUF012
        "inertia": {"nominal": 0.01, "sd": 0.01, "unit": "kg m^2", "low": 0.001, "fitted": True},
        "gravity_torque": {"nominal": 0.5, "sd": 0.05, "unit": "N m", "low": 0.0},
        "viscous": {"nominal": 0.0, "sd": 0.05, "unit": "N m s/rad", "low": 0.0, "fitted": True},
        "torque_scale": {"nominal": 1.0, "sd": 0.5, "unit": "1", "low": 0.1, "fitted": True},
    }


def found_of(robot, logs):
    simulator = checked(robot, "robot")
    return calibrate(simulator, logs, effects_of(simulator, logs))


def test_planted_values_are_found_with_their_errors_and_held_out_logs_are_nearer():
    true = {"inertia": 0.014, "viscous": 0.02, "torque_scale": 1.3}
    found = found_of(Guessed(), [log(s, seconds=1.5, **true) for s in range(2)])
    body = found.body()
    assert found.left["angle"] < 1.1
    for name, value in true.items():
        told = body["parameters"][name]
        assert told["mean"] == pytest.approx(value, rel=0.01)
        assert abs(told["mean"] - value) < 5 * told["sd"] < 0.1 * value
        assert told["interval_90"][0] < told["mean"] < told["interval_90"][1]
    assert set(body["parameters"]) == {*true} and not body["combinations"] and not body["reasons"]
    assert body["heldout"]["after"]["angle"] < 0.05 * body["heldout"]["before"]["angle"]  # the start is read
    json.dumps(body, allow_nan=False)


def test_what_acts_only_together_is_told_as_a_sum_and_what_does_nothing_not_at_all():
    class Twice(Guessed):
        parameters = Guessed.parameters | {
            "more": {"nominal": 0.0, "sd": 0.03, "unit": "N m s/rad", "fitted": True},
            "idle": {"nominal": 1.0, "sd": 0.3, "unit": "K", "fitted": True},
        }

        def simulate(self, parameters, recording, start=None):
            drag = parameters["viscous"] + 2 * parameters["more"]
            return super().simulate({**parameters, "viscous": drag}, recording, start)

    body = found_of(Twice(), [log(s, seconds=1.5, viscous=0.03) for s in range(2)]).body()
    untold = {n for n, p in body["parameters"].items() if p["mean"] is None}
    assert untold == {"viscous", "more", "idle"} == set(body["reasons"])
    assert "told only together with more" in body["reasons"]["viscous"]
    assert "add little" in body["reasons"]["idle"]
    (one,) = body["combinations"]
    assert set(one["of"]) == {"viscous", "more"}
    assert one["of"]["more"] / one["of"]["viscous"] == pytest.approx(2.0, rel=1e-3)
    assert one["mean"] / one["of"]["viscous"] == pytest.approx(0.03, rel=0.02)


def test_one_log_is_held_out_by_halves_and_what_nothing_explains_is_told():
    body = found_of(Guessed(), [log(0, seconds=2.0, viscous=0.02)]).body()
    assert body["heldout"]["after"]["angle"] < 0.2 * body["heldout"]["before"]["angle"]
    refused("nothing of the model is uncertain", found_of, Swing(), [log(0)])
    logs = [log(s, seconds=1.5) for s in range(2)]
    found = found_of(Guessed(), [each.with_columns({"angle": each["angle"] + 0.05}) for each in logs])
    assert found.left["angle"] > LEAVES**0.5


ROBOT = """<mujoco><compiler angle="radian"/><option timestep="0.002" integrator="implicitfast"/>
<worldbody><body name="arm">
<joint name="hinge" axis="0 1 0" damping="0.1" range="-3 3"/>
<geom name="rod" type="capsule" fromto="0 0 0 0 0 -0.3" size="0.02" mass="0.5"/></body></worldbody>
<actuator><position name="servo" joint="hinge" kp="20" kv="1"/></actuator></mujoco>"""
MAP = '[columns.q]\njoint = "hinge"\n[columns.u]\nactuator = "servo"\nunit = "rad"\n'


def test_the_command_patches_the_model_and_tells_how_commands_were_held(tmp_path):
    """A servo that followed lines between the targets that were logged, its gain other than stated."""
    mujoco = pytest.importorskip("mujoco")
    (tmp_path / "robot.xml").write_text(ROBOT)
    (tmp_path / "map.toml").write_text(MAP)
    model = mujoco.MjModel.from_xml_string(ROBOT.replace('kp="20"', 'kp="15"'))
    rng, files = np.random.default_rng(0), []
    t = np.arange(0.0, 3.0, 0.02)
    for k in range(3):
        u = np.interp(t, np.arange(0, 3.2, 0.2), rng.uniform(-1, 1, 16))
        data, rows = mujoco.MjData(model), []
        for step in range(t.size * 10):
            if step % 10 == 0:
                rows.append([t[step // 10], data.qpos[0] + 1e-4 * rng.standard_normal(), u[step // 10]])
            data.ctrl[0] = np.interp(step * 0.002 + 0.001, t, u)
            mujoco.mj_step(model, data)
        files.append(str(tmp_path / f"{k}.csv"))
        np.savetxt(files[-1], rows, delimiter=",", header="t,q,u", comments="")
    robot = ["--model", str(tmp_path / "robot.xml"), "--map", str(tmp_path / "map.toml")]
    told = ["--json", str(tmp_path / "out.json"), "--patch", str(tmp_path / "new"), "--quiet"]
    assert main(["calibrate", *files, *robot, *told]) == 0
    body = json.loads((tmp_path / "out.json").read_text())
    assert body["format"] == "hmmseg.calibrate/1"
    assert body["parameters"]["actuator:servo.gain"]["mean"] == pytest.approx(-0.25, abs=0.01)
    assert body["numerics"]["option.hold"]["mean"] == pytest.approx(1.0, abs=0.1)
    assert not {*body["numerics"]} & {*body["parameters"]}
    patched = mujoco.MjModel.from_xml_path(str(tmp_path / "new/robot.xml"))
    assert patched.actuator_gainprm[0, 0] == pytest.approx(15.0, rel=0.01)
    ranges = json.loads((tmp_path / "new/ranges.json").read_text())
    assert ranges["fitted"]["actuator:servo.gain"]["nominal"] == 0.0
    (line,) = ranges["not_in_xml"]  # and no law that was not fitted
    assert line.startswith("command.delay") and any(line in warning for warning in body["warnings"])


def test_a_command_that_jumps_between_two_samples_is_no_gap(tmp_path):
    """A drive that took its commands at 500 Hz, logged at 50 Hz: when a jump came is not in the log."""
    mujoco = pytest.importorskip("mujoco")
    from simgap.simulators.mjcf.load import load_mjcf

    (tmp_path / "robot.xml").write_text(ROBOT)
    (tmp_path / "map.toml").write_text(MAP)
    jumps = (0.513, 1.262, 2.447)
    robot = mujoco.MjModel.from_xml_string(ROBOT)
    data, rows = mujoco.MjData(robot), []
    for step in range(1500):
        t = 0.002 * step
        u = 0.3 * np.sin(2 * t) + 0.5 * (sum(t >= at for at in jumps) % 2)
        if step % 10 == 0:
            rows.append([t, data.qpos[0], u])
        data.ctrl[0] = u
        mujoco.mj_step(robot, data)
    noise = 4e-4 * np.random.default_rng(0).standard_normal(len(rows))
    np.savetxt(tmp_path / "log.csv", np.array(rows) + np.outer(noise, [0, 1, 0]), delimiter=",",
               header="t,q,u", comments="")  # fmt: skip
    loaded = load_mjcf(tmp_path / "robot.xml", tmp_path / "map.toml")
    log = loaded.read(tmp_path / "log.csv")
    effects = effects_of(loaded.simulator, [log], loaded.effects([log]))
    model = Composed.of(loaded.simulator, [log], effects, noises(loaded.simulator, [log]))
    held = {"option.hold": {"hold": 1.0}}
    linear = linearise(model, held, [])
    mean = np.mean(covariances(model, linear).whitener()(linear.residual) ** 2)
    doubted = [w for w in model.windows if JUMPS in w.doubt]
    assert len(doubted) <= len(jumps)
    assert all(any(log.t[w.begin] - 0.02 < at < log.t[w.end - 1] for at in jumps) for w in doubted)
    for window in model.windows:
        window.doubt.pop(JUMPS, None)
    without = linearise(model, held, [])
    plain = np.mean(covariances(model, without).whitener()(without.residual) ** 2)
    assert mean < 0.1 * plain


KNOWN = ("mass", "length", "gain", "coulomb")
TRUE = {"mass": 0.5, "length": 0.12, "gain": 2.6, "coulomb": 0.15}
SIMULATOR = checked(Servo(0.5, 0.12, 16.0), "servo.py:Servo")


def recorded(motion: str, seed: int, changed: dict[str, float]) -> Recording:
    """A log of 2 s at 50 Hz of the servo with its true parameters."""
    t = np.arange(100) / 50
    goal = {"slow": 1.2 * np.sin(1.5 * t), "slower": 0.9 * t / 2, "slowest": -0.7 * np.sin(0.8 * t),
            "fast": 0.8 * np.sin(7 * t), "step": np.where(t > 0.4, 1.3, 0.0),
            "drop": np.where(t < 1, 1.4 * np.minimum(t / 0.8, 1), 1.4)}[motion]  # fmt: skip
    on = np.where((motion == "drop") & (t > 1), 0.0, 1.0)
    columns = {"goal": goal, "volts": np.full(t.size, 12.0), "on": on, "position": np.zeros(t.size)}
    nominal = {n: p.nominal for n, p in SIMULATOR.parameters.items()} | TRUE | changed
    start, rng = {"position": 0.0, "position_rate": 0.0}, np.random.default_rng(seed)
    log = Recording(f"{motion}_{seed}.csv", t, columns)
    angle = SIMULATOR.simulate(nominal, log, start)["position"] + 0.001 * rng.normal(size=t.size)
    log = log.with_columns({"position": angle})
    duty = SIMULATOR.simulate(nominal, log, start)["duty"] + 0.002 * rng.normal(size=t.size)
    return log.with_columns({"duty": duty})


def logs(seed: int, motions: tuple[str, ...] = ("slow", "fast", "step", "drop"),
         **changed: float) -> list[Recording]:  # fmt: skip
    return [recorded(m, seed + k, changed) for k, m in enumerate(motions)]


@cache
def healthy() -> tuple[dict, list[Recording], Calibration]:
    old = logs(0)
    every = effects_of(SIMULATOR, old)
    effects = {n: replace(e, fitted=n in ("gain", "coulomb")) for n, e in every.items() if n in KNOWN}
    return effects, old, calibrate(SIMULATOR, old, effects)


@cache
def compared(**changed: float) -> comparing.Changes:
    effects, old, calibration = healthy()
    before = compared().old if changed else None
    return changes(SIMULATOR, old, logs(100, **changed), effects, calibration=calibration, known=before)


def test_nothing_changed_is_none_and_one_old_log_is_too_few():
    found = compared()
    body = found.body()
    assert (body["verdict"], body["causes"]) == ("none", [])
    assert sum(body["probabilities"].values()) == pytest.approx(1.0)
    line = "--healthy: has 1 log; expected two"
    refused(line, changes, SIMULATOR, logs(0, ("slow",)), logs(1, ("slow",)), {})


def test_a_gain_doubled_is_named_with_its_ratio():
    found = compared(gain=5.2)
    assert found.verdict == "named" and found.best.effects == ("gain",)
    size = found.sizes()["gain"]
    low, high = size["ratio_90"]
    assert low <= 2.0 <= high and size["ratio"] == pytest.approx(2.0, rel=0.03)
    body = found.body()
    assert body["changes"][0].startswith("gain +") and {*body["effects"]["gain"]["parameters"]} == {"gain"}
    pair = replace(found.best, effects=("gain", "mass"), **{n: np.repeat(getattr(found.best, n), 2) for n in
                   ("x", "sd", "freedom")})  # fmt: skip
    both = replace(found, best=pair).body()["effects"]
    assert {n: {*e["parameters"]} for n, e in both.items()} == {
        "gain+mass": {"gain.gain", "mass.mass"}, "gain": {"gain"}, "mass": {"mass"},
    }  # fmt: skip


def test_next_experiments_are_motions_that_differ_most_and_logs_of_old_tell_nothing_of_the_arm():
    found = compared(gain=5.2)
    apart = 0.1 * np.arange(found.best.left.size)
    other = replace(found.best, effects=("mass",), left=found.best.left + apart)
    asked = replace(found, verdict="set", others=(other,)).body()["next_experiment"]
    unit = found.runs.units[-1]
    rows = found.runs.unit == unit
    assert asked["log"] == found.composed.recordings[int(found.runs.log[rows][0])].name
    assert asked["expected_gain_nats"] == pytest.approx(apart[-1] * rows.sum() / found.old.dependence)
    assert asked["separates"] == ["gain", "mass"]
    nominal = {n: p.nominal for n, p in SIMULATOR.parameters.items()} | TRUE
    log, start = recorded("fast", 0, {}), {"position": 0.0, "position_rate": 0.0}

    def angles(**changed: float) -> np.ndarray:
        return SIMULATOR.simulate(nominal | {"mass": 0.5} | changed, log, start)["position"]

    np.testing.assert_allclose(angles(arm=2.0), angles(), atol=1e-9)
    assert np.abs(angles(arm=2.0, mass=0.9) - angles(mass=0.9)).max() > 1e-3


@pytest.mark.slow
def test_what_no_log_can_tell_apart_is_a_set_whose_intervals_hold():
    found = compared(mass=0.7)
    members = {c.effects for c in (found.best, *found.others)}
    assert ("mass",) in members and members <= {("mass",), ("length",)}
    mass = next(c for c in (found.best, *found.others) if c.effects == ("mass",))
    low, high = found.sizes(mass)["mass"]["interval_90"]
    assert low <= 0.7 <= high
    old, new = logs(0), logs(50, mass=0.7)
    every = effects_of(SIMULATOR, old)
    effects = {n: replace(every[n], fitted=n == "coulomb") for n in ("mass", "coulomb")}
    effects["twin"] = replace(every["mass"], name="twin")
    found = changes(SIMULATOR, old, new, effects)
    assert found.verdict == "set"
    assert {c.effects for c in (found.best, *found.others)} == {("mass",), ("twin",)}


def test_a_single_wild_sample_is_found_and_is_no_cause_and_the_end_of_a_log_is_not_broken():
    (log,) = logs(3, ("fast",))
    wild = log["position"].copy()
    wild[57] = -3.14
    (clean,), broken = without_broken(SIMULATOR, [log.with_columns({"position": wild})])
    assert [(b.channel, b.time, b.value) for b in broken] == [("position", 1.14, -3.14)]
    assert np.isnan(clean["position"][57]) and np.isfinite(np.delete(clean["position"], 57)).all()
    assert without_broken(SIMULATOR, [log])[1] == []
    (log,) = logs(3, ("step",))
    ends = log["duty"].copy()
    ends[[0, -1]] = 0.9
    assert without_broken(SIMULATOR, [log.with_columns({"duty": ends})])[1] == []


def test_leaving_one_out_of_means_is_welchs_test():
    rng = np.random.default_rng(0)
    a, b = rng.normal(size=5), 3 * rng.normal(size=4)
    without = [np.array([[np.delete(v, k).mean()] for k in range(v.size)]) for v in (a, b)]
    sd, freedom = jackknife(without)
    welch = ttest_ind(a, b, equal_var=False)
    assert (a.mean() - b.mean()) / sd[0] == pytest.approx(welch.statistic)
    assert freedom[0] == pytest.approx(welch.df)
    more, many = jackknife(without, np.array([4.0]))  # what a prior leaves open adds to what motions say
    assert more[0] == pytest.approx(np.hypot(sd[0], 2.0)) and many[0] > freedom[0]
    assert np.isinf(jackknife([without[0], np.zeros((1, 1))])[0][0])  # of one unit nothing is sure


def test_a_size_takes_in_that_all_else_may_have_drifted():
    """Drifts as parameters of their own, with the prior that they have, leave the same variances."""
    rng = np.random.default_rng(0)
    p, k, drift = 3, 2, np.array([0.1, 0.0, 0.4])
    before, new = (a.T @ a for a in (rng.normal(size=(6, p)), rng.normal(size=(9, p + k))))
    total = new.copy()
    total[:p, :p] += before
    whole = np.zeros((2 * p + k, 2 * p + k))  # OLD's theta, changes, drifts
    whole[: p + k, : p + k] = total
    whole[: p + k, p + k :] = new[:, :p]
    whole[p + k :] = np.hstack([new[:p], new[:p, :p] + np.diag(1 / np.maximum(drift, 1e-12))])
    wanted = np.diag(np.linalg.inv(whole))[p : p + k] - np.diag(np.linalg.inv(total))[p:]
    np.testing.assert_allclose(comparing.added_by_drift(total, before, drift)[p:], wanted, rtol=1e-6)


def test_an_explanations_energy_is_minus_the_log_of_its_evidence():
    """By quadrature over the change, with nothing fitted along."""
    every = effects_of(SIMULATOR, logs(0))
    found = changes(SIMULATOR, logs(0), logs(100, gain=3.5), {"gain": replace(every["gain"], fitted=False)})
    one = next(c for c in found.tried if c.effects == ("gain",))
    both = comparing.Comparison(found.composed, found.old, [], found.runs.unit)
    of = comparing.Hypothesis.about(both.runs, found.old, ("gain",))
    x = one.x[0] + np.linspace(-0.1, 0.1, 401)
    costs = np.array([of.cost(np.array([v])) for v in x]) / found.old.dependence
    evidence = logsumexp(-costs - np.log(np.pi * (1 + x**2))) + np.log(x[1] - x[0])
    assert one.energy == pytest.approx(-evidence, abs=0.1) and found.p_value < 1e-6


def test_gains_and_unlike_motions_are_judged_by_chance():
    gains = np.array([0.3, 0.1, 0.5, -0.1])
    assert comparing.by_chance(gains) == pytest.approx(ttest_1samp(gains, 0, alternative="greater").pvalue)
    rng = np.random.default_rng(0)
    drawn = [[np.exp(rng.normal(size=n)) for n in (2, 3)] for _ in range(2000)]
    found = np.array([comparing._unlike(*each) for each in drawn])
    assert np.mean(found < 0.1) == pytest.approx(0.1, abs=0.02)


@pytest.mark.parametrize(("p", "likelier"),
                         [(1e-6, "unknown"), (0.007, "unknown"), (0.02, "none"), (0.6, "none")])  # fmt: skip
def test_unknown_is_likelier_than_none_where_it_is_the_verdict(p, likelier):
    found = comparing._chances(partly(comparing.Change, effects=()), {}, 1.0, p)
    assert max(found, key=lambda n: found[n]) == likelier and sum(found.values()) == pytest.approx(1.0)
