"""The paper's estimators on made signals with known answers, and on its own blocks."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest

from estimation.paper_formulas import Estimate, FrictionBound, estimate_plugin
from hmmseg.contact.decompose import ABOVE_GROUND, FREE, subtasks
from hmmseg.hand.signals import Signals
from hmmseg.io.task import BlockTask, Move
from hmmseg.segmentation.spans import Segmentation, Span
from hmmseg.segmentation.thresholds import StateLabels

STACK = BlockTask(
    {"block1": "block2", "block2": "ground"}, (Move("block1", "ground"), Move("block2", "block1"))
)
TOWER = BlockTask(
    {"a": "b", "b": "c", "c": "ground"}, (Move("a", "ground"), Move("b", "ground"), Move("c", "a"))
)
WEIGHT = {"block1": 0.343, "block2": 0.437, "a": 0.2, "b": 0.3, "c": 0.4}
WIDTH = {"block1": 0.0159, "block2": 0.0254, "a": 0.02, "b": 0.021, "c": 0.022}
HEIGHT = {"block1": 0.016, "block2": 0.0127, "a": 0.01, "b": 0.011, "c": 0.013}
PER_SUBTASK = 40
# Height under the object at pickup and place, by move.
RESTS = {
    "stack": ((HEIGHT["block2"], 0.0), (0.0, HEIGHT["block1"])),
    "tower": ((HEIGHT["b"] + HEIGHT["c"], 0.0), (HEIGHT["c"], 0.0), (0.0, HEIGHT["a"])),
}


def make(task: BlockTask, rests, seed: int | None = None) -> tuple[Signals, Segmentation]:
    """One trial whose subtasks last 40 samples each, with scatter if a seed is given."""
    steps = subtasks(task)
    size = PER_SUBTASK * len(steps)
    t = np.arange(size) * 0.05
    zero = {name: np.zeros(size) for name in ("x1", "y1", "fx1", "fy1", "x2", "y2", "fx2", "fy2")}
    s = Signals(t=t, **zero, **{n: np.zeros(size) for n in ("vx1", "vy1", "vx2", "vy2")},
                **{f"sd_{n}": np.zeros(size) for n in ("x", "y", "vx", "vy")}, sd_force=0.01)  # fmt: skip
    spans = []
    for i, step in enumerate(steps):
        inside = slice(i * PER_SUBTASK, (i + 1) * PER_SUBTASK)
        start, end = t[inside][0] - 0.025, t[inside][-1] + 0.025
        spans.append(
            Span(step.name, step.object, step.state, start, end, 0.0, 0.0, (start, start), (end, end))
        )
        if step.state == FREE:
            continue
        assert step.move is not None
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
    out = estimate_plugin([signals], [segmentation], task)
    for name in task.objects:
        for key, planted in (("weight", WEIGHT), ("width", WIDTH), ("height", HEIGHT)):
            estimate = out.properties[name][key]
            assert isinstance(estimate, Estimate), out.reasons
            assert estimate.mean == pytest.approx(planted[name], rel=1e-9)
        bound = out.properties[name]["friction"]
        assert isinstance(bound, FrictionBound) and bound.lower_bound == pytest.approx(0.3)  # 0.6 / 2
    assert out.reasons == {}


def test_trim_leaves_out_five_percent_at_either_end():
    signals, segmentation = make(STACK, RESTS["stack"])
    carry = slice(2 * PER_SUBTASK, 3 * PER_SUBTASK)
    third = signals.fy1.copy()
    third[carry.start + 2] += 3.6  # the first sample behind the trimmed two of forty
    out = estimate_plugin([replace(signals, fy1=third)], [segmentation], STACK)
    assert out.properties["block1"]["weight"].mean == pytest.approx(0.343 + 3.6 / 36)


def test_standard_deviation_is_the_samples_and_trials_pool_by_mean():
    made = [make(STACK, RESTS["stack"], seed) for seed in range(8)]
    signals, segmentations = [list(column) for column in zip(*made, strict=True)]
    each = [estimate_plugin([s], [g], STACK).properties["block1"]["weight"] for s, g in made]
    pooled = estimate_plugin(signals, segmentations, STACK).properties["block1"]["weight"]
    assert pooled.mean == pytest.approx(np.mean([e.mean for e in each]))
    assert pooled.sd == pytest.approx(0.01 * math.sqrt(2), rel=0.15)
    assert pooled.standard_error == pytest.approx(0.01 * math.sqrt(2 / (36 * 8)), rel=0.15)
    document = pooled.to_json()
    assert document["interval_95"][1] - pooled.mean == pytest.approx(1.959964 * pooled.standard_error)
    assert pooled.mean - document["interval_68"][0] == pytest.approx(0.994458 * pooled.standard_error)


def test_dropouts_and_missing_samples_are_left_out():
    signals, segmentation = make(STACK, RESTS["stack"])
    state = np.where(np.abs(signals.fx1) > 1, np.where(signals.fy > 0, 2, 3), 1)
    wild, gap = 2 * PER_SUBTASK + 10, 2 * PER_SUBTASK + 11
    fy1 = signals.fy1.copy()
    fy1[wild], fy1[gap] = 50.0, np.nan
    state[[wild, gap]] = 0
    labels = StateLabels(state, np.zeros(state.size, dtype=bool))
    out = estimate_plugin([replace(signals, fy1=fy1)], [segmentation], STACK, [labels])
    assert out.properties["block1"]["weight"].mean == pytest.approx(0.343)
    assert out.properties["block1"]["friction"].lower_bound == pytest.approx(0.3)


def test_what_the_task_or_the_recording_withholds_is_none_with_a_reason():
    pick = BlockTask({"block": "ground"}, (Move("block", "ground"),))
    steps = subtasks(pick)
    stack, segmentation = make(STACK, RESTS["stack"])
    names = {"block1": "block", "block2": "block"}
    spans = tuple(replace(s, object=names[str(s.object)]) for s in segmentation.spans[: len(steps)])
    out = estimate_plugin([stack], [replace(segmentation, spans=spans)], pick)
    assert out.properties["block"]["height"] is None
    assert "height" in out.reasons["block.height"]
    assert out.properties["block"]["weight"] is not None

    half = replace(segmentation, spans=segmentation.spans[:5])  # the second move is missing
    out = estimate_plugin([stack], [half], STACK)
    assert out.properties["block1"]["height"] is None and out.properties["block2"]["weight"] is None
    assert out.properties["block2"]["height"].mean == pytest.approx(HEIGHT["block2"])
    assert set(out.reasons) == {f"block2.{p}" for p in ("weight", "width", "friction")} | {"block1.height"}
    json.dumps(out.to_json(), allow_nan=False)

    slide = BlockTask({"block": "ground"}, (Move("block", "ground", slide=True),))
    assert "block" in estimate_plugin([stack], [replace(half, spans=())], slide).reasons["block.weight"]


def test_heights_that_only_sums_reveal_are_not_guessed():
    reversal = BlockTask(TOWER.initial, (Move("a", "ground"), Move("b", "a"), Move("c", "b")))
    h = HEIGHT
    signals, segmentation = make(reversal, ((h["b"] + h["c"], 0.0), (h["c"], h["a"]), (0.0, h["a"] + h["b"])))
    out = estimate_plugin([signals], [segmentation], reversal)
    assert [out.properties[name]["height"] for name in "abc"] == [None] * 3
    assert "together with the height of c" in out.reasons["b.height"]
