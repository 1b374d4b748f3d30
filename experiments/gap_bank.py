"""The bank that the diagnosis is calibrated on: healthy recordings of our own simulator.

    python -m experiments.gap_bank RECORDINGS/CASE [--folder results/gap_bank]

CASE gives the nominal rig.toml and task.toml; its recordings are not read. Writes
simgap/gap/bank.json: noise model, detection thresholds, calibration, and the reference from which the
thresholds are moved to other rigs.
"""

from __future__ import annotations

import argparse
import pickle
import sys
from collections.abc import Sequence
from pathlib import Path

from hmmseg.io.rig import read_rig
from hmmseg.io.task import BlockTask, read_task
from simgap.gap import bank as store
from simgap.gap.adapt import rate_of
from simgap.gap.calibrate import (
    CATALOGUED,
    HEALTHY,
    detection,
    fitted,
    frames,
    healthy_cases,
    noise_model,
    reference,
)
from simgap.gap.judge import Calibration

TRIALS = 4


def main(args: Sequence[str] | None = None) -> int:
    """Simulate, learn, write the bank."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("case", type=Path)
    parser.add_argument("--folder", type=Path, default=Path("results/gap_bank"))
    parser.add_argument("--healthy", type=int, default=HEALTHY)
    parser.add_argument("--catalogued", type=int, default=CATALOGUED)
    given = parser.parse_args(args)
    rig, task = read_rig(given.case / "rig.toml"), read_task(given.case / "task.toml")
    if not isinstance(task, BlockTask):
        raise SystemExit("a task of blocks is needed")
    given.folder.mkdir(parents=True, exist_ok=True)
    file = given.folder / f"healthy_{given.healthy}.pkl"
    if not file.exists():
        file.write_bytes(pickle.dumps(healthy_cases(task, rig, TRIALS, given.healthy, print)))
    cases = pickle.loads(file.read_bytes())
    noise, clean = noise_model(frames(cases, task, rig, print))
    fits = [fitted(frame, noise) for frame in clean]
    found, floor = detection(fits, given.catalogued, print)
    known = reference(fits, rate_of(cases[0]))
    bank = store.Bank(noise, found, Calibration(floor=round(floor, 4)), known)
    store.FILE.write_text(bank.to_json(), encoding="utf-8")
    print(f"{len(clean)} healthy cases; {found}; bootstrap {known.bootstrap}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
