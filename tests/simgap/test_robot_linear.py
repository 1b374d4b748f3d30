"""Windows, sensitivities, noise and phases of robots' logs against closed forms and planted values."""

import itertools

import numpy as np
import pytest
from simgap_swing import Swing, log

from hmmseg.errors import InputError
from hmmseg.io.task import SequenceTask, parse_task
from simgap.channels import delayed, lowpass
from simgap.robot_effects import candidates
from simgap.robot_effects.base import Setting
from simgap.robots.linear import base_at, linearise, vary
from simgap.robots.model import Composed
from simgap.robots.rows import estimate_noise, noises, phases_by_task, resolution, rows_of
from simgap.robots.sets import identifiability
from simgap.robots.whiten import NONE, covariances
from simgap.robots.windows import REACH, smoothed
from simgap.simulators.protocol import Parameter
from simgap.simulators.recording import Recording
from simgap.simulators.user import checked


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


def test_no_discrepancy_is_learned_from_a_true_model_and_one_from_a_false_one():
    model = composed([log(s) for s in range(3)])
    linear = linearise(model, {}, [])
    cov = covariances(model, linear)
    assert cov.estimate(linear.residual) == NONE
    off = composed([log(s, viscous=0.01) for s in range(3)])
    linear = linearise(off, {}, [])
    cov = covariances(off, linear)
    found = cov.estimate(linear.residual)
    assert set(found) >= {"angle"} and found["angle"] > 0.1
    white = cov.whitener(found)(linear.residual)
    assert 0.4 < np.mean(white**2) < 1.6 < np.mean(cov.whitener()(linear.residual) ** 2)


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


@pytest.mark.parametrize("course", [lambda t: 0 * t, lambda t: -4.9 * t**2, lambda t: np.sin(3 * t)])
def test_motion_is_no_noise(course):
    """A fall's second difference at 150 Hz is 0.4 mm, twenty times this noise."""
    t, rng = np.arange(3000) / 150, np.random.default_rng(0)
    log = Recording("log.csv", t, {"z": course(t) + 2e-5 * rng.standard_normal(t.size)})
    assert estimate_noise([log], "z") == pytest.approx(2e-5, rel=0.1)


@pytest.mark.parametrize("noise", [0.6, 0.75, 0.9, 1.2])
def test_noise_of_a_step_of_the_encoder_is_estimated(noise):
    """Of readings in steps a median of differences is a whole number of steps: 25 % too little."""
    t, rng = np.arange(6000) / 500, np.random.default_rng(0)
    read = 1e-4 * np.round(1e4 * np.sin(3 * t) + noise * rng.standard_normal(t.size))
    wanted, log = 1e-4 * np.sqrt(noise**2 + 1 / 12), Recording("log.csv", t, {"z": read})
    assert estimate_noise([log], "z", 1e-4) == pytest.approx(wanted, rel=0.06)


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
    with pytest.raises(InputError, match="task of blocks"):
        phases_by_task(logs, blocks)
    with pytest.raises(InputError, match="no column force; expected torque, angle"):
        phases_by_task(logs, SequenceTask(("a", "b"), channels=("force",)))


def test_a_model_that_explodes_at_a_candidate_is_said_and_the_others_go_on():
    class Explosive(Swing):
        parameters = Swing.parameters | {"charge": Parameter(0.0, 1.0)}

        def simulate(self, parameters, recording, start=None):
            found = super().simulate(parameters, recording, start)
            return found if parameters["charge"] == 0 else {n: v * np.inf for n, v in found.items()}

    linear = linearise(composed([log(0, seconds=2.0)], Explosive), {}, ["charge", "viscous"])
    assert linear.diverged == ("charge",) and set(linear.moved) == {"viscous"}
