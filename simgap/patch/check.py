"""Whether a corrected model reproduces recordings better than the nominal one does."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from hmmseg.io.rig import Rig, read_rig
from hmmseg.io.task import BlockTask
from hmmseg.io.trial import Trial
from hmmseg.segmentation.align import segment
from simgap.patch.model import replayed
from simgap.world.properties import read_properties


def reproduced(
    written: Mapping[str, str], body: Mapping[str, Any], trials: Sequence[Trial], task: BlockTask, rig: Rig
) -> tuple[float, float]:
    """Root mean square [N] of recorded minus predicted forces, by the nominal and by the corrected model.

    Both are driven by the trials' motions; `written` are the files of `simgap.patch.files` for the diagnosis
    `body`, `rig` the nominal one. Trials that do not fit their task are left out; nan where none is left.
    """
    with tempfile.TemporaryDirectory(prefix="hmmseg-") as place:
        for name, text in written.items():
            (Path(place) / name).write_text(text, encoding="utf-8")
        patched = read_rig(Path(place) / "rig.toml")
        after = read_properties(Path(place) / "actual.toml", task)
    shift = body["effects"]["+".join(body["causes"])]["property_shift"]
    before = {n: replace(b, **_before(n, shift)) for n, b in after.items()}
    squares: list[tuple[float, float]] = []
    for trial, spans in zip(trials, segment(trials, task, rig), strict=True):
        if spans.failed is None:
            ends = [s.start for s in spans.spans[1:]]
            both = (replayed(trial, task, *model, ends) for model in ((rig, before), (patched, after)))
            nominal, corrected = (float(np.nanmean(r.residual**2)) for r in both)
            squares.append((nominal, corrected))
    if not squares:
        return float("nan"), float("nan")
    nominal, corrected = np.sqrt(np.mean(squares, axis=0))
    return float(nominal), float(corrected)


def _before(name: str, shift: Mapping[str, Any]) -> dict[str, float]:
    """A block's properties as they were without the causes."""
    return {k.partition(".")[2]: v["before"] for k, v in shift.items() if k.startswith(f"{name}.")}
