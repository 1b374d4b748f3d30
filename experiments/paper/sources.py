"""What every script here starts from, trials of the paper's blocks, and how results are saved."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from experiments.recordings import Case, read_case
from experiments.saving import commit_of
from hmmseg.hand.signals import task_space
from hmmseg.segmentation.spans import Segmentation
from hmmseg.segmentation.thresholds import segment_qualitative
from paper_figs.results import RESULTS
from simgap.world.properties import PAPER_BLOCKS, UNITS, Block, Blocks
from simgap.world.simulate import simulate_trials

RECORDINGS = Path(__file__).resolve().parents[2] / "recordings"
BLOCKS = ("block1", "block2")
TRIALS = 10  # simulated; as many as were recorded
ONE = 8  # index of trial_09, the recording of the figures: the one whose states never flicker

# Table 4 of the paper: estimate and its standard deviation, N and m.
PRINTED = {
    "block1": {"weight": (0.352, 0.024), "height": (0.0175, 0.0001), "width": (0.0147, 0.0001),
               "friction": 0.49},
    "block2": {"weight": (0.425, 0.071), "height": (0.0129, 0.0002), "width": (0.0236, 0.0001),
               "friction": 1.06},
}  # fmt: skip


@cache
def recorded(name: str = "paper_blocks") -> Case:
    """Recordings of the stand-in rig."""
    return read_case(RECORDINGS / name)


@cache
def simulated(name: str = "paper_blocks") -> Case:
    """The project's own trials: the task, rig and blocks of a recorded case, another operator."""
    case = recorded(name)
    blocks = PAPER_BLOCKS if name == "paper_blocks" else true_blocks(case)
    trials = simulate_trials(case.task, case.rig, [blocks] * TRIALS, list(range(TRIALS)))
    return Case(
        f"simulated {name}", case.rig, case.task, tuple(t.trial for t in trials),
        tuple(task_space(t.trial, case.rig) for t in trials),
        tuple(tuple(map(float, t.boundaries)) for t in trials), case.blocks, ("none",),
    )  # fmt: skip


def true_blocks(case: Case) -> Blocks:
    """Blocks of a scene from a case's true properties."""
    keys = (*UNITS, "friction")
    return {name: Block(**{key: known[key][0] for key in keys if key in known})
            for name, known in case.blocks.items()}  # fmt: skip


def qualitative(case: Case) -> list[Segmentation]:
    """Every trial of a case by the paper's thresholds and rules."""
    return [segment_qualitative(t, s, case.task) for t, s in zip(case.trials, case.signals, strict=True)]


def save(name: str, document: dict[str, Any]) -> None:
    """Write a result with this code's commit; floats to six digits, lists of numbers on one line."""
    RESULTS.mkdir(parents=True, exist_ok=True)
    text = _text({**document, "made_by": commit_of()})
    (RESULTS / f"{name}.json").write_text(text + "\n", encoding="utf-8")


def _text(value: Any, indent: int = 0) -> str:
    if isinstance(value, np.ndarray):
        value = value.tolist()
    if isinstance(value, dict):
        inner = [f"{json.dumps(str(key))}: {_text(entry, indent + 1)}" for key, entry in value.items()]
        return _lines("{", inner, "}", indent)
    if isinstance(value, Sequence) and not isinstance(value, str):
        inner = [_text(entry, indent + 1) for entry in value]
        flat = not any(isinstance(entry, dict | list | tuple | np.ndarray) for entry in value)
        return f"[{', '.join(inner)}]" if flat else _lines("[", inner, "]", indent)
    if isinstance(value, float | np.floating):
        return f"{float(value) + 0.0:.6g}" if math.isfinite(value) else "null"
    return json.dumps(value.item() if isinstance(value, np.generic) else value, ensure_ascii=False)


def _lines(start: str, inner: list[str], end: str, indent: int) -> str:
    pad = "\n" + " " * (indent + 1)
    return f"{start}{pad}{(',' + pad).join(inner)}\n{' ' * indent}{end}" if inner else start + end
