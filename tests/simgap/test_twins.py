"""Statistics of healthy twins are kept for the code that made them."""

from __future__ import annotations

import re

from demo_recordings import RIG, TASK, TRIALS

from simgap.gap import twins


def test_other_code_has_a_cache_of_its_own(monkeypatch):
    known = twins.source_digest()
    mine = twins._file(TRIALS, TASK, RIG, None, 0)
    assert re.fullmatch("[0-9a-f]{64}", known)
    assert mine == twins._file(TRIALS, TASK, RIG, None, 0) != twins._file(TRIALS, TASK, RIG, None, 1)
    monkeypatch.setattr(twins, "source_digest", lambda: known[::-1])
    assert twins._file(TRIALS, TASK, RIG, None, 0) != mine
