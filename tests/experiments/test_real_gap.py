"""The paper's own gap: the published result holds what it says."""

import json

import numpy as np
import pytest

from experiments.paper.paper_gap import rigid
from experiments.paper.sources import recorded
from paper_figs.results import RESULTS


def test_rigid_fingertips_are_those_of_the_paper():
    rig = recorded().rig
    assert np.isinf(rigid(rig).fingertip.normal_stiffness)
    assert rigid(rig).fingertip.shear_stiffness == rig.fingertip.shear_stiffness


def test_the_published_worked_case_blames_the_pads_and_no_slip():
    saved = json.loads((RESULTS / "gap.json").read_text())
    for name in ("rigid", "rigid_with_actual"):
        entry = saved[name]
        assert (entry["verdict"], entry["causes"]) == ("named", ["fingertip_compliance"])
        assert entry["slip_probability"] < 0.01
        for block in ("block1", "block2"):
            width = entry["properties"][f"{block}.width"]
            assert width["before_error"] == pytest.approx(-1.3e-3, abs=0.2e-3)
            assert abs(width["after_error"]) < 5e-5
    assert saved["nominal"]["verdict"] == "none"


@pytest.mark.slow
def test_rigid_fingertips_are_diagnosed_again():
    from hmmseg.segmentation.align import align
    from simgap.gap.diagnose import diagnose

    case = recorded()
    found = diagnose(align(list(case.trials[:2]), case.task, rigid(case.rig)))
    assert found.body["causes"] == ["fingertip_compliance"]
