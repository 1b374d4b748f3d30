"""Plain ordered tasks on recordings with planted boundaries."""

import dataclasses
import json
from functools import cache

import numpy as np
import pytest

from hmmseg.errors import InputError
from hmmseg.io.task import SequenceTask
from hmmseg.io.trial import Trial
from hmmseg.sequence.fit import fit_sequence, read_labels
from hmmseg.sequence.model import load_model, save_model
from hmmseg.sequence.segment import segment_sequence

TASK = SequenceTask(("wait", "push", "turn", "pull"))
LEVELS = {"wait": (0.0, 0.0), "push": (4.0, 0.5), "turn": (4.0, 3.0), "pull": (-2.0, 1.0)}


def record(seed, sequence=("wait", "push", "turn", "pull"), rate=50.0, correlation=0.0, lag=0.0, mean=1.5):
    """A trial of noisy levels and its boundaries; what the channels show comes `lag` s after them."""
    rng = np.random.default_rng(seed)
    durations = mean * rng.uniform(0.6, 1.4, len(sequence))
    boundaries = np.cumsum(durations)[:-1]
    t = np.arange(0, durations.sum(), 1 / rate)
    path = np.searchsorted(boundaries + lag, t, side="right")
    noise = rng.standard_t(4, (t.size, 2)) * 0.3
    for i in range(1, t.size):
        noise[i] = correlation * noise[i - 1] + np.sqrt(1 - correlation**2) * noise[i]
    values = np.array([LEVELS[sequence[k]] for k in path]) + noise
    trial = Trial(f"trial_{seed}.csv", t, {"a": values[:, 0], "b": values[:, 1]})
    return trial, boundaries


@cache
def recordings(count, start=0, lag=0.0):
    return [record(start + i, lag=lag) for i in range(count)]


def found(result):
    return np.array([span.start for span in result.spans[1:]])


@cache
def taught(lag=0.0):
    data = recordings(4, lag=lag)
    return fit_sequence([t for t, _ in data], TASK, {t.name: b.tolist() for t, b in data})


def test_planted_boundaries_are_recovered_without_labels():
    data = recordings(4)
    for result, (trial, boundaries) in zip(segment_sequence([t for t, _ in data], TASK), data, strict=True):
        assert result.complete, result.failed
        assert [span.subtask for span in result.spans] == list(TASK.sequence)
        np.testing.assert_allclose(found(result), boundaries, atol=0.08)
        assert result.spans[0].start == trial.t[0] and result.spans[-1].end == trial.t[-1]
        for one, two in zip(result.spans, result.spans[1:], strict=False):
            assert one.end == two.start and one.end_90[0] <= one.end <= one.end_90[1]


def test_labels_teach_their_lag():
    # The channels change 0.2 s after the labels: only a labelled model can know.
    data = recordings(3, start=40, lag=0.2)
    lagged = taught(lag=0.2)
    for result, (_, boundaries) in zip(segment_sequence([t for t, _ in data], TASK, lagged), data,
                                       strict=True):  # fmt: skip
        np.testing.assert_allclose(found(result), boundaries, atol=0.06)


def test_the_start_of_a_trial_does_not_matter():
    trial, boundaries = record(60)
    keep = trial.t >= 0.7
    late = Trial("late.csv", trial.t[keep] + 100, {n: x[keep] for n, x in trial.channels.items()})
    whole, cropped = segment_sequence([trial], TASK, taught())[0], segment_sequence([late], TASK, taught())[0]
    np.testing.assert_allclose(found(cropped) - 100, found(whole), atol=0.02)
    np.testing.assert_allclose(found(whole), boundaries, atol=0.06)


def test_gaps_other_rates_and_missing_samples():
    trial, boundaries = record(61, rate=170.0)
    rng = np.random.default_rng(0)
    keep = np.sort(rng.choice(trial.t.size, trial.t.size * 2 // 3, replace=False))
    channels = {n: x[keep].copy() for n, x in trial.channels.items()}
    channels["a"][rng.random(keep.size) < 0.3] = np.nan
    channels["b"][100:130] = np.nan
    result = segment_sequence([Trial("gaps.csv", trial.t[keep], channels)], TASK, taught())[0]
    assert result.complete, result.failed
    np.testing.assert_allclose(found(result), boundaries, atol=0.08)


@pytest.mark.slow
@pytest.mark.parametrize("correlation", [0.0, 0.9])
def test_intervals_cover_planted_boundaries(correlation):
    hits = []
    for group in range(6):
        data = [record(1000 + 10 * group + i, correlation=correlation) for i in range(5)]
        for result, (_, boundaries) in zip(segment_sequence([t for t, _ in data], TASK), data, strict=True):
            hits += [low <= b <= high for (low, high), b in zip([s.start_90 for s in result.spans[1:]],
                                                                boundaries, strict=True)]  # fmt: skip
    assert np.mean(hits) >= 0.85, np.mean(hits)


def test_correlated_noise_widens_intervals():
    widths = []
    for correlation in (0.0, 0.95):
        data = [record(300 + i, correlation=correlation) for i in range(3)]
        model = fit_sequence([t for t, _ in data], TASK, {t.name: b for t, b in data})
        widths.append(model.emissions.temper)
    assert widths[1] < widths[0] / 2


def test_optional_subtasks_may_be_absent():
    task = SequenceTask(TASK.sequence, optional=("turn",))
    kinds = [TASK.sequence, ("wait", "push", "pull"), TASK.sequence, TASK.sequence]
    data = [record(80 + i, sequence=kind) for i, kind in enumerate(kinds)]
    labels = {}
    for (trial, boundaries), kind in zip(data, kinds, strict=True):
        b = boundaries.tolist()
        labels[trial.name] = b if len(kind) == 4 else [b[0], b[1], b[1]]
    model = fit_sequence([t for t, _ in data], task, labels)
    tests = [record(90, sequence=kinds[1]), record(91)]
    without, with_it = segment_sequence([t for t, _ in tests], task, model)
    assert [span.subtask for span in without.spans] == ["wait", "push", "pull"] and without.complete
    np.testing.assert_allclose(found(without), tests[0][1], atol=0.06)
    assert [span.subtask for span in with_it.spans] == list(TASK.sequence)
    np.testing.assert_allclose(found(with_it), tests[1][1], atol=0.06)


def test_a_state_that_comes_twice_is_one():
    task = SequenceTask(("wait", "push", "wait", "pull"))
    data = [record(120 + i, sequence=task.sequence) for i in range(3)]
    model = fit_sequence([t for t, _ in data], task)
    np.testing.assert_array_equal(model.emissions.loc[0], model.emissions.loc[2])
    for result, (_, boundaries) in zip(segment_sequence([t for t, _ in data], task, model), data,
                                       strict=True):  # fmt: skip
        np.testing.assert_allclose(found(result), boundaries, atol=0.06)


@pytest.mark.parametrize(("sequence", "index"), [
    (("wait", "push", "pull"), 2),
    (("wait", "push", "turn"), 3),
    (("wait", "push", "wait", "push", "turn", "pull"), 1),
])  # fmt: skip
def test_a_trial_that_leaves_its_task_says_where(sequence, index):
    result = segment_sequence([record(70, sequence=sequence)[0]], TASK, taught())[0]
    assert not result.complete
    assert (result.failed.index, result.failed.subtask) == (index, TASK.sequence[index])
    assert len(result.spans) == 4  # the rest is kept


def test_trials_that_fit_are_not_called_failures():
    data = recordings(8, start=200)
    assert all(r.complete for r in segment_sequence([t for t, _ in data], TASK, taught()))


def test_saved_models_segment_alike(tmp_path):
    trial, _ = record(62)
    save_model(taught(), tmp_path / "m.npz")
    loaded = load_model(tmp_path / "m.npz", TASK)
    assert segment_sequence([trial], TASK, loaded) == segment_sequence([trial], TASK, taught())


@pytest.mark.parametrize(("changes", "message"), [
    ({"format": "hmmseg.sequence-model/9"}, r"has format 'hmmseg.sequence-model/9'; expected"),
    ({"loc": None}, "lacks loc; expected a complete model"),
    ({"typical": np.ones(3)}, r"typical has shape \(3,\); expected finite numbers of shape \(4,\)"),
    ({"scale": np.full(4, np.nan)}, r"scale is not finite; expected finite numbers of shape \(4,\)"),
    ({"temper": np.nan}, r"temper is not finite; expected finite numbers of shape \(\)"),
    ({"step": np.inf}, "step is not finite"),
    ({"detectors.weight": np.nan}, r"detectors\.weight is not finite"),
    ({"sequence": np.array(["a", "b", "c", "d"])}, r"was learned for sequence \['a', 'b', 'c', 'd'\]"),
    ({"detectors.mean": np.zeros((1, 1, 1))}, "detectors"),
])  # fmt: skip
def test_bad_model_files_are_refused(tmp_path, changes, message):
    path = tmp_path / "m.npz"
    save_model(taught(), path)
    with np.load(path) as file:
        table = dict(file) | changes
    np.savez(path, **{k: v for k, v in table.items() if v is not None})
    with pytest.raises(InputError, match=message):
        load_model(path, TASK)


def test_files_that_are_no_models_are_refused(tmp_path):
    with pytest.raises(InputError, match="no such file"):
        load_model(tmp_path / "absent.npz", TASK)
    (tmp_path / "text.npz").write_text("hello")
    with pytest.raises(InputError, match="cannot be read"):
        load_model(tmp_path / "text.npz", TASK)
    save_model(taught(), tmp_path / "m.npz")
    with pytest.raises(InputError, match=r"was learned from channels \['a', 'b'\]"):
        load_model(tmp_path / "m.npz", dataclasses.replace(TASK, channels=("a", "c")))


@pytest.mark.parametrize(("labels", "message"), [
    ({"trial_0": [1.0]}, "has 1 boundaries; expected 3 for 4 subtasks"),
    ({"trial_0": [1.0, 0.5, 2.0]}, r"boundary 2 \(0.5\) does not come after boundary 1 \(1\)"),
    ({"trial_0": [1.0, 2.0, 2.0]}, "does not come after"),
    ({"trial_0": [1.0, 2.0, 99.0]}, "times between 0 and"),
    ({"trial_0": [1.0, np.nan, 2.0]}, "a boundary that is no number"),
    ({"trial_0": ["x", 1, 2]}, "a list of times in s"),
    ({"other": [1.0, 2.0, 3.0]}, "none is for these trials"),
    ({"trial_0": [None, None, None]}, "has no boundary"),
    ({"trial_0": {"lift": 2.0}}, "gives the start of 'lift', which has none in this task"),
    ({"trial_0": {"wait": 2.0}}, "gives the start of 'wait'"),
    ({"trial_0": {"pull": 99.0}}, "times between 0 and"),
])  # fmt: skip
def test_bad_labels_are_refused(labels, message):
    with pytest.raises(InputError, match=message):
        fit_sequence([record(0)[0]], TASK, labels)


def test_labels_in_order_or_from_files_are_those_by_name(tmp_path):
    data = recordings(4)
    trials, truth = [t for t, _ in data], [b.tolist() for _, b in data]
    expected = read_labels(trials, TASK, {"trial_0": truth[0], "trial_2.csv": truth[2]})
    in_order = [truth[0], None, truth[2], None]
    starts = {n: dict(zip(TASK.sequence[1:], truth[n], strict=True)) for n in (0, 2)}
    rows = [(f"trial_{n}", name, at) for n, mine in starts.items() for name, at in mine.items()]
    lines = [("trial", "subtask", "start"), *[(a, b, repr(c)) for a, b, c in rows]]
    for name, text in {"comma.csv": "\ufeff# ours\n" + "".join(",".join(line) + "\n" for line in lines),
                       "semicolon.csv": "".join(";".join(line).replace(".", ",") + "\n" for line in lines),
                       "tab.tsv": "".join("\t".join(line) + "\n" for line in lines)}.items():  # fmt: skip
        (tmp_path / name).write_text(text, encoding="utf-8")
        np.testing.assert_array_equal(read_labels(trials, TASK, tmp_path / name), expected)
    for n in (0, 2):
        (tmp_path / f"trial_{n}.json").write_text(json.dumps({"boundaries": truth[n]}))
    np.testing.assert_array_equal(read_labels(trials, TASK, str(tmp_path)), expected)
    np.testing.assert_array_equal(read_labels(trials, TASK, in_order), expected)
    whole = {"trial_0": {"wait": 0.0} | starts[0]}
    np.testing.assert_array_equal(read_labels(trials, TASK, whole)[0], expected[0])
    np.testing.assert_array_equal(read_labels(trials, TASK, np.array(truth)), truth)
    with pytest.raises(InputError, match="are 1 for 4 trials; expected one entry for each"):
        read_labels(trials, TASK, truth[:1])


def test_bad_trials_are_refused():
    trial, _ = record(0)
    with pytest.raises(InputError, match="at least one trial"):
        fit_sequence([], TASK)
    with pytest.raises(InputError, match="has no channel c"):
        fit_sequence([trial], dataclasses.replace(TASK, channels=("a", "c")))
    with pytest.raises(InputError, match="has no channel a"):
        segment_sequence([Trial("x.csv", trial.t, {"b": trial.channels["b"]})], TASK, taught())
    with pytest.raises(InputError, match="was learned for"):
        segment_sequence([trial], SequenceTask(("one", "two")), taught())
    short = Trial("s.csv", trial.t[:7], {n: x[:7] for n, x in trial.channels.items()})
    with pytest.raises(InputError, match="at least two for each of 4 subtasks"):
        fit_sequence([short], TASK)
