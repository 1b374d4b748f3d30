"""Identification and diagnosis stand on one alignment and one set of contact equations: they must agree."""

import numpy as np
import pytest
from demo_recordings import recorded

from estimation.identification import identify_aligned
from hmmseg.errors import InputError
from hmmseg.segmentation.align import align
from simgap.api import diagnose
from simgap.gap.frame import build
from simgap.gap.problem import fit, neutral, problem
from simgap.world.properties import Block
from simgap.world.simulate import simulate_trials

PROPERTIES = ("weight", "width", "height")
DRAWN = {"block1": Block(0.71, 0.0231, 0.0142), "block2": Block(0.26, 0.0174, 0.0193)}


def as_recorded():
    return align(*recorded("none_1", 2))


def simulated():
    _, task, rig = recorded("none_1", 1)
    made = simulate_trials(task, rig, [DRAWN] * 3, [5, 6, 7], None)
    return align([one.trial for one in made], task, rig)


@pytest.mark.parametrize("source", [as_recorded, simulated])
def test_properties_without_an_effect_are_those_identified(source):
    """Each within one standard deviation of what `identify` says: two summaries of the same samples."""
    aligned = source()
    found = identify_aligned(aligned)
    given = problem(build(aligned))
    healthy = fit(given, (), neutral(given))
    values = given.properties(healthy.u)
    assert len(found.names) == 6
    for obj, prop in found.names:
        draws = found.of(obj, prop)
        mine = values[aligned.task.objects.index(obj), PROPERTIES.index(prop)]
        assert abs(mine - draws.mean()) < draws.std(), (obj, prop)


def test_a_diagnosis_takes_an_identification_with_its_alignment(monkeypatch):
    found = identify_aligned(as_recorded())

    def never(*args):
        raise AssertionError("aligned or identified again")

    with monkeypatch.context() as patched:
        patched.setattr("simgap.gap.search.align", never)
        patched.setattr("simgap.gap.search.identify_aligned", never)
        told = diagnose(found)
    assert told.body["verdict"] == "none"
    np.testing.assert_array_equal([a.quantile(0.5) for a in told.search.aligned.trials[0].boundaries],
                                  [a.quantile(0.5) for a in found.aligned.trials[0].boundaries])  # fmt: skip
    # An effect that is never chosen is taken where asked for, healthy recordings of one's own are the null,
    # and the document has the properties that were identified, and shifts them from there.
    effects = diagnose(found, effects=("object_inertia",), healthy=found.aligned).body["effects"]
    taken = effects["object_inertia"]
    assert abs(taken["parameters"]["scale"]["mean"] - 1) < 0.1
    forced = taken["property_shift"]
    assert set(forced) == {".".join(name) for name in found.centres}
    for name, mean in found.centres.items():
        assert abs(forced[".".join(name)]["before"] - mean) < found.of(*name).std(), name
    # A result like others: it reads like the terminal, and its draws are what its document sums up.
    assert repr(told).startswith(told.words()) and "probabilities" in repr(told)
    assert "<td>none</td>" in told._repr_html_()
    drawn = told.to_arviz().posterior
    (name, entry), *_ = told.body["effects"].items()
    for key, p in entry["parameters"].items():
        assert np.median(drawn[f"{name}.{key}"]) == pytest.approx(p["mean"])
        assert np.percentile(drawn[f"{name}.{key}"], (5, 95)) == pytest.approx(p["interval_90"])


def test_an_effect_that_is_misspelt_is_said():
    with pytest.raises(InputError, match=r"unknown effect.*force_bias"):
        diagnose(as_recorded(), effects=("force_bais",))
