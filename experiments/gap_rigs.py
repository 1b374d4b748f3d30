"""False alarms of the diagnosis on rigs and tasks that its bank was not learned on.

    python -m experiments.gap_rigs RECORDINGS/CASE [--cases N] [--only RIG]...

CASE gives the nominal rig.toml and task.toml; its recordings are not read. Healthy recordings of every
other rig are simulated and judged by the nominal bank as it is, by the bank moved by the linearised
bootstrap, and by a bank learned on that rig. Writes experiments/results/gap_rigs.json: all p values, and
their shares below each level.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import jax
import numpy as np

from experiments.table_text import RESULTS
from hmmseg.io.rig import Rig, read_rig
from hmmseg.io.task import GROUND, BlockTask, Move, read_task
from hmmseg.io.trial import Trial
from simgap.gap.adapt import adapted
from simgap.gap.bank import Bank, load_bank
from simgap.gap.calibrate import healthy_cases, learned
from simgap.gap.search import search
from simgap.world.operator import OperatorSettings

TRIALS = 4
FIRST = 500  # no bank is learned on cases from this one on
LEVELS = (0.05, 0.01)
ONE_MOVE = BlockTask({"a": GROUND}, (Move("a", GROUND),))
ONE_SLIDE = BlockTask({"a": GROUND}, (Move("a", GROUND, slide=True),))


def others(task: BlockTask, rig: Rig) -> dict[str, tuple[BlockTask, Rig, OperatorSettings | None]]:
    """Tasks, rigs and operators that differ from the nominal ones, by what is different."""
    noise = {k: 4 * v for k, v in rig.noise.model_dump().items() if v is not None}
    loud = rig.model_copy(update={"noise": rig.noise.model_copy(update=noise)})
    share = 1500.0 / rig.fingertip.normal_stiffness
    give = {k: share * v for k, v in rig.fingertip.model_dump().items()}
    soft = rig.model_copy(update={"fingertip": rig.fingertip.model_copy(update=give)})
    return {
        "four times the noise": (task, loud, None),
        "100 Hz": (task, rig.model_copy(update={"rate": 100.0}), None),
        "pads of 1500 N/m": (task, soft, None),
        "one move": (ONE_MOVE, rig, None),
        "one slide": (ONE_SLIDE, rig, None),
        "twice the pace": (task, rig, OperatorSettings(pace=(1.8, 2.0))),
    }


def p_values(
    trials: Sequence[Trial], task: BlockTask, rig: Rig, nominal: Bank, own: Bank
) -> dict[str, float]:
    """The p value of one case by each bank."""
    tell = lambda text: None  # noqa: E731
    found = search(trials, task, rig, nominal, None, (), (), tell)
    here = adapted(nominal, found.problem, found.healthy, trials)
    again = search(trials, task, rig, own, None, (), (), tell)
    return {
        "nominal": nominal.detection.p_value(found.statistics),
        "bootstrap": here.detection.p_value(found.statistics),
        "calibrated": own.detection.p_value(again.statistics),
    }


def rig_row(
    name: str, task: BlockTask, rig: Rig, operator: OperatorSettings | None, number: int
) -> dict[str, Any]:
    """Everything found on one rig; a bank of its own is learned on the usual operator's work."""
    tell = partial(print, f"{name}:", flush=True)
    own = learned(task, rig, TRIALS, load_bank().calibration, tell)
    rows = []
    for trials in healthy_cases(task, rig, TRIALS, number, tell, FIRST, operator):
        rows.append(p_values(trials, task, rig, load_bank(), own))
        tell(" ".join(f"{bank} {p:.2g}" for bank, p in rows[-1].items()))
    found = {bank: np.array([row[bank] for row in rows]) for bank in rows[0]}
    return {"cases": number} | {
        bank: {"p": p.tolist(), "below": [float(np.mean(p < level)) for level in LEVELS]}
        for bank, p in found.items()
    }


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line of this experiment."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("case", type=Path)
    parser.add_argument("--cases", type=int, default=16)
    parser.add_argument("--only", action="append", default=[], metavar="RIG")
    given = parser.parse_args(arguments)
    task = read_task(given.case / "task.toml")
    if not isinstance(task, BlockTask):
        raise SystemExit("a task of blocks is needed")
    if load_bank().reference is None:
        raise SystemExit("simgap/gap/bank.json has no reference: run experiments.gap_bank first")
    file = RESULTS / "gap_rigs.json"
    done = json.loads(file.read_text(encoding="utf-8"))["rigs"] if given.only and file.exists() else {}
    for name, (moves, rig, operator) in others(task, read_rig(given.case / "rig.toml")).items():
        if not given.only or name in given.only:
            done[name] = rig_row(name, moves, rig, operator, given.cases)
            jax.clear_caches()  # of no use to the next one, and memory for programs is not without end
            table = {"levels": LEVELS, "rigs": done}
            file.write_text(json.dumps(table, indent=1) + "\n", encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
