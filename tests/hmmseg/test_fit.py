"""Plain ordered tasks: planted boundaries, all ways to read what no label decides, the estimator."""

import itertools
import json
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from refusals import refused

from hmmseg import segment
from hmmseg.io.task import SequenceTask
from hmmseg.io.trial import Trial
from hmmseg.segmentation.spans import most_telling
from hmmseg.sequence import courses as courses_of
from hmmseg.sequence.courses import WEIGHING, naming, partition, seen
from hmmseg.sequence.emissions import StudentEmissions, from_weights, independent_share
from hmmseg.sequence.features import cell_means, drop_repeats, edge_preserving_slopes, feature_map, features
from hmmseg.sequence.fit import fit_sequence, read_labels
from hmmseg.sequence.model import NamedCourse, load_model, save_model
from hmmseg.sequence.segment import _shortest, mix, places, segment_sequence

TASK = SequenceTask(("wait", "push", "turn", "pull"))
LEVELS = {"wait": (0.0, 0.0), "push": (4.0, 0.5), "turn": (4.0, 3.0), "pull": (-2.0, 1.0)}


def record(seed, sequence=("wait", "push", "turn", "pull"), rate=50.0, correlation=0.0, lag=0.0, mean=1.5):
    """A trial of noisy levels and its boundaries; what the channels show comes `lag` s after them."""
    rng = np.random.default_rng(seed)
    durations = mean * rng.uniform(0.6, 1.4, len(sequence))
    boundaries, t = np.cumsum(durations)[:-1], np.arange(0, durations.sum(), 1 / rate)
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


def test_planted_boundaries_are_recovered_without_labels_and_states_that_come_twice_are_one():
    data = recordings(4)
    for result, (trial, boundaries) in zip(segment_sequence([t for t, _ in data], TASK), data, strict=True):
        assert result.complete, result.failed
        assert [span.subtask for span in result.spans] == list(TASK.sequence)
        np.testing.assert_allclose(found(result), boundaries, atol=0.08)
        assert result.spans[0].start == trial.t[0] and result.spans[-1].end == trial.t[-1]
        for one, two in zip(result.spans, result.spans[1:], strict=False):
            assert one.end == two.start and one.end_90[0] <= one.end <= one.end_90[1]
    task = SequenceTask(("wait", "push", "wait", "pull"))
    data = [record(120 + i, sequence=task.sequence) for i in range(3)]
    model = fit_sequence([t for t, _ in data], task)
    np.testing.assert_array_equal(model.emissions.loc[0], model.emissions.loc[2])
    for result, (_, boundaries) in zip(segment_sequence([t for t, _ in data], task, model), data,
                                       strict=True):  # fmt: skip
        np.testing.assert_allclose(found(result), boundaries, atol=0.06)


def test_labels_teach_their_lag_and_correlated_noise_widens_intervals():
    # The channels change 0.2 s after the labels: only a labelled model can know.
    data, lagged = recordings(3, start=40, lag=0.2), taught(lag=0.2)
    for result, (_, boundaries) in zip(segment_sequence([t for t, _ in data], TASK, lagged), data,
                                       strict=True):  # fmt: skip
        np.testing.assert_allclose(found(result), boundaries, atol=0.06)
    widths = []
    for correlation in (0.0, 0.95):
        data = [record(300 + i, correlation=correlation) for i in range(3)]
        model = fit_sequence([t for t, _ in data], TASK, {t.name: b for t, b in data})
        widths.append(model.emissions.temper)
    assert widths[1] < widths[0] / 2


def test_the_start_of_a_trial_gaps_other_rates_and_missing_samples_do_not_matter():
    trial, boundaries = record(60)
    keep = trial.t >= 0.7
    late = Trial("late.csv", trial.t[keep] + 100, {n: x[keep] for n, x in trial.channels.items()})
    whole, cropped = segment_sequence([trial], TASK, taught())[0], segment_sequence([late], TASK, taught())[0]
    np.testing.assert_allclose(found(cropped) - 100, found(whole), atol=0.02)
    np.testing.assert_allclose(found(whole), boundaries, atol=0.06)
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


@pytest.mark.parametrize(("sequence", "index"), [
    (("wait", "push", "pull"), 2),
    (("wait", "push", "turn"), 3),
    (("wait", "push", "wait", "push", "turn", "pull"), 1)])  # fmt: skip
def test_a_trial_that_leaves_its_task_says_where(sequence, index):
    result = segment_sequence([record(70, sequence=sequence)[0]], TASK, taught())[0]
    assert not result.complete
    assert (result.failed.index, result.failed.subtask) == (index, TASK.sequence[index])
    assert len(result.spans) == 4  # the rest is kept


@pytest.mark.parametrize(("changes", "message"), [
    ({"format": "hmmseg.sequence-model/9"}, r"has format 'hmmseg.sequence-model/9'; expected"),
    ({"loc": None}, "lacks loc; expected a complete model"),
    ({"typical": np.ones(3)}, r"typical has shape \(3,\); expected finite numbers of shape \(4,\)"),
    ({"scale": np.full(4, np.nan)}, r"scale is not finite; expected finite numbers of shape \(4,\)"),
    ({"temper": np.nan}, r"temper is not finite; expected finite numbers of shape \(\)"),
    ({"step": np.inf}, "step is not finite"),
    ({"detectors.weight": np.nan}, r"detectors\.weight is not finite"),
    ({"sequence": np.array(["a", "b", "c", "d"])}, r"was learned for sequence \['a', 'b', 'c', 'd'\]"),
    ({"detectors.mean": np.zeros((1, 1, 1))}, "detectors")])  # fmt: skip
def test_bad_model_files_are_refused(tmp_path, changes, message):
    path = tmp_path / "m.npz"
    save_model(taught(), path)
    with np.load(path) as file:
        table = dict(file) | changes
    np.savez(path, **{k: v for k, v in table.items() if v is not None})
    refused(message, load_model, path, TASK)


def test_files_that_are_no_models_and_trials_that_do_not_fit_are_refused(tmp_path):
    refused("no such file", load_model, tmp_path / "absent.npz", TASK)
    (tmp_path / "text.npz").write_text("hello")
    refused("cannot be read", load_model, tmp_path / "text.npz", TASK)
    save_model(taught(), tmp_path / "m.npz")
    other, (trial, _) = replace(TASK, channels=("a", "c")), record(0)
    refused(r"was learned from channels \['a', 'b'\]", load_model, tmp_path / "m.npz", other)
    refused("at least one trial", fit_sequence, [], TASK)
    refused("has no channel c", fit_sequence, [trial], other)
    without = Trial("x.csv", trial.t, {"b": trial.channels["b"]})
    refused("has no channel a", segment_sequence, [without], TASK, taught())
    refused("was learned for", segment_sequence, [trial], SequenceTask(("one", "two")), taught())
    short = Trial("s.csv", trial.t[:7], {n: x[:7] for n, x in trial.channels.items()})
    refused("at least two for each of 4 subtasks", fit_sequence, [short], TASK)


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
    ({"trial_0": {"pull": 99.0}}, "times between 0 and")])  # fmt: skip
def test_bad_labels_are_refused(labels, message):
    refused(message, fit_sequence, [record(0)[0]], TASK, labels)


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
    refused("are 1 for 4 trials; expected one entry for each", read_labels, trials, TASK, truth[:1])


THREE = SequenceTask(("wait", "push", "pull"))


def ambiguous(count=5, events=(2.0, 4.0, 6.5), levels=(0.0, 3.0, 6.0, 9.0), noise=0.3, seed=0):
    """Trials with three like changes, of which a task of three states names two."""
    rng = np.random.default_rng(seed)
    trials, truth = [], []
    for i in range(count):
        cuts = np.array(events) * rng.uniform(0.8, 1.2, len(events))
        cuts.sort()
        t = np.arange(0, 9.0, 0.02)
        level = np.array(levels)[np.searchsorted(cuts, t, side="right")]
        values = level[:, None] + noise * rng.normal(size=(t.size, 2))
        trials.append(Trial(f"trial_{i}.csv", t, {"a": values[:, 0], "b": -values[:, 1]}))
        truth.append(cuts)
    return trials, np.array(truth)


def drawn_course(rng, stretches, trials=2):
    later = np.arange(stretches + 1)[None] > np.arange(stretches + 1)[:, None]
    cost = np.where(later, 20 * rng.random((stretches + 1, stretches + 1)), np.inf)
    ends = np.sort(rng.uniform(0.05, 0.95, (trials, stretches - 1)), axis=1)
    seen = np.log(rng.uniform(0.01, 1.0, stretches - 1))
    return courses_of.Course([np.zeros((50, stretches))] * trials, ends, cost, 0.5, seen)


def enumerated(course, states, labels):
    """Log weight of every choice: (changes that are boundaries, where something settles or None)."""
    n, w = len(course.cost) - 1, WEIGHING
    temper = w.independent * 0.5 / (w.independent + course.observations)
    edges = np.column_stack([np.zeros(len(course.ends)), course.ends, np.ones(len(course.ends))])
    found = {}
    for cuts in itertools.combinations(range(1, n), states - 1):
        for settles in [None, *range(cuts[-1] + 1, n)]:
            bounds = [0, *cuts, *([] if settles is None else [settles]), n]
            log = -temper * sum(course.cost[a, b] for a, b in itertools.pairwise(bounds))
            for a, b in itertools.pairwise([0, *cuts]):
                log += w.shares * np.log(edges[:, b] - edges[:, a]).mean()
            changes = [*cuts] if settles is None else [*cuts, settles]
            log += sum(np.log(w.unseen + (1 - w.unseen) * np.exp(course.seen[j - 1])) for j in changes)
            log += 0.0 if settles is None else w.settled
            for i, known in enumerate(labels):
                for b in np.flatnonzero(np.isfinite(known)):
                    density = np.exp(-abs(known[b] - edges[i, cuts[b]]) / w.lag) / (2 * w.lag)
                    log += np.log((1 - w.elsewhere) * density + w.elsewhere)
            found[cuts, settles] = log
    return found


@pytest.mark.parametrize("labelled", [False, True])
def test_naming_is_the_sum_over_all_choices(labelled):
    rng = np.random.default_rng(3)
    for states in (2, 3, 4):
        course = drawn_course(rng, 7)
        labels = [np.full(states - 1, np.nan), np.full(states - 1, np.nan)]
        if labelled:
            labels[1][0] = course.ends[1, 2] + 0.003
        every = enumerated(course, states, labels)
        total = np.logaddexp.reduce(list(every.values()))
        probability, settled = np.zeros((states - 1, 6)), np.zeros(6)
        for (cuts, settles), log in every.items():
            probability[range(states - 1), np.array(cuts) - 1] += np.exp(log - total)
            if settles is not None:
                settled[settles - 1] += np.exp(log - total)
        found = naming(course, states, labels)
        np.testing.assert_allclose(found.probability, probability, atol=1e-12)
        np.testing.assert_allclose(found.settled, settled, atol=1e-12)
        weight = WEIGHING.unseen + (1 - WEIGHING.unseen) * np.exp(course.seen)
        choices = sum(np.prod(weight[list(cuts)]) for cuts in itertools.combinations(range(6), states - 1))
        assert found.log_evidence == pytest.approx(total - np.log(choices))


def test_a_partition_needs_a_cell_a_stretch_and_a_level_cut_in_two_is_not_seen():
    rng, level = np.random.default_rng(5), np.repeat([0.0, 0.0, 1.5], 60)
    values = [level[:, None] + 0.3 * rng.normal(size=(180, 2)) for _ in range(3)]
    found = np.exp(seen(values, [np.repeat([0, 1, 2], 60)] * 3, 3, share=2.0))
    assert found[0] < 0.01 and found[1] > 0.999
    refused("2 cells, expected at least 3", partition, np.zeros((2, 1)), 3, 0.1, error=ValueError)


def test_the_best_choice_has_most_boundaries_right():
    rng = np.random.default_rng(4)
    courses = [drawn_course(rng, 6), drawn_course(rng, 8)]
    none = [np.full(2, np.nan)] * 2
    namings = [naming(course, 3, none) for course in courses]
    weights = courses_of.probabilities(namings)
    evidence = np.array([each.log_evidence for each in namings])
    np.testing.assert_allclose(weights, np.exp(evidence) / np.exp(evidence).sum())
    expected = {}
    for i, course in enumerate(courses):
        for cuts in itertools.combinations(range(course.ends.shape[1]), 2):
            right = 0.0
            for weight, other, its in zip(weights, courses, namings, strict=True):
                for b, j in itertools.product(range(2), range(other.ends.shape[1])):
                    near = np.median(np.abs(course.ends[:, cuts[b]] - other.ends[:, j])) < courses_of.NEAR
                    right += weight * its.probability[b, j] * near
            expected[i, cuts] = right
    choice = courses_of.best_choice(courses, namings, weights)
    assert choice.right.sum() == pytest.approx(max(expected.values()))
    assert expected[choice.course, tuple(j - 1 for j in choice.ends[:2])] == pytest.approx(choice.right.sum())


def test_boundaries_and_gain_from_the_joint_table_of_naming_and_label():
    rng = np.random.default_rng(1)
    lag, cells = np.array([1.5, 1.5]), 200
    tables, courses = [], []
    for changes in (3, 4):
        crossing = np.zeros((cells, changes))
        for j in range(changes):
            crossing[60 + 25 * j + rng.choice(5, 3, replace=False), j] = 1 / 3
        named = rng.dirichlet(np.ones(changes), 2)
        emissions = StudentEmissions(np.zeros((1, 1)), np.ones((1, 1)))
        tables.append(crossing)
        courses.append(NamedCourse(0.5, emissions, np.ones(changes + 1), named,
                                   np.array([[0.0], [3.0]] * np.ones(changes))))  # fmt: skip
    crossing, gains = mix(tables, courses, lag)
    offsets = np.arange(-40, 41)
    law = np.exp(-np.abs(offsets) / 1.5)
    law /= law.sum()
    for b, shift in enumerate((0, 3)):
        rows, weights = [], []
        for table, course in zip(tables, courses, strict=True):
            for j in range(table.shape[1]):
                row = np.zeros(cells)
                for at in np.flatnonzero(table[:, j]):
                    row[at + shift + offsets] += table[at, j] * law
                rows.append(row)
                weights.append(0.5 * course.naming[b, j])
        joint = np.array(weights)[:, None] * np.array(rows)
        mixed = joint.sum(0)
        alone = joint.sum(1, keepdims=True) * mixed
        gain = (joint * np.log(np.where(joint > 0, joint / np.where(joint > 0, alone, 1), 1))).sum()
        assert gains[b] == pytest.approx(gain, rel=1e-3)
        expected = (1 - WEIGHING.elsewhere) * mixed + WEIGHING.elsewhere / cells
        np.testing.assert_allclose(crossing[:, b], expected, atol=1e-4)


def test_places_lie_near_a_time_and_intervals_of_nine_tenths_are_the_shortest():
    edges, crossing = np.arange(102.0), np.zeros(100)
    crossing[[20, 21, 50, 51, 80]] = [0.3, 0.2, 0.23, 0.23, 0.04]
    found = places(edges, crossing, 51.2)
    assert [(p.time, pytest.approx(p.probability)) for p in found] == [(21.0, 0.5), (51.2, 0.46)]
    crossing = np.zeros(100)
    crossing[[20, 60]] = [0.97, 0.03]
    assert places(edges, crossing, 21.0) == ()
    rng = np.random.default_rng(0)
    for _ in range(50):
        middle = np.arange(rng.integers(4, 30) + 1.0)
        probability = rng.exponential(size=middle.size - 1) * (rng.random(middle.size - 1) < 0.6)
        probability[0] += 1e-3
        cumulative = np.r_[0.0, np.cumsum(probability) / probability.sum()]
        pairs = itertools.combinations(range(middle.size), 2)
        lengths = [middle[b] - middle[a] for a, b in pairs if cumulative[b] - cumulative[a] > 0.9 - 1e-12]
        low, high = _shortest(middle, cumulative)
        assert high - low == min(lengths)


def test_what_cannot_be_known_is_told_with_the_label_that_would_decide():
    trials, truth = ambiguous(noise=2.0)
    found = segment_sequence(trials, THREE)
    for segmentation, cuts in zip(found, truth, strict=True):
        _, push, pull = segmentation.spans
        assert push.alternatives or pull.alternatives
        for span, possible in ((push, cuts[:2]), (pull, cuts[1:])):
            told = [place.time for place in span.alternatives] or [span.start]
            for true in possible:
                assert min(abs(np.array(told) - true)) < 0.5, (span, true)
            if span.alternatives:
                assert 0.5 < sum(place.probability for place in span.alternatives) <= 1 + 1e-9
    question = most_telling(found)
    assert question.gain > 0.1
    assert question.gain == max(s.question.gain for s in found if s.question is not None)
    entry = found[0].to_json()
    assert any(segment.get("alternatives") for segment in entry["segments"])
    json.dumps(entry, allow_nan=False)
    assert "could as well be at" in repr(found[0])


@pytest.mark.parametrize(("label", "named"), [
    (list, {1: 0, 2: 1}), (list, {1: 1, 2: 2}), (list, {1: 0, 2: 2}),
    (lambda times: [None, *times], {2: 1}), (lambda times: {"pull": times[0]}, {2: 2})])  # fmt: skip
def test_labels_of_one_trial_decide_and_one_boundary_where_it_lies(label, named):
    trials, truth = ambiguous(3)
    model = fit_sequence(trials, THREE, {"trial_2.csv": label(truth[2, [*named.values()]].tolist())})
    for segmentation, cuts in zip(segment_sequence(trials, THREE, model), truth, strict=True):
        for span, at in named.items():
            assert segmentation.spans[span].start == pytest.approx(cuts[at], abs=0.1)
            assert not segmentation.spans[span].alternatives


def test_courses_are_saved(tmp_path):
    trials, _ = ambiguous(noise=2.0)
    model = fit_sequence(trials, THREE)
    assert len(model.courses) > 1 and (model.sure < 0.95).any()
    assert sum(course.probability for course in model.courses) == pytest.approx(1)
    save_model(model, tmp_path / "m.npz")
    loaded = load_model(tmp_path / "m.npz", THREE)
    assert segment_sequence(trials[:1], THREE, loaded) == segment_sequence(trials[:1], THREE, model)
    with np.load(tmp_path / "m.npz") as file:
        table = dict(file)
    np.savez(tmp_path / "m.npz", **{k: v for k, v in table.items() if k != "courses.0.loc"})
    refused(r"lacks courses\.0\.loc", load_model, tmp_path / "m.npz", THREE)


def test_a_channel_that_ends_early_or_is_constant_dates_no_jump():
    trials, truth = ambiguous(3, events=(3.0, 6.0), levels=(0.0, 2.0, -1.0), noise=0.1)
    more = {"flat": np.full(trials[0].t.size, 3.0),
            "ends": np.where(trials[0].t < 4, np.sin(1e3 * trials[0].t), np.nan)}  # fmt: skip
    both = [replace(t, channels=t.channels | more) for t in trials]
    task = SequenceTask(("a", "b", "c"))
    alone = [[s.start for s in found.spans] for found in segment_sequence(trials, task)]
    with_them = [[s.start for s in found.spans] for found in segment_sequence(both, task)]
    np.testing.assert_allclose(np.array(alone)[:, 1:], truth, atol=0.011)
    np.testing.assert_allclose(np.array(with_them)[:, 1:], truth, atol=0.011)


def test_cells_average_fresh_readings_and_stay_empty_where_there_are_none():
    t = np.array([0.0, 0.1, 0.2, 1.0, 1.1, 3.0])
    trial = Trial("x", t, {"a": np.array([1.0, 2.0, np.nan, 5.0, 7.0, 9.0])})
    edges, means = cell_means(trial, ("a",), 1.0)
    np.testing.assert_allclose(edges, [0, 1, 2, 3])
    np.testing.assert_allclose(means[:, 0], [1.5, 6.0, 9.0])
    edges, means = cell_means(trial, ("a",), 0.5)
    assert np.isnan(means[3, 0]) and edges[-1] == pytest.approx(3.0)
    rng = np.random.default_rng(0)
    slow = rng.normal(size=40)
    np.testing.assert_array_equal(drop_repeats(np.repeat(slow, 4))[::4], slow)
    assert np.isnan(drop_repeats(np.repeat(slow, 4))).sum() == 120
    again = np.repeat(np.r_[slow[:20], slow[19], slow[20:]], 4)  # a reading that is the same once more
    assert np.isfinite(drop_repeats(again)).sum() == 41
    for fresh in (slow, np.round(np.cumsum(rng.normal(size=200))), np.zeros(50)):  # quantised, constant
        np.testing.assert_array_equal(drop_repeats(fresh), fresh)


def test_features_are_free_of_units_and_emissions_shrug_off_outliers():
    rng, t = np.random.default_rng(0), np.arange(200) / 20
    x = rng.normal(size=200).cumsum()
    one, other = Trial("x", t, {"a": x}), Trial("x", t, {"a": 1000 * x - 7})
    values = [features(trial, feature_map([trial], ("a",))).values for trial in (one, other)]
    np.testing.assert_allclose(values[0], values[1], atol=1e-9)
    x = np.concatenate([0.5 * np.arange(60), 40 - 0.2 * np.arange(60)])[:, None]
    slope = edge_preserving_slopes(x, 9)[:, 0]
    np.testing.assert_allclose(slope, np.repeat([0.5, -0.2], 60), atol=1e-9)
    rng = np.random.default_rng(2)
    x = rng.normal(2.0, 0.5, size=(500, 1))
    x[:15] = 80.0
    emissions = from_weights(x, np.ones((500, 1)), 0.01, 1.0, iterations=50)
    assert emissions.loc[0, 0] == pytest.approx(2.0, abs=0.1) and 0.3 < emissions.scale[0, 0] < 0.7
    emissions = from_weights(np.array([[0.0], [1.0], [2.0]]), np.ones((3, 1)), 0.1, 1.0)
    assert emissions.log_likelihoods(np.array([[np.nan]]))[0, 0] == 0.0


@pytest.mark.parametrize("num_stretches", [1, 2, 3])
def test_partition_is_the_best_of_all(num_stretches):
    rng = np.random.default_rng(num_stretches)
    values = rng.normal(size=(9, 2)) + np.repeat([[0.0, 1.0], [3.0, 1.0], [3.0, -2.0]], 3, axis=0)
    floor = 0.3

    def cost(cuts):
        stretches = np.split(values, cuts)
        return sum(len(s) / 2 * np.log(s.var(0) + floor**2).sum() for s in stretches)

    best = min(itertools.combinations(range(1, 9), num_stretches - 1), key=cost)
    path = partition(values, num_stretches, floor)
    assert np.flatnonzero(np.diff(path)).tolist() == [cut - 1 for cut in best]
    assert path.max() == num_stretches - 1


def test_share_of_independent_observations():
    rng = np.random.default_rng(1)
    white = rng.normal(size=(4000, 3))
    assert independent_share([white]) == pytest.approx(1.0, rel=0.1)
    phi = 0.8  # integrated autocorrelation time of AR(1): (1 + phi) / (1 - phi) = 9
    slow = np.zeros((40000, 1))
    for i, e in enumerate(rng.normal(size=39999), 1):
        slow[i] = phi * slow[i - 1] + e
    assert independent_share([slow]) == pytest.approx(1 / 9, rel=0.25)
    assert independent_share([np.repeat(white[:, :1], 5, axis=1)]) == pytest.approx(1 / 5, rel=0.15)


EXPECTED = {"check_clustering": "rows are samples in time, not points to be clustered in any order",
            "check_methods_sample_order_invariance": "the order of the samples is what is modelled",
            "check_methods_subset_invariance": "a stretch of a sequence is another sequence"}  # fmt: skip


def steps(seed, edges=(60, 140), length=200):
    rng = np.random.default_rng(seed)
    states = np.searchsorted(edges, np.arange(length), side="right")
    return np.stack([states * 1.0, 2.0 - states], axis=1) + 0.1 * rng.normal(size=(length, 2)), states


@pytest.fixture
def segmenter():
    pytest.importorskip("sklearn")
    from hmmseg.sequence.estimator import OrderedSegmenter

    return OrderedSegmenter


def test_one_sequence_and_several_some_of_them_labelled(segmenter):
    x, states = steps(0)
    found = segmenter(n_states=3, rate=50.0).fit(x)
    assert (found.labels_ != states).mean() < 0.03
    np.testing.assert_array_equal(found.fit_predict(x), found.predict(x))
    from sklearn.base import clone

    sequences = [steps(k, (50 + 5 * k, 130 + 4 * k)) for k in range(4)]
    x, y = [s[0] for s in sequences], [s[1] for s in sequences]
    found = clone(segmenter(n_states=3, rate=50.0)).fit(x, [y[0], y[1], None, None])
    for got, wanted in zip(found.predict(x), y, strict=True):
        assert (got != wanted).mean() < 0.03


def test_abrupt_changes_are_dated_where_they_jump_and_short_states_are_there(segmenter):
    truth = np.array([19.2, 19.4, 19.6])
    states = np.searchsorted(truth, np.arange(1000) / 50, side="right")
    x = [3.0 * states[:, None] + np.random.default_rng(k).normal(0, 0.2, (1000, 1)) for k in range(3)]
    found = segmenter(n_states=4, rate=50.0).fit(x)
    for predicted in found.predict(x):
        assert (np.diff(predicted) >= 0).all() and set(predicted) == {0, 1, 2, 3}
    y = np.array([0, 0.3, 0.2, 0.1, 10, 11, 12, 13])
    spans = segment({"t": np.arange(8.0), "y": y}, {"sequence": ["low", "high"]})[0].spans
    assert spans[1].start == 3.5 and spans[1].start_90[0] <= 3.5 <= spans[1].start_90[1]


def test_scikit_learns_own_checks(segmenter):
    from sklearn.utils.estimator_checks import check_estimator

    check_estimator(segmenter(), expected_failed_checks=EXPECTED, on_skip=None)
