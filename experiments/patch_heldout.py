"""Does a patched model reproduce recordings that took no part in it? Half of each set's trials judge.

    python -m experiments.patch_heldout RECORDINGS [--only NAME...]

For every folder of labelled recordings: `hmmseg diagnose --patch` on the first half of the trials, then the
virtual model is driven by the motions of the other half, nominal and patched, and the forces it predicts
are compared with those recorded.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from experiments.saving import save
from experiments.table_text import RESULTS, load, markdown
from hmmseg.hand.read import read_trial
from hmmseg.io.rig import Rig, read_rig
from hmmseg.io.task import BlockTask, read_task
from hmmseg.io.trial import Trial
from hmmseg.segmentation.align import align, segment
from simgap.gap.diagnose import diagnose
from simgap.patch import files, replayed
from simgap.world.properties import read_properties


def measured(folder: Path) -> dict[str, Any]:
    """Root mean square of the force residual [N] of held-out trials, nominal and patched."""
    rig, task = read_rig(folder / "rig.toml"), read_task(folder / "task.toml")
    assert isinstance(task, BlockTask)
    trials = [read_trial(f, rig) for f in sorted(folder.glob("trial_*.csv"))]
    half = (len(trials) + 1) // 2
    body = diagnose(align(trials[:half], task, rig)).body
    row: dict[str, Any] = {"recording": folder.name, "verdict": body["verdict"], "causes": body["causes"]}
    written = files((folder / "rig.toml").read_text(encoding="utf-8"), body)
    if not written:
        return row
    nominal, patched = reproduced(written, body, trials[half:], task, rig)
    return row | {"nominal": nominal, "patched": patched}


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


def table() -> str | None:
    """docs/gap_results.md: the held-out residuals."""
    found = load("patch_heldout")
    if found is None:
        return None
    head = ["recording", "causes named on the first half", "nominal model [N]", "patched model [N]"]
    rows = []
    for row in found["rows"]:
        ends = [f"{row[k]:.3f}" if k in row else "" for k in ("nominal", "patched")]
        rows.append([row["recording"], " + ".join(row["causes"]) or row["verdict"], *ends])
    return markdown(head, rows)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("recordings", type=Path)
    parser.add_argument("--only", nargs="+", help="these folders alone")
    given, rows = parser.parse_args(), []
    for task in sorted(given.recordings.glob("*/task.toml")):
        if given.only and task.parent.name not in given.only:
            continue
        rows.append(measured(task.parent))
        print(json.dumps(rows[-1]), flush=True)
    save(RESULTS / "patch_heldout.json", {"rows": rows})


if __name__ == "__main__":
    main()
