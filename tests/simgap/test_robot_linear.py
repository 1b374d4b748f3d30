"""Windows, sensitivities and noise of logs against closed forms; simulators read from files of users."""

import itertools
import sys

import numpy as np
import pytest
from refusals import refused
from simgap_swing import Swing, log

from hmmseg.io.task import SequenceTask, parse_task
from simgap.channels import delayed, lowpass
from simgap.robot_effects import candidates
from simgap.robot_effects.base import Setting
from simgap.robots.linear import base_at, linearise, vary
from simgap.robots.model import Composed
from simgap.robots.rows import estimate_noise, noises, phases_by_task, resolution, rows_of
from simgap.robots.sets import identifiability
from simgap.robots.whiten import covariances
from simgap.robots.windows import REACH, cut, smoothed
from simgap.simulators.protocol import Job, Parameter, Simulator, run_all
from simgap.simulators.recording import Recording, read_recording
from simgap.simulators.user import checked, load_simulator, restarts


def composed(recordings, robot=Swing) -> Composed:
    simulator = checked(robot(), robot.__name__)
    effects = candidates(Setting(simulator, recordings))
    return Composed.of(simulator, recordings, effects, noises(simulator, recordings))


def whitened(model: Composed, point=None, effects=()):
    """Residual and Jacobians, whitened by the sensors' noise and the starts' alone."""
    linear = linearise(model, point or {}, list(effects))
    whiten = covariances(model, linear).whitener()
    return whiten(linear.residual), {n: whiten(m.jacobian) for n, m in linear.moved.items()}, linear


def test_windows_tile_every_log_and_run_across_no_gap():
    model = composed([log(0), log(1, seconds=2.05)])
    for number, recording in enumerate(model.recordings):
        mine = [w for w in model.windows if w.log == number]
        assert recording.t[mine[0].begin] - recording.t[0] == pytest.approx(REACH, abs=1e-3)
        assert mine[-1].end == len(recording) and all(a.end == b.begin for a, b in itertools.pairwise(mine))
    whole = log(0)
    kept = np.r_[0:150, 180:300, 304 : len(whole)]
    columns = {n: v[kept] for n, v in whole.columns.items()}
    model = composed([Recording(whole.name, whole.t[kept], columns)])
    steps = [np.diff(model.recordings[0].t[w.begin : w.end]).max() for w in model.windows]
    assert max(steps) < 0.011
    residual, _, _ = whitened(model)
    assert np.mean(residual**2) < 1.3


def test_starts_are_right_within_what_they_say_and_of_a_jerk_read_as_such():
    t, off = np.linspace(0, 1, 201), []
    for seed in range(200):
        values = 0.3 * np.sin(5 * t) + 1e-3 * np.random.default_rng(seed).standard_normal(t.size)
        (value, sd), (rate, rate_sd) = smoothed(t, values, 80, 1e-3)
        off.append([(value - 0.3 * np.sin(2.0)) / sd, (rate - 1.5 * np.cos(2.0)) / rate_sd])
    # what is said is three times what white noise makes of it
    assert np.all(np.std(off, 0) < 0.45) and np.all(np.std(off, 0) > 0.2)
    t = np.linspace(0, 1, 101)
    values = 300.0 * np.maximum(t - 0.485, 0.0) ** 3 + 1e-4 * np.random.default_rng(0).standard_normal(t.size)
    _, (rate, sd) = smoothed(t, values, 50, 1e-4)
    true = 900.0 * (t[50] - 0.485) ** 2
    assert abs(rate - true) < sd
    x = t[47:54] - t[50]  # a parabola takes the jerk for a rate
    assert abs(np.polyfit(x, values[47:54], 2)[1] - true) > 3 * sd


def test_a_rate_that_swings_between_samples_is_in_doubt_by_as_much():
    nominal = {"inertia": 0.01, "gravity_torque": 36.0, "viscous": 1.1, "torque_scale": 1.0}
    own = {n: {**p, "nominal": nominal[n]} for n, p in Swing.parameters.items()}
    channels = Swing.channels | {"angle": {**Swing.channels["angle"], "noise": 1e-5}}
    robot = type("Stiff", (Swing,), {"parameters": own, "channels": channels})
    t, torque = np.arange(4000) / 1000, np.repeat(18 * np.sin(5 * np.arange(400) / 100), 10)
    angle = Swing().simulate(nominal, Recording("log.csv", t, {"torque": torque}))["angle"]
    seen = angle[::10] + 1e-5 * np.random.default_rng(0).standard_normal(400)
    model = composed([Recording("log.csv", t[::10], {"torque": torque[::10], "angle": seen})], robot)
    off = np.array([w.start["angle_rate"] - np.diff(angle)[10 * w.first - 1] / 1e-3 for w in model.windows])
    plain = cut(model.simulator, model.recordings, model.noise)
    swinging, smooth = (np.array([w.doubt["angle_rate"] for w in every]) for every in (model.windows, plain))
    assert np.std(off / swinging) < 1 and np.std(off / smooth) > 3


def test_commands_that_were_logged_late_are_found_early():
    plain = log(0)
    late = plain.with_columns({"torque": np.append(plain["torque"][0], plain["torque"][:-1])})
    early = composed([late]).effects["command.early"].command(late, {"early": 0.01})
    assert early["torque"][:-1] == pytest.approx(plain["torque"][:-1], abs=1e-9)


def test_what_is_read_late_at_a_windows_begin_is_what_went_before():
    plain = log(0, seconds=20.0, noise=0.0)
    jolts = 0.4 * np.sign(np.random.default_rng(1).standard_normal(200))[(plain.t / 0.1).astype(int)]
    jolted = plain.with_columns({"torque": jolts})
    robot = checked(Swing(), "Swing")
    true = robot.simulate({n: p.nominal for n, p in robot.parameters.items()}, jolted)["angle"]
    late = delayed(plain.t, true, 0.02) + 5e-4 * np.random.default_rng(2).standard_normal(plain.t.size)
    model = composed([jolted.with_columns({"angle": late})])
    point = {"readout:angle.lag": {"delay": 0.02}}
    linear = linearise(model, point, [])
    early = linear.rows.time - model.recordings[0].t[[w.begin for w in model.windows]][linear.rows.window]
    squares = covariances(model, linear).whitener()(linear.residual) ** 2
    assert squares[early < 0.015].mean() < 1.5


def test_whitened_residuals_of_a_true_model_or_of_an_effect_at_its_value_are_white():
    model = composed([log(s) for s in range(4)])
    residual, _, linear = whitened(model)
    assert 0.9 < np.sqrt(np.mean(residual**2)) < 1.05
    inside = linear.rows.window[1:] == linear.rows.window[:-1]
    assert abs(np.mean((residual[1:] * residual[:-1])[inside])) < 0.06
    recording = log(5)
    late = delayed(recording.t - recording.t[0], recording["angle"], 0.01)
    model = composed([recording.with_columns({"angle": late})])
    nominal, _, _ = whitened(model)
    there, _, _ = whitened(model, {"readout:angle.lag": {"delay": 0.01}})
    assert np.mean(nominal**2) > 3 and np.mean(there**2) < 1.2


@pytest.mark.parametrize(("effect", "values"), [
    ("viscous", {"viscous": 4e-4}), ("gravity_torque", {"gravity_torque": 0.505}),
    ("readout:angle.bias", {"bias": 2e-3}), ("readout:angle.lag", {"delay": 1e-3}),
    ("command.delay", {"delay": 2e-3}), ("readout:angle.gain", {"gain": 2e-3}),
])  # fmt: skip
def test_a_planted_effect_is_what_its_sensitivity_says(effect, values):
    """A small effect, starts read through it too, changes the residual by its Jacobian times it."""
    recording = log(3, noise=1e-9)
    model = composed([recording])
    made = model.effects[effect]
    if made.model:
        planted = log(3, noise=1e-9, **values)
    elif made.command is not None:
        acted, robot = made.command(recording, values), Swing()
        nominal = {n: p["nominal"] for n, p in robot.parameters.items()}
        planted = recording.with_columns({"angle": robot.simulate(nominal, acted)["angle"]})
    else:
        planted = recording.with_columns(made.alter(recording, recording.columns, values))
    changed = composed([planted])
    before, _, _ = whitened(model)
    after, jacobian, _ = whitened(changed, effects=[effect])
    shift = after - before
    predicted = jacobian[effect] @ np.array([values[n] - p.nominal for n, p in made.parameters.items()])
    left = np.linalg.norm(shift - predicted) / np.linalg.norm(shift)
    assert np.linalg.norm(shift) > 2 and left < 0.1


@pytest.mark.parametrize("name", ["readout:angle.gain", "readout:angle.bias", "readout:angle.lag"])
def test_a_large_misreading_moves_starts_farther_than_along_straight_lines(name):
    model = composed([log(3)])
    base = base_at(model, {})
    ((short, p),) = model.effects[name].parameters.items()
    there = {short: p.nominal + 4 * p.sd}
    one = vary(model, base, name, at=there)
    np.testing.assert_allclose(one.shift, base_at(model, {name: there}).rows - base.rows, atol=1e-12)


@pytest.mark.parametrize(("name", "value"), [("lag", 0.02), ("lowpass", 0.03)])
def test_a_reading_s_past_is_undone_from_the_samples_that_are_there(name, value):
    """Of a column read at every second row as of the same column in rows of its own."""
    whole = log(3)
    gaps = np.where(np.arange(len(whole)) % 2, np.nan, whole["angle"])
    own = Recording(whole.name, whole.t[::2], {n: v[::2] for n, v in whole.columns.items()})
    effect = composed([whole]).effects[f"readout:angle.{name}"]
    undone, expected = (effect.restore(r, {n: value for n in effect.parameters})["angle"]
                        for r in (whole.with_columns({"angle": gaps}), own))  # fmt: skip
    np.testing.assert_array_equal(undone[::2], expected)
    assert np.isnan(undone[1::2]).all()


def test_lowpass_resolution_and_noise_are_as_planted():
    t = np.linspace(0, 3, 3001)
    np.testing.assert_allclose(lowpass(t, 2 * t + 1, 0.1), 2 * (t - 0.1) + 1, atol=1e-12)
    w, tau = 2 * np.pi, 0.05
    found = lowpass(t, np.sin(w * t), tau)
    exact = np.imag(np.exp(1j * w * t) / (1 + 1j * w * tau))
    np.testing.assert_allclose(found[1000:], exact[1000:], atol=1e-5)
    values = np.random.default_rng(0).standard_normal(500)
    assert resolution(values) < 1e-4 and resolution(np.round(values / 0.01) * 0.01) == pytest.approx(0.01)
    log = Recording("log.csv", np.arange(3) / 150, {"z": np.array([0.0, 1e-3, 0.0])})
    assert estimate_noise([log], "z") == pytest.approx(1.4826 * 2e-3 / np.sqrt(6))
    assert estimate_noise([log.window(0, 2)], "z") == 1.0


def test_what_only_acts_together_is_said():
    """Torques and inertia scaled together change no motion: all four parameters are one set, exactly."""
    model = composed([log(s) for s in range(2)])
    _, jacobian, _ = whitened(model, {"viscous": {"viscous": 0.02}}, list(model.simulator.parameters))
    names = list(jacobian)
    scale = [model.simulator.parameters[n].sd for n in names]
    columns = np.concatenate([jacobian[n] for n in names], 1) * np.array(scale)
    found = identifiability(names, columns.T @ columns)
    assert any(a.own < 1e-3 and set(a.names) == set(names) for a in found.alike)
    kept = [k for k, n in enumerate(names) if n != "torque_scale"]
    assert not identifiability([names[k] for k in kept], columns[:, kept].T @ columns[:, kept]).alike


def test_numerics_are_exact_at_a_point_and_constant_about_it():
    """What the step changes is no part of other effects' derivatives, and needs no runs for them."""
    runs = []

    class Stepped(Swing):
        parameters = Swing.parameters | {"step": {"nominal": 0.0, "sd": 0.5}}
        numerics = frozenset({"step"})

        def simulate(self, parameters, recording, start=None):
            runs.append(parameters["step"])
            found = super().simulate(parameters, recording, start)["angle"]
            return {"angle": found * (1 + 0.01 * parameters["step"])}

    made = composed([log(0, seconds=1.0)], Stepped)
    runs.clear()
    point = {"step": {"step": 0.5}}
    linear = linearise(made, point, ["viscous", "inertia"])
    assert sum(s != 0 for s in runs) <= 0.4 * len(runs)
    exact = linearise(made, {}, ["viscous", "inertia"])
    base = made.rows.averaged(made.read(made.rolled(point, made.starts(point)), point))
    np.testing.assert_allclose(linear.residual, made.rows.observed - base)
    for name in exact.moved:
        near = pytest.approx(exact.moved[name].jacobian, rel=1e-6, abs=1e-9)
        assert linear.moved[name].jacobian == near
    doubled = linearise(made, point, ["step"]).moved["step"]
    assert 0.5 * doubled.jacobian[:, 0] == pytest.approx(0.01 * 0.5 * (made.rows.observed - exact.residual),
                                                         rel=1e-3, abs=1e-9)  # fmt: skip


@pytest.mark.parametrize("noise", [0.6, 0.75, 0.9, 1.2])
def test_noise_is_no_motion_and_no_step_of_an_encoder(noise):
    """A fall's second difference is 0.4 mm, twenty times the noise; in steps a median of differences
    is a whole number of steps: 25 % too little."""
    t, white = np.arange(6000) / 500, noise * np.random.default_rng(0).standard_normal(6000)
    for course in (0 * t, -50 * t**2, np.sin(3 * t)):
        falls = Recording("log.csv", t, {"z": course + 3e-5 * white})
        assert estimate_noise([falls], "z") == pytest.approx(3e-5 * noise, rel=0.1)
    wanted, read = 1e-4 * np.sqrt(noise**2 + 1 / 12), 1e-4 * np.round(1e4 * np.sin(3 * t) + white)
    assert estimate_noise([Recording("log.csv", t, {"z": read})], "z", 1e-4) == pytest.approx(
        wanted, rel=0.06
    )


def still_then_swinging(seed: int, begin: float):
    found = log(seed, seconds=6.0)
    torque = np.where(found.t < begin, 0.0, found["torque"])
    empty, robot = found.with_columns({"torque": torque}), Swing()
    angle = robot.simulate({n: p["nominal"] for n, p in robot.parameters.items()}, empty)["angle"]
    noise = 5e-4 * np.random.default_rng(seed).standard_normal(angle.size)
    return empty.with_columns({"angle": angle + noise})


@pytest.mark.slow
def test_a_task_names_the_phases_of_logs():
    begins = [2.0, 2.6, 3.1]
    logs = [still_then_swinging(k, b) for k, b in enumerate(begins)]
    phases = phases_by_task(logs, SequenceTask(("rest", "swing")))
    assert phases.names == ("rest", "swing")
    for starts, number, begin in zip(phases.starts, phases.number, begins, strict=True):
        assert list(number) == [0, 1] and starts[1] == pytest.approx(begin, abs=0.1)
    simulator = checked(Swing(), "Swing")
    composed = Composed.of(simulator, logs, {}, noises(simulator, logs))
    rows = rows_of(logs, composed.windows, composed.noise)
    told = phases.of(rows)
    assert (told == 1)[rows.time > 3.3].all() and not (told == 1)[rows.time < 1.8].any()


def test_what_is_no_sequence_and_what_is_no_column_is_said():
    logs = [log(0)]
    blocks = parse_task({"objects": {"block1": {"on": "ground"}},
                         "moves": [{"object": "block1", "to": "ground"}]})  # fmt: skip
    refused("task of blocks", phases_by_task, logs, blocks)
    forces = SequenceTask(("a", "b"), channels=("force",))
    refused("no column force; expected torque, angle", phases_by_task, logs, forces)


def test_a_model_that_explodes_at_a_candidate_is_said_and_the_others_go_on():
    class Explosive(Swing):
        parameters = Swing.parameters | {"charge": Parameter(0.0, 1.0)}

        def simulate(self, parameters, recording, start=None):
            found = super().simulate(parameters, recording, start)
            return found if parameters["charge"] == 0 else {n: v * np.inf for n, v in found.items()}

    linear = linearise(composed([log(0, seconds=2.0)], Explosive), {}, ["charge", "viscous"])
    assert linear.diverged == ("charge",) and set(linear.moved) == {"viscous"}


GOOD = """
parameters = {"slope": {"nominal": 1.0, "sd": 0.1, "unit": "1/s", "low": 0.0}}
channels = {
    "u": {"unit": "rad", "kind": "command"},
    "y": {"unit": "rad", "kind": "position", "noise": 1e-3},
}

class Robot:
    parameters, channels = parameters, channels
    def simulate(self, parameters, recording, start=None):
        return {"y": parameters["slope"] * (recording.t - recording.t[0]) + (start or {"y": 0.0})["y"]}

def open_loop(parameters, recording):
    return {"y": parameters["slope"] * recording["u"]}
open_loop.parameters, open_loop.channels = parameters, channels
thing = Robot()
number = 3
"""
RUN = """
import sys, time
import numpy as np
parameters = {"slope": {"nominal": 1.0, "sd": 0.1}}
channels = {"y": {"unit": "rad", "kind": "position", "noise": 1e-3}}
def run(parameters, recording, start=None):
    %s
run.parameters, run.channels, run.timeout = parameters, channels, 0.5
"""
LOG = Recording("a.csv", np.arange(3.0), {"y": np.ones(3)})


@pytest.fixture
def file(tmp_path):
    def write(text: str = GOOD):
        path = tmp_path / "robot.py"
        path.write_text(text)
        return path

    return write


@pytest.mark.parametrize(("name", "restarted"), [("Robot", True), ("thing", True), ("open_loop", False)])
def test_classes_objects_and_functions_will_do(file, name, restarted):
    simulator = load_simulator(f"{file()}:{name}")
    assert isinstance(simulator, Simulator) and restarts(simulator) is restarted
    assert simulator.parameters["slope"].sd == 0.1 and simulator.channels["u"].kind == "command"


def test_runs_may_diverge_or_be_interrupted_and_what_is_alike_will_do(file):
    simulator = load_simulator(f"{file()}:open_loop")
    log = Recording("a.csv", np.arange(3.0), {"u": np.ones(3)})
    found = run_all(simulator, [Job({"slope": 2.0}, log, None), Job({"slope": np.inf}, log, None)])
    assert found[0] is not None and found[0]["y"].tolist() == [2.0, 2.0, 2.0] and found[1] is None
    with pytest.raises(KeyboardInterrupt):
        load_simulator(f"{file(RUN % 'raise KeyboardInterrupt')}:run").simulate({}, LOG)
    for good in ("[1, 2, True]", "recording.t.astype(np.float32)", "np.array([1, 2, 3], object)"):
        code = f"return {{'y': {good}, 'more': 'text'}}"
        found = load_simulator(f"{file(RUN % code)}:run").simulate({}, LOG)
        assert found["y"].dtype == float and list(found) == ["y"]


@pytest.mark.parametrize(("name", "text", "line"), [
    ("Robt", GOOD, r"has no Robt; expected one of .*did you mean Robot\?"),
    ("number", GOOD, "has no mapping 'parameters'; expected parameters, channels and simulate"),
    ("Robot", "x = 1\nraise KeyError('x')", r"robot\.py, line 2: KeyError: 'x'; expected a file"),
    ("Robot", "import sys\nsys.exit(0)", r"robot\.py, line 2: SystemExit: 0; expected a file that runs"),
    ("Robot", "def f(:\n", r"robot\.py, line 1: SyntaxError: "),
    ("Robot", GOOD.replace("1.0,", "10**400,"), "parameter slope: int too large"),
    ("Robot", GOOD.replace("class Robot:", "class Robot:\n    by_log = 5"), "AttributeError"),
    ("Robot", GOOD + "Robot.parameters = property(lambda self: 1 / 0)", r"line 18: ZeroDivisionError"),
    ("Robot", GOOD.replace('"sd": 0.1', '"sd": 0.0'), "slope: nominal 1.0 and sd 0.0: expected"),
    ("Robot", GOOD.replace('"low": 0.0', '"low": 2.0'), "parameter slope: nominal 1.0 lies outside of"),
    ("Robot", GOOD.replace('"sd": 0.1', '"std": 0.1'), r"slope: std: unknown key; .*did you mean sd\?"),
    ("Robot", GOOD.replace("position", "place"), "channel y: kind 'place': expected one of position,"),
    ("Robot", GOOD.replace("1e-3", "-1e-3"), "channel y: noise -0.001: expected above 0"),
    ("Robot", GOOD.replace("position", "command"), "no channel to compare"),
    ("Robot", GOOD.replace("class Robot:", "class Robot:\n    numerics = {'slop'}"), "no parameter slop"),
    ("Robot", GOOD.replace("class Robot:", "class Robot:\n    window = 0"), "window: 0; expected"),
    ("Robot", GOOD.replace("def simulate", "def run"), "cannot be run; expected a method simulate"),
])  # fmt: skip
def test_what_is_wrong_is_said_in_a_line(file, name, text, line):
    refused(line, load_simulator, f"{file(text)}:{name}")


@pytest.mark.parametrize(("code", "line"), [
    ("raise ValueError('no\\nsuch motor')", r"robot\.py, line 7: ValueError: no such motor$"),
    ("sys.exit(0)", r"robot\.py, line 7: SystemExit: 0"),
    ("return np.linalg.inv(np.zeros((2, 2)))", r"robot\.py, line 7: LinAlgError"),
    ("parameters['slop']", r"robot\.py, line 7: KeyError: 'slop'"),
    ("recording.t[0] = 7", r"robot\.py, line 7: ValueError: assignment destination is read-only"),
    ("return None", r"robot\.py, line 6: gave None; expected a dict of channels"),
    ("return {}", r"robot\.py, line 6: gave no channel 'y'; expected y"),
    ("return {'y': recording.t[1:]}", r"line 6: channel y: gave an array \(2,\) of float64; "),
    ("return {'y': 1.0}", r"channel y: gave float '1.0'; expected 3 numbers"),
    ("return {'y': None}", r"channel y: gave None; expected 3 numbers"),
    ("return {'y': ['a', 'b', 'c']}", r"channel y: gave list of 3; expected real numbers"),
    ("return {'y': [1, None, 10**400]}", r"channel y: gave list of 3; expected real numbers"),
    ("return {'y': recording.t * 1j}", r"of complex128; expected real numbers"),
    ("return {'y': [[1], [2, 3], 4]}", r"robot\.py.*: ValueError"),
    ("while True: time.sleep(0.01)", r"robot\.py, line 7: took more than 0.5 s; expected a run"),
])  # fmt: skip
def test_whatever_a_run_does_is_said_in_a_line_that_names_its_place(file, code, line):
    simulator = load_simulator(f"{file(RUN % code)}:run")
    refused(line, run_all, simulator, [Job({"slope": 2.0}, LOG, None)])
    assert LOG.t[0] == 0


@pytest.mark.parametrize(("name", "code", "line"), [
    ("simulate_many", "return []", "gave 0 runs; expected 1, one for each job"),
    ("simulate_many", "return [{'y': [1]}]", "channel y: gave list of 1; expected 3 numbers"),
    ("simulate_many", "return 3", "TypeError"),
    ("state_at", "return {'y': 1.0}", r"expected \{state: \(value, standard deviation\)\}"),
    ("state_at", "return {'y': (float('nan'), 1.0)}", "state y: nan with standard dev"),
    ("contacts", "return None", r"gave None; expected times \[s\] in one row"),
    ("contacts", "exit(3)", "line 10: SystemExit: 3")])  # fmt: skip
def test_what_else_a_simulator_offers_is_checked_alike(file, name, code, line):
    text = RUN % "return {'y': recording.t}" + f"def more(*args):\n    {code}\nrun.{name} = more\n"
    simulator = load_simulator(f"{file(text)}:run")
    given = {"simulate_many": ([Job({"slope": 2.0}, LOG, None)],), "state_at": (LOG, 0.0), "contacts": (LOG,)}
    refused(line, getattr(simulator, name), *given[name])


def test_a_file_is_read_by_its_own_name_whatever_it_is_called(tmp_path):
    import scipy

    (tmp_path / "scipy.py").write_text(GOOD)
    load_simulator(f"{tmp_path / 'scipy.py'}:Robot")
    assert sys.modules["scipy"] is scipy
    refused(r"names no object; expected FILE\.py:NAME", load_simulator, "robot.py")
    refused(r"no such file missing\.py", load_simulator, "missing.py:Robot")


def test_logs_may_have_their_own_name_for_time_and_columns_at_a_slower_rate(tmp_path):
    path = tmp_path / "log.csv"
    path.write_text("stamp,y\n" + "".join(f"{0.1 * i},{i}\n" for i in range(10)))
    log = read_recording(path, ["y"], "stamp")
    assert log.t[3] == pytest.approx(0.3) and log["y"][3] == 3 and log.name == "log.csv"
    for absent in ("time", "t"):  # a robot has no rig.toml
        told = rf'column {absent}: missing; expected times in s, or time = ".+" in map.toml, one of stamp, y'
        refused(told, read_recording, path, ["y"], absent)
    refused(r"log\.csv: column z: missing", read_recording, path, ["z"], "stamp")
    path.write_text("t,y\n" + "".join(f"{0.1 * (i if i != 5 else 3)},{i}\n" for i in range(10)))
    refused(r"row 7, column t: 0\.3 after 0\.4; expected strictly increasing", read_recording, path, ["y"])
    path, rng = tmp_path / "log.csv", np.random.default_rng(0)
    fast, slow = rng.standard_normal(200), rng.standard_normal(200)
    path.write_text("t,x,y\n" + "".join(f"{0.01 * i:.2f},{fast[i]:.6f},{'' if i % 2 else f'{slow[i]:.6f}'}\n"
                                        for i in range(200)))  # fmt: skip
    log = read_recording(path, ["x", "y"])
    assert np.isfinite(log["x"]).all()
    assert np.flatnonzero(np.isfinite(log["y"])).tolist() == [*range(0, 200, 2)]
    assert log["y"][::2] == pytest.approx(slow[::2], abs=1e-6)
    assert estimate_noise([log], "y") == pytest.approx(1.0, rel=0.3)  # filled in between, it was nothing


def test_a_column_t_next_to_another_that_counts_the_time_is_itself(tmp_path):
    path, t = tmp_path / "log.csv", 0.01 * np.arange(20)
    rows = np.column_stack([t, np.sin(9 * t), np.cos(9 * t)])
    np.savetxt(path, rows, "%.6f", ",", header="stamp,t,y", comments="")
    log = read_recording(path, ["t", "y"], "stamp")
    np.testing.assert_allclose([log.t, log["t"], log["y"]], rows.T, atol=1e-5)
    path.write_text(path.read_text().replace("stamp,t,y", "stamp,torque,y"))
    refused(r"column t: missing; expected .*torque", read_recording, path, ["t", "y"], "stamp")
