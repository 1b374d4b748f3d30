"""Sequences without labels: all ways to read them, what is said of them, and what one label decides."""

import itertools
import json
from dataclasses import replace

import numpy as np
import pytest

from hmmseg.errors import InputError
from hmmseg.io.task import SequenceTask
from hmmseg.io.trial import Trial
from hmmseg.segmentation.spans import most_telling
from hmmseg.sequence.courses import NEAR, WEIGHING, Course, best_choice, naming, probabilities, seen
from hmmseg.sequence.emissions import StudentEmissions
from hmmseg.sequence.fit import fit_sequence
from hmmseg.sequence.model import NamedCourse, load_model, save_model
from hmmseg.sequence.segment import _shortest, places, segment_sequence, together

TASK = SequenceTask(("wait", "push", "pull"))


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
    return Course([np.zeros((50, stretches))] * trials, ends, cost, 0.5, seen)


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


def test_a_jump_is_seen_and_a_level_cut_in_two_is_not():
    rng = np.random.default_rng(5)
    level = np.repeat([0.0, 0.0, 1.5], 60)
    values = [level[:, None] + 0.3 * rng.normal(size=(180, 2)) for _ in range(3)]
    found = np.exp(seen(values, [np.repeat([0, 1, 2], 60)] * 3, 3, share=2.0))
    assert found[0] < 0.01
    assert found[1] > 0.999


def test_the_best_choice_has_most_boundaries_right():
    rng = np.random.default_rng(4)
    courses = [drawn_course(rng, 6), drawn_course(rng, 8)]
    none = [np.full(2, np.nan)] * 2
    namings = [naming(course, 3, none) for course in courses]
    weights = probabilities(namings)
    evidence = np.array([each.log_evidence for each in namings])
    np.testing.assert_allclose(weights, np.exp(evidence) / np.exp(evidence).sum())
    expected = {}
    for i, course in enumerate(courses):
        for cuts in itertools.combinations(range(course.ends.shape[1]), 2):
            right = 0.0
            for weight, other, its in zip(weights, courses, namings, strict=True):
                for b, j in itertools.product(range(2), range(other.ends.shape[1])):
                    near = np.median(np.abs(course.ends[:, cuts[b]] - other.ends[:, j])) < NEAR
                    right += weight * its.probability[b, j] * near
            expected[i, cuts] = right
    choice = best_choice(courses, namings, weights)
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
        courses.append(
            NamedCourse(
                0.5, emissions, np.ones(changes + 1), named, np.array([[0.0], [3.0]] * np.ones(changes))
            )
        )
    found = together(tables, courses, lag)
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
        assert found.gain[b] == pytest.approx(gain, rel=1e-3)
        expected = (1 - WEIGHING.elsewhere) * mixed + WEIGHING.elsewhere / cells
        np.testing.assert_allclose(found.crossing[:, b], expected, atol=1e-4)


def test_places_are_what_lies_near_a_time():
    edges = np.arange(102.0)
    crossing = np.zeros(100)
    crossing[[20, 21, 50, 51, 80]] = [0.3, 0.2, 0.23, 0.23, 0.04]
    found = places(edges, crossing, 51.2)
    assert [(p.time, pytest.approx(p.probability)) for p in found] == [(21.0, 0.5), (51.2, 0.46)]
    crossing = np.zeros(100)
    crossing[[20, 60]] = [0.97, 0.03]
    assert places(edges, crossing, 21.0) == ()


def test_what_cannot_be_known_is_told_with_the_label_that_would_decide():
    trials, truth = ambiguous(noise=2.0)
    found = segment_sequence(trials, TASK)
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
    assert question is not None and question.gain > 0.1
    assert question.gain == max(s.question.gain for s in found if s.question is not None)
    entry = found[0].to_json()
    assert any(segment.get("alternatives") for segment in entry["segments"])
    json.dumps(entry, allow_nan=False)
    assert "could as well be at" in repr(found[0])


@pytest.mark.parametrize("named", [(0, 1), (1, 2), (0, 2)])
def test_labels_of_one_trial_decide(named):
    trials, truth = ambiguous()
    labels = {"trial_2": truth[2, list(named)].tolist()}
    model = fit_sequence(trials, TASK, labels)
    for segmentation, cuts in zip(segment_sequence(trials, TASK, model), truth, strict=True):
        starts = [span.start for span in segmentation.spans[1:]]
        np.testing.assert_allclose(starts, cuts[list(named)], atol=0.1)
        assert not any(span.alternatives for span in segmentation.spans)


@pytest.mark.parametrize("form", ["list", "name"])
def test_one_boundary_decides_where_it_lies(form):
    trials, truth = ambiguous()
    for at in (1, 2):
        time = float(truth[1, at])
        given = [None, time] if form == "list" else {"pull": time}
        model = fit_sequence(trials, TASK, {"trial_1.csv": given})
        for segmentation, cuts in zip(segment_sequence(trials, TASK, model), truth, strict=True):
            assert segmentation.spans[2].start == pytest.approx(cuts[at], abs=0.1)
            assert not segmentation.spans[2].alternatives


def test_courses_are_saved(tmp_path):
    trials, _ = ambiguous(noise=2.0)
    model = fit_sequence(trials, TASK)
    assert len(model.courses) > 1 and (model.sure < 0.95).any()
    assert sum(course.probability for course in model.courses) == pytest.approx(1)
    save_model(model, tmp_path / "m.npz")
    loaded = load_model(tmp_path / "m.npz", TASK)
    assert segment_sequence(trials[:1], TASK, loaded) == segment_sequence(trials[:1], TASK, model)
    with np.load(tmp_path / "m.npz") as file:
        table = dict(file)
    np.savez(tmp_path / "m.npz", **{k: v for k, v in table.items() if k != "courses.0.loc"})
    with pytest.raises(InputError, match=r"lacks courses\.0\.loc"):
        load_model(tmp_path / "m.npz", TASK)


@pytest.mark.parametrize(
    ("labels", "message"),
    [
        ({"trial_0": [None, None]}, "has no boundary"),
        ({"trial_0": {"lift": 2.0}}, "gives the start of 'lift', which has none in this task"),
        ({"trial_0": {"wait": 2.0}}, "gives the start of 'wait'"),
        ({"trial_0": {"pull": 99.0}}, "times between 0 and"),
    ],
)
def test_labels_that_do_not_fit_are_refused(labels, message):
    with pytest.raises(InputError, match=message):
        fit_sequence(ambiguous(1)[0], TASK, labels)


def test_the_shortest_interval_holds_nine_tenths_and_none_on_a_fine_grid_is_shorter():
    rng = np.random.default_rng(0)
    for _ in range(50):
        middle = np.arange(rng.integers(4, 30) + 1.0)
        probability = rng.exponential(size=middle.size - 1) * (rng.random(middle.size - 1) < 0.6)
        probability[0] += 1e-3
        cumulative = np.r_[0.0, np.cumsum(probability) / probability.sum()]
        low, high = _shortest(middle, cumulative)
        held = np.interp([low, high], middle, cumulative)
        assert held[1] - held[0] > 0.9 - 1e-9
        fine = np.linspace(0.0, middle[-1], 2001)
        of = np.interp(fine, middle, cumulative)
        ends = np.searchsorted(of, of + 0.9 - 1e-9)
        lengths = [fine[end] - start for start, end in zip(fine, ends, strict=True) if end < fine.size]
        assert high - low < min(lengths) + 1e-9


def test_a_channel_that_ends_early_or_is_constant_dates_no_jump():
    trials, truth = ambiguous(3, events=(3.0, 6.0), levels=(0.0, 2.0, -1.0), noise=0.1)
    more = {
        "flat": np.full(trials[0].t.size, 3.0),
        "ends": np.where(trials[0].t < 4, np.sin(1e3 * trials[0].t), np.nan),
    }
    both = [replace(t, channels=t.channels | more) for t in trials]
    task = SequenceTask(("a", "b", "c"))
    alone = [[s.start for s in found.spans] for found in segment_sequence(trials, task)]
    with_them = [[s.start for s in found.spans] for found in segment_sequence(both, task)]
    np.testing.assert_allclose(np.array(alone)[:, 1:], truth, atol=0.011)
    np.testing.assert_allclose(np.array(with_them)[:, 1:], truth, atol=0.011)
