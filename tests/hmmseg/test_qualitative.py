"""The qualitative baseline on signals with known states, and on the paper's blocks."""

import itertools
import json
import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from experiments.score_recordings import first_change_order
from hmmseg.contact.decompose import subtasks
from hmmseg.errors import InputError
from hmmseg.hand.signals import Signals
from hmmseg.io.task import BlockTask, Move, SequenceTask
from hmmseg.io.trial import Trial
from hmmseg.segmentation.thresholds import (
    StateLabels,
    agreement,
    label_states,
    monotone_order,
    segment_qualitative,
    threshold,
)

STACK = BlockTask(
    {"block1": "block2", "block2": "ground"}, (Move("block1", "ground"), Move("block2", "block1"))
)
PICK = BlockTask({"block": "ground"}, (Move("block", "ground"),))
SLIDE = BlockTask({"block": "ground"}, (Move("block", "ground", slide=True),))
# fx1, fy1, fx2, fy2 [N], vx, vy [m/s] that show each state; s slides, 0 shows none.
PATTERNS = {
    "1": (0.0, 0.0, 0.0, 0.0, 0.2, 0.1),
    "2": (2.0, 0.2, -2.0, 0.2, 0.2, 0.1),
    "3": (2.0, -0.2, -2.0, 0.2, 0.0, 0.0),
    "s": (2.0, -0.2, -2.0, -0.2, -0.2, 0.0),
    "0": (2.0, 0.0, 0.0, 0.0, 0.0, 0.0),
}


def make_signals(states: str, dt: float = 0.05) -> Signals:
    columns = np.array([PATTERNS[s] for s in states]).T
    fx1, fy1, fx2, fy2, vx, vy = columns
    zero = np.zeros(len(states))
    return Signals(
        t=np.arange(len(states)) * dt, x1=zero, y1=zero, vx1=vx, vy1=vy, fx1=fx1, fy1=fy1,
        x2=zero + 0.02, y2=zero, vx2=vx, vy2=vy, fx2=fx2, fy2=fy2,
        sd_x=zero, sd_y=zero, sd_vx=zero, sd_vy=zero, sd_force=0.01,
    )  # fmt: skip


def segment(states: str, task, **options):
    signals = make_signals(states)
    return segment_qualitative(Trial("made.csv", signals.t, {}), signals, task, **options)


def starts(segmentation) -> list[float]:
    return [span.start for span in segmentation.spans]


def test_threshold_is_tri_valued_and_keeps_missing_samples_missing():
    out = threshold(np.array([0.06, 0.05, 0.0, -0.05, -0.06, np.nan]), 0.05)
    np.testing.assert_array_equal(out, [1, 0, 0, 0, -1, np.nan])


def test_states_in_the_paper_s_numbering():
    labels = label_states(make_signals("123s0"))
    np.testing.assert_array_equal(labels.state, [1, 2, 3, 3, 0])
    np.testing.assert_array_equal(labels.sliding, [False, False, False, True, False])


@pytest.mark.parametrize(("state", "change", "options", "expected"), [
    ("1", {"fx1": -0.06}, {}, 0), ("1", {"fy1": -0.06}, {}, 0), ("1", {"fx2": -0.06}, {}, 0),
    ("1", {"fy2": -0.06}, {}, 0), ("3", {"vy1": 0.04, "vy2": 0.04}, {}, 3),
    ("3", {"vy1": 0.06, "vy2": 0.06}, {}, 0), ("3", {"fy2": 0.3}, {}, 2),
    ("2", {}, {"force_threshold": 0.5}, 0),
    ("2", {}, {"force_threshold": 0.5, "velocity_threshold": 0.15}, 3),
])  # fmt: skip
def test_rules_ask_for_every_component_beyond_its_threshold(state, change, options, expected):
    signals = replace(make_signals(state), **{name: np.array([value]) for name, value in change.items()})
    assert label_states(signals, **options).state[0] == expected


@pytest.mark.parametrize("state, name, expected", [
    ("1", "fy2", 0), ("2", "fx1", 0), ("2", "fy1", 0), ("2", "vy1", 2), ("3", "vy2", 0),
    ("3", "vx1", 3), ("s", "vx1", 3),
])  # fmt: skip
def test_missing_sample_is_unidentified_only_where_its_signal_is_needed(state, name, expected):
    signals = replace(make_signals(state), **{name: np.array([np.nan])})
    labels = label_states(signals)
    assert labels.state[0] == expected
    assert not labels.sliding[0]


def test_clean_sequence_has_its_boundaries_half_way_between_samples():
    out = segment("111" + "33" + "22222" + "333" + "11" + "333" + "2222" + "33" + "1111", STACK)
    assert out.complete and out.log_evidence is None
    assert [s.subtask for s in out.spans] == [s.name for s in subtasks(STACK)]
    changes = np.cumsum([3, 2, 5, 3, 2, 3, 4, 2])
    np.testing.assert_allclose(starts(out)[1:], (changes - 0.5) * 0.05)
    np.testing.assert_allclose([s.start_sd for s in out.spans[1:]], 0.05 / math.sqrt(12))
    widths = [s.start_90[1] - s.start_90[0] for s in out.spans[1:]]
    np.testing.assert_allclose(widths, 0.9 * 0.05)
    assert out.spans[0].start == 0.0 and out.spans[0].start_90 == (0.0, 0.0)
    assert out.spans[-1].end == pytest.approx(27 * 0.05) and out.spans[-1].end_sd == 0.0


def test_dropouts_between_subtasks_widen_their_boundary():
    out = segment("1113300222233311", PICK)
    assert out.spans[2].start == pytest.approx((4 + 7) / 2 * 0.05)
    assert out.spans[2].start_sd == pytest.approx(3 * 0.05 / math.sqrt(12))


def test_oscillating_grip_is_recovered_by_the_monotone_order_only():
    # The grip flickers to hold-above-ground and back before it lifts, as real grips do.
    states = "11111" + "3233333" + "22222222" + "33333" + "1111"
    monotone, first = segment(states, PICK), segment(states, PICK, order=first_change_order)
    np.testing.assert_allclose(starts(monotone)[1:], (np.array([5, 12, 20, 25]) - 0.5) * 0.05)
    # The plain rule takes the flicker for the carry, and the rest of the pickup for the place.
    np.testing.assert_allclose(starts(first)[1:4], (np.array([5, 6, 7]) - 0.5) * 0.05)


def test_ground_sliding_counts_as_hold_on_ground_unless_the_move_is_a_slide():
    carried = segment("1113s3222233s11", PICK)
    assert carried.complete
    slid = segment("111" + "33" + "ssss" + "33" + "11", SLIDE)
    assert [s.subtask for s in slid.spans] == ["pregrasp", "pickup", "slide", "place", "release"]
    np.testing.assert_allclose(starts(slid)[1:], (np.array([3, 5, 9, 11]) - 0.5) * 0.05)
    np.testing.assert_allclose(
        starts(segment("111" + "33" + "ssss" + "33" + "11", SLIDE, order=first_change_order)), starts(slid)
    )


def test_a_move_that_never_happens_fails_at_its_pickup_and_keeps_the_rest():
    out = segment("1113322222333111111", STACK)
    assert not out.complete and out.failed is not None
    assert (out.failed.index, out.failed.subtask, out.failed.object) == (5, "pickup", "block2")
    assert "hold-on-ground" in out.failed.reason and "0.05 N" in out.failed.reason
    assert [s.subtask for s in out.spans] == ["pregrasp", "pickup", "carry", "place", "release"]
    assert out.spans[-1].end == pytest.approx(18 * 0.05)
    json.dumps(out.to_json(), allow_nan=False)


def test_flicker_does_not_pass_for_a_later_move():
    # Agreeing with the first 2 and 3 of the flicker would make the rest the moves of block2.
    out = segment("1" * 30 + "2" + "3" * 12 + "2" * 30 + "3" * 12 + "1" * 30, STACK)
    assert out.failed is not None and out.failed.index == 5
    assert [s.object for s in out.spans] == ["block1"] * 5


def test_an_unknown_number_of_repeats_is_counted():
    task = replace(PICK, repeat="unknown")
    for number in (1, 2, 3):
        out = segment("111" + "3332222333111" * number, task)
        assert out.complete and len(out.spans) == 1 + 4 * number


def test_refused_input():
    with pytest.raises(InputError, match=r"--force-threshold: found 0\.0; expected a number > 0"):
        segment("111", PICK, force_threshold=0.0)
    with pytest.raises(InputError, match="--velocity-threshold: found nan"):
        segment("111", PICK, velocity_threshold=math.nan)
    with pytest.raises(InputError, match="plain ordered task"):
        segment("111", SequenceTask(("a", "b")))


def best_agreement(agrees: np.ndarray) -> float | None:
    """By enumeration: most agreeing samples of any order whose every subtask has one."""
    length, count = agrees.shape
    scores = []
    for cuts in itertools.combinations(range(1, length), count - 1):
        edges = (0, *cuts, length)
        hits = [agrees[a:b, s].sum() for s, (a, b) in enumerate(itertools.pairwise(edges))]
        if min(hits) > 0:
            scores.append(sum(hits))
    return max(scores) / length if scores else None


@settings(max_examples=60, deadline=None)
@given(st.lists(st.sampled_from([0, 1, 2, 3]), min_size=8, max_size=12))
def test_monotone_order_against_enumeration(states):
    labels = StateLabels(np.array(states), np.zeros(len(states), dtype=bool))
    steps = subtasks(PICK)
    out, best = monotone_order(labels, steps), best_agreement(agreement(labels, steps))
    assert out.complete == (best is not None)
    if best is not None:
        assert out.agreement == pytest.approx(best)
        assert out.agreement >= first_change_order(labels, steps).agreement
