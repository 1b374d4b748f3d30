"""Scores against hand-made truths, and the reading of a case."""

import json
import math
from pathlib import Path

import numpy as np
import pytest

from experiments.recordings import list_cases, read_case
from experiments.score_recordings import METHODS, score_case, summarise
from experiments.scoring import (
    boundaries_covered,
    boundary_residuals,
    property_scores,
    state_accuracy,
    summarise_boundaries,
    summarise_properties,
)
from hmmseg.contact.decompose import subtasks
from hmmseg.errors import InputError
from hmmseg.io.task import BlockTask, Move
from hmmseg.segmentation.spans import Segmentation, Span

STEPS = subtasks(BlockTask({"block": "ground"}, (Move("block", "ground"),)))
TRUTH = (1.0, 2.0, 3.0, 4.0)


def make(starts, number=5) -> Segmentation:
    edges = [0.0, *starts, 5.0]
    spans = [Span(s.name, s.object, s.state, a, b, 0.1, 0.1, (a - 0.1, a + 0.1), (b - 0.1, b + 0.1))
             for s, a, b in zip(STEPS, edges, edges[1:], strict=False)]  # fmt: skip
    return Segmentation("made.csv", 20.0, None, tuple(spans[:number]))


def test_boundaries_against_truth():
    segmentation = make([1.05, 1.8, 3.0, 4.2])
    np.testing.assert_allclose(boundary_residuals(segmentation, TRUTH), [0.05, -0.2, 0.0, 0.2], atol=1e-12)
    np.testing.assert_array_equal(boundaries_covered(segmentation, TRUTH), [1, 0, 1, 0])
    missing = make([1.0, 2.0], 3)
    assert np.isnan(boundary_residuals(missing, TRUTH)).all()
    assert np.isnan(boundaries_covered(missing, TRUTH)).all()


def test_summary_of_boundaries_leaves_out_what_is_missing():
    summary = summarise_boundaries(np.array([-0.1, 0.3, math.nan]), np.array([1.0, 0.0, math.nan]))
    assert summary == pytest.approx({"median": 0.2, "percentile_95": 0.29, "coverage_90": 0.5})
    assert summarise_boundaries(np.array([math.nan]), np.array([math.nan]))["median"] is None


def test_state_accuracy_counts_samples():
    t = np.arange(0, 5, 0.1)
    assert state_accuracy(make(TRUTH), TRUTH, t, STEPS) == 1.0
    assert state_accuracy(make([1.0, 2.0, 3.0, 4.5]), TRUTH, t, STEPS) == pytest.approx(0.9)
    assert state_accuracy(Segmentation("made.csv", 20.0, None, ()), TRUTH, t, STEPS) == 0.0


def test_properties_against_truth():
    estimate = {"mean": 1.1, "interval_68": [1.05, 1.15], "interval_95": [0.95, 1.25]}
    blocks = {"block": {"weight": (1.0, 0.0), "width": (2.0, 0.0), "friction": (1.2, 0.0)}}
    scores = property_scores({"block": {"weight": estimate, "width": None}}, blocks)
    assert [s["property"] for s in scores] == ["weight", "width"]
    assert scores[0]["residual"] == pytest.approx(0.1)
    assert (scores[0]["in_68"], scores[0]["in_95"]) == (False, True)
    summary = summarise_properties(scores)
    assert summary["weight"] == pytest.approx({"count": 1, "null": 0, "rms": 0.1, "coverage_68": 0.0,
                                               "coverage_95": 1.0})  # fmt: skip
    assert summary["width"] == {"count": 0, "null": 1} and summary["height"] == {"count": 0, "null": 0}


def test_a_folder_without_cases_is_refused(tmp_path):
    with pytest.raises(InputError, match="holds no case"):
        list_cases(tmp_path)


def test_the_rules_on_the_paper_s_blocks():
    folder = Path(__file__).resolve().parents[2] / "recordings/paper_blocks"
    assert list_cases(folder) == [folder]
    case = read_case(folder)
    assert case.healthy and case.blocks["block1"]["weight"] == (0.343, 0.0005)
    scores = {name: score_case(case, METHODS[name], 4, 0) for name in ("qualitative", "first-change")}
    assert len(scores["qualitative"]["properties"]) == 2 * 2 * 3  # two groups, two blocks
    json.dumps(scores["qualitative"], allow_nan=False)
    ordered, plain = (summarise([scores[name]])["boundaries"] for name in scores)
    assert ordered["median"] < 0.025 and ordered["percentile_95"] < plain["percentile_95"]
