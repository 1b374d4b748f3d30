"""Contact that is not tidy, made by two simulators: does it move a boundary, or start a false misfit?

    python -m experiments.untidy_contacts

The project's own simulator (experiments/untidy.py) and the blind check's in MuJoCo
(experiments/blind_check/untidy.py), each row's trials segmented one by one; every boundary should lie
within a sample of where it truly is. Writes experiments/results/untidy_contacts.json, which
docs/calibration.md shows.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from experiments.blind_check.untidy_trials import write_untidy
from experiments.boundary_worlds import World, trials_of
from experiments.saving import save
from experiments.scoring import boundaries_covered, boundary_residuals
from experiments.sweeps.cells import Cell
from experiments.sweeps.trials import scene
from hmmseg.hand.signals import task_space
from hmmseg.io.rig import Rig, read_rig
from hmmseg.io.task import BlockTask, read_task
from hmmseg.io.trial import Trial, read_trial
from hmmseg.segmentation.align import segment
from hmmseg.segmentation.spans import Segmentation

RESULTS = Path(__file__).parent / "results" / "untidy_contacts.json"
FIRST, SEED, RATES = 119_000, 119_001, (20.0, 100.0)  # seeds that nothing was chosen on
SLID = 0.015  # m down in the grip: the least height of a block, beyond which the fingers have left it
TRIALS = {"own": 32, "mujoco": 12}
KINDS = {  # what is untidy: its names in both simulators
    "nothing (tidy)": (None, ("tidy",)),
    "blocks turn when gripped off centre": ("turned", ("turning",)),
    "blocks set down on a slope": (None, ("slope",)),
    "one finger up to 0.1 s late": ("late finger", ("apart_60", "apart_100")),
    "a grip slips and holds again": ("slipping", ("slip",)),
    "taps before the grip": ("tapping", ("tap",)),
    "a push on the ground": ("pushed", ("push",)),
    "ten seconds held still": ("still", ("still",)),
    "hesitation": ("hesitating", ("hesitate",)),
    "a finger on the table first": (None, ("table",)),
}
Pairs = list[tuple[Segmentation, np.ndarray]]


def summary(pairs: Pairs, rate: float) -> dict:
    """Trials, misfits, and of those that fit: errors [ms], boundaries off by more than a sample, coverage."""
    fitting = [(s, truth) for s, truth in pairs if s.complete]
    out: dict = {"trials": len(pairs), "misfits": [str(s.failed) for s, _ in pairs if not s.complete]}
    if fitting:
        off = np.abs(np.concatenate([boundary_residuals(s, truth.tolist()) for s, truth in fitting]))
        held = np.concatenate([boundaries_covered(s, truth.tolist()) for s, truth in fitting])
        out |= {
            "boundaries": int(off.size), "median": 1e3 * float(np.median(off)),
            "percentile_95": 1e3 * float(np.percentile(off, 95)), "farthest": 1e3 * float(off.max()),
            "beyond_a_sample": int((off > 1 / rate).sum()), "coverage_90": float(held.mean()),
        }  # fmt: skip
    return out


def own(name: str | None, rate: float, num: int) -> Pairs:
    """Trials of the project's own simulator."""
    world, (_, task) = World(str(name), Cell(rate=rate), untidy=name), scene()
    judged = trials_of(world, range(FIRST, FIRST + num))
    return [(segment([j.trial], task, j.rig)[0], j.boundaries) for j in judged]


def recorded(folder: Path) -> Pairs:
    """Trials that lie in a folder with their answers."""
    rig, task = read_rig(folder / "rig.toml"), read_task(folder / "task.toml")
    assert isinstance(task, BlockTask)
    truth = json.loads((folder / "truth.json").read_text(encoding="utf-8"))["boundaries"]
    trials = [read_trial(folder / f"trial_{k + 1:02d}.csv", rig) for k in range(len(truth))]
    told = [(t, np.array(b)) for t, b in zip(trials, truth, strict=True)]
    return [(segment([t], task, rig)[0], b) for t, b in told if not _fell(t, b, rig)]


def _fell(trial: Trial, boundaries: np.ndarray, rig: Rig) -> bool:
    """Whether a block slid to its support with the hand still far above: that is a drop, and a misfit."""
    signals = task_space(trial, rig)
    placed = [(signals.t >= land) & (signals.t < let_go) for land, let_go in boundaries.reshape(-1, 4)[:, 2:]]
    return any(np.ptp(signals.y[span]) > SLID for span in placed if span.any())


def rows(made: Path, num: int) -> Iterator[tuple[str, str, float, dict]]:
    """Kind, simulator, rate and summary of every row; `made`: folders of the other simulator."""
    for kind, (ours, others) in KINDS.items():
        for rate in RATES:
            if ours is not None or others == ("tidy",):
                yield kind, "own", rate, summary(own(ours, rate, num), rate)
            pairs = [pair for name in others for pair in recorded(made / f"{name}_{rate:g}hz")]
            yield kind, "mujoco", rate, summary(pairs, rate)


def main(arguments: Sequence[str] | None = None) -> None:
    """Command line of this experiment."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--output", type=Path, default=RESULTS)
    options = parser.parse_args(arguments)
    document: dict = {"first": FIRST, "seed": SEED, "rows": []}
    with tempfile.TemporaryDirectory() as folder:
        write_untidy(Path(folder), TRIALS["mujoco"], SEED, RATES)
        for kind, simulator, rate, found in rows(Path(folder), TRIALS["own"]):
            document["rows"].append({"kind": kind, "simulator": simulator, "rate": rate} | found)
            print(kind, simulator, f"{rate:g} Hz", found, flush=True)
    save(options.output, document)


if __name__ == "__main__":
    main()
