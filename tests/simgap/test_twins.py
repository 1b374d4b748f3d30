"""Statistics of healthy twins are kept for the code that made them."""

import re

import numpy as np
from demo_recordings import RIG, TASK, TRIALS

from hmmseg.io.rig import Noise
from hmmseg.segmentation.align import align
from simgap.gap import twins
from simgap.gap.search import search


def test_other_code_has_a_cache_of_its_own(monkeypatch):
    known = twins.source_digest()
    mine = twins._file(TRIALS, TASK, RIG, None, 0)
    assert re.fullmatch("[0-9a-f]{64}", known)
    assert mine == twins._file(TRIALS, TASK, RIG, None, 0) != twins._file(TRIALS, TASK, RIG, None, 1)
    monkeypatch.setattr(twins, "source_digest", lambda: known[::-1])
    assert twins._file(TRIALS, TASK, RIG, None, 0) != mine


def test_without_stated_noise_there_are_twins_too():
    rig = RIG.model_copy(update={"noise": Noise()})
    found = search(align(TRIALS[:1], TASK, rig))
    twin = twins._recorded(found, range(1), 0)
    assert len(twin) == 1 and len(twin[0]) == 1
    assert np.isfinite(twin[0][0].channels["fx1"]).all()
