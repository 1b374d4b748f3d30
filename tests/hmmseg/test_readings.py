"""Sequences without labels: all ways to read them, what is said of them, and what one label decides."""

import itertools
import json

import numpy as np
import pytest

from hmmseg.errors import InputError
from hmmseg.hmm import left_to_right, smooth
from hmmseg.io.task import SequenceTask
from hmmseg.io.trial import Trial
from hmmseg.sequence.fit import fit_sequence
from hmmseg.sequence.model import load_model, save_model
from hmmseg.sequence.places import gains, mixed, most_telling, places
from hmmseg.sequence.readings import best_groupings
from hmmseg.sequence.segment import segment_sequence

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


def test_groupings_are_the_best_of_all():
    rng = np.random.default_rng(0)
    for _ in range(40):
        n = int(rng.integers(3, 8))
        groups = int(rng.integers(1, n))
        later = np.arange(n + 1)[None] > np.arange(n + 1)[:, None]
        cost = np.where(later, rng.random((n + 1, n + 1)), np.inf)
        allowed = rng.random((groups - 1, n + 1)) < 0.8
        every = {
            cuts: sum(cost[a, b] for a, b in itertools.pairwise((0, *cuts, n)))
            for cuts in itertools.combinations(range(1, n), groups - 1)
            if all(allowed[i, at] for i, at in enumerate(cuts))
        }
        found = best_groupings(cost, groups, allowed)
        for cuts, value in found.items():
            assert value == pytest.approx(every[cuts])
        for b, at in itertools.product(range(groups - 1), range(1, n)):
            with_it = [value for cuts, value in every.items() if cuts[b] == at]
            if with_it:
                assert min(v for cuts, v in found.items() if cuts[b] == at) == pytest.approx(min(with_it))


def test_mixture_and_gain_against_enumeration_of_readings_and_paths():
    rng = np.random.default_rng(1)
    probability = np.array([0.5, 0.3, 0.2])
    tables = [rng.normal(size=(7, 3)) * 2 for _ in probability]
    chain = left_to_right([3, 2, 2])
    # Every path of every reading, weighed.
    joint = np.zeros((3, 6, 2))
    for r, table in enumerate(tables):
        weights = {}
        for one, two in itertools.combinations(range(1, 7), 2):
            path = np.repeat([0, 1, 2], [one, two - one, 7 - two])
            log = table[np.arange(7), path].sum()
            for before, after in itertools.pairwise(path):
                log += chain.bands[0][before] if before == after else chain.bands[1][before]
            weights[one, two] = np.exp(log)
        total = sum(weights.values())
        for (one, two), weight in weights.items():
            joint[r, one - 1, 0] += probability[r] * weight / total
            joint[r, two - 1, 1] += probability[r] * weight / total
    crossings = [smooth(table, chain).boundary for table in tables]
    np.testing.assert_allclose(mixed(probability, crossings), joint.sum(0), atol=1e-12)
    # Mutual information of reading and label from the joint table itself.
    for b in range(2):
        table = joint[:, :, b]
        independent = table.sum(1, keepdims=True) * table.sum(0, keepdims=True)
        expected = (table * np.log(np.where(table > 0, table / np.where(table > 0, independent, 1), 1))).sum()
        assert gains(probability, crossings)[b] == pytest.approx(expected)


def test_places_are_those_of_overlapping_readings():
    found = places(
        [2.0, 2.1, 5.0, 8.0], [(1.9, 2.15), (2.0, 2.2), (4.9, 5.1), (7, 9)], [0.3, 0.2, 0.46, 0.04]
    )
    assert [(p.time, pytest.approx(p.probability)) for p in found] == [(2.0, 0.5), (5.0, 0.46)]
    assert places([2.0, 5.0], [(1.9, 2.1), (4.9, 5.1)], [0.97, 0.03]) == ()


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
    assert question.gain == max(s.question.gain for s in found)
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


def test_readings_are_saved(tmp_path):
    trials, _ = ambiguous(noise=2.0)
    model = fit_sequence(trials, TASK)
    assert model.others
    assert sum(p for p, _ in model.readings) == pytest.approx(1)
    save_model(model, tmp_path / "m.npz")
    loaded = load_model(tmp_path / "m.npz", TASK)
    assert segment_sequence(trials[:1], TASK, loaded) == segment_sequence(trials[:1], TASK, model)
    with np.load(tmp_path / "m.npz") as file:
        table = dict(file)
    np.savez(tmp_path / "m.npz", **{k: v for k, v in table.items() if k != "others.0.loc"})
    with pytest.raises(InputError, match="lacks loc"):
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
