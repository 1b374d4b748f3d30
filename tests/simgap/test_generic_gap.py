"""The generic diagnosis: features, planted effects, alike ensembles; `hmmseg diagnose --against`."""

import json
import re
from itertools import pairwise

import numpy as np
import pandas as pd
import pytest
from refusals import refused

from experiments.generic_ensembles import PLANTED, TASK, Scatter, ensemble
from experiments.generic_ensembles import made as case_of
from hmmseg.errors import InputError
from hmmseg.example import example_folder
from hmmseg.io.task import SequenceTask
from hmmseg.io.trial import Trial
from hmmseg_cli.main import main
from simgap.generic.diagnose import diagnose, gap_of, whitening
from simgap.generic.effects import predicted, scene
from simgap.generic.ring import Ring, find_ring, fit_ring
from simgap.generic.trials import FAST, SLOW, _sub_bands, align, bin_edges, both, layout, means, transformed


def made(seed=1, effects=None, count=6):
    rng = np.random.default_rng(seed)
    real, first = ensemble(rng, count, effects)
    sim, second = ensemble(rng, count, None, name="sim")
    return real, sim, first | second


def cut(*given, **more):
    real, sim, boundaries = made(*given, **more)
    return align(real, sim, TASK, boundaries=boundaries)


@pytest.fixture(scope="module")
def alike():
    return layout(cut())


def test_features_have_known_values_and_each_belongs_to_one_channel_or_is_a_duration(alike):
    t, values = np.array([0.0, 1.0, 3.0]), np.array([0.0, 2.0, 0.0])
    found = means(t, values, np.array([0.0, 0.5, 2.0, 3.0]))
    np.testing.assert_allclose(found, [0.5, (0.75 + 1.5) / 1.5, 0.5])
    power = (transformed(0.3 * np.random.default_rng(0).standard_normal((4000, 50))) ** 2).mean(0)
    np.testing.assert_allclose(power[2:], 0.09, rtol=0.12)
    assert power[:2] == pytest.approx(0.0, abs=2e-2)  # the straight line is out
    found = np.concatenate([alike.of_channel(c) for c in (0, 1, -1)])
    assert sorted(found) == list(range(alike.kind.size)) and np.isfinite(np.concatenate(both(alike))).all()


def test_parts_follow_their_event_and_whitened_rows_have_the_squares_that_are_stated(alike):
    edges, first = np.array([0.0, 1.0, 3.0, 5.0]), int(alike.bins[0])
    short, long = (bin_edges(alike, edges + np.array([0, 0, d, d])) for d in (0.0, 1.0))
    assert short.size == alike.bins.sum() + 1 and (np.diff(short) > 0).all()
    assert short[np.cumsum([0, *alike.bins])] == pytest.approx(edges)
    assert short[first + 6] == long[first + 6] == pytest.approx(1.0 + alike.event[1])
    assert alike.event[0] == 0 and alike.event[1] > 0.2
    squares, stated = [], []
    for seed in range(8):
        lay = layout(cut(seed))
        features = both(lay)
        gap = gap_of(lay, whitening(scene(lay), *features), *features, ())
        squares.append([(gap.residual**2)[gap.rows.channel == c].sum() for c in range(5)])
        stated.append([gap.mean_square[gap.rows.channel == c].sum() for c in range(5)])
    np.testing.assert_allclose(np.sum(squares, 0) / np.sum(stated, 0), 1.0, atol=0.3)


@pytest.mark.parametrize("window", [9, 10, 14, 30, 61, 200, 1999])
def test_sub_bands_cover_the_spectrum_without_gaps(window):
    found = _sub_bands(6, window)
    assert found[0].start == 6 and found[-1].stop == window
    assert all(a.stop == b.start for a, b in pairwise(found)) and min(s.stop - s.start for s in found) >= 3
    assert _sub_bands(6, 8) == ()


@pytest.mark.parametrize(("name", "shift"), [("bias", 0.3), ("gain", 0.2), ("rate", 0.1)])
def test_predicted_shifts_are_those_of_changed_simulated_trials(name, shift):
    real, sim, boundaries = made(count=4)

    def changed(trial: Trial) -> Trial:
        x = trial.channels["fa"]
        new = {"bias": x + shift, "gain": (1 + shift) * x, "rate": x + shift * trial.t}[name]
        return Trial(trial.file, trial.t, trial.channels | {"fa": new})

    plain = layout(align(real, sim, TASK, boundaries=boundaries))
    other = layout(align(real, [changed(t) for t in sim], TASK, boundaries=boundaries))
    given, effect = scene(plain), {"rate": "force_drift"}.get(name, f"force_{name}")
    guess = predicted(given, 0, {effect: {name: shift}}) - predicted(given, 0, {})
    slow = plain.of_channel(0)[: plain.bins.sum()]
    truth = (both(other)[1] - both(plain)[1]).mean(0)[slow]
    tolerance = 0.02 if name == "rate" else 0.03  # trials differ in pace; the prediction is of their mean
    np.testing.assert_allclose(guess[: slow.size], truth, atol=tolerance)


def test_lags_and_filters_reach_the_spectrum_but_not_the_noise_that_comes_after_them(alike):
    given = scene(alike)
    fast = slice(int((alike.kind[alike.channel == 0] == SLOW).sum()), None)
    plain = predicted(given, 0, {})[fast]
    assert (predicted(given, 0, {"force_lowpass": {"time_constant": 0.1}})[fast] - plain).min() < -2
    loud = predicted(given, 0, {"noise_level": {"sd": 0.2}})[fast].reshape(3, 8)[:, 4:]  # above contacts'
    np.testing.assert_allclose(loud, np.log(0.04 + 0.0004), atol=0.1)
    assert np.abs(predicted(given, 0, {"force_lag": {"delay": 0.08}})[fast] - plain).max() > 0.2
    plain = predicted(given, 0, {})[fast].reshape(3, 8)[:, -1]  # nothing but noise in the highest band
    # Were it read through them, too, its log power would be off by 0.8 and by -7.
    for effect in ({"force_gain": {"gain": 0.5}}, {"force_lowpass": {"time_constant": 0.05}}):
        np.testing.assert_allclose(predicted(given, 0, effect)[fast].reshape(3, 8)[:, -1], plain, atol=0.2)


def test_rings_begin_at_their_event_and_are_recovered_with_their_interval():
    rng, t, rings = np.random.default_rng(3), np.arange(400) / 200, []
    for _ in range(7):
        phase, size = rng.uniform(0, 6), rng.uniform(0.5, 1.0)
        wave = size * np.exp(-0.06 * 2 * np.pi * 7.4 * t) * np.sin(2 * np.pi * 7.4 * t + phase)
        rings.append(wave + 0.3 * t - 0.1 * t**2 + 0.02 * rng.standard_normal(t.size))
    found = fit_ring(np.array(rings), 200.0)
    assert found.frequency_90[0] < 7.4 < found.frequency_90[1]
    assert found.damping_90[0] < 0.06 < found.damping_90[1]
    assert found.frequency_90[1] - found.frequency_90[0] < 0.1
    assert fit_ring(np.tile(np.exp(-3 * t), (4, 1)), 200.0) is None  # a course is no ring
    waves = Ring(5.0, 0.1, 0.0, 0.0, (0.0, 0.0), (0.0, 0.0)).waves(np.array([-0.1, 0.0, 0.05]))
    np.testing.assert_allclose(waves[:, 0], 0.0)
    np.testing.assert_allclose(waves[:, 1], [0.0, 1.0])
    assert waves[0, 2] == pytest.approx(np.exp(-0.1 * 2 * np.pi * 5 * 0.05))


def test_a_contact_that_changes_as_it_rings_adds_no_damping():
    ringing = {"structural_vibration": PLANTED["structural_vibration"]}
    found = [find_ring(layout(cut(seed, ringing))).damping for seed in range(8)]
    assert abs(np.log(np.divide(found, 0.05)).mean()) < 0.04  # 0.07 if searched from the largest swing on


def test_effects_can_be_forced_and_alike_ensembles_are_called_alike():
    assert sum(diagnose(cut(seed)).body["verdict"] != "none" for seed in range(8)) <= 1
    few = cut(2, count=4)
    assert diagnose(few, forced=["force_bias"]).body["causes"] == ["force_bias"]
    refused("needs the virtual model or is unknown", diagnose, few, forced=["grip_slip"])


@pytest.mark.parametrize("name", list(PLANTED))
def test_a_planted_effect_is_named_with_its_parameters(name):
    body = diagnose(cut(5, {name: PLANTED[name]})).body
    assert body["verdict"] in ("named", "set") and name in {*body["causes"], *body["indistinguishable"]}
    assert sum(body["probabilities"].values()) == pytest.approx(1.0)
    best = body["effects"]["+".join(body["causes"])]["parameters"]
    prefix = f"{name}." if len(body["causes"]) > 1 else ""
    key, true = {
        "timing": ("press", 1.3), "structural_vibration": ("frequency", 7.5),
    }.get(name, ("fa", PLANTED[name].get("value")))  # fmt: skip
    if name in body["causes"]:
        p = best[prefix + key]
        low, high = p["interval_90"]
        wide = 2 * (high - low)
        assert low - wide < true < high + wide and p["mean"] == pytest.approx(true, rel=0.25)
    assert body["shrinkage"]["fraction"] > 0.5
    assert {row["channel"] for row in body["where"]} <= {"fa", "fb", "duration"}
    assert sum(row["share"] for row in body["where"]) == pytest.approx(1.0)


@pytest.mark.parametrize("pair", [("force_gain", "force_lag"), ("force_bias", "force_gain")])
def test_two_planted_effects_are_both_named(pair):
    ensembles = case_of(101, {name: PLANTED[name] for name in pair}, False)
    assert diagnose(ensembles).body["causes"] == list(pair)


def test_one_trial_is_weaker_and_trials_that_do_not_go_together_are_refused():
    real, sim, boundaries = made(4, {"force_bias": {"value": 1.0}})
    found = diagnose(align(real[:1], sim, TASK, boundaries=boundaries))
    assert any("nothing is held out" in w for w in found.warnings) and "force_bias" in found.leading
    real, sim, boundaries = made(4)
    refused("one real and one simulated", align, real[:1], sim[:1], TASK, boundaries=boundaries)
    one = boundaries | {real[0].file: np.array([1.0])}
    refused("2 increasing times", align, real, sim, TASK, boundaries=one)
    refused("column fc: missing", align, real, sim, SequenceTask(TASK.sequence, ("fa", "fc")))


def test_missing_samples_are_bridged_and_rates_may_differ(alike):
    real, sim, boundaries = made()
    holed = real[0].channels["fa"].copy()
    holed[50:60] = np.nan
    real[0] = Trial(real[0].file, real[0].t, real[0].channels | {"fa": holed})
    found = both(layout(align(real, sim, TASK, boundaries=boundaries)))[0]
    assert np.isfinite(found).all()
    changed = ~np.isclose(found[0], both(alike)[0][0])
    assert 0 < changed.sum() < found.shape[1] / 3
    rng = np.random.default_rng(6)
    real, first = ensemble(rng, 5)
    sim, second = ensemble(rng, 5, None, Scatter(rate=1000.0, noise=0.02 * np.sqrt(10)), "sim")
    lay = layout(align(real, sim, TASK, boundaries=first | second))
    assert lay.rate == pytest.approx(100, rel=1e-3)
    found, top = both(lay), lay.kind == FAST
    assert np.abs(found[0].mean(0) - found[1].mean(0))[top].mean() < 0.6  # averaged, not picked


@pytest.mark.slow
def test_the_hmm_finds_the_subtasks_by_itself():
    real, sim, boundaries = made(7, {"force_bias": {"value": 1.0}})
    given = align(real, sim, TASK)
    # Without labels a boundary may settle anywhere in the course, but in all trials of both kinds alike.
    late = [cut.edges[1] - boundaries[cut.trial.file][0] for cut in (*given.real, *given.sim)]
    assert np.std(late) < 0.1 and "force_bias" in diagnose(given).body["causes"]


@pytest.fixture
def folder(tmp_path):
    """A plain ordered task with real trials that carry a large bias, and simulated ones."""
    rng = np.random.default_rng(7)
    for name, effects in (("real", {"force_bias": {"value": 1.0}}), ("sim", None)):
        trials, _ = ensemble(rng, 5, effects, name=name)
        for trial in trials:
            pd.DataFrame({"t": trial.t, **trial.channels}).to_csv(tmp_path / trial.file, index=False)
    (tmp_path / "task.toml").write_text('sequence = ["approach", "press", "hold"]\n')
    return tmp_path


def arguments(folder, *more, count=5):
    trials = {kind: [str(folder / f"{kind}_{k:02d}.csv") for k in range(count)] for kind in ("real", "sim")}
    task = ["--task", str(folder / "task.toml")]
    return ["diagnose", *trials["real"], *task, "--against", *trials["sim"], *more]


def test_values_of_against_reach_up_to_the_next_option(folder, monkeypatch):
    taken = {}

    def against(out, paths, sims, *rest):
        taken["real"], taken["sim"] = [p.name for p in paths], [p.name for p in sims]

    monkeypatch.setattr("hmmseg_cli.diagnose._against", against)
    given = arguments(folder, "--seed", "1")
    assert main(given) == 0
    once, again = taken | {}, [a for n in given[given.index("--against") + 1 : -2] for a in ("--against", n)]
    assert main([*given[: given.index("--against")], *again]) == 0
    assert once == taken and len(once["sim"]) == len(once["real"]) == 5


@pytest.fixture
def read(monkeypatch):
    """The trials that a command has read, which then stops."""
    trials = []

    def stop(real, simulated, *_):
        trials.extend([*real, *simulated])
        raise InputError("test", "has seen enough")

    for name in ("align", "align_block_trials"):
        monkeypatch.setattr(f"simgap.generic.trials.{name}", stop)
    return trials


def test_columns_of_a_plain_task_are_those_that_the_rig_maps(folder, read):
    expected = pd.read_csv(folder / "sim_04.csv")
    for path in [*folder.glob("real_*.csv"), *folder.glob("sim_*.csv")]:
        pd.read_csv(path).rename(columns={"t": "stamp"}).to_csv(path, index=False)
    (folder / "columns.toml").write_text('[columns]\nt = {from = "stamp"}\n')
    assert main(arguments(folder, "--rig", str(folder / "columns.toml"))) == 2
    assert len(read) == 10 and all(sorted(trial.channels) == ["fa", "fb"] for trial in read)
    np.testing.assert_allclose(read[-1].t, expected.t, atol=1e-9)
    np.testing.assert_allclose(read[-1].channels["fa"], expected.fa)


def test_plain_tasks_need_simulated_trials_and_settled_boundaries(folder, tmp_path, capsys):
    (folder / "task.toml").write_text('sequence = ["approach", "press"]\n')  # one of two changes
    out = tmp_path / "out.json"
    assert main(arguments(folder, "--json", str(out), "--quiet")) == 0
    document = json.loads(out.read_text())
    assert document["causes"] == ["force_bias"]
    assert any("as well be elsewhere" in line for line in document["warnings"])
    args = arguments(folder)
    assert main(args[: args.index("--against")]) == 2
    line = capsys.readouterr().err
    assert "--against SIM" in line and line.count("\n") == 1


@pytest.mark.parametrize(("more", "line"), [
    (["--actual", "actual.toml"], "does not go with --against"),
    (["--healthy", "sim_04.csv"], "does not go with --against"),
    (["--effect", "grip_slip"], "needs the virtual model"),
    (["--against", "real_00.csv"], "the same trial as")])  # fmt: skip
def test_what_does_not_go_with_given_trials_is_refused(folder, capsys, monkeypatch, more, line):
    monkeypatch.chdir(folder)
    (folder / "actual.toml").write_text("")
    assert main(arguments(folder, *more)) == 2 and line in capsys.readouterr().err


def test_trials_as_simulate_writes_them_go_with_recordings_of_other_columns(tmp_path, read):
    example = example_folder()
    clock = '\n[columns]\nt = {from = "stamp", unit = "ms"}\n'
    (tmp_path / "rig.toml").write_text((example / "rig.toml").read_text() + clock)
    table = pd.read_csv(example / "trial_01.csv").rename(columns={"t": "stamp"})
    table.assign(stamp=1000 * table.stamp).to_csv(tmp_path / "real.csv", index=False)
    args = ["--task", str(example / "task.toml"), "--rig", str(tmp_path / "rig.toml"), "--against"]
    assert main(["diagnose", str(tmp_path / "real.csv"), *args, str(example / "trial_01.csv")]) == 2
    real, simulated = read
    np.testing.assert_allclose(real.t, simulated.t, atol=1e-9)


@pytest.mark.slow
def test_a_bias_is_named_with_figures_and_page(folder):
    outputs = ["--json", f"{folder}/d.json", "--figures", f"{folder}/f", "--report", f"{folder}/p.html"]
    assert main(arguments(folder, *outputs, "--quiet")) == 0
    document = json.loads((folder / "d.json").read_text())
    assert document["format"] == "hmmseg.diagnose/1"
    assert (document["verdict"], document["causes"]) == ("named", ["force_bias"])
    assert document["effects"]["force_bias"]["parameters"]["fa"]["mean"] == pytest.approx(1.0, abs=0.1)
    assert document["effects"]["force_bias"]["parameters"]["fa"]["unit"] == "unit of fa"
    assert {row["channel"] for row in document["where"]} == {"fa"} and document["shrinkage"]["fraction"] > 0.9
    assert all((folder / "f" / f"gap_{n}.png").stat().st_size > 5000
               for n in ("where", "signal", "before_after"))  # fmt: skip
    page = (folder / "p.html").read_text()
    assert 'id="verdict"' in page and "force_bias" in page and not re.search(r"(src|href)=\"(?!data:)", page)
