"""The paper's method: states by thresholds and properties by its formulas, on signals with known answers."""

import itertools
import json
import math
from dataclasses import replace

import numpy as np
import pytest
from hand_signals import signals_of
from hypothesis import given, settings
from hypothesis import strategies as st
from refusals import refused

from estimation.paper_formulas import estimate_plugin
from experiments.score_recordings import first_change_order
from hmmseg.contact.decompose import ABOVE_GROUND, FREE, subtasks
from hmmseg.hand.signals import Signals
from hmmseg.io.task import BlockTask, Move, SequenceTask
from hmmseg.io.trial import Trial
from hmmseg.segmentation import thresholds
from hmmseg.segmentation.spans import Segmentation, Span

STACK = BlockTask({"block1": "block2", "block2": "ground"},
                  (Move("block1", "ground"), Move("block2", "block1")))  # fmt: skip
PICK = BlockTask({"block": "ground"}, (Move("block", "ground"),))
SLIDE = BlockTask({"block": "ground"}, (Move("block", "ground", slide=True),))
# fx1, fy1, fx2, fy2 [N], vx, vy [m/s] that show each state; s slides, 0 shows none.
PATTERNS = {"1": (0.0, 0.0, 0.0, 0.0, 0.2, 0.1), "2": (2.0, 0.2, -2.0, 0.2, 0.2, 0.1),
            "3": (2.0, -0.2, -2.0, 0.2, 0.0, 0.0), "s": (2.0, -0.2, -2.0, -0.2, -0.2, 0.0),
            "0": (2.0, 0.0, 0.0, 0.0, 0.0, 0.0)}  # fmt: skip
TOWER = BlockTask({"a": "b", "b": "c", "c": "ground"},
                  (Move("a", "ground"), Move("b", "ground"), Move("c", "a")))  # fmt: skip
WEIGHT = {"block1": 0.343, "block2": 0.437, "a": 0.2, "b": 0.3, "c": 0.4}
WIDTH = {"block1": 0.0159, "block2": 0.0254, "a": 0.02, "b": 0.021, "c": 0.022}
HEIGHT = {"block1": 0.016, "block2": 0.0127, "a": 0.01, "b": 0.011, "c": 0.013}
PER_SUBTASK = 40
# Height under the object at pickup and place, by move.
RESTS = {"stack": ((HEIGHT["block2"], 0.0), (0.0, HEIGHT["block1"])),
         "tower": ((HEIGHT["b"] + HEIGHT["c"], 0.0), (HEIGHT["c"], 0.0), (0.0, HEIGHT["a"]))}  # fmt: skip


def make_signals(states: str, dt: float = 0.05) -> Signals:
    fx1, fy1, fx2, fy2, vx, vy = np.array([PATTERNS[s] for s in states]).T
    return signals_of(np.arange(len(states)) * dt, 0.01, fx1=fx1, fy1=fy1, fx2=fx2, fy2=fy2, vx1=vx, vy1=vy,
                      vx2=vx, vy2=vy, x2=0.02)  # fmt: skip


def segment(states: str, task, **options):
    signals = make_signals(states)
    return thresholds.segment_qualitative(Trial("made.csv", signals.t, {}), signals, task, **options)


def starts(segmentation) -> list[float]:
    return [span.start for span in segmentation.spans]


@pytest.mark.parametrize(("state", "change", "options", "expected"), [
    ("1", {"fx1": -0.06}, {}, 0), ("1", {"fy1": -0.06}, {}, 0), ("1", {"fx2": -0.06}, {}, 0),
    ("1", {"fy2": -0.06}, {}, 0), ("3", {"vy1": 0.04, "vy2": 0.04}, {}, 3),
    ("3", {"vy1": 0.06, "vy2": 0.06}, {}, 0), ("3", {"fy2": 0.3}, {}, 2),
    ("2", {}, {"force_threshold": 0.5}, 0), ("1", {"fx1": 0.05, "fx2": -0.05}, {}, 1),
    ("1", {"fx1": 0.06}, {}, 0), ("2", {}, {"force_threshold": 0.5, "velocity_threshold": 0.15}, 3),
    # A missing sample matters only where its signal is needed.
    ("1", {"fy2": np.nan}, {}, 0), ("2", {"fx1": np.nan}, {}, 0), ("2", {"fy1": np.nan}, {}, 0),
    ("2", {"vy1": np.nan}, {}, 2), ("3", {"vy2": np.nan}, {}, 0), ("3", {"vx1": np.nan}, {}, 3),
    ("s", {"vx1": np.nan}, {}, 3)])  # fmt: skip
def test_rules_ask_for_every_component_beyond_its_threshold(state, change, options, expected):
    signals = replace(make_signals(state), **{name: np.array([value]) for name, value in change.items()})
    labels = thresholds.label_states(signals, **options)
    assert labels.state[0] == expected and (options or not labels.sliding[0])


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


def test_flickering_grips_dropouts_and_ties_are_put_in_order():
    out = segment("1113300222233311", PICK)
    assert out.spans[2].start == pytest.approx((4 + 7) / 2 * 0.05)
    assert out.spans[2].start_sd == pytest.approx(3 * 0.05 / math.sqrt(12))
    out = segment("111" + "323" + "2222" + "333" + "111", PICK)
    assert out.spans[2].start == pytest.approx(5.5 * 0.05)
    # The grip flickers to hold-above-ground and back before it lifts, as real grips do.
    states = "11111" + "3233333" + "22222222" + "33333" + "1111"
    monotone, first = segment(states, PICK), segment(states, PICK, order=first_change_order)
    np.testing.assert_allclose(starts(monotone)[1:], (np.array([5, 12, 20, 25]) - 0.5) * 0.05)
    # The plain rule takes the flicker for the carry, and the rest of the pickup for the place.
    np.testing.assert_allclose(starts(first)[1:4], (np.array([5, 6, 7]) - 0.5) * 0.05)


def test_slides_and_repeats_are_counted_as_the_task_has_them():
    carried = segment("1113s3222233s11", PICK)
    assert carried.complete
    slid = segment("111" + "33" + "ssss" + "33" + "11", SLIDE)
    assert [s.subtask for s in slid.spans] == ["pregrasp", "pickup", "slide", "place", "release"]
    np.testing.assert_allclose(starts(slid)[1:], (np.array([3, 5, 9, 11]) - 0.5) * 0.05)
    np.testing.assert_allclose(starts(segment("111" + "33" + "ssss" + "33" + "11", SLIDE,
                                              order=first_change_order)), starts(slid))  # fmt: skip
    task = replace(PICK, repeat="unknown")
    for number in (1, 2, 3):
        out = segment("111" + "3332222333111" * number, task)
        assert out.complete and len(out.spans) == 1 + 4 * number


def test_a_move_that_never_happens_fails_at_its_pickup_though_a_grip_flickers():
    out = segment("1113322222333111111", STACK)
    assert not out.complete and out.failed is not None
    assert (out.failed.index, out.failed.subtask, out.failed.object) == (5, "pickup", "block2")
    assert "hold-on-ground" in out.failed.reason and "0.05 N" in out.failed.reason
    assert [s.subtask for s in out.spans] == ["pregrasp", "pickup", "carry", "place", "release"]
    assert out.spans[-1].end == pytest.approx(18 * 0.05)
    json.dumps(out.to_json(), allow_nan=False)
    # Agreeing with the first 2 and 3 of the flicker would make the rest the moves of block2.
    out = segment("1" * 30 + "2" + "3" * 12 + "2" * 30 + "3" * 12 + "1" * 30, STACK)
    assert out.failed.index == 5 and [s.object for s in out.spans] == ["block1"] * 5


def test_refused_input():
    line = r"--force-threshold: found 0\.0; expected a number > 0"
    refused(line, segment, "111", PICK, force_threshold=0.0)
    refused("--velocity-threshold: found nan", segment, "111", PICK, velocity_threshold=math.nan)
    refused("plain ordered task", segment, "111", SequenceTask(("a", "b")))


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
    labels = thresholds.StateLabels(np.array(states), np.zeros(len(states), dtype=bool))
    steps = subtasks(PICK)
    out, best = thresholds.monotone_order(labels, steps), best_agreement(thresholds.agreement(labels, steps))
    assert out.complete == (best is not None)
    if best is not None:
        assert out.agreement == pytest.approx(best)
        assert out.agreement >= first_change_order(labels, steps).agreement


def make(task: BlockTask, rests, seed: int | None = None) -> tuple[Signals, Segmentation]:
    steps = subtasks(task)
    size = PER_SUBTASK * len(steps)
    t = np.arange(size) * 0.05
    s, spans = signals_of(t, 0.01), []
    for i, step in enumerate(steps):
        inside = slice(i * PER_SUBTASK, (i + 1) * PER_SUBTASK)
        start, end = t[inside][0] - 0.025, t[inside][-1] + 0.025
        spans.append(Span(step.name, step.object, step.state, start, end, 0.0, 0.0, (start, start),
                          (end, end)))  # fmt: skip
        if step.state == FREE:
            continue
        lift = 0.03 if step.state == ABOVE_GROUND else rests[step.move][step.name == "place"]
        s.y2[inside] = s.y1[inside] = lift + 0.004
        s.x2[inside] = WIDTH[step.object]
        s.fx1[inside], s.fx2[inside] = 2.0, -2.0
        vertical = WEIGHT[step.object] if step.state == ABOVE_GROUND else -0.1
        s.fy1[inside] = s.fy2[inside] = vertical / 2
        if step.state == ABOVE_GROUND:  # lift-off and impact, within the trimmed 5 %
            s.fy1[inside.start], s.fy1[inside.stop - 1] = 0.5, 0.6
    if seed is not None:
        rng = np.random.default_rng(seed)
        s = replace(s, **{n: getattr(s, n) + rng.normal(0, 0.01, size) for n in ("fy1", "fy2")})
    return s, Segmentation("made.csv", 20.0, None, tuple(spans))


@pytest.mark.parametrize("task, rests", [(STACK, RESTS["stack"]), (TOWER, RESTS["tower"])])
def test_exact_signals_give_the_planted_properties(task, rests):
    signals, segmentation = make(task, rests)
    properties, reasons = estimate_plugin([signals], [segmentation], task)
    for name in task.objects:
        for key, planted in (("weight", WEIGHT), ("width", WIDTH), ("height", HEIGHT)):
            estimate = properties[name][key]
            assert estimate is not None, reasons
            assert estimate["mean"] == pytest.approx(planted[name], rel=1e-9)
        bound = properties[name]["friction"]
        assert bound["lower_bound"] == pytest.approx(0.3)  # 0.6 / 2
    assert reasons == {}


def test_the_ends_of_a_carry_dropouts_and_missing_samples_are_left_out():
    signals, segmentation = make(STACK, RESTS["stack"])
    carry, third = slice(2 * PER_SUBTASK, 3 * PER_SUBTASK), signals.fy1.copy()
    third[carry.start + 2] += 3.6  # the first sample behind the trimmed two of forty
    properties, _ = estimate_plugin([replace(signals, fy1=third)], [segmentation], STACK)
    assert properties["block1"]["weight"]["mean"] == pytest.approx(0.343 + 3.6 / 36)
    wild, gap = carry.start + 10, carry.start + 11
    fx1, fy1, fx2 = signals.fx1.copy(), signals.fy1.copy(), signals.fx2.copy()
    fx1[wild], fx2[wild], fy1[wild], fy1[gap] = 0.0, 0.0, 50.0, np.nan  # no grip: not a state of holding
    properties, _ = estimate_plugin([replace(signals, fx1=fx1, fy1=fy1, fx2=fx2)], [segmentation], STACK)
    assert properties["block1"]["weight"]["mean"] == pytest.approx(0.343)
    assert properties["block1"]["friction"]["lower_bound"] == pytest.approx(0.3)


def test_standard_deviation_is_the_samples_and_trials_pool_by_mean():
    made = [make(STACK, RESTS["stack"], seed) for seed in range(8)]
    signals, segmentations = [list(column) for column in zip(*made, strict=True)]
    each = [estimate_plugin([s], [g], STACK)[0]["block1"]["weight"] for s, g in made]
    pooled = estimate_plugin(signals, segmentations, STACK)[0]["block1"]["weight"]
    assert pooled["mean"] == pytest.approx(np.mean([e["mean"] for e in each]))
    assert pooled["sd"] == pytest.approx(0.01 * math.sqrt(2), rel=0.15)
    assert pooled["standard_error"] == pytest.approx(0.01 * math.sqrt(2 / (36 * 8)), rel=0.15)
    assert pooled["interval_95"][1] - pooled["mean"] == pytest.approx(1.959964 * pooled["standard_error"])
    assert pooled["mean"] - pooled["interval_68"][0] == pytest.approx(0.994458 * pooled["standard_error"])


def test_what_the_task_or_the_recording_withholds_is_none_with_a_reason():
    steps = subtasks(PICK)
    stack, segmentation = make(STACK, RESTS["stack"])
    names = {"block1": "block", "block2": "block"}
    spans = tuple(replace(s, object=names[str(s.object)]) for s in segmentation.spans[: len(steps)])
    properties, reasons = estimate_plugin([stack], [replace(segmentation, spans=spans)], PICK)
    assert properties["block"]["height"] is None and "height" in reasons["block.height"]
    assert properties["block"]["weight"] is not None
    half = replace(segmentation, spans=segmentation.spans[:5])  # the second move is missing
    properties, reasons = estimate_plugin([stack], [half], STACK)
    assert properties["block1"]["height"] is None and properties["block2"]["weight"] is None
    assert properties["block2"]["height"]["mean"] == pytest.approx(HEIGHT["block2"])
    assert set(reasons) == {f"block2.{p}" for p in ("weight", "width", "friction")} | {"block1.height"}
    json.dumps(properties, allow_nan=False)
    assert "block" in estimate_plugin([stack], [replace(half, spans=())], SLIDE)[1]["block.weight"]


def test_heights_that_only_sums_reveal_are_not_guessed():
    reversal = BlockTask(TOWER.initial, (Move("a", "ground"), Move("b", "a"), Move("c", "b")))
    h = HEIGHT
    signals, segmentation = make(reversal, ((h["b"] + h["c"], 0.0), (h["c"], h["a"]), (0.0, h["a"] + h["b"])))
    properties, reasons = estimate_plugin([signals], [segmentation], reversal)
    assert [properties[name]["height"] for name in "abc"] == [None] * 3
    assert "together with the height of c" in reasons["b.height"]
